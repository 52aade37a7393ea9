"""Gradients of the photometric blocks against finite differences, by situation. That of outlines is in test_silhouette.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from sphere_scene import RADIUS, SphereScene, make_sphere

from mvps.joint.blocks import (
    DirectionalLights,
    Vertices,
    evaluate,
    law_derivatives,
    light_jacobian,
    tangents,
    vertex_derivatives,
    vertex_equations,
)
from mvps.joint.grey import grey_lights
from mvps.joint.observe import ViewSamples, observe
from mvps.scene import Law, Surface
from solvers.low_rank import CAUCHY_95

CPU = torch.device("cpu")

SITUATIONS = {
    "moving vertex facing the light": ((0.1, 0.0, 1.0), (0.3, 0.2, 1.0), 20.0),
    "moving vertex under grazing light": ((0.1, 0.0, 1.0), (1.0, 0.1, 0.02), 20.0),
    "moving vertex seen at a grazing angle": ((1.0, 0.0, 0.1), (0.6, 0.3, 1.0), 20.0),
    "rotating light in a sharp lobe": ((0.1, 0.05, 1.0), (0.2, 0.1, 1.0), 300.0),
    "attached shadow": ((0.1, 0.0, 1.0), (1.0, 0.0, -0.3), 20.0),
    "light from behind, opposite to the view": ((0.1, 0.0, 1.0), (-0.05, -0.1, -0.99), 20.0),
}


@pytest.mark.parametrize("microfacet", [False, True])
@pytest.mark.parametrize("situation", SITUATIONS)
def test_derivatives_against_finite_differences(situation: str, microfacet: bool) -> None:
    *directions, sharpness = SITUATIONS[situation]
    normal, light = (torch.tensor(v, dtype=torch.float64) for v in directions)
    normal, light = (torch.nn.functional.normalize(v, dim=0)[None] for v in (normal, light))
    view = torch.nn.functional.normalize(torch.tensor([[0.05, 0.1, 1.0]], dtype=torch.float64), dim=1)
    reflectance = torch.tensor([[0.4, 0.3]], dtype=torch.float64)
    intensity, gathered = torch.tensor([1.3], dtype=torch.float64), torch.tensor([[[0.2, 0.1, 0.3]]], dtype=torch.float64)
    law = Law((sharpness,), -0.3, 0.7, microfacet, gleam=0.4)
    frame = tangents(normal)

    def image(turn: torch.Tensor, values: torch.Tensor, m: torch.Tensor) -> torch.Tensor:
        turned = torch.nn.functional.normalize(normal + turn[:1] * frame[0] + turn[1:] * frame[1], dim=1)
        length = m.norm(dim=1)
        return evaluate(turned, values, view, DirectionalLights(m / length[:, None], length), law, gathered).predicted[0, 0]

    lights = DirectionalLights(light, intensity)
    shaded = evaluate(normal, reflectance, view, lights, law, gathered)
    by_vertex = torch.stack(vertex_derivatives(shaded, frame, view, lights), 1)[0, :, 0]
    by_light = light_jacobian(shaded, normal, view, lights, law, torch.eye(3, dtype=torch.float64))[0, :, 0]
    zero = torch.zeros(2, dtype=torch.float64)
    numeric = torch.autograd.functional.jacobian(image, (zero, reflectance, light * intensity))
    assert torch.allclose(by_vertex, torch.cat([numeric[0], numeric[1][0]]), atol=1e-10)
    assert torch.allclose(by_light, numeric[2][0], atol=1e-10)
    step = 1e-6
    by_law = law_derivatives(shaded, reflectance, lights, law)
    for name, derivative in zip(("grazing", "bounce", "gleam"), by_law, strict=True):
        after, before = (
            evaluate(normal, reflectance, view, lights, replace(law, **{name: getattr(law, name) + s}), gathered).predicted
            for s in (step, -step)
        )
        assert abs((after - before) / (2 * step) - derivative) < 1e-8
    for k in range(2):
        turn = torch.zeros(2, dtype=torch.float64)
        turn[k] = step
        difference = (image(turn, reflectance, light * intensity) - image(-turn, reflectance, light * intensity)) / (2 * step)
        assert abs(difference - by_vertex[k]) < 1e-6


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(subdivisions=3)


def under_a_ball(surface: Surface, place: tuple[float, float, float]) -> Surface:
    """The surface with a small ball beside it that throws its shadow on it; its vertices come last."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS / 4)
    return Surface(np.vstack([surface.vertices, ball.vertices + place]), np.vstack([surface.faces, ball.faces + len(surface.vertices)]))


def state(scene: SphereScene, views: list[ViewSamples], count: int) -> Vertices:
    """Vertices some degrees and per cent beside what the photographs say."""
    g, material = torch.Generator().manual_seed(0), scene.reconstruction.material
    normal = torch.zeros(count, 3) + torch.tensor([0.0, 0.0, 1.0])
    normal[: len(material.normal)] = torch.tensor(material.normal, dtype=torch.float32)
    normal = torch.nn.functional.normalize(normal + 0.05 * torch.randn(count, 3, generator=g), dim=1)
    return Vertices(normal, 0.2 + 0.1 * torch.rand(count, 3, generator=g), torch.full((count,), 0.05))


