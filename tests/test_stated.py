"""Stated errors of normals against those that samples with known errors lead to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from sphere_scene import SphereScene, make_sphere

from mvps.joint.blocks import DirectionalLights, Vertices, evaluate
from mvps.joint.grey import grey_lights
from mvps.joint.observe import ViewSamples, observe
from mvps.joint.reflectance import Observed
from mvps.joint.stated import icosahedron, stated_errors
from mvps.joint.steps import free_reflectance, vertex_steps
from mvps.mesh import vertex_normals
from mvps.scene import RELIABLE, Float, Law, Surface

CPU = torch.device("cpu")
LAMBERT = Law(())


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(subdivisions=4)


def photographed(scene: SphereScene) -> tuple[list[ViewSamples], Vertices, list[DirectionalLights]]:
    """Samples of a matte grey ball whose normals are its mesh's, free of errors; the true vertices and lights."""
    surface, lights = scene.reconstruction.surface, grey_lights(scene.reconstruction.lights, CPU)
    normal = torch.tensor(vertex_normals(surface), dtype=torch.float32)
    truth = Vertices(normal, torch.full((len(normal), 1), 0.5), torch.full((len(normal),), 0.01))
    views = []
    for samples, of_view in zip(observe(scene.capture, surface, scene.reconstruction.lights, CPU), lights, strict=True):
        index = samples.vertex
        views.append(replace(samples, image=evaluate(normal[index], truth.reflectance[index], samples.towards, of_view, LAMBERT).predicted))
    return views, truth, lights


def stated_deg(
    scene: SphereScene, views: list[ViewSamples], vertices: Vertices, lights: list[DirectionalLights], finer: bool = False
) -> Float:
    """Stated standard deviations, degrees, infinite where nothing is known."""
    observed = Observed(scene.capture, scene.reconstruction.surface, views, vertices, lights, LAMBERT)
    with np.errstate(divide="ignore"):
        return np.degrees(RELIABLE * np.sqrt(1 / stated_errors(observed, 0.3, finer).confidence - 1))


def solved(views: list[ViewSamples], truth: Vertices, lights: list[DirectionalLights]) -> Vertices:
    return vertex_steps(views, truth, lights, LAMBERT, free_reflectance(truth.normal, 100.0, 1), 6)


def measured_deg(found: Vertices, truth: Vertices) -> Float:
    """What a standard deviation is measured against: the turn of each vertex's normal, of each tangential component."""
    return np.degrees((found.normal - truth.normal).norm(dim=1).numpy() / np.sqrt(2))


def independent(samples: ViewSamples, draw: torch.Generator) -> torch.Tensor:
    return 0.02 * torch.randn(samples.image.shape, generator=draw)


def of_view(samples: ViewSamples, draw: torch.Generator) -> torch.Tensor:
    """A slope across the view's lights that all of a vertex's samples there follow."""
    slope = torch.linspace(-1, 1, samples.image.shape[1])
    return 0.05 * slope * torch.randn(len(samples.vertex), 1, generator=draw)


@pytest.mark.parametrize(("error", "most"), [(independent, 2.5), (of_view, 3.0)])
def test_stated_errors_are_no_smaller_than_those_that_come_out(scene: SphereScene, error: Callable[..., torch.Tensor], most: float) -> None:
    """They err on the safe side. Where samples share nothing, the sums over views and lights and what the surface contradicts each say the
    whole error: 1.7 times as large (1.4 to 2.0 in quarters). Slopes of views partly cancel in a view but not under a light, which then says
    still more."""
    views, truth, lights = photographed(scene)
    draw = torch.Generator().manual_seed(0)
    wrong = [replace(samples, image=samples.image + error(samples, draw)) for samples in views]
    found = solved(wrong, truth, lights)
    stated, measured = stated_deg(scene, wrong, found, lights), measured_deg(found, truth)
    known = np.flatnonzero(np.isfinite(stated))
    for group in np.array_split(known[np.argsort(stated[known])], 4):
        assert 1 < np.sqrt((stated[group] ** 2).mean() / (measured[group] ** 2).mean()) < most


