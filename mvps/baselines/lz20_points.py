"""LZ20, second step: points of the surface that several views agree on, and the normals that azimuths of several views make.

Every view i that sees a point tells a direction T_i in the tangent plane there (lz20_azimuth.py). Two or more tell the normal:

    n = argmin over |n| = 1 of  sum_i g_i rho(T_i . n / sigma_i),      g_i = cos^2 of the viewing angle

(the least eigenvector of sum g_i T_i T_i' / sigma_i^2, reweighted). What is left at the minimum says how well the views agree on a tangent
plane. A vertex that slides along its normal, x + d n, lies on the surface where they agree best; the second derivative of the cost says how
sharply. In plane regions all offsets agree and the vertex says nothing.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mvps.baselines.lz20_azimuth import Azimuths
from mvps.camera import project, view_directions
from mvps.cores import on_cores
from mvps.joint.agreement import Agreement
from mvps.mesh import normalise, vertex_normals
from mvps.scene import RELIABLE, Capture, Float, Int, Surface, View
from mvps.silhouette import sampled
from mvps.visibility import ray_caster, visible_vertices
from solvers.low_rank import CAUCHY_95

Array = NDArray[Any]

SIGMA_FLOOR = 0.01
"""Radians: below it errors of azimuths are not noise but what the model leaves out, and views share them."""

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Entries of a symmetric matrix, in the order in which they are stored."""

OUTSIDE = 9.0
"""Squared deviations, in Cauchy's scale, that a view counts to whose mask a point lies outside of: it cannot lie on the surface."""

VERTICES_AT_ONCE = 4096
SWEEPS = 2

LEAST_VIEWS = 3
"""Two tangents always agree on a plane."""


def tensors(view: View, azimuths: Azimuths) -> NDArray[np.float32]:
    """(height, width, 6) T T' / sigma^2 of a view's pixels, 0 in the background."""
    image = np.zeros((*view.mask.shape, 6), np.float32)
    weight = 1 / (azimuths.sigma**2 + SIGMA_FLOOR**2)
    image[view.mask] = np.stack([azimuths.along[:, i] * azimuths.along[:, j] * weight for i, j in PAIRS], 1)
    return image


def seen_by(capture: Capture, surface: Surface) -> list[Int]:
    """Per view the vertices that it sees."""
    caster = ray_caster(surface)
    return on_cores(lambda view: np.flatnonzero(visible_vertices(caster, view.camera)), capture.views)


def _told(view: View, image: NDArray[np.float32], points: Float) -> Array:
    """(n, 6) tensors at points (n, 3)."""
    at = project(view.camera, points)[0]
    halves = [sampled(np.ascontiguousarray(image[..., k : k + 3]), at, cv2.BORDER_CONSTANT) for k in (0, 3)]
    return np.concatenate(halves, 1)


def _applied(tensor: Array, n: Array) -> Array:
    """(..., 3) the symmetric matrices (..., 6) times n (..., 3)."""
    a, b, c, d, e, f = np.moveaxis(tensor, -1, 0)
    x, y, z = np.moveaxis(n, -1, 0)
    return np.stack([a * x + b * y + c * z, b * x + d * y + e * z, c * x + e * y + f * z], -1)


def least_eigenvector(tensor: Array, start: Array) -> Array:
    """(n, 3) unit eigenvectors of the smallest eigenvalues of matrices (n, 6), on the side of start (n, 3): inverse iteration."""
    a, b, c, d, e, f = (tensor + 1e-6 * tensor[:, [0, 3, 5]].sum(1, keepdims=True) * np.array([1, 0, 0, 1, 0, 1])).T
    adjugate = np.stack([d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b], -1)
    n = start
    for _ in range(3):
        n = normalise(_applied(adjugate, n))
    return np.where((n * start).sum(1, keepdims=True) < 0, -n, n)


def tangent_planes(of: list[tuple[Int, Array, Array]], start: Array) -> tuple[Array, Array, Array]:
    """Normals (n, 3) on which the views agree, cost (n,) in squared standard deviations and sum of the tensors (n, 6).

    of: per view rows, tensors (rows, 6) and g (rows,); start (n, 3).
    """
    n, rows_total = start, len(start)
    total = np.zeros((rows_total, 6))
    for _ in range(SWEEPS + 1):
        weighted, cost, g_sum = np.zeros((rows_total, 6)), np.zeros(rows_total), np.zeros(rows_total)
        first = not total.any()
        for rows, tensor, g in of:
            square = 0 if first else np.maximum((_applied(tensor, n[rows]) * n[rows]).sum(1), 0) / CAUCHY_95**2
            square = np.where(tensor[:, 0] + tensor[:, 3] + tensor[:, 5] > 0, square, OUTSIDE)
            weighted[rows] += tensor * (g / (1 + square))[:, None]
            cost[rows] += g * CAUCHY_95**2 * np.log1p(square)
            g_sum[rows] += g
        total = weighted
        n = least_eigenvector(total, start)
    return n, cost / np.maximum(g_sum, 1e-9), total


