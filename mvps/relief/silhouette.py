"""Rough normals from a silhouette alone: the mask blown up like a balloon.

With depth z over the image plane and w = z^2, a ball has the Laplacian of w = -4 and w = 0 on its outline (Poisson's equation on a mask,
in the spirit of Prasad and Fitzgibbon 2006, "Single view reconstruction of curved surfaces"). For any mask the solution of

    Laplace w = -4 inside,   w = 0 outside,      n ~ (-w_x / 2, -w_y / 2, -sqrt(w))      camera frame, x right, y down, z forward

has normals that are perpendicular to the outline there, as those of every smooth object are, and is a ball's where the mask is a disc.
Where the image's frame cuts the mask off there is no outline; there w is the chord's own, w_tt = -2 along the frame, and goes on across it
with w_nn = -2, as a ball's does.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from mvps.mesh import normalise
from mvps.scene import Bool, Float, Int
from solvers.linear import CholeskyLike

HELD = 1e-9
"""Weight of w itself where a frame cuts the mask off: no outline may end a chord."""


def inflated_normals(mask: Bool) -> Float:
    """(pixels, 3) unit normals, camera frame, of the foreground pixels of mask (height, width) in row-major order."""
    w = _inflated(mask)
    padded = _beyond_frame(w, mask)
    down, right = (np.gradient(padded, axis=axis)[1:-1, 1:-1][mask] for axis in (0, 1))
    return normalise(np.stack([-right / 2, -down / 2, -np.sqrt(np.maximum(w[mask], 0))], -1))


def _inflated(mask: Bool) -> Float:
    """(height, width) w, 0 outside of the mask."""
    number = np.full(mask.shape, -1)
    number[mask] = np.arange(int(mask.sum()))
    count = int(mask.sum())
    row, column, upright = _pairs(mask)
    y, x = np.nonzero(mask)
    ends = [np.isin(of, (0, size - 1)) for of, size in zip((y, x), mask.shape, strict=True)]
    # Across the frame a second difference is -2 whatever w is; along it the other one is.
    cut = ends[0].astype(int) + ends[1]
    kept = ~np.where(upright, ends[0][row], ends[1][row])
    laplacian = sp.diags(4.0 - 2 * cut) - sp.coo_matrix((np.ones(kept.sum()), (row[kept], column[kept])), shape=(count, count))
    right = 4.0 - 2 * cut
    w = np.zeros(mask.shape)
    if not cut.any():
        w[mask] = CholeskyLike(laplacian).solve(right[:, None])[:, 0]
        return w
    for corner in np.flatnonzero(cut == 2) if min(mask.shape) > 1 else ():
        # Of a corner of the frame neither says anything; there w_xy is 0, as a ball's is.
        inward = np.array([1 if at == 0 else -1 for at in (y[corner], x[corner])])
        beside = [number[y[corner] + a * inward[0], x[corner] + b * inward[1]] for a, b in ((1, 0), (0, 1), (1, 1))]
        known = np.array([(k, of) for k, of in zip(beside, (-1.0, -1.0, 1.0), strict=True) if k >= 0]).reshape(-1, 2)
        at = np.append(known[:, 0].astype(int), corner)
        laplacian += sp.coo_matrix((np.append(known[:, 1], 1.0), (np.full(len(at), corner), at)), shape=(count, count))
        right[corner] = 0.0
    w[mask] = spsolve(sp.csc_matrix(laplacian + HELD * sp.identity(count)), right)
    return w


def _pairs(mask: Bool) -> tuple[Int, Int, Bool]:
    """Pixels of the mask (n,) that stand beside others of it (n,), by their numbers, and whether one above the other."""
    padded = np.pad(np.full(mask.shape, -1), 1, constant_values=-1)
    padded[1:-1, 1:-1][mask] = np.arange(int(mask.sum()))
    inside, rows, columns, across = padded >= 0, [], [], []
    for step, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):
        neighbour = np.roll(padded, step, axis)[inside]
        rows.append(np.flatnonzero(neighbour >= 0))
        columns.append(neighbour[neighbour >= 0])
        across.append(np.full(len(rows[-1]), axis == 0))
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(across)


def _beyond_frame(w: Float, mask: Bool) -> Float:
    """(height + 2, width + 2) w with what it goes on to beyond the frame where that cuts the mask off, else 0."""
    padded = np.pad(w, 1)
    if min(w.shape) > 1:
        padded[0, 1:-1] = np.where(mask[0], 2 * w[0] - w[1] - 2, 0)
        padded[-1, 1:-1] = np.where(mask[-1], 2 * w[-1] - w[-2] - 2, 0)
        padded[1:-1, 0] = np.where(mask[:, 0], 2 * w[:, 0] - w[:, 1] - 2, 0)
        padded[1:-1, -1] = np.where(mask[:, -1], 2 * w[:, -1] - w[:, -2] - 2, 0)
    return padded