def test_what_the_surface_contradicts_is_stated(scene: SphereScene) -> None:
    views, truth, lights = photographed(scene)
    aside = torch.nn.functional.normalize(torch.linalg.cross(truth.normal, torch.tensor([[0.3, 0.5, 0.8]])), dim=1)
    turned = replace(truth, normal=np.cos(0.1) * truth.normal + np.sin(0.1) * aside)
    views = [
        replace(s, image=evaluate(turned.normal[s.vertex], turned.reflectance[s.vertex], s.towards, of, LAMBERT).predicted)
        for s, of in zip(views, lights, strict=True)
    ]
    stated = stated_deg(scene, views, turned, lights)
    assert np.allclose(stated[np.isfinite(stated)], np.degrees(0.1) / np.sqrt(2), rtol=0.02)


def test_a_vertex_without_samples_has_no_confidence_and_lends_none(scene: SphereScene) -> None:
    views, truth, lights = photographed(scene)
    draw = torch.Generator().manual_seed(1)
    noisy = [replace(samples, image=samples.image + independent(samples, draw)) for samples in views]
    dark = torch.tensor(scene.reconstruction.surface.vertices[:, 2] > 0)
    seen = [samples.of_pairs((~dark[samples.vertex]).nonzero()[:, 0]) for samples in noisy]
    all_seen, half_seen = (stated_deg(scene, some, truth, lights) for some in (noisy, seen))
    assert np.isinf(half_seen[dark.numpy()]).all()
    both = np.isfinite(all_seen) & np.isfinite(half_seen)
    assert np.median(np.abs(half_seen / all_seen - 1)[both]) < 0.05 and (half_seen[both] > 0.3 * all_seen[both]).all()


def test_kinds_of_lights_are_spread_evenly() -> None:
    corners = icosahedron()
    assert np.allclose(np.linalg.norm(corners, axis=1), 1)
    nearest = np.sort(corners @ corners.T, axis=1)
    assert np.allclose(nearest[:, -6:-1], 1 / np.sqrt(5)) and np.allclose(corners.sum(0), 0)


def test_detail_at_the_edges_stands_for_detail_below_them(scene: SphereScene) -> None:
    """Normals that change from each vertex to the next, of the photographs and of the surface alike, state about as much error; what noise
    makes them differ by is not taken for detail."""
    _, truth, lights = photographed(scene)
    ball, draw = scene.reconstruction.surface, torch.Generator().manual_seed(0)
    edge = np.linalg.norm(ball.vertices[ball.faces[:, 0]] - ball.vertices[ball.faces[:, 1]], axis=1).mean()
    lumps = np.random.default_rng(0).normal(size=(len(ball.vertices), 1)) * 0.04 * edge
    rough = Surface(ball.vertices * (1 + lumps / np.linalg.norm(ball.vertices, axis=1, keepdims=True)), ball.faces)
    turned = replace(truth, normal=torch.tensor(vertex_normals(rough), dtype=torch.float32))
    stated = []
    for surface, vertices in ((ball, truth), (rough, turned)):
        made = SphereScene(replace(scene.reconstruction, surface=surface), scene.capture)
        views = photographed(made)[0]
        noisy = [replace(samples, image=samples.image + 0.01 * independent(samples, draw)) for samples in views]
        found = stated_deg(made, noisy, vertices, lights)
        stated.append(np.sqrt((found[np.isfinite(found)] ** 2).mean()))
    shown = np.degrees((turned.normal - truth.normal).norm(dim=1).numpy()) / np.sqrt(2)
    assert 0.5 < stated[1] / np.sqrt((shown**2).mean()) < 2
    assert stated[0] < 0.3 * stated[1]
    # A finer mesh has it.
    within = stated_deg(made, noisy, vertices, lights, finer=True)
    assert np.sqrt((within[np.isfinite(within)] ** 2).mean()) < 0.3 * stated[1]
