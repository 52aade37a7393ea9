"""The geometric block: vertex positions from fused normals, from the agreement of views (agreement.py) and from masks.

Masks. A segment of the mesh's outline in a view (mvps/silhouette.py) says by how much the surface there is to move along its normal, with a
standard deviation of 1 / sqrt(12) of a pixel for every pixel of its length; its corners take their shares.

Fusion. Positions y minimise

    sum_f A_f |grad y - R_f grad x|^2 / (a sigma_f^2)  +  sum_i rho(|y_i - t_i| / sigma_i)

R_f turns face f's normal to the views' (fused.py); t_i is the position on which views and masks agree, sigma_f the error of f's normal in
radians, a the mean area of a vertex (normals are independent from vertex to vertex). Its minimum is one sparse solve
(cotangent weights: Yu et al. 2004; normals and positions together: Nehab et al. 2005): normals decide detail shorter than
2 pi sigma / sigma_f, positions what is longer.
"""

from __future__ import annotations

from typing import NamedTuple

import igl
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mvps.camera import inside_image
from mvps.cores import on_cores
from mvps.joint.agreement import Agreement
from mvps.mesh import corners, cross, face_areas, face_normals, vertex_normals
from mvps.scene import Capture, Float, Surface
from mvps.silhouette import outline, sampled
from mvps.visibility import ray_caster
from solvers.linear import CholeskyLike

SWEEPS = 2
"""Reweightings of the agreed positions in a fusion. Five views, three fusions in the last round: 2 of them 0.148 px, 3 0.145, 5 0.143."""

FAR_OFF = 3.0
"""Standard deviations from which an agreed position counts as an outlier (Cauchy's scale)."""


MASK_SIGMA_PIXELS = 1 / np.sqrt(12)
"""Standard deviation of a mask's boundary: anywhere in its pixel."""

SHARED = 16
"""Agreed positions that share an error: half of it is common over 3 to 8 pixels, that of a mask over one, so a pixel of a mask counts as
often."""

ALONG = 0.5
"""Least slope of the distance to a mask along an outline's normal, 1 where they are parallel; below it another part is nearer."""

SLIVER = 1e-6
"""Of the mean face's area, below which a face takes no part: the cotangents of its angles are as large as all others' together, or no
numbers. Remeshing leaves one in some hundred thousand."""


class Moved(NamedTuple):
    """A surface, and where views and masks agreed that its vertices lie before normals had their say: place (V, 3), sigma (V,) standard
    deviation, infinite where they do not say; world units."""

    surface: Surface
    place: Float
    sigma: Float


def with_masks(agreed: Agreement, capture: Capture, surface: Surface, distance: list[NDArray[np.float32]], floor: float) -> Agreement:
    """The agreement of views (floor: its smallest standard deviation) together with what the masks say of the outlines.

    distance: per view the signed distance to its mask (height, width), pixels.
    """
    caster = ray_caster(surface)
    count = len(surface.vertices)

    def of_view(i: int) -> tuple[Float, Float]:
        camera = capture.views[i].camera
        line = outline(caster, camera)
        across = [line.image + step * line.outward for step in (0, 1, -1)]
        here, beyond, before = (sampled(distance[i], at) for at in across)
        slope = (beyond - before) / 2
        # Of outlines beyond the frame a mask says nothing.
        on = [inside_image(camera, at) for at in across]
        told = (slope > ALONG) & on[0] & on[1] & on[2]
        weight = told * line.length * SHARED * (line.rate / MASK_SIGMA_PIXELS) ** 2
        wanted = -here / np.where(told, slope, 1) / np.where(line.rate > 0, line.rate, 1)
        corners, shares = surface.faces[line.face].ravel(), weight[:, None] * line.barycentric
        weights, pulls = (np.bincount(corners, values.ravel(), count) for values in (shares, shares * wanted[:, None]))
        return weights.astype(np.float64), pulls.astype(np.float64)

    weight, pull = (sum(parts) for parts in zip(*on_cores(of_view, range(len(capture.views))), strict=True))
    own = agreed.weight(floor)
    return Agreement.of_weights(own + weight, own * agreed.offset + pull)


