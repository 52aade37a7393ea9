"""Depth from normals, with discontinuities: bilateral normal integration (Cao et al. 2022, ECCV, perspective case).

A point X = z r on the ray r = K^-1 (x, y, 1) of a pixel moves within the surface, whose normal is n (camera frame): with t = log z

    f (n . r) d_x t + f n . r_x = 0,      f (n . r) d_y t + f n . r_y = 0,       r_x, r_y the derivatives of r, f the focal length.

Each derivative is taken to both sides, t(x + 1) - t(x) and t(x) - t(x - 1), and the two equations share one weight,

    w and 1 - w,     w = sigmoid(k ((f n.r (t - t_-))^2 - (f n.r (t_+ - t))^2))

so that a pixel beside a step holds on to the side that is continuous with it. Reweighted least squares, sparse, from w = 1/2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.special import expit

from mvps.camera import pixel_centres
from mvps.scene import Bool, Camera, Float, Int
from solvers.linear import CholeskyLike

STIFFNESS = 2.0
"""k: a side that departs by a pixel more than the other gets an eighth of the weight (value of the paper)."""

MOST_SWEEPS, SETTLED = 60, 1e-4
"""Of reweighting; relative change of the energy below which it ends (the paper's are 150 and 1e-4)."""

GAUGE, SOFT = 1e-8, 1e-3
"""Weight of log depth itself: parts of the mask that nothing connects would otherwise have no depth. No more than SOFT of what differences
weigh in a wave as long as the mask, which would otherwise be flattened where that is many pixels across."""

GRAZING = 0.02
"""Least -n.r over |r|: 89 degrees from the ray. Normals beyond are noise, and their depth would be infinite."""


class Depth(NamedTuple):
    """log_depth (pixels,), of mean 0; per pixel and neighbour (right, left, down, up; -1 where there is none) neighbour (pixels, 4) and
    weight (pixels, 4), the share that the pixel's equation gives it: 1/2 on smooth ground, near 0 across a step."""

    log_depth: Float
    neighbour: Int
    weight: Float


def neighbours(mask: Bool) -> Int:
    """(pixels, 4) row-major numbers of the foreground neighbours right, left, down, up; -1 where there is none."""
    index = np.full(np.add(mask.shape, 2), -1)
    index[1:-1, 1:-1][mask] = np.arange(int(mask.sum()))
    shifted = (index[1:-1, 2:], index[1:-1, :-2], index[2:, 1:-1], index[:-2, 1:-1])
    return np.stack([s[mask] for s in shifted], 1)


def slopes(camera: Camera, pixels: Int, normal: Float) -> tuple[Float, Float]:
    """Coefficients f (n.r) (n,) and f (n.r_x), f (n.r_y) (n, 2) for pixels (n, 2), normals (n, 3) in the camera's frame; normals that look
    away are turned to GRAZING."""
    inverse = np.linalg.inv(camera.K)
    ray = np.concatenate([pixel_centres(pixels), np.ones((len(pixels), 1))], 1) @ inverse.T
    length = np.linalg.norm(ray, axis=1)
    facing = np.minimum((normal * ray).sum(1), -GRAZING * length)
    across: Float = camera.focal_length * normal @ inverse[:, :2]
    return camera.focal_length * facing, across


def integrate(camera: Camera, mask: Bool, normal: Float, confidence: Float) -> Depth:
    """Log depth of the foreground pixels of mask (height, width) from their normals (pixels, 3), camera frame, counted by confidence
    (pixels,) in [0, 1]."""
    pixels, beside = np.argwhere(mask), neighbours(mask)
    facing, across = slopes(camera, pixels, normal)
    count, sign = len(pixels), np.array([1.0, -1.0, 1.0, -1.0])
    row, side = np.nonzero(beside >= 0)
    # facing * sign * (t_neighbour - t) + across = 0
    coefficient = facing[row] * sign[side]
    number = np.arange(len(row))
    difference = sp.csr_matrix(
        (np.concatenate([coefficient, -coefficient]), (np.tile(number, 2), np.concatenate([beside[row, side], row]))),
        shape=(len(row), count),
    )
    right = -across[row, side // 2]
    alone = beside[row, side ^ 1] < 0
    trust = np.maximum(confidence, 1e-3)[row]
    share = np.full(len(row), 0.5)
    longest = float(trust.mean()) * (2 * np.pi / (np.ptp(pixels, axis=0).max() + 1)) ** 2
    gauge = min(GAUGE, SOFT * longest) * float(np.mean(facing**2))
    t, factor, before = np.zeros((count, 1)), None, np.inf
    for _ in range(MOST_SWEEPS):
        weight = trust * share
        matrix = difference.T @ sp.diags(weight) @ difference + gauge * sp.identity(count)
        target = difference.T @ (weight * right)[:, None]
        factor = factor or CholeskyLike(matrix)
        t = factor.nearby(matrix, target, t)
        energy = float((weight * (difference @ t[:, 0] - right) ** 2).sum())
        if np.isfinite(before) and abs(before - energy) <= SETTLED * before:
            break
        before = energy
        jump = np.zeros((count, 4))
        jump[row, side] = (difference @ t[:, 0]) ** 2
        share = expit(STIFFNESS * (jump[row, side ^ 1] - jump[row, side]))
        # A pixel that has a neighbour on one side only has no choice.
        share = np.where(alone, 0.5, share)
    weights = np.zeros((count, 4))
    weights[row, side] = share
    return Depth(t[:, 0] - t.mean(), beside, weights)