def agreement(capture: Capture, surface: Surface, images: list[NDArray[np.float32]], seen: list[Int], offsets: Float) -> Agreement:
    """Where along its normal each vertex agrees best between views. images: `tensors` of every view; seen: per view the vertices that
    it sees, in order; offsets (n,) evenly spaced, world units."""
    normal = vertex_normals(surface)

    def of_block(start: int) -> Agreement:
        stop = min(start + VERTICES_AT_ONCE, len(normal))
        chosen = [index[slice(*np.searchsorted(index, (start, stop)))] for index in seen]
        facing = [_facing(view, surface.vertices[among], normal[among]) for view, among in zip(capture.views, chosen, strict=True)]
        costs = []
        for offset in offsets:
            told = []
            for view, image, among, g in zip(capture.views, images, chosen, facing, strict=True):
                told.append((among - start, _told(view, image, surface.vertices[among] + offset * normal[among]), g))
            costs.append(tangent_planes(told, normal[start:stop])[1])
        views = np.zeros(stop - start)
        for among, g in zip(chosen, facing, strict=True):
            views[among - start] += g > 0
        return _lowest(np.stack(costs, 1), views, offsets)

    blocks = on_cores(of_block, range(0, len(normal), VERTICES_AT_ONCE))
    return Agreement(np.concatenate([block.offset for block in blocks]), np.concatenate([block.sigma for block in blocks]))


def _facing(view: View, points: Float, normal: Float) -> Array:
    facing: Array = np.maximum(np.einsum("ni,ni->n", normal, view_directions(view.camera, points)), 0) ** 2
    return facing


def _lowest(cost: Float, views: Float, offsets: Float) -> Agreement:
    """Foot and width of the parabola through the least cost (V, offsets) and its neighbours."""
    step = float(offsets[1] - offsets[0])
    best = cost.argmin(1)
    known = (best > 0) & (best < len(offsets) - 1) & (views >= LEAST_VIEWS)
    middle = np.clip(best, 1, len(offsets) - 2)
    rows = np.arange(len(cost))
    low, mid, high = (cost[rows, middle + k] for k in (-1, 0, 1))
    curvature = np.maximum(low - 2 * mid + high, 1e-30)
    shift = np.clip(0.5 * (low - high) / curvature, -1, 1)
    # Less than one standard deviation is luck.
    sigma = step * np.sqrt(2 * np.maximum(mid, 1) / (np.maximum(views - 2, 1) * curvature))
    return Agreement(np.where(known, offsets[middle] + step * shift, 0), np.where(known, sigma, np.inf))


def tangents_at(
    capture: Capture, images: list[NDArray[np.float32]], points: Float, otherwise: Float, seen: list[Int]
) -> tuple[Float, Float]:
    """Normals (n, 3) that the views' azimuths make at points (n, 3) and their standard deviation (n,) in radians along the worse tangent.

    otherwise (n, 3), unit, is where they start and what stays, with an infinite standard deviation, where fewer than two views see the
    point. seen: per view the points.
    """
    told, count, weight = [], np.zeros(len(points)), np.zeros(len(points))
    for view, image, rows in zip(capture.views, images, seen, strict=True):
        facing = _facing(view, points[rows], otherwise[rows])
        told.append((rows, _told(view, image, points[rows]), facing))
        count[rows] += 1
        weight[rows] += facing
    normal, cost, total = tangent_planes(told, otherwise)
    # In the tangent plane the smaller of the two eigenvalues says how well the normal is held. Views share their errors, so that many
    # are as good as one whose deviations are theirs.
    trace, square = total[:, [0, 3, 5]].sum(1), (total**2 * np.array([1, 2, 2, 1, 2, 1])).sum(1)
    second = (trace - np.sqrt(np.maximum(2 * square - trace**2, 0))) / 2
    known = (count >= 2) & (second > 0)
    sigma = np.sqrt(np.maximum(cost, 1) * weight / np.where(known, second, 1))
    return np.where(known[:, None], normal, otherwise), np.where(known, sigma, np.inf)


def confident(sigma: Float) -> Float:
    """Confidence (n,) in normals of standard deviation sigma (n,), as scene.py has it."""
    confidence: Float = 1 / (1 + (sigma / RELIABLE) ** 2)
    return confidence
