"""Adam (Kingma and Ba 2015) on parts of tables.

    m <- b1 m + (1 - b1) g,   v <- b2 v + (1 - b2) g^2,   x <- x - rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

An entry whose gradients have all been zero does not move, so a table of which only the first rows are in use needs steps of those rows
alone. Rows are handled in pieces that stay in the processor's cache, on the threads of a pool. (torch.optim steps whole tensors, and
loads torch's compiler when first used: 2 s.)
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

import torch
from torch import Tensor

PIECE = 1 << 15
"""Entries handled at once: four arrays of them fill a core's cache."""


class Adam:
    """The moments of some parameters (rows, ...), each with its own rate."""

    def __init__(self, parameters: Sequence[Tensor], betas: tuple[float, float], epsilon: float) -> None:
        self.parameters, self.betas, self.epsilon = parameters, betas, epsilon
        self._moments = [(torch.zeros_like(p, requires_grad=False), torch.zeros_like(p, requires_grad=False)) for p in parameters]
        self._steps = 0

    @torch.no_grad()
    def step(self, gradients: Sequence[Sequence[Tensor]], rates: Sequence[float], pool: Executor) -> None:
        """One step. gradients: of each parameter the summands of its gradient, for its first rows; rates: of each parameter."""
        self._steps += 1
        b1, b2 = self.betas
        first, second = 1 - b1**self._steps, (1 - b2**self._steps) ** 0.5

        def piece(task: tuple[int, slice]) -> None:
            k, rows = task
            m, v = (moment[rows] for moment in self._moments[k])
            gradient = sum((part[rows] for part in gradients[k][1:]), start=gradients[k][0][rows])
            m.lerp_(gradient, 1 - b1)
            v.mul_(b2).addcmul_(gradient, gradient, value=1 - b2)
            self.parameters[k].detach()[rows].addcdiv_(m, v.sqrt().div_(second).add_(self.epsilon), value=-rates[k] / first)

        tasks = []
        for k, (gradient, *_) in enumerate(gradients):
            step = max(1, PIECE * len(gradient) // max(1, gradient.numel()))
            tasks += [(k, slice(start, min(start + step, len(gradient)))) for start in range(0, len(gradient), step)]
        list(pool.map(piece, tasks))
