"""LZ20, third step: known depths carried along iso-depth contours, and all views' points fused to a surface.

Contour   X = C + r d(p) with distance r to the camera C: a step h T (lz20_azimuth.py) leaves r as it is and the point on the surface. An
          error of T . n by sigma_T lifts the point off the surface by sigma_T h, so a path of length s ends within  sigma_0 + sum sigma_T
          h. A path ends at the mask, at a standard deviation of LIMIT pixels, and where it has left the surface so far by more than the
          known points may (it has run over an occluding edge).
Fusion    Every pixel's depths are told as offsets from the surface so far, along its normal. A vertex takes the robust mean over the views
          that see it; positions and the normals of the views' azimuths then make the surface (Nehab et al. 2005).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mvps.baselines.lz20_azimuth import Azimuths
from mvps.baselines.lz20_points import SIGMA_FLOOR
from mvps.camera import bilinear, footprint, project
from mvps.cores import on_cores
from mvps.joint.agreement import Agreement
from mvps.mesh import lengths, normalise, vertex_normals
from mvps.scene import Bool, Capture, Float, Int, Surface, View
from mvps.visibility import RayCaster, camera_hits, interpolate, ray_caster

Array = NDArray[Any]

LIMIT = 1.0
"""Pixels: a contour that may be farther off says no more than the surface so far."""

MOST_STEPS = 256
"""Steps of one pixel along a contour to either side."""

APART = 4
"""Pixels between points from which contours start: between them contours pass within a pixel or two of every pixel."""

SWEEPS = 3


@dataclass(frozen=True, eq=False)
class Known:
    """What the surface so far looks like at a view's pixels: distance to the camera (pixels,), inf where it is not met, and the cosine
    (pixels,) between its normal and the line of sight."""

    distance: Float
    cosine: Float


def looked_at(caster: RayCaster, view: View) -> Known:
    """The caster's surface in a view."""
    hits = camera_hits(caster, view.camera, view.pixels)
    normal = normalise(interpolate(caster.surface, hits, caster.vertex_normals))
    points = interpolate(caster.surface, hits, caster.surface.vertices)
    cosine = np.einsum("ni,ni->n", normal, normalise(view.camera.centre - points))
    return Known(hits.distance, np.maximum(cosine, 0))


def traced(view: View, azimuths: Azimuths, known: Known, points: Float, sigma: Float, reach: float) -> tuple[Array, Array]:
    """Offsets (pixels,) from the surface so far along its normal and their standard deviations (pixels,), infinite where no contour came
    by.

    points (n, 3) lie on the surface within sigma (n,); reach: farthest that they are off the surface so far. World units.
    """
    pixel = float(np.median(footprint(view.camera, points)))
    tangent_sigma = np.sqrt(azimuths.sigma**2 + SIGMA_FLOOR**2)
    first = _sampled(view, known, points, sigma, reach)
    samples = [first]
    for side in (-1.0, 1.0):
        x, spread, index = points[first.chosen], first.sigma, first.pixel
        before: Float = side * azimuths.along[index].astype(np.float64)
        for _ in range(MOST_STEPS):
            middle = _stepped(view, azimuths, x, index, before, pixel / 2)
            index = _under(view, middle)
            on = (index >= 0) & (spread < LIMIT * pixel)
            x, spread, before, index = x[on], spread[on], before[on], index[on]
            if not len(x):
                break
            # The direction half-way: with the one at the start a path would leave every bend on its outer side.
            before = _aligned(azimuths, index, before)
            x = _moved(view, x, pixel * before)
            sample = _sampled(view, known, x, spread + pixel * tangent_sigma[index], reach)
            samples.append(sample)
            x, spread, before, index = x[sample.chosen], sample.sigma, before[sample.chosen], sample.pixel
    index, offset, spread = (np.concatenate(parts) for parts in list(zip(*samples, strict=True))[:3])
    return _robust_mean(index, offset, spread, len(view.pixels))


def _aligned(azimuths: Azimuths, index: Int, before: Float) -> Float:
    """The contours' directions (n, 3) at pixels index (n,), on the side of `before` (n, 3)."""
    T = azimuths.along[index].astype(np.float64)
    return np.where(np.einsum("ni,ni->n", T, before)[:, None] < 0, -T, T)


def _moved(view: View, x: Float, step: Float) -> Float:
    """Points x (n, 3) after a step (n, 3), at the distance to the camera that they had."""
    camera = view.camera.centre
    return camera + lengths(x - camera)[:, None] * normalise(x + step - camera)


