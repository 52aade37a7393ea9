"""Views that are handled together say what they say one by one."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mvps.joint import observe
from mvps.joint.blocks import DirectionalLights, Vertices, batches, vertex_equations
from mvps.joint.observe import ViewSamples
from mvps.scene import Law

PAIRS, LIGHTS = (7, 0, 12, 40, 3, 5), (4, 4, 4, 4, 4, 6)


def unit(g: torch.Generator, count: int) -> Tensor:
    return torch.nn.functional.normalize(
        torch.randn(count, 3, generator=g, dtype=torch.float64) * 0.4 + torch.tensor([0.0, 0.0, 1.0]), dim=1
    )


@pytest.fixture
def problem() -> tuple[list[ViewSamples], Vertices, list[DirectionalLights]]:
    g = torch.Generator().manual_seed(3)
    vertices = Vertices(unit(g, 40), torch.rand(40, 3, generator=g, dtype=torch.float64), torch.full((40,), 0.1, dtype=torch.float64))
    views, lights = [], []
    for n, count in zip(PAIRS, LIGHTS, strict=True):
        image, gathered, weight = (torch.rand(n, count, generator=g, dtype=torch.float64) for _ in range(3))
        seen = torch.randperm(40, generator=g)[:n]
        terms = torch.stack([gathered, weight, gathered * weight, image], -1)
        views.append(ViewSamples(seen, unit(g, n), weight[:, 0], image, image > 0.2, terms))
        lights.append(DirectionalLights(unit(g, count), 0.5 + torch.rand(count, generator=g, dtype=torch.float64)))
    return views, vertices, lights


def test_small_views_with_equally_many_lights_go_together(problem: tuple[list[ViewSamples], Vertices, list[DirectionalLights]]) -> None:
    views, _, lights = problem
    assert [batch.views for batch in batches(views, lights)] == [[0, 2, 3, 4], [5]]


def test_a_large_view_goes_in_parts(
    problem: tuple[list[ViewSamples], Vertices, list[DirectionalLights]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(observe, "SAMPLES_PER_CHUNK", 4 * 36)
    views, _, lights = problem
    found = [(batch.views, batch.vertex.shape[1]) for batch in batches(views, lights)]
    # Parts of the large one come as they do; the small ones around it still go together.
    assert sorted(found) == [([0, 2, 4], 12), ([3], 4), ([3], 36), ([5], 5)]


@pytest.mark.parametrize("samples", [1, 60, 120, 1 << 17])
def test_equations_do_not_depend_on_what_goes_together(
    problem: tuple[list[ViewSamples], Vertices, list[DirectionalLights]], monkeypatch: pytest.MonkeyPatch, samples: int
) -> None:
    views, vertices, lights = problem
    law = Law((8.0, 32.0), 0.2, 0.7, gleam=0.3)
    alone = [vertex_equations([view], vertices, [of_view], law) for view, of_view in zip(views, lights, strict=True)]
    monkeypatch.setattr(observe, "SAMPLES_PER_CHUNK", samples)
    together = vertex_equations(views, vertices, lights, law)
    for name in ("hessian", "gradient", "squares", "count"):
        torch.testing.assert_close(getattr(together, name), sum(getattr(part, name) for part in alone))
