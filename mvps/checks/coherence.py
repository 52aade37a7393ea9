"""Silhouette coherence: how far the line of sight through a mask's outline passes beside what the other views leave of the object.

With m_j(x) the signed distance in pixels from the projection of x into view j to the outline of its mask, negative inside, and x(t) on the
line of sight through a point q of view i's outline,

    e(q) = min over t of max over j != i of m_j(x(t)).

The line touches the object, which lies inside all masks: with right poses e(q) <= 0 everywhere (Hernandez et al. 2007), and most lines
touch the hull of the others, where e is near 0. A pose that is off by p pixels lifts e to about p along parts of the outlines.

At the minimum either one view's m is least along the line, or two views' are equal there, one falling and one rising. With weights w >= 0,
sum w = 1, sum w dm/dt = 0, the derivative of e by any motion is the weighted sum of those of m_j at the point (Danskin 1967): of camera j,
which moves the projection, and of camera i, which carries the line along.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.measure import find_contours

from mvps.camera import project, rays
from mvps.motions import Object, image_derivatives, units
from mvps.scene import Bool, Camera, Float, Int
from mvps.silhouette import sampled, sampled_at

COARSE_PIXELS, FINE_STEPS = 2.0, 10
"""Step along a line of sight, pixels, and the parts into which the two steps around the least value are divided."""

PROBE_PIXELS = 0.5
"""Half the step of the difference quotient that stands for the gradient of m, which is smooth over a pixel."""

Fields = list[NDArray[np.float32]]

Derivatives = Callable[[Camera, Float], Float]
"""(n, 3, u) of points (n, 3) in a camera's frame: what each of the camera's u unknowns moves them by, or moves their projections like."""


@dataclass(frozen=True, eq=False)
class Coherence:
    """Of the n outline points of a view: miss (n,) e in pixels; point (n, 3) x; against (n, 2) the views that decide, and their weight
    (n, 2)."""

    miss: Float
    point: Float
    against: Int
    weight: Float

    def of(self, rows: Bool) -> Coherence:
        """Only some of the points."""
        return Coherence(self.miss[rows], self.point[rows], self.against[rows], self.weight[rows])


def outline_points(field: NDArray[np.float32], spacing: float) -> Float:
    """(n, 2) image coordinates on the outline of a mask with this signed distance, in its order, about `spacing` pixels apart."""
    found = []
    for line in find_contours(field, 0.0):
        along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        at = np.arange(0, along[-1], spacing)
        found.append(np.stack([np.interp(at, along, line[:, k]) for k in (1, 0)], -1) + 0.5)
    return np.concatenate(found) if found else np.zeros((0, 2))


def _along(cameras: Sequence[Camera], fields: Fields, own: int, origins: Float, directions: Float, t: Float) -> tuple[Float, Int]:
    """Largest m (n, T) of all views but `own` at depths t (n, T) along lines of sight, and whose it is."""
    largest = np.full(t.shape, -np.inf, np.float32)
    whose = np.zeros(t.shape, np.int16)
    for j, (camera, field) in enumerate(zip(cameras, fields, strict=True)):
        if j == own:
            continue
        start = (origins @ camera.rotation.T + camera.translation) @ camera.K.T
        slope = directions @ camera.rotation.T @ camera.K.T
        x, y, depth = (start[:, k, None] + t * slope[:, k, None] for k in range(3))
        x, y = x / depth, y / depth
        m = sampled_at(field, x.ravel(), y.ravel()).reshape(t.shape)
        if min(edge.min() for edge in (field[0], field[-1], field[:, 0], field[:, -1])) < 0:
            # What the image cuts off may go on beside it, as deep inside as anything.
            m[(x < 0) | (y < 0) | (x > camera.width) | (y > camera.height)] = field.min()
        above = m > largest
        np.copyto(largest, m, where=above)
        np.copyto(whose, j, where=above)
    return largest, whose


def coherence(cameras: Sequence[Camera], fields: Fields, body: Object, own: int, image: Float) -> Coherence:
    """The miss at outline points `image` (n, 2) of view `own`."""
    camera = cameras[own]
    origins, directions = rays(camera, image)
    middle = ((body.centre - origins) * directions).sum(-1)
    pixel = units(camera, body)[1][3]
    steps = max(2, int(np.ceil(2 * body.radius / (COARSE_PIXELS * pixel))))
    coarse = np.linspace(-body.radius, body.radius, steps + 1)
    t = middle[:, None] + coarse
    values, _ = _along(cameras, fields, own, origins, directions, t)
    rows, step = np.arange(len(t)), coarse[1] - coarse[0]
    best = t[rows, values.argmin(1)]
    t = best[:, None] + np.linspace(-step, step, 2 * FINE_STEPS + 1)
    values, whose = _along(cameras, fields, own, origins, directions, t)
    at = values.argmin(1).clip(1, 2 * FINE_STEPS - 1)
    against = np.stack([whose[rows, at - 1], whose[rows, at + 1]], -1).astype(np.int64)
    fall, rise = values[rows, at - 1] - values[rows, at], values[rows, at + 1] - values[rows, at]
    total = np.maximum(fall + rise, 1e-9)
    weight = np.clip(np.stack([rise / total, fall / total], -1), 0, 1)
    weight[against[:, 0] == against[:, 1]] = 0.5
    return Coherence(values[rows, at].astype(np.float64), origins + t[rows, at, None] * directions, against, weight)


def gradients(field: NDArray[np.float32], image: Float) -> Float:
    """(n, 2) gradient of a signed distance at image coordinates (n, 2)."""
    ends = [[sampled(field, image + side * PROBE_PIXELS * axis) for side in (-1, 1)] for axis in np.eye(2)]
    return np.stack([(b - a) / (2 * PROBE_PIXELS) for a, b in ends], -1).astype(np.float64)


def jacobian(cameras: Sequence[Camera], fields: Fields, own: int, found: Coherence, derivatives: Derivatives) -> Float:
    """(n, cameras, u) derivatives of the misses of view `own` by the unknowns of all cameras."""
    own_local = found.point @ cameras[own].rotation.T + cameras[own].translation
    carried = derivatives(cameras[own], own_local)
    # Along the line of sight e does not change, but a camera's distance moves the point far along it.
    carried -= own_local[..., None] / own_local[:, 2, None, None] * carried[:, 2:]
    result = np.zeros((len(found.miss), len(cameras), carried.shape[2]))
    for side in range(2):
        for j in np.unique(found.against[:, side]):
            rows = np.flatnonzero(found.against[:, side] == j)
            camera, points = cameras[j], found.point[rows]
            slope = np.einsum("nk,nkc->nc", gradients(fields[j], project(camera, points)[0]), image_derivatives(camera, points))
            slope *= found.weight[rows, side, None]
            local = points @ camera.rotation.T + camera.translation
            result[rows, j] += np.einsum("nc,ncp->np", slope, derivatives(camera, local))
            relative = camera.rotation @ cameras[own].rotation.T
            result[rows, own] -= np.einsum("nc,ncp->np", slope @ relative, carried[rows])
    return result
