"""A neural occupancy field: the visual hull's signed distance plus a residual from feature grids and a small network.

    signed_distance(x) = base(x) + sum_l g_l0(x) + network(g_11(x), ..., g_LF(x)),
    occupancy(x)       = sigmoid(-signed_distance(x) / width)

base is the hull's signed distance and g_lf the features of level l, both interpolated trilinearly; level l + 1 is twice
as fine as level l. The first feature of every level enters the sum directly: with it the signed distance is linear in
most of its parameters, and the losses on its gradient are nearly quadratic. At the start the residual is zero.
The network's further outputs are the colour at x. Lengths are pixels (see occupancy.py), so that the width, the grids'
spacings and the learning rates mean the same for every capture.

Gradients are central differences over a tetrahedron, which also needs no second derivatives of the interpolation:

    grad d(x) ~ sum_i k_i d(x + step k_i) / (4 step),    k = (1,1,1), (1,-1,-1), (-1,1,-1), (-1,-1,1).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

BITS = tuple((a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1))

TETRAHEDRON = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))


class Lattice(NamedTuple):
    """Nodes of several nested grids, kept in one table: origin (3,), spacing (levels,), size (levels, 3), first row (levels,)."""

    origin: Tensor
    spacing: Tensor
    size: Tensor
    first: Tensor

    def finest(self, levels: int) -> Lattice:
        """The first `levels` grids."""
        return Lattice(self.origin, self.spacing[:levels], self.size[:levels], self.first[:levels])

    def nodes(self) -> int:
        """Rows of the table."""
        return int(self.first[-1] + self.size[-1].prod())


def lattice(low: Tensor, high: Tensor, spacings: list[float]) -> Lattice:
    """Grids that cover the box from low (3,) to high (3,) at these spacings."""
    spacing = torch.tensor(spacings, dtype=torch.float32, device=low.device)
    size = (((high - low) / spacing[:, None]).ceil().long() + 1).clamp_min(2)
    rows = size.prod(1)
    return Lattice(low, spacing, size, torch.cumsum(rows, 0) - rows)


class Corners(NamedTuple):
    """The 8 nodes around n points in each grid: rows (levels, n, 8) of the table, their weights (levels, n, 8), and the points'
    position within the cell (3, levels, n)."""

    rows: Tensor
    weight: Tensor
    fraction: Tensor


def corners(grids: Lattice, points: Tensor) -> Corners:
    """Corners of the cells around points (n, 3). Points outside a grid are moved to its border.

    The points' axis is innermost until the end: torch's loops are fast only along a long last axis.
    """
    size = grids.size.T[..., None]
    position = (points.T[:, None] - grids.origin[:, None, None]) / grids.spacing[:, None]
    cell = torch.minimum(position.floor().clamp_min_(0), (size - 2).to(points.dtype))
    near = position.sub_(cell).clamp_(0, 1)
    sides = torch.stack([1 - near, near])
    i, j, k = cell.to(torch.int32)
    stride = torch.stack([size[1] * size[2], size[2], torch.ones_like(size[2])]).to(torch.int32)
    base = i * stride[0] + j * stride[1] + k + grids.first[:, None].to(torch.int32)
    rows = torch.empty((8, *base.shape), dtype=torch.int32, device=points.device)
    weight = torch.empty((8, *base.shape), dtype=points.dtype, device=points.device)
    for corner, (a, b, c) in enumerate(BITS):
        torch.add(base, a * stride[0] + b * stride[1] + c, out=rows[corner])
        torch.mul(sides[a, 0] * sides[b, 1], sides[c, 2], out=weight[corner])
    return Corners(rows.permute(1, 2, 0).contiguous(), weight.permute(1, 2, 0).contiguous(), near)


def _slope(fraction: Tensor, axis: int) -> Tensor:
    """(levels, n, 8) derivative of the corners' weights along one axis of the cell."""
    sides = torch.stack([1 - fraction, fraction])
    sides[0, axis], sides[1, axis] = -1, 1
    return torch.stack([sides[a, 0] * sides[b, 1] * sides[c, 2] for a, b, c in BITS], -1)