def _stepped(view: View, azimuths: Azimuths, x: Float, index: Int, before: Float, length: float) -> Float:
    return _moved(view, x, length * _aligned(azimuths, index, before))


def _under(view: View, points: Float) -> Int:
    """(n,) position in the view's pixels of the one that shows each point, -1 in the background."""
    column, row = np.floor(project(view.camera, points)[0]).astype(np.int64).T
    inside = (row >= 0) & (row < view.camera.height) & (column >= 0) & (column < view.camera.width)
    index = view.pixel_index[np.where(inside, row, 0), np.where(inside, column, 0)]
    return np.where(inside, index, -1)


class Samples(NamedTuple):
    """Pixel, offset and standard deviation of the points that are near the surface so far, and which these are: `chosen` (n,) bool."""

    pixel: Int
    offset: Float
    sigma: Float
    chosen: Bool


def _sampled(view: View, known: Known, points: Float, sigma: Float, reach: float) -> Samples:
    """Points (n, 3) with standard deviations (n,) as seen from the surface so far; those farther than reach from it are left out."""
    index = _under(view, points)
    corners, weights = bilinear(view.pixel_index, project(view.camera, points)[0])
    between = (np.where(weights > 0, known.distance[corners], 0) * weights).sum(1)
    excess = lengths(points - view.camera.centre) - between
    offset = -np.where(np.isfinite(excess), excess, 0) * known.cosine[index]
    near = (index >= 0) & np.isfinite(excess) & (np.abs(offset) <= reach)
    return Samples(index[near], offset[near], sigma[near], near)


def _robust_mean(index: Array, value: Array, sigma: Array, count: int) -> tuple[Array, Array]:
    """Means (count,) of the values (n,) of every index (n,), each weighted by 1 / sigma^2, and the least sigma (count,) of each."""
    weight = 1 / sigma**2
    mean = np.zeros(count)
    for sweep in range(SWEEPS):
        robust = weight / (1 + ((value - mean[index]) / sigma) ** 2) if sweep else weight
        total = np.bincount(index, robust, count)
        mean = np.bincount(index, robust * value, count) / np.maximum(total, 1e-300)
    least = np.full(count, np.inf)
    # Samples of one contour share its errors: many are no better than the best.
    np.minimum.at(least, index, sigma)
    return mean, least


def _sparse(view: View, rows: Int, points: Float, sigma: Float) -> Int:
    """Of the points of these rows the surest in every square of APART pixels."""
    rows = rows[np.argsort(sigma[rows], kind="stable")]
    cell = np.floor(project(view.camera, points[rows])[0] / APART).astype(np.int64)
    _, first = np.unique(cell, axis=0, return_index=True)
    return rows[first]


def carried(capture: Capture, surface: Surface, maps: tuple[Azimuths, ...], agreed: Agreement, reach: float, seen: list[Int]) -> Agreement:
    """The vertices' offsets after the depths of the agreed points went along the contours of all views. seen: per view the vertices."""
    caster = ray_caster(surface)
    normal = vertex_normals(surface)
    moved = surface.vertices + agreed.offset[:, None] * normal
    known_points = np.isfinite(agreed.sigma)

    def of_view(i: int) -> tuple[Array, Array, Array]:
        view, rows = capture.views[i], seen[i]
        seeds = _sparse(view, rows[known_points[rows]], moved, agreed.sigma)
        if not len(seeds):
            return rows, np.zeros(len(rows)), np.full(len(rows), np.inf)
        offset, sigma = traced(view, maps[i], looked_at(caster, view), moved[seeds], agreed.sigma[seeds], reach)
        corners, weights = bilinear(view.pixel_index, project(view.camera, surface.vertices[rows])[0])
        part = weights * np.isfinite(sigma[corners])
        total = part.sum(1)
        value = (part * offset[corners]).sum(1) / np.maximum(total, 1e-12)
        spread = (part * np.where(part > 0, sigma[corners], 0)).sum(1) / np.maximum(total, 1e-12)
        return rows, value, np.where(total > 0.5, spread, np.inf)

    told = on_cores(of_view, range(len(capture.views)))
    rows, offset, sigma = (np.concatenate([part[k] for part in told]) for k in range(3))
    on = np.isfinite(sigma)
    mean, least = _robust_mean(rows[on], offset[on], sigma[on], len(normal))
    return Agreement(np.where(np.isfinite(least), mean, 0), least)
