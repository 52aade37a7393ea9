"""Where the views agree: offsets of vertices along their normals.

A vertex x slides along its normal, x + d n, and every view v that sees it reports the albedo-scaled normal b_v of its photometric stereo
there, with weight w_v, its confidence times the squared cosine of the viewing angle. They agree best where x lies on the surface:

    c(d) = s^2 sum w rho(|b - m| / s) / sum w,    rho(r) = log(1 + r^2)

m their robust mean (one step from the plain mean). A view that looks past the rim of a hollow at something else is an outlier, and would
hold the vertex where it looks at the same thing as the others. s is Cauchy's scale of 95 % efficiency, from the least plain variance over
the offsets. The lowest sample of c and its two neighbours give a parabola, whose foot is the agreed offset and whose curvature its standard
deviation:

    sigma^2 = 2 c_min / (3 n c'')        n views and 3 channels (least squares)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mvps.camera import view_directions
from mvps.cores import at_a_time, on_cores
from mvps.mesh import vertex_normals
from mvps.scene import Camera, Capture, Float, Int, NormalMap, Surface, View
from mvps.silhouette import REMAP_LIMIT, sampled
from solvers.low_rank import CAUCHY_95

MINIMUM_VIEWS = 1.5
"""Effective number of views, (sum w)^2 / sum w^2, from which their agreement says something."""

VERTICES_AT_ONCE = 8192
"""Few enough for little memory (some ten views and offsets each), enough for few calls: with 512 it takes half as long again."""

ROUNDING = 1e-4
"""Least s over the length of b: float32 knows differences no better."""

LEAST_VARIANCE = np.float32(1e-30)
"""Of b, where all views see black: (1e-15 of white)^2, over which float32 holds a square of 1e4."""

CHANNELS = 3


@dataclass(frozen=True, eq=False)
class Agreement:
    """Agreed offset along the normal (V,) and its standard deviation (V,), infinite where views do not tell; world units."""

    offset: Float
    sigma: Float

    def weight(self, floor: float) -> Float:
        """(V,) inverse variance, with a standard deviation of at least `floor`; 0 where nothing is known."""
        return np.where(np.isfinite(self.sigma), 1 / np.maximum(self.sigma, floor) ** 2, 0)

    @staticmethod
    def of_weights(weight: Float, pull: Float) -> Agreement:
        """From inverse variances (V,) and offsets times these (V,)."""
        safe = np.where(weight > 0, weight, 1)
        return Agreement(pull / safe, np.where(weight > 0, 1 / np.sqrt(safe), np.inf))

    @staticmethod
    def unknown(count: int) -> Agreement:
        """Of `count` vertices about which nothing is known."""
        return Agreement(np.zeros(count), np.full(count, np.inf))

    def joined(self, other: Agreement, floor: float) -> Agreement:
        """Both together; floor: the smallest standard deviation of either."""
        own, others = self.weight(floor), other.weight(floor)
        return Agreement.of_weights(own + others, own * self.offset + others * other.offset)


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


@dataclass(frozen=True, eq=False)
class Swept:
    """What a view says of n vertices: their numbers (n,), squared cosine (n,); weight (n, offsets), b (3, n, offsets)."""

    rows: Int
    facing: NDArray[np.float32]
    weight: NDArray[np.float32]
    b: NDArray[np.float32]


def agreement(capture: Capture, surface: Surface, maps: tuple[NormalMap, ...], seen: list[Int], offsets: Float) -> Agreement:
    """Where along its normal each vertex agrees best between views. seen: per view the indices of vertices it sees, in order;
    offsets (n,) evenly spaced, world units."""
    normal = vertex_normals(surface)
    images = on_cores(lambda view, of: feature_image(of, view.mask, view.pixel_index), capture.views, maps)

    def reports(i: int, some: slice) -> list[Swept]:
        vertex = seen[i][some]
        return swept(capture.views[i], [images[i]], surface.vertices[vertex], normal[vertex], offsets, vertex)

    return lowest_of(len(normal), reports, seen, offsets)


def lowest_of(count: int, reports: Callable[[int, slice], list[Swept]], seen: list[Int], offsets: Float) -> Agreement:
    """Where each of `count` vertices agrees best. reports(i, some): what view i says of `some` of seen[i], its vertices in order."""

    # As many to each core.
    calls = at_a_time() * -(-count // (at_a_time() * VERTICES_AT_ONCE))
    size = -(-count // calls)

    def of_block(start: int) -> Agreement:
        stop, found = min(start + size, count), []
        for i, index in enumerate(seen):
            some = slice(*(int(k) for k in np.searchsorted(index, (start, stop))))
            if some.start < some.stop:
                found += [replace(of, rows=of.rows - start) for of in reports(i, some)]
        return _lowest(*_costs(found, stop - start, len(offsets)), offsets)

    blocks = on_cores(of_block, range(0, count, size))
    return Agreement(np.concatenate([block.offset for block in blocks]), np.concatenate([block.sigma for block in blocks]))


def swept(view: View, images: Sequence[NDArray[np.float32]], points: Float, normal: Float, offsets: Float, rows: Int) -> list[Swept]:
    """What images (height, width, 4) of b times weight, and weight, each say of points (n, 3) along their normals (n, 3)."""
    facing = _facing(view, points, normal)
    step = max(1, REMAP_LIMIT // len(offsets))
    starts = range(0, len(points), step)
    places = [_slid(view.camera, points[k : k + step], normal[k : k + step], offsets) for k in starts]
    found = []
    for image in images:
        value = np.concatenate([sampled(image, place, cv2.BORDER_CONSTANT) for place in places])
        *b, confidence = np.ascontiguousarray(value.reshape(-1, 4).T).reshape(4, len(points), len(offsets))
        found.append(Swept(rows, facing, confidence * facing[:, None], np.stack(b) / np.maximum(confidence, 1e-6)))
    return found


def _costs(swept: list[Swept], count: int, offsets: int) -> tuple[Float, NDArray[np.bool_], Float]:
    """c (count, offsets), which vertices (count,) the views say something about, and by how many views (count,), effectively."""
    facing, facing2 = np.zeros(count), np.zeros(count)
    total, square = np.zeros((2, count, offsets), np.float32)
    mean: NDArray[Any] = np.zeros((CHANNELS, count, offsets), np.float32)
    for of in swept:
        facing[of.rows] += of.facing
        facing2[of.rows] += of.facing**2
        total[of.rows] += of.weight
        for sums, b in zip(mean, of.b, strict=True):
            weighted = of.weight * b
            sums[of.rows] += weighted
            square[of.rows] += weighted * b
    safe = np.maximum(total, np.float32(1e-9))
    mean /= safe
    square /= safe
    variance = np.maximum(square - (mean**2).sum(0), ROUNDING**2 * square + LEAST_VARIANCE)
    unit = (CHANNELS / (CAUCHY_95**2 * variance.min(1))).astype(np.float32)

    def apart(of: Swept) -> NDArray[np.float32]:
        """|b - m|^2 / s^2."""
        squared = np.zeros_like(of.weight)
        for sums, b in zip(mean, of.b, strict=True):
            squared += (b - sums[of.rows]) ** 2
        squared *= unit[of.rows, None]
        return squared

    robust, weights, cost = np.zeros_like(mean), np.zeros_like(total), np.zeros_like(total)
    for of in swept:
        weight = of.weight / (1 + apart(of))
        weights[of.rows] += weight
        for sums, b in zip(robust, of.b, strict=True):
            sums[of.rows] += weight * b
    mean = robust / np.maximum(weights, np.float32(1e-9))
    for of in swept:
        cost[of.rows] += of.weight * np.log1p(apart(of))
    views = facing**2 / np.maximum(facing2, 1e-12)
    known = (total > 0.05 * facing[:, None]).all(1) & (views >= MINIMUM_VIEWS)
    # The variance of n samples about their own mean is short of the true one by (n - 1) / n.
    unbias = views / np.maximum(views - 1, 0.5)
    with np.errstate(over="ignore"):
        # Where hardly a view speaks, of what is not known.
        mean_cost = cost / (safe * unit[:, None]) * unbias[:, None]
    return mean_cost, known, views


def _lowest(cost: Float, known: NDArray[np.bool_], views: Float, offsets: Float) -> Agreement:
    """Of cost (V, offsets), known (V,), views (V,)."""
    step = float(offsets[1] - offsets[0])
    best = cost.argmin(1)
    # Costs that no float32 holds say nothing; as a number, one of them would spread over the whole surface.
    known = known & np.isfinite(cost).all(1)
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
