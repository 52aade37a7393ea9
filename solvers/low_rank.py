"""Robust factorisation of a matrix with missing entries into low-rank factors.

    minimise  sum_ij w_ij rho((M_ij - x_i . y_j) / s_i)      M (m, n),  X (m, r),  Y (n, r)

by alternating weighted least squares: each row of X, then each row of Y, is a small r x r problem. rho is Cauchy's
log(1 + u^2) / 2, with weight 1 / (1 + u^2) recomputed in every sweep (Holland and Welsch 1977); the scale s_i of a row
is the median absolute residual of that row times 1.4826 / efficiency constant 2.385.

The rows of M that are complete start the iteration by a singular value decomposition.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CAUCHY_95 = 2.385
"""Cauchy's tuning constant: 95 % efficiency on normal noise."""

MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""


@dataclass(frozen=True)
class Factorisation:
    """M ~ left @ right.T: left (m, r), right (n, r); weight (m, n) final robust weights; residual: weighted relative RMS;
    singular_values (min(n, 2 r),) of the complete rows, scaled to a first value of 1."""

    left: NDArray[np.float64]
    right: NDArray[np.float64]
    weight: NDArray[np.float32]
    residual: float
    singular_values: NDArray[np.float64]


def solve_rows(M: NDArray[Any], W: NDArray[Any], Y: NDArray[Any], ridge: float = 1e-9) -> NDArray[np.float64]:
    """(m, r) rows x_i that minimise sum_j W_ij (M_ij - x_i . y_j)^2, damped by `ridge` of the mean diagonal."""
    r = Y.shape[1]
    pairs = (Y[:, :, None] * Y[:, None, :]).reshape(len(Y), r * r)
    A = (W @ pairs).reshape(-1, r, r)
    trace = np.trace(A, axis1=1, axis2=2) / r
    A += (ridge * trace + 1e-30)[:, None, None] * np.eye(r)
    b = (W * M) @ Y
    solution: NDArray[np.float64] = np.linalg.solve(A, b[..., None])[..., 0]
    return solution


def of_length_one(M: NDArray[Any], known: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rows of M (m, n) over the root mean square of their known (m, n) samples, and these (m,), one where a row has none: all count alike,
    where by their largest samples those that have few would outweigh all others."""
    level = np.sqrt((known * M**2).sum(1) / np.maximum(known.sum(1), 1))
    level = np.where(level > 0, level, 1.0)
    return M / level[:, None], level


def robust_weights(residual: NDArray[Any], known: NDArray[Any], floor: float) -> NDArray[np.float64]:
    """Cauchy weights of residuals (m, n), scale per row from its known entries; `floor` is the smallest scale (noise)."""
    # Unknown entries are sorted to the end: numpy's nanmedian is many times slower.
    ordered = np.sort(np.where(known > 0, np.abs(residual), np.inf), axis=1)
    count = (known > 0).sum(1)
    middle = [np.take_along_axis(ordered, np.maximum(k, 0)[:, None], 1) for k in ((count - 1) // 2, count // 2)]
    # A row without entries has no scale and needs none.
    median = np.where(count[:, None] > 0, (middle[0] + middle[1]) / 2, 1.0)
    scale = np.maximum(median * MAD_TO_SIGMA, max(floor, np.finfo(np.float64).tiny))
    weights: NDArray[np.float64] = known / (1 + (residual / (CAUCHY_95 * scale)) ** 2)
    return weights


FULLEST = 2
"""Times the rank: the least number of rows, those with most known entries, that factors start from."""


def factorise(M: NDArray[Any], known: NDArray[Any], rank: int, sweeps: int = 20, floor: float = 0.0) -> Factorisation:
    """Robust factors of M (m, n), entries with known = 0 ignored; rows should have comparable scale.

    floor is the noise level of an entry: no robust scale goes below it. Raises ValueError where M has fewer columns or rows than rank.
    """
    for side, given in zip(("rows", "columns"), M.shape, strict=True):
        if given < rank:
            raise ValueError(f"factorise: wanted at least {rank} {side}, given {given}")
    known = known.astype(np.float64)
    fullness = known.mean(1)
    complete = fullness >= min(1.0, float(np.quantile(fullness, 0.9)))
    if complete.sum() < FULLEST * rank:
        complete = np.isin(np.arange(len(M)), np.argsort(-fullness, kind="stable")[: FULLEST * rank])
    _, s, Vt = np.linalg.svd(np.where(known > 0, M, 0)[complete], full_matrices=False)
    right = Vt[:rank].T * s[:rank] / np.sqrt(complete.sum())
    W = known
    for _ in range(sweeps):
        left = solve_rows(M, W, right)
        W = robust_weights(M - left @ right.T, known, floor)
        right = solve_rows(M.T, W.T, left)
    left = solve_rows(M, W, right)
    residual = M - left @ right.T
    relative = float(np.sqrt((W * residual**2).sum() / max((W * M**2).sum(), 1e-300)))
    return Factorisation(left, right, W.astype(np.float32), relative, s[: 2 * rank] / s[0])
