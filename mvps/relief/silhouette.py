"""Rough normals from a silhouette alone: the mask blown up like a balloon.

With depth z over the image plane and w = z^2, a ball has the Laplacian of w = -4 and w = 0 on its outline (Poisson's equation on a mask,
in the spirit of Prasad and Fitzgibbon 2006, "Single view reconstruction of curved surfaces"). For any mask the solution of

    Laplace w = -4 inside,   w = 0 outside,      n ~ (-w_x / 2, -w_y / 2, -sqrt(w))      camera frame, x right, y down, z forward

has normals that are perpendicular to the outline there, as those of every smooth object are, and is a ball's where the mask is a disc.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from mvps.mesh import normalise
from mvps.scene import Bool, Float
from solvers.linear import CholeskyLike


def inflated_normals(mask: Bool) -> Float:
    """(pixels, 3) unit normals, camera frame, of the foreground pixels of mask (height, width) in row-major order."""
    count = int(mask.sum())
    padded = np.pad(np.full(mask.shape, -1), 1, constant_values=-1)
    padded[1:-1, 1:-1][mask] = np.arange(count)
    inside = padded >= 0
    rows, columns = [], []
    for step, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):
        neighbour = np.roll(padded, step, axis)[inside]
        rows.append(np.flatnonzero(neighbour >= 0))
        columns.append(neighbour[neighbour >= 0])
    row, column = np.concatenate(rows), np.concatenate(columns)
    laplacian = sp.identity(count) * 4 - sp.coo_matrix((np.ones(len(row)), (row, column)), shape=(count, count))
    w = np.zeros(padded.shape)
    w[inside] = CholeskyLike(laplacian).solve(np.full((count, 1), 4.0))[:, 0]
    down, right = np.gradient(w)
    return normalise(np.stack([-right[inside] / 2, -down[inside] / 2, -np.sqrt(w[inside])], -1))