def objective(views: list[ViewSamples], vertices: Vertices, lights: list[DirectionalLights], law: Law) -> torch.Tensor:
    """(V,) 1/2 sum w rho(r), rho Cauchy's: c^2 log(1 + (r / c)^2)."""
    total = torch.zeros(len(vertices.normal), dtype=torch.float64)
    for samples, of_view in zip(views, lights, strict=True):
        index = samples.vertex
        predicted = evaluate(vertices.normal[index], vertices.reflectance[index], samples.towards, of_view, law).predicted
        c = CAUCHY_95 * vertices.scale[index, None].double()
        cost = c**2 * torch.log1p(((predicted - samples.image).double() / c) ** 2) / 2
        total.index_add_(0, index, (samples.weight[:, None] * samples.data * cost).sum(1))
    return total


PLACE = (0.0, 0.3 * RADIUS, 1.5 * RADIUS)


def shadowed(scene: SphereScene, place: tuple[float, float, float]) -> list[ViewSamples]:
    return observe(scene.capture, under_a_ball(scene.reconstruction.surface, place), scene.reconstruction.lights, CPU)


def test_gradient_of_a_shadow_receiver(scene: SphereScene) -> None:
    """Normal and reflectance of vertices that some lights do not reach, under the whole objective: weights, shadows, outliers."""
    views, lights, law = shadowed(scene, PLACE), grey_lights(scene.reconstruction.lights, CPU), Law((20.0, 60.0), 0.1)
    count = len(under_a_ball(scene.reconstruction.surface, PLACE).vertices)
    double = [replace(s, **{k: getattr(s, k).double() for k in ("towards", "weight", "image")}) for s in views]
    lights = [DirectionalLights(of_view.direction.double(), of_view.intensity.double()) for of_view in lights]
    found = state(scene, views, count)
    vertices = Vertices(found.normal.double(), found.reflectance.double(), found.scale.double())
    gradient = vertex_equations(double, vertices, lights, law).gradient
    hidden = torch.zeros(count)
    for with_ball, alone in zip(views, observe(scene.capture, scene.reconstruction.surface, scene.reconstruction.lights, CPU), strict=True):
        both = torch.isin(with_ball.vertex, alone.vertex)
        lost = alone.data[torch.isin(alone.vertex, with_ball.vertex)] & ~with_ball.data[both]
        hidden.index_add_(0, with_ball.vertex[both], lost.sum(1).float())
    receivers = (hidden > 0) & (torch.arange(count) < len(scene.reconstruction.surface.vertices))
    assert receivers.sum() > 20
    first, second = tangents(vertices.normal)
    step = 1e-6
    for k, tangent in enumerate((first, second)):
        up, down = (
            replace(vertices, normal=torch.nn.functional.normalize(vertices.normal + sign * step * tangent, dim=1)) for sign in (1, -1)
        )
        numeric = (objective(double, up, lights, law) - objective(double, down, lights, law)) / (2 * step)
        assert torch.allclose(gradient[receivers, k], numeric[receivers], rtol=1e-3, atol=1e-5 * float(gradient[receivers, k].abs().max()))
    for k in range(3):
        up, down = (replace(vertices, reflectance=vertices.reflectance + sign * step * torch.eye(3)[k]) for sign in (1, -1))
        numeric = (objective(double, up, lights, law) - objective(double, down, lights, law)) / (2 * step)
        of_k = gradient[receivers, 2 + k]
        assert torch.allclose(of_k, numeric[receivers], rtol=1e-3, atol=1e-5 * float(of_k.abs().max()))


def test_gradient_of_a_moving_occluder(scene: SphereScene) -> None:
    """None: what a shadow hides is no data, so that a receiver's cost does not change with the occluder's position but where the shadow's
    edge passes it. Positions follow agreement and masks, not shadows."""
    lights, law = grey_lights(scene.reconstruction.lights, CPU), Law((20.0, 60.0), 0.1)
    count = len(under_a_ball(scene.reconstruction.surface, PLACE).vertices)
    step = 1e-3
    costs = []
    for aside in (0.0, step):
        views = shadowed(scene, (PLACE[0] + aside, *PLACE[1:]))
        costs.append(objective(views, state(scene, views, count), lights, law)[: len(scene.reconstruction.surface.vertices)])
    changed = costs[0] != costs[1]
    assert changed.float().mean() < 0.02
    alone = observe(scene.capture, scene.reconstruction.surface, scene.reconstruction.lights, CPU)
    without = objective(alone, state(scene, alone, len(scene.reconstruction.surface.vertices)), lights, law)
    assert (without != costs[0]).float().mean() > 5 * changed.float().mean()
