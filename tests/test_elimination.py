"""Vertices eliminated from the equations of lights and law, against the whole matrix."""

from __future__ import annotations

import pytest
import torch

from mvps.joint import elimination
from mvps.joint.elimination import Blocks, eliminated
from mvps.joint.patches import Patches


@pytest.mark.parametrize("at_once", [3, 64])
@pytest.mark.parametrize("rigs", [0, 1, 4])
def test_the_reduced_system_is_that_of_the_whole_matrix(monkeypatch: pytest.MonkeyPatch, rigs: int, at_once: int) -> None:
    monkeypatch.setattr(elimination, "VERTICES_PER_BLOCK", at_once)
    monkeypatch.setattr(elimination, "COLUMNS_PER_BLOCK", 1)
    generator = torch.Generator().manual_seed(rigs)
    n, p, lights = 40, 5, 6

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    rows = drawn(n, p, 8)
    free = (torch.rand(n, p, generator=generator) > 0.1).float()
    free[:, :2] = 1
    hessian = (rows @ rows.mT) * free[:, :, None] * free[:, None] + torch.diag_embed(1 - free)
    blocks = Blocks(hessian, drawn(n, p) * free, free)
    # Of four rigs each lights what half of the views see; the law's columns are everywhere.
    of_rigs = [
        drawn(n, p, 3 * lights) * (torch.arange(n) % 4 < 2 if rigs < 2 else (torch.arange(n) + k) % 4 < 2)[:, None, None]
        for k in range(rigs)
    ]
    derivatives = [*of_rigs, drawn(n, p, 3)]
    of, A = torch.arange(n) // 10, drawn(n, 2, 2).double()
    unused = torch.zeros(n, 3)
    patches = Patches(torch.arange(n), of, unused, unused, unused[:, 0], unused[:, :2])

    m = sum(d.shape[2] for d in derivatives)
    before = drawn(m, m).double(), drawn(m).double()
    found = eliminated(before[0].clone(), before[1].clone(), derivatives, blocks, A, patches)

    inverse = torch.linalg.inv(hessian.double())
    cross = (torch.cat(derivatives, 2) * free[..., None]).double()
    to_patch = torch.nn.functional.one_hot(of).double()
    gradient = blocks.gradient.double()
    expected = (
        before[0] - torch.einsum("jpm,jpq,jqn->mn", cross, inverse, cross),
        before[1] - torch.einsum("jpm,jpq,jq->m", cross, inverse, gradient),
        torch.einsum("jk,jap,jpq,jbq->kab", to_patch, A, inverse[:, :2, :2], A),
        torch.einsum("jk,jap,jpq,jqm->kam", to_patch, A, inverse[:, :2], cross),
        torch.einsum("jk,jap,jpq,jq->ka", to_patch, A, inverse[:, :2], gradient),
    )
    for mine, wanted in zip((found.H, found.g, found.E, found.F, found.f), expected, strict=True):
        torch.testing.assert_close(mine, wanted, rtol=1e-9, atol=1e-9 * float(wanted.abs().max()))
