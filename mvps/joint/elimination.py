"""Vertices eliminated from the equations of lights and law (lights.py has these):

    sum_j H_mj (H_jj + P_j)^-1 H_jm = sum_j half_j^T half_j,        half_j = L_j^-1 H_jm,    L_j L_j^T = H_jj + P_j

Under one rig H_jm has a column for every light. Where every view has lights of its own it is sparse, since a vertex is nothing to the
lights of a view that does not see it: of the products of two views' columns only those of vertices that both see are formed. Of 20 views
with 96 lights each that is an eighth of all, and both triangles are the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from mvps.cores import on_cores
from mvps.joint.patches import Patches

VERTICES_PER_BLOCK, COLUMNS_PER_BLOCK = 512, 49152
"""Vertices that are eliminated at once, and more where a view has few lights, up to so many columns: derivatives stay in the processor's
cache, and products are large enough for it."""


@dataclass(frozen=True)
class Reduced:
    """H (m, m) and g (m,) of the equations of lights and law, less what eliminated vertices take from them; E (k, 2, 2), F (k, 2, m) and
    f (k, 2) of the patches."""

    H: Tensor
    g: Tensor
    E: Tensor
    F: Tensor
    f: Tensor


@dataclass(frozen=True)
class Blocks:
    """H_jj + P_j (V, p, p) and g_j (V, p) of the vertices, 0 where free (V, p) is 0: weights at their bound are no unknowns."""

    hessian: Tensor
    gradient: Tensor
    free: Tensor

    def of(self, part: slice) -> Blocks:
        """Only some of the vertices."""
        return Blocks(self.hessian[part], self.gradient[part], self.free[part])


@dataclass(frozen=True)
class _Half:
    """L^-1 H_jm, with L L^T = H_jj + P_j, in some columns of m, of those of n vertices that have any: rows (k,), in order; place (n,)
    where they stand among these, -1 for others; values (k, p, columns)."""

    columns: slice
    rows: Tensor
    place: Tensor
    values: Tensor

    def of_common_vertices(self, other: _Half) -> tuple[Tensor, Tensor]:
        """Values of the vertices that both have."""
        if len(self.rows) == len(self.place) == len(other.rows):
            return self.values, other.values
        there = other.place[self.rows]
        common = (there >= 0).nonzero()[:, 0]
        return self.values.index_select(0, common), other.values.index_select(0, there[common])


def _half(derivatives: Tensor, L: Tensor, free: Tensor, columns: slice) -> _Half:
    """Of derivatives (n, p, columns), L (n, p, p) and what is free (n, p): the lights of a view are nothing to vertices it does not see."""
    rows = derivatives.flatten(1).any(1).nonzero()[:, 0]
    place = torch.full((len(L),), -1, dtype=torch.long, device=L.device)
    place[rows] = torch.arange(len(rows), device=L.device)
    if len(rows) < len(place):
        derivatives, L, free = derivatives[rows], L[rows], free[rows]
    return _Half(columns, rows, place, torch.linalg.solve_triangular(L, derivatives * free.double()[..., None], upper=False))


def eliminated(H: Tensor, g: Tensor, derivatives: list[Tensor], blocks: Blocks, A: Tensor, patches: Patches) -> Reduced:
    """Vertices whose H_jm (V, p, m) comes in parts (V, p, columns), of each rig, then of the law; A (V, 2, 2) as in patches.py. H and g
    are changed in place: where every view has lights of its own there is no room for copies."""
    count, ends = patches.count, [0, *accumulate(d.shape[2] for d in derivatives)]
    total = Reduced(H, g, *(A.new_zeros(count, 2, *shape) for shape in ((2,), (ends[-1],), ())))
    step = max(VERTICES_PER_BLOCK, COLUMNS_PER_BLOCK // max(d.shape[2] for d in derivatives))
    for start in range(0, len(A), step):
        part = slice(start, start + step)
        columns = [(d[part], slice(*ends[k : k + 2])) for k, d in enumerate(derivatives)]
        _eliminate(total, columns, blocks.of(part), A[part], patches.of[part])
    return total


def _eliminate(total: Reduced, derivatives: list[tuple[Tensor, slice]], blocks: Blocks, A: Tensor, of: Tensor) -> None:
    """Adds to the total, in place, what some vertices add: n of patches `of` (n,). Columns are dealt to the cores: each writes where no
    other does."""
    L = torch.linalg.cholesky(blocks.hessian.double())
    # L^-1 of the normals' columns: products of two such halves have the inverse of the whole block between them.
    unit = torch.eye(L.shape[1], 2, dtype=L.dtype, device=L.device).expand(len(L), -1, -1)
    normals = A @ torch.linalg.solve_triangular(L, unit, upper=False).transpose(1, 2)
    right = torch.linalg.solve_triangular(L, blocks.gradient.double()[..., None], upper=False)
    total.E.index_add_(0, of, normals @ normals.transpose(1, 2))
    total.f.index_add_(0, of, (normals @ right)[..., 0])
    halves = on_cores(lambda one: _half(one[0], L, blocks.free, one[1]), derivatives)

    def multiply(k: int) -> None:
        one = halves[k]
        total.F[..., one.columns].index_add_(0, of[one.rows], normals[one.rows] @ one.values)
        total.g[one.columns] -= one.values.flatten(0, 1).T @ right[one.rows].flatten()
        for other in halves[: k + 1]:
            mine, others = one.of_common_vertices(other)
            product = mine.flatten(0, 1).T @ others.flatten(0, 1)
            total.H[one.columns, other.columns] -= product
            if other is not one:
                total.H[other.columns, one.columns] -= product.T

    on_cores(multiply, range(len(halves)))
