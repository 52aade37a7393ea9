"""Batched small least-squares problems on tensors: Gauss-Newton steps with damping and lower bounds, and robust rows.

For each of n problems with normal equations H (p, p), g (p,):   minimise over d   1/2 d.H d + g.d   subject to d >= lower.

Levenberg-Marquardt damping adds `damping` times the diagonal (Marquardt's scaling, invariant to the units of the unknowns), plus a floor
for unknowns that no sample speaks of, so that the step is finite and zero along them.

The bounds are met by fixing the violated unknowns at their bound and solving again for the rest, at most p times (the fixing half of
block principal pivoting, Portugal et al. 1994): every fixed unknown wanted to go below its bound.

Robust rows: x_i that minimise sum_j w_ij rho((M_ij - x_i . y_j) / s_i) for known y_j, by reweighted least squares with the weights and
scales of low_rank.py, which solves for both factors (in numpy).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from solvers.low_rank import CAUCHY_95, MAD_TO_SIGMA

FLOOR = 1e-7
"""Damping of an unknown relative to the largest diagonal entry of its problem: above float32's rounding, below any measurement."""


def damped(hessian: Tensor, damping: float) -> Tensor:
    """H (n, p, p) with its diagonal raised: positive definite for every positive semidefinite H."""
    diagonal = torch.diagonal(hessian, dim1=1, dim2=2)
    largest = diagonal.amax(1, keepdim=True)
    extra = damping * diagonal + FLOOR * largest + torch.finfo(hessian.dtype).tiny ** 0.5
    return hessian + torch.diag_embed(extra)


def bounded_step(hessian: Tensor, gradient: Tensor, lower: Tensor, damping: float = 1e-3) -> Tensor:
    """Steps d (n, p) for H (n, p, p), g (n, p), lower (n, p) <= 0 (-inf where free)."""
    H = damped(hessian, damping)
    fixed = torch.zeros_like(gradient, dtype=torch.bool)
    step = _solve_with_fixed(H, gradient, lower, fixed)
    for _ in range(gradient.shape[1]):
        violated = (step < lower) & ~fixed
        rows = violated.any(1).nonzero()[:, 0]
        if not len(rows):
            break
        fixed[rows] |= violated[rows]
        step[rows] = _solve_with_fixed(H[rows], gradient[rows], lower[rows], fixed[rows])
    return torch.maximum(step, lower)


def _solve_with_fixed(H: Tensor, gradient: Tensor, lower: Tensor, fixed: Tensor) -> Tensor:
    """Steps where the fixed unknowns sit at their bound: their rows and columns become the identity's."""
    value = torch.where(fixed, lower, torch.zeros_like(lower))
    right = -gradient - (H @ value[..., None])[..., 0]
    right = torch.where(fixed, value, right)
    free = (~fixed).to(H.dtype)
    masked = H * free[:, :, None] * free[:, None, :] + torch.diag_embed(1 - free)
    return _solved(masked, right)


def columns_of_inverse(hessian: Tensor, wanted: int, damping: float = 1e-3) -> Tensor:
    """(n, p, wanted) first columns of the inverses of the damped H (n, p, p)."""
    H = damped(hessian, damping)
    unit = torch.eye(H.shape[1], wanted, dtype=H.dtype, device=H.device)
    return _solved(H, unit.expand(len(H), -1, -1))


def _solved(H: Tensor, right: Tensor) -> Tensor:
    """x (n, p[, k]) with H x = right (n, p[, k]); 0 where H is singular."""
    # Scaling to a unit diagonal first keeps the float32 factorisation accurate when the unknowns have different units.
    scale = torch.diagonal(H, dim1=1, dim2=2).clamp_min(1e-30).rsqrt()
    scaled = H * scale[:, :, None] * scale[:, None, :]
    matrix = right if right.ndim == 3 else right[..., None]
    solution: Tensor = torch.linalg.solve_ex(scaled, matrix * scale[..., None])[0] * scale[..., None]
    solution = torch.where(torch.isfinite(solution), solution, torch.zeros_like(solution))
    return solution if right.ndim == 3 else solution[..., 0]


def weighted_rows(M: Tensor, W: Tensor, Y: Tensor, ridge: float) -> Tensor:
    """(m, r) rows x_i that minimise sum_j W_ij (M_ij - x_i . y_j)^2 for M, W (m, n), Y (n, r), damped by `ridge` of the mean diagonal."""
    r = Y.shape[1]
    A = (W @ (Y[:, :, None] * Y[:, None, :]).view(-1, r * r)).view(-1, r, r)
    trace = A.diagonal(dim1=1, dim2=2).sum(1) / r
    A = A + (ridge * trace + 1e-30)[:, None, None] * torch.eye(r, dtype=A.dtype, device=A.device)
    solution: Tensor = torch.linalg.solve_ex(A, ((W * M) @ Y)[..., None])[0][..., 0]
    return solution


def ascending(rows: Tensor) -> Tensor:
    """Rows (m, n), each in ascending order. On a CPU numpy sorts a dozen numbers in a seventh of torch's time."""
    if rows.device.type == "cpu":
        return torch.from_numpy(np.sort(rows.numpy(), axis=1))
    return rows.sort(dim=1).values


def cauchy_weights(residual: Tensor, known: Tensor, floor: float) -> Tensor:
    """Cauchy's weights of residuals (m, n), 0 where not known (m, n), the scale of a row from its known entries and at least `floor`."""
    ordered = ascending(torch.where(known > 0, residual.abs(), torch.inf))
    count = (known > 0).sum(1, keepdim=True)
    median = (ordered.gather(1, ((count - 1) // 2).clamp_min(0)) + ordered.gather(1, count // 2)) / 2
    # A row without entries has no scale and needs none.
    scale = (torch.where(count > 0, median, 1.0) * MAD_TO_SIGMA).clamp_min(max(floor, torch.finfo(residual.dtype).tiny))
    return known / (1 + (residual / (CAUCHY_95 * scale)) ** 2)