def turned(source: Float, target: Float, vectors: Float) -> Float:
    """Vectors (n, 3) turned by the smallest rotations that turn unit vectors source (n, 3) to target (n, 3) (Rodrigues)."""
    axis = cross(source, target)
    cosine = np.clip(np.einsum("ni,ni->n", source, target), -0.99, 1)
    aside = cross(axis, vectors)
    result: Float = vectors + aside + cross(axis, aside) / (1 + cosine)[:, None]
    return result


def _laplacian(surface: Surface, weight: Float) -> sp.csr_matrix:
    """(V, V) cotangent Laplacian, positive, with weights (F,) on the faces."""
    first, second = (surface.faces[:, order].ravel() for order in ([1, 2, 0], [2, 0, 1]))
    half = igl.cotmatrix_entries(surface.vertices, surface.faces) * weight[:, None]
    aside = sp.coo_matrix((half.ravel(), (first, second)), (len(surface.vertices),) * 2).tocsr()
    both = aside + aside.T
    return sp.csr_matrix(sp.diags(np.asarray(both.sum(1)).ravel()) - both)


def _turned_divergence(surface: Surface, target: Float, weight: Float) -> Float:
    """(V, 3) divergence of weight (F,) R_f grad x: a corner of face f takes R_f (n x opposite side) / 2, its hat function's gradient times
    the area."""
    normal, ends = face_normals(surface), corners(surface)
    first, second = (turned(normal, target, cross(normal, ends[k - 1] - ends[k - 2]) / 2) * weight[:, None] for k in (0, 1))
    divergence = np.zeros_like(surface.vertices)
    # The three sides of a face add up to nothing.
    for k, share in enumerate((first, second, -first - second)):
        for axis in range(3):
            divergence[:, axis] += np.bincount(surface.faces[:, k], share[:, axis], len(divergence))
    return divergence


def fuse(
    surface: Surface, target: Float, agreed: Agreement, normal_sigma: float | Float, factor: CholeskyLike | None = None
) -> tuple[Surface, CholeskyLike]:
    """The surface moved so that its faces follow `target` (F, 3), unit, and its vertices the agreed positions; same faces.

    normal_sigma: of the faces (F,), or one for all, radians. The factor of the system may serve another fusion of a surface that has hardly
    moved.
    """
    x = surface.vertices
    area = face_areas(surface)
    scale = np.broadcast_to(len(x) / (normal_sigma**2 * area.sum()), area.shape)
    # Solved together, one that is no number would take all others with it.
    target = np.where(np.isfinite(target).all(1, keepdims=True), target, face_normals(surface))
    even, whole = surface, area > SLIVER * area.mean()
    if not whole.all():
        even, target, scale = Surface(x, surface.faces[whole]), target[whole], scale[whole]
    L = _laplacian(even, scale)
    known = np.isfinite(agreed.offset) & np.isfinite(agreed.sigma)
    offset, sigma = np.where(known, agreed.offset, 0), np.where(known, agreed.sigma, np.inf)
    right = _turned_divergence(even, target, scale)
    outward = vertex_normals(surface)
    agreed_at, weight = x + offset[:, None] * outward, 1 / sigma**2
    # Vertices that no views agree on hold still softly: without them a patch seen by nobody would have no place.
    rest = 1e-4 * float(np.median(weight[weight > 0])) if (weight > 0).any() else 1.0
    y = x
    robust = np.ones(len(x))
    # Reweighting changes the diagonal alone: the first factor stays a good preconditioner.
    factor = factor or CholeskyLike(L + sp.diags(weight + rest))
    for _ in range(SWEEPS):
        held = weight * robust
        y = factor.nearby(L + sp.diags(held + rest), right + held[:, None] * agreed_at + rest * x, y)
        away = np.abs(((y - agreed_at) * outward).sum(1))
        robust = 1 / (1 + (away / (FAR_OFF * sigma)) ** 2)
    return Surface(y, surface.faces), factor
