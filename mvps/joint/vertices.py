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

from mvps.camera import project, view_directions
from mvps.cores import on_cores
from mvps.joint.blocks import WORKERS
from mvps.mesh import face_areas, face_normals, vertex_normals
from mvps.scene import Capture, Float, Int, NormalMap, Surface, View
from mvps.silhouette import outline, sampled
from mvps.visibility import RayCaster
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


def _remap(image: NDArray[np.float32], at: Float) -> NDArray[np.float32]:
    out = np.empty((len(at), image.shape[2]), np.float32)
    at = at.astype(np.float32) - np.float32(0.5)
    for start in range(0, len(at), 1 << 14):
        part = at[None, start : start + (1 << 14)]
        out[start : start + part.shape[1]] = cv2.remap(image, part[..., 0], part[..., 1], cv2.INTER_LINEAR)[0]
    return out


def _facing(view: View, points: Float, normal: Float) -> NDArray[np.float32]:
    """(n,) squared cosine of the viewing angle."""
    cosine = np.einsum("ni,ni->n", normal, view_directions(view.camera, points))
    squared: NDArray[np.float32] = np.maximum(cosine, 0).astype(np.float32) ** 2
    return squared


def agreement(capture: Capture, surface: Surface, maps: tuple[NormalMap, ...], seen: list[Int], offsets: Float) -> Agreement:
    """Where along its normal each vertex agrees best between views. seen: per view the indices of vertices it sees;
    offsets (n,) evenly spaced, world units."""
    normal = vertex_normals(surface)
    weights_squared, weights_sum = np.zeros(len(normal)), np.zeros(len(normal))

    def swept(hand: int) -> tuple[NDArray[np.float32], ...]:
        """Sums over every WORKERS-th view."""
        total = np.zeros((len(offsets), len(normal)), np.float32)
        first, second = np.zeros((*total.shape, 3), np.float32), np.zeros_like(total)
        for view, photometric, index in list(zip(capture.views, maps, seen, strict=True))[hand::WORKERS]:
            image = feature_image(photometric, view.mask, view.pixel_index)
            local, points = normal[index], surface.vertices[index]
            cosine = _facing(view, points, local)
            for j, offset in enumerate(offsets):
                value = _remap(image, project(view.camera, points + offset * local)[0])
                confidence = value[:, 3]
                feature = value[:, :3] / np.maximum(confidence, 1e-6)[:, None]
                weight = cosine * confidence
                total[j, index] += weight
                first[j, index] += weight[:, None] * feature
                second[j, index] += weight * np.einsum("ni,ni->n", feature, feature)
        return total, first, second

    for view, index in zip(capture.views, seen, strict=True):
        cosine = _facing(view, surface.vertices[index], normal[index])
        weights_sum[index] += cosine
        weights_squared[index] += cosine**2
    total, first, second = (sum(parts) for parts in zip(*on_cores(swept, range(WORKERS)), strict=True))
    mean = first / np.maximum(total, 1e-9)[..., None]
    views = weights_sum**2 / np.maximum(weights_squared, 1e-12)
    # The variance of n samples about their own mean is short of the true one by (n - 1) / n.
    unbias = views / np.maximum(views - 1, 0.5)
    cost = np.maximum(second / np.maximum(total, 1e-9) - (mean**2).sum(-1), 0) * unbias
    known = (total > 0.05 * weights_sum).all(0) & (views >= MINIMUM_VIEWS)
    return _lowest(cost, known, offsets, views)


def _lowest(cost: Float, known: NDArray[np.bool_], offsets: Float, views: Float) -> Agreement:
    step = float(offsets[1] - offsets[0])
    best = cost.argmin(0)
    inside = (best > 0) & (best < len(offsets) - 1) & known
    middle = np.clip(best, 1, len(offsets) - 2)
    columns = np.arange(cost.shape[1])
    low, mid, high = (cost[middle + k, columns].astype(np.float64) for k in (-1, 0, 1))
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
    caster = RayCaster(surface)
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


def rotations(source: Float, target: Float) -> Float:
    """(n, 3, 3) smallest rotations that turn unit vectors source (n, 3) to target (n, 3) (Rodrigues)."""
    axis = np.cross(source, target)
    cosine = np.clip((source * target).sum(1), -0.99, 1)
    K = np.zeros((len(source), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    K[:, 1, 0], K[:, 2, 0], K[:, 2, 1] = axis[:, 2], -axis[:, 1], axis[:, 0]
    rotated: Float = np.eye(3) + K + K @ K / (1 + cosine)[:, None, None]
    return rotated


def fuse(
    surface: Surface, target: Float, agreed: Agreement, normal_sigma: float, factor: CholeskyLike | None = None
) -> tuple[Surface, CholeskyLike]:
    """The surface moved so that its faces follow `target` (F, 3), unit, and its vertices the agreed positions; same faces.

    normal_sigma radians. The factor of the system may serve another fusion of a surface that has hardly moved.
    """
    x = surface.vertices
    faces = np.ascontiguousarray(surface.faces)
    R = rotations(face_normals(surface), target)
    G = igl.grad(np.ascontiguousarray(x), faces)
    F = len(faces)
    gradient = (G @ x).reshape(3, F, 3)  # [axis of differentiation, face, coordinate]
    # Turning a face turns both the directions of differentiation and the coordinates: grad of the identity map R_f applied to x.
    turned = np.einsum("fab,dfb->dfa", R, gradient).reshape(3 * F, 3)
    area = face_areas(surface)
    scale = 1 / (normal_sigma**2 * area.sum() / len(x))
    divergence = G.T @ sp.diags(np.tile(area, 3))
    L = (divergence @ G * scale).tocsc()
    right = divergence @ turned * scale
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
