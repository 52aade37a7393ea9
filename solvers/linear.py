"""Sparse symmetric positive definite systems: factor once, solve many, and nearby ones by preconditioned conjugate gradients.

A = P^T L U P by SuperLU in symmetric mode (minimum degree ordering of A + A^T, no pivoting off the diagonal), which for a
positive definite matrix is as stable as Cholesky's factorisation (Golub and Van Loan 2013, section 4.2).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import NDArray

TOLERANCE = 1e-9
"""Of the residual in `nearby`, relative: far below the error of any measurement, far above rounding."""


class CholeskyLike:
    """The factor of a sparse symmetric positive definite matrix (n, n)."""

    def __init__(self, matrix: sp.spmatrix) -> None:
        self._factor = spl.splu(sp.csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def solve(self, right: NDArray[Any]) -> NDArray[np.float64]:
        """x (n,) or (n, k) with A x = right."""
        solution: NDArray[np.float64] = self._factor.solve(np.ascontiguousarray(right, dtype=np.float64))
        return solution

    def nearby(self, matrix: sp.spmatrix, right: NDArray[Any], start: NDArray[Any]) -> NDArray[np.float64]:
        """x (n, k) with matrix x = right (n, k) for a matrix near the factored one, from `start` (n, k)."""
        preconditioner = spl.LinearOperator(matrix.shape, self._factor.solve)
        columns = [spl.cg(matrix, b, x0, rtol=TOLERANCE, M=preconditioner)[0] for b, x0 in zip(right.T, start.T, strict=True)]
        return np.stack(columns, axis=1)
