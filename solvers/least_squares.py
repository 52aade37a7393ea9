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

RAISES = tuple(10.0**k for k in range(-6, 4))
"""Of a diagonal, one after the other."""


def _entries_first(values: Tensor) -> Tensor:
    """(p[, k], n) of values (n, p[, k]): operations of a few entries each then run along all problems, which on a CPU takes a quarter of
    the time."""
    # A copy in any case: of one problem, or one unknown, the order of the numbers is the same.
    return values.movedim(0, -1).clone(memory_format=torch.contiguous_format)


def _damped(hessian: Tensor, damping: float) -> Tensor:
    """H (n, p, p) as (p, p, n) with its diagonal raised: positive definite for every positive semidefinite H."""
    H = _entries_first(hessian)
    diagonal = H.diagonal().T
    diagonal += damping * diagonal + FLOOR * diagonal.amax(0) + torch.finfo(H.dtype).tiny ** 0.5
    return H


def bounded_step(hessian: Tensor, gradient: Tensor, lower: Tensor, damping: float = 1e-3) -> Tensor:
    """Steps d (n, p) for H (n, p, p), g (n, p), lower (n, p) <= 0 (-inf where free)."""
    H, wanted, lower = _damped(hessian, damping), _entries_first(-gradient), _entries_first(lower)
    fixed = torch.zeros_like(wanted, dtype=torch.bool)
    step = _solved(H, wanted[:, None])[:, 0]
    for _ in range(len(H)):
        violated = (step < lower) & ~fixed
        rows = violated.any(0).nonzero()[:, 0]
        if not len(rows):
            break
        fixed[:, rows] |= violated[:, rows]
        step[:, rows] = _solved_with_fixed(H[..., rows], wanted[:, rows], lower[:, rows], fixed[:, rows])
    return torch.maximum(step, lower).T.contiguous()


def _solved_with_fixed(H: Tensor, wanted: Tensor, lower: Tensor, fixed: Tensor) -> Tensor:
    """Steps (p, n) where the fixed unknowns sit at their bound: their rows and columns become the identity's."""
    value = torch.where(fixed, lower, 0)
    right = torch.where(fixed, value, wanted - (H * value).sum(1))
    free = (~fixed).to(H.dtype)
    masked = H * free[:, None] * free
    masked.diagonal().T.add_(1 - free)
    return _solved(masked, right[:, None])[:, 0]


def columns_of_inverse(hessian: Tensor, wanted: int, damping: float = 1e-3) -> Tensor:
    """(n, p, wanted) first columns of the inverses of the damped H (n, p, p)."""
    H = _damped(hessian, damping)
    unit = torch.eye(len(H), wanted, dtype=H.dtype, device=H.device)
    return _solved(H, unit[..., None].expand(-1, -1, H.shape[2])).movedim(-1, 0).contiguous()


def _solved(H: Tensor, right: Tensor) -> Tensor:
    """x (p, k, n) with H x = right (p, k, n), H (p, p, n) positive definite; 0 where it is singular. By Gauss's elimination, which needs
    no pivots here."""
    # Scaling to a unit diagonal first keeps the float32 factorisation accurate when the unknowns have different units.
    scale = H.diagonal().T.clamp_min(1e-30).rsqrt()
    H, x = H * scale[:, None] * scale, right * scale[:, None]
    for k in range(len(H)):
        ratio = H[k + 1 :, k] / H[k, k]
        H[k + 1 :, k + 1 :] -= ratio[:, None] * H[k, k + 1 :]
        x[k + 1 :] -= ratio[:, None] * x[k]
    for k in reversed(range(len(H))):
        x[k] = (x[k] - (H[k, k + 1 :, None] * x[k + 1 :]).sum(0)) / H[k, k]
    x *= scale[:, None]
    return torch.where(torch.isfinite(x), x, 0)


def damped_solution(H: Tensor, right: Tensor) -> Tensor:
    """x (n,) with H x = right (n,), H (n, n) float64 positive definite but for rounding: by Cholesky's factor, and where there is none with
    the diagonal raised by as little of itself as it takes (Levenberg 1944). 0 where nothing helps."""
    diagonal = H.diagonal().abs()
    for damping in (0, *RAISES):
        factor, failed = torch.linalg.cholesky_ex(H + torch.diag(damping * diagonal) if damping else H)
        if not failed:
            return torch.cholesky_solve(right[:, None], factor)[:, 0]
    return torch.zeros_like(right)


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
