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

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn


class Grid:
    """The nodes of a grid: the first at low (3,), the others `spacing` apart, size (3,) of them."""

    def __init__(self, low: Tensor, spacing: float, size: Sequence[int]) -> None:
        self.low, self.size = low, tuple(size)
        # torch wants points from -1 at the first node to 1 at the last.
        self.scale = 2 / (spacing * (torch.tensor(self.size, dtype=low.dtype, device=low.device) - 1))

    def interpolate(self, values: Tensor, points: Tensor) -> Tensor:
        """(n, features) values (1, features, *size) at points (n, 3), trilinear; beyond the grid those of its border."""
        # Last axis first.
        at = ((points - self.low) * self.scale - 1).flip(1).view(1, 1, 1, -1, 3)
        return nn.functional.grid_sample(values, at, padding_mode="border", align_corners=True).view(values.shape[1], -1).T


def covering(low: Tensor, high: Tensor, spacing: float) -> Grid:
    """A grid over the box from low (3,) to high (3,) or a little beyond."""
    size = (((high - low) / spacing).ceil().long() + 1).clamp_min(2)
    return Grid(low, spacing, size.tolist())


class OccupancyField(nn.Module):
    """Signed distance and colour at points; lengths in pixels."""

    def __init__(
        self, base: Tensor, base_grid: Grid, grids: Sequence[Grid], features: int, hidden: int, colours: int, generator: torch.Generator
    ) -> None:
        """base (x, y, z) is the hull's signed distance on the nodes of base_grid; grids from coarse to fine."""
        super().__init__()
        self.base, self.base_grid, self.grids = base[None, None], base_grid, grids
        width = len(grids) * features
        self.features = nn.ParameterList()
        for grid in grids:
            values = 0.1 * torch.randn(1, features, *grid.size, generator=generator)
            values[:, 0] = 0
            self.features.append(nn.Parameter(values.to(base.device)))
        self.activate(len(grids))
        first = torch.randn(hidden, width, generator=generator) * (2 / width) ** 0.5
        self.first = nn.Parameter(first.to(base.device))
        self.first_bias = nn.Parameter(torch.zeros(hidden, device=base.device))
        self.last = nn.Parameter(torch.zeros(1 + colours, hidden, device=base.device))
        self.last_bias = nn.Parameter(torch.zeros(1 + colours, device=base.device))

    def activate(self, levels: int) -> None:
        """Use the first `levels` grids only."""
        self.active = levels

    def network(self) -> list[nn.Parameter]:
        """The network's weights and biases."""
        return [self.first, self.first_bias, self.last, self.last_bias]

    def in_use(self) -> list[nn.Parameter]:
        """The features of the grids in use."""
        return list(self.features[: self.active])

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (n,) and colour (n, colours) at points (n, 3)."""
        base = self.base_grid.interpolate(self.base, points)[:, 0]
        features = [grid.interpolate(values, points) for grid, values in zip(self.grids[: self.active], self.in_use(), strict=True)]
        flat = torch.cat(features, 1)
        hidden = torch.relu(torch.addmm(self.first_bias, flat, self.first[:, : flat.shape[1]].T))
        out = torch.addmm(self.last_bias, hidden, self.last.T)
        return base + sum(of_level[:, 0] for of_level in features) + out[:, 0], out[:, 1:]

    def signed_distance(self, points: Tensor) -> Tensor:
        """(n,) signed distance at points (n, 3)."""
        distance: Tensor = self(points)[0]
        return distance


class SampledField:
    """A field's signed distance (x, y, z) on the nodes of one grid, interpolated in between."""

    def __init__(self, values: Tensor, grid: Grid) -> None:
        self.values, self.grid = values[None, None], grid

    def signed_distance(self, points: Tensor) -> Tensor:
        """(n,) signed distance at points (n, 3)."""
        return self.grid.interpolate(self.values, points)[:, 0]


def gradient(field: Any, points: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Gradient (n, 3) and mean (n,) of the field's signed distance over a tetrahedron of half-edge `step` around points (n, 3)."""
    # Made on the device: a copy from the host would wait for all that is under way there.
    offset = torch.cat([points.new_ones(1, 3), 2 * torch.eye(3, device=points.device, dtype=points.dtype) - 1])
    around = (points[:, None] + step * offset).view(-1, 3)
    value = field.signed_distance(around).view(-1, 4)
    return value @ offset / (4 * step), value.mean(1)
