"""The geometric block: vertex positions from fused normals and from the agreement of views.

Agreement. A vertex x slides along its normal, x + d n, and every view that sees it reports the albedo-scaled normal b of its photometric
stereo there. Their weighted variance over the views,  c(d) = sum w |b - mean b|^2 / sum w,  is least where x lies on the surface. The
lowest sample and its two neighbours give a parabola, whose foot is the agreed offset and whose curvature its standard deviation:

    sigma^2 = 2 c_min / (3 n c'')        n views and 3 channels (least squares)

Masks. A segment of the mesh's outline in a view (mvps/silhouette.py) says by how much the surface there is to move along its normal, with a
standard deviation of 1 / sqrt(12) of a pixel for every pixel of its length; its corners take their shares.

Fusion. Positions y minimise

    sum_f A_f |grad y - R_f grad x|^2 / (a sigma_n^2)  +  sum_i rho(|y_i - t_i| / sigma_i)

R_f turns face f's normal to the views' (fused.py); t_i is the position on which views and masks agree, sigma_n the error of normals in
radians, a the mean area of a vertex (normals are independent from vertex to vertex). Its minimum is one sparse solve
(cotangent weights: Yu et al. 2004; normals and positions together: Nehab et al. 2005): normals decide detail shorter than
2 pi sigma / sigma_n, positions what is longer.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import igl
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mvps.camera import view_directions
from mvps.cores import on_cores
from mvps.joint.blocks import WORKERS
from mvps.mesh import cross, face_areas, face_normals, vertex_normals
from mvps.scene import Camera, Capture, Float, Int, NormalMap, Surface, View
from mvps.silhouette import REMAP_LIMIT, outline, sampled
from mvps.visibility import ray_caster
from solvers.linear import CholeskyLike

MINIMUM_VIEWS = 1.5
"""Effective number of views, (sum w)^2 / sum w^2, from which their agreement says something."""

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


@dataclass(frozen=True, eq=False)
class Agreement:
    """Agreed offset along the normal (V,) and its standard deviation (V,), infinite where views do not tell; world units."""

    offset: Float
    sigma: Float


def feature_image(maps: NormalMap, mask: NDArray[np.bool_], index: Int) -> NDArray[np.float32]:
    """(height, width, 4) albedo-scaled normal times confidence, and confidence, 0 in the background."""
    image = np.zeros((*mask.shape, 4), np.float32)
    confidence = maps.confidence[:, None]
    image[mask, :3] = maps.normal * maps.albedo.mean(1, keepdims=True) * confidence
    image[mask, 3] = maps.confidence
    return image


def _slid(camera: Camera, points: Float, direction: Float, offsets: Float) -> Float:
    """(n * offsets, 2) image coordinates of points (n, 3) moved by offsets (offsets,) along their directions (n, 3)."""
    start = (points @ camera.rotation.T + camera.translation) @ camera.K.T
    along = direction @ (camera.K @ camera.rotation).T
    moved = (start[:, None] + offsets[:, None] * along[:, None]).reshape(-1, 3)
    return moved[:, :2] / moved[:, 2:]


def _facing(view: View, points: Float, normal: Float) -> NDArray[np.float32]:
    """(n,) squared cosine of the viewing angle."""
    cosine = np.einsum("ni,ni->n", normal, view_directions(view.camera, points))
    squared: NDArray[np.float32] = np.maximum(cosine, 0).astype(np.float32) ** 2
    return squared


def agreement(capture: Capture, surface: Surface, maps: tuple[NormalMap, ...], seen: list[Int], offsets: Float) -> Agreement:
    """Where along its normal each vertex agrees best between views. seen: per view the indices of vertices it sees;
    offsets (n,) evenly spaced, world units."""
    normal, count = vertex_normals(surface), len(offsets)
    step = max(1, REMAP_LIMIT // count)

    def swept(hand: int) -> tuple[Float, NDArray[np.float32]]:
        """Over every WORKERS-th view, sums of w and w^2 (V, 2) and, at every offset, of w b, w, w |b|^2 (V, offsets, 5)."""
        weights, sums = np.zeros((len(normal), 2)), np.zeros((len(normal), count, 5), np.float32)
        for view, photometric, index in list(zip(capture.views, maps, seen, strict=True))[hand::WORKERS]:
            image = feature_image(photometric, view.mask, view.pixel_index)
            for start in range(0, len(index), step):
                part = index[start : start + step]
                points, local = surface.vertices[part], normal[part]
                cosine = _facing(view, points, local)
                value = sampled(image, _slid(view.camera, points, local, offsets), cv2.BORDER_CONSTANT).reshape(-1, count, 4)
                term = np.empty((len(part), count, 5), np.float32)
                np.multiply(value, cosine[:, None, None], out=term[..., :4])
                square = np.einsum("njc,njc->nj", term[..., :3], value[..., :3])
                np.divide(square, np.maximum(value[..., 3], 1e-6), out=term[..., 4])
                sums[part] += term
                weights[part] += np.stack([cosine, cosine**2], 1)
        return weights, sums

    weights, sums = (sum(parts) for parts in zip(*on_cores(swept, range(WORKERS)), strict=True))
    views = weights[:, 0] ** 2 / np.maximum(weights[:, 1], 1e-12)
    # The variance of n samples about their own mean is short of the true one by (n - 1) / n.
    unbias = views / np.maximum(views - 1, 0.5)
    total = np.maximum(sums[..., 3], 1e-9)
    cost = sums[..., 4] / total - np.square(sums[..., :3] / total[..., None]).sum(-1)
    known = (sums[..., 3] > 0.05 * weights[:, :1]).all(1) & (views >= MINIMUM_VIEWS)
    return _lowest(np.maximum(cost, 0) * unbias[:, None], known, offsets, views)


def _lowest(cost: Float, known: NDArray[np.bool_], offsets: Float, views: Float) -> Agreement:
    """Of cost (V, offsets), known (V,), views (V,)."""
    step = float(offsets[1] - offsets[0])
    best = cost.argmin(1)
    inside = (best > 0) & (best < len(offsets) - 1) & known
    middle = np.clip(best, 1, len(offsets) - 2)
    rows = np.arange(len(cost))
    low, mid, high = (cost[rows, middle + k].astype(np.float64) for k in (-1, 0, 1))
    curvature = np.maximum(low - 2 * mid + high, 1e-30)
    shift = np.clip(0.5 * (low - high) / curvature, -1, 1)
    sigma = step * np.sqrt(2 * mid / (3 * np.maximum(views, 1) * curvature))
    offset = np.where(inside, offsets[middle] + step * shift, offsets[np.clip(best, 0, len(offsets) - 1)])
    # A minimum at the end of the sweep only says in which direction to go on.
    sigma = np.where(inside, sigma, step * len(offsets))
    return Agreement(np.where(known, offset, 0), np.where(known, sigma, np.inf))


def with_masks(agreed: Agreement, capture: Capture, surface: Surface, distance: list[NDArray[np.float32]], floor: float) -> Agreement:
    """The agreement of views (floor: its smallest standard deviation) together with what the masks say of the outlines.

    distance: per view the signed distance to its mask (height, width), pixels.
    """
    caster = ray_caster(surface)
    count = len(surface.vertices)

    def of_view(i: int) -> tuple[Float, Float]:
        line = outline(caster, capture.views[i].camera)
        here, beyond, before = (sampled(distance[i], line.image + step * line.outward) for step in (0, 1, -1))
        slope = (beyond - before) / 2
        told = slope > ALONG
        weight = told * line.length * SHARED * (line.rate / MASK_SIGMA_PIXELS) ** 2
        wanted = -here / np.where(told, slope, 1) / line.rate
        corners, shares = surface.faces[line.face].ravel(), weight[:, None] * line.barycentric
        weights, pulls = (np.bincount(corners, values.ravel(), count) for values in (shares, shares * wanted[:, None]))
        return weights.astype(np.float64), pulls.astype(np.float64)

    weight, pull = (sum(parts) for parts in zip(*on_cores(of_view, range(len(capture.views))), strict=True))
    known = np.isfinite(agreed.sigma)
    own = np.where(known, 1 / np.maximum(agreed.sigma, floor) ** 2, 0)
    total = own + weight
    safe = np.where(total > 0, total, 1)
    return Agreement((own * agreed.offset + pull) / safe, np.where(total > 0, 1 / np.sqrt(safe), np.inf))


def turned(source: Float, target: Float, vectors: Float) -> Float:
    """Vectors (n, 3) turned by the smallest rotations that turn unit vectors source (n, 3) to target (n, 3) (Rodrigues)."""
    axis = cross(source, target)
    cosine = np.clip(np.einsum("ni,ni->n", source, target), -0.99, 1)
    aside = cross(axis, vectors)
    result: Float = vectors + aside + cross(axis, aside) / (1 + cosine)[:, None]
    return result


def _turned_divergence(surface: Surface, target: Float) -> Float:
    """(V, 3) divergence of R_f grad x: a corner of face f takes R_f (n x opposite side) / 2, its hat function's gradient times the area."""
    normal, corners = face_normals(surface), [surface.vertices[surface.faces[:, k]] for k in range(3)]
    first, second = (turned(normal, target, cross(normal, corners[k - 1] - corners[k - 2]) / 2) for k in (0, 1))
    divergence = np.zeros_like(surface.vertices)
    # The three sides of a face add up to nothing.
    for k, share in enumerate((first, second, -first - second)):
        for axis in range(3):
            divergence[:, axis] += np.bincount(surface.faces[:, k], share[:, axis], len(divergence))
    return divergence


def fuse(
    surface: Surface, target: Float, agreed: Agreement, normal_sigma: float, factor: CholeskyLike | None = None
) -> tuple[Surface, CholeskyLike]:
    """The surface moved so that its faces follow `target` (F, 3), unit, and its vertices the agreed positions; same faces.

    normal_sigma radians. The factor of the system may serve another fusion of a surface that has hardly moved.
    """
    x = surface.vertices
    scale = len(x) / (normal_sigma**2 * face_areas(surface).sum())
    L = igl.cotmatrix(x, surface.faces) * -scale
    right = _turned_divergence(surface, target) * scale
    outward = vertex_normals(surface)
    agreed_at = x + agreed.offset[:, None] * outward
    sigma = agreed.sigma
    weight = np.where(np.isfinite(sigma), 1 / sigma**2, 0)
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
