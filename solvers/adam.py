"""Adam (Kingma and Ba 2015) on the first few of many parameters.

    m <- b1 m + (1 - b1) g,   v <- b2 v + (1 - b2) g^2,   x <- x - rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

An entry whose gradients have all been zero does not move, so parameters that are not in use yet need no steps. On a CPU entries are
handled in pieces that stay in the processor's cache, on the threads of a pool. (torch.optim steps whole tensors, and loads torch's compiler
when first used: 2 s.)
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor

import torch
from torch import Tensor

PIECE = 1 << 15
"""Entries handled at once: four arrays of them fill a core's cache."""


class Adam:
    """The moments of some parameters, each with its own rate."""

    def __init__(self, parameters: Sequence[Tensor], betas: tuple[float, float], epsilon: float) -> None:
        """parameters: contiguous, stepped in place."""
        self.betas, self.epsilon = betas, epsilon
        self._values = [p.detach().view(-1) for p in parameters]
        self._moments = [(torch.zeros_like(p), torch.zeros_like(p)) for p in self._values]
        self._steps = 0

    @torch.no_grad()
    def step(self, gradients: Sequence[Sequence[Tensor]], rates: Sequence[float], pool: Executor) -> None:
        """One step of the first parameters. gradients: of each the summands of its gradient; rates: of each."""
        self._steps += 1
        b1, b2 = self.betas
        first, second = 1 - b1**self._steps, (1 - b2**self._steps) ** 0.5

        def piece(task: tuple[int, slice]) -> None:
            k, part = task
            m, v = (moment[part] for moment in self._moments[k])
            gradient = sum((summand.view(-1)[part] for summand in gradients[k][1:]), start=gradients[k][0].view(-1)[part])
            m.lerp_(gradient, 1 - b1)
            v.mul_(b2).addcmul_(gradient, gradient, value=1 - b2)
            self._values[k][part].addcdiv_(m, v.sqrt().div_(second).add_(self.epsilon), value=-rates[k] / first)

        tasks = []
        for k in range(len(gradients)):
            count = self._values[k].numel()
            size = PIECE if self._values[k].device.type == "cpu" else max(1, count)
            tasks += [(k, slice(start, min(start + size, count))) for start in range(0, count, size)]
        list(pool.map(piece, tasks))