class Interpolation(torch.autograd.Function):
    """Trilinear interpolation of table rows (rows, features) -> (levels, n, features), differentiable in table and points."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, points: Tensor, grids: Lattice) -> Tensor:
        rows, weight, fraction = corners(grids, points)
        ctx.save_for_backward(table, rows, weight, fraction)
        ctx.spacing = grids.spacing
        summed = nn.functional.embedding_bag(rows.view(-1, 8), table, mode="sum", per_sample_weights=weight.view(-1, 8))
        return summed.view(*rows.shape[:2], -1)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        table, rows, weight, fraction = ctx.saved_tensors
        gradient = gradients[0]
        rows = rows.view(-1).long()
        to_table = to_points = None
        if ctx.needs_input_grad[0]:
            spread = weight[..., None] * gradient[..., None, :]
            to_table = torch.zeros_like(table).index_add_(0, rows, spread.view(-1, table.shape[1]))
        if ctx.needs_input_grad[1]:
            corner = (table.index_select(0, rows).view(*weight.shape, -1) * gradient[..., None, :]).sum(-1)
            slopes = [((corner * _slope(fraction, axis)).sum(-1) / ctx.spacing[:, None]).sum(0) for axis in range(3)]
            to_points = torch.stack(slopes, -1)
        return to_table, to_points, None


def interpolate(table: Tensor, points: Tensor, grids: Lattice) -> Tensor:
    """Values (levels, n, features) at points (n, 3) of a table (rows, features) on the nodes of grids."""
    result: Tensor = Interpolation.apply(table, points, grids)  # type: ignore[no-untyped-call]
    return result


class OccupancyField(nn.Module):
    """Signed distance and colour at points; lengths in pixels."""

    def __init__(
        self,
        base: Tensor,
        base_grid: Lattice,
        grids: Lattice,
        features: int,
        hidden: int,
        colours: int,
        generator: torch.Generator,
    ) -> None:
        """base (nodes, 1) is the hull's signed distance on the nodes of base_grid."""
        super().__init__()
        self.base, self.base_grid, self.grids = base, base_grid, grids
        width = len(grids.spacing) * features
        table = 0.1 * torch.randn(grids.nodes(), features, generator=generator)
        table[:, 0] = 0
        self.features = table.to(base.device)
        self.activate(len(grids.spacing))
        first = torch.randn(hidden, width, generator=generator) * (2 / width) ** 0.5
        self.first = nn.Parameter(first.to(base.device))
        self.first_bias = nn.Parameter(torch.zeros(hidden, device=base.device))
        self.last = nn.Parameter(torch.zeros(1 + colours, hidden, device=base.device))
        self.last_bias = nn.Parameter(torch.zeros(1 + colours, device=base.device))

    def activate(self, levels: int) -> None:
        """Use the first `levels` grids only; `table`, whose gradients training asks for, is their part of the features."""
        self.active = self.grids.finest(levels)
        self.table = nn.Parameter(self.features[: self.active.nodes()])

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (n,) and colour (n, colours) at points (n, 3)."""
        base = interpolate(self.base, points, self.base_grid).view(-1)
        features = interpolate(self.table, points, self.active)
        flat = features.transpose(0, 1).flatten(1)
        hidden = torch.relu(torch.addmm(self.first_bias, flat, self.first[:, : flat.shape[1]].T))
        out = torch.addmm(self.last_bias, hidden, self.last.T)
        return base + features[..., 0].sum(0) + out[:, 0], out[:, 1:]

    def signed_distance(self, points: Tensor) -> Tensor:
        """(n,) signed distance at points (n, 3)."""
        distance: Tensor = self(points)[0]
        return distance


class SampledField:
    """A field's signed distance on the nodes of one grid, interpolated in between."""

    def __init__(self, values: Tensor, grid: Lattice) -> None:
        """values (nodes, 1)."""
        self.values, self.grid = values, grid

    def signed_distance(self, points: Tensor) -> Tensor:
        """(n,) signed distance at points (n, 3)."""
        return interpolate(self.values, points, self.grid).view(-1)


def gradient(field: Any, points: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Gradient (n, 3) and mean (n,) of the field's signed distance over a tetrahedron of half-edge `step` around points (n, 3)."""
    offset = torch.tensor(TETRAHEDRON, device=points.device, dtype=points.dtype)
    around = (points[:, None] + step * offset).view(-1, 3)
    value = field.signed_distance(around).view(-1, 4)
    return value @ offset / (4 * step), value.mean(1)
