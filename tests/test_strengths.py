"""Photographs under one rig whose exposures differ: how bright each is comes out with the lights, and nothing does where they are alike."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from references import in_patches
from sphere_scene import SphereScene, make_sphere

from mvps.joint.blocks import DirectionalLights, Vertices, evaluate
from mvps.joint.grey import coloured_lights, grey_lights
from mvps.joint.lights import light_step, told_of_strengths, with_mean_one
from mvps.joint.observe import ViewSamples, channel_ratio, observe
from mvps.joint.steps import free_reflectance, vertex_step
from mvps.joint.strengths import (
    MUCH,
    SOME,
    Strengths,
    Told,
    as_bright,
    borne_out,
    needed,
    of_photographs,
    strengths_in,
    strengths_of,
    unknown_in,
    unknown_of,
)
from mvps.mesh import angles_deg
from mvps.outcome import all_lights
from mvps.progress import Progress
from mvps.reconstruct import Settings, reconstruct
from mvps.scene import Capture, Lights
from mvps.synthetic.scene import make_scene, render_capture
from mvps.synthetic.settings import SceneSettings

CPU = torch.device("cpu")
EXPOSURE = np.array([0.7, 1.3, 1.0, 0.8, 1.5, 0.9])
UP_AND_DOWN = [0.1, -0.1, 0.1, -0.1]
FLICKER = np.exp(np.random.default_rng(3).normal(0, 0.05, (6, 10)))


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(subdivisions=4)


def problem(scene: SphereScene, exposure: np.ndarray) -> tuple[list[ViewSamples], Vertices, list[DirectionalLights], list[torch.Tensor]]:
    """Samples of photographs that are so many (views,) or (views, lights) times as bright, true vertices, the lights of one rig, and the
    views' rotations."""
    r = scene.reconstruction
    direction, intensity = r.lights.direction[0] @ scene.capture.views[0].camera.rotation.T, r.lights.intensity[0]
    rotations = [view.camera.rotation for view in scene.capture.views]
    rig = Lights(tuple(direction @ rotation for rotation in rotations), (intensity,) * len(rotations), True)
    values = np.column_stack([r.material.albedo.mean(1), r.material.specular_weight])
    normal, reflectance = (torch.tensor(a, dtype=torch.float32) for a in (r.material.normal, values))
    vertices = Vertices(normal, reflectance, torch.full((len(values),), 0.01))
    lights = grey_lights(rig, CPU)
    views = [
        replace(samples, image=predicted * torch.as_tensor(e, dtype=torch.float32))
        for samples, predicted, e in zip(observe(scene.capture, r.surface, rig, CPU), images(scene, rig, vertices), exposure, strict=True)
    ]
    return views, vertices, lights, [torch.tensor(rotation, dtype=torch.float32) for rotation in rotations]


def images(scene: SphereScene, rig: Lights, vertices: Vertices) -> list[torch.Tensor]:
    """What the model says of all samples of the rig's views."""
    r = scene.reconstruction
    views = observe(scene.capture, r.surface, rig, CPU)
    return [
        evaluate(vertices.normal[s.vertex], vertices.reflectance[s.vertex], s.towards, of_view, r.material.law).predicted
        for s, of_view in zip(views, grey_lights(rig, CPU), strict=True)
    ]


@dataclass
class Solved:
    """What steps of lights and vertices came to, and what strengths would be told there."""

    lights: list[DirectionalLights]
    truth: list[DirectionalLights]
    rotations: list[torch.Tensor]
    strengths: Strengths | None
    told: Told


def solved(scene: SphereScene, exposure: np.ndarray, unknown: int) -> Solved:
    """Steps from the truth but for the photographs' brightness, which is unknown or taken for alike (unknown 0)."""
    views, vertices, truth, rotations = problem(scene, exposure)
    law, surface = scene.reconstruction.material.law, scene.reconstruction.surface
    views, vertices, anchor, patches = in_patches(surface, views, vertices, free_reflectance(vertices.normal, 0.3, 3))
    lights, found = truth, replace(as_bright(truth), unknown=unknown) if unknown else None
    for _ in range(10):
        lights, law = light_step(views, vertices, lights, law, anchor, patches, rotations, True, strengths=found)
        found = found and strengths_in(lights, unknown)
        lights, vertices = with_mean_one(lights, vertices)
        for _ in range(2):
            vertices = vertex_step(views, vertices, lights, law, anchor, patches=patches)
    free = (True, True, True)
    told = told_of_strengths(views, vertices, lights, law, anchor, patches, rotations, free, found or as_bright(lights))
    return Solved(lights, truth, rotations, found, told)


@pytest.mark.parametrize(
    ("exposure", "unknown"), [(EXPOSURE, 1), (np.ones(6), 1), (EXPOSURE[:, None] * FLICKER, 10)], ids=["views", "alike", "photographs"]
)
def test_brightness_of_photographs_comes_out_with_lights_and_vertices(scene: SphereScene, exposure: np.ndarray, unknown: int) -> None:
    found = solved(scene, exposure, unknown)
    assert found.strengths is not None
    strengths = np.array([e.numpy() for e in found.strengths.of])
    true = np.broadcast_to(exposure.reshape(6, -1), (6, 10))
    np.testing.assert_allclose(strengths, true / true.mean(0), rtol=0.01)
    assert needed(found.told, 10, SOME) == 0
    cosine = np.concatenate([(a.direction * b.direction).sum(1).numpy() for a, b in zip(found.lights, found.truth, strict=True)])
    assert np.degrees(np.arccos(cosine.clip(max=1))).mean() < 0.5
    # One rig: the same directions and, but for the photographs' brightness, intensities in the cameras' frames.
    products = [
        (one.direction @ rotation.T * (one.intensity / e)[:, None]).numpy()
        for one, rotation, e in zip(found.lights, found.rotations, found.strengths.of, strict=True)
    ]
    np.testing.assert_allclose(products, np.broadcast_to(products[0], np.shape(products)), atol=1e-3)


@pytest.mark.parametrize(
    ("exposure", "wanted"),
    [(np.ones(6), 0), (EXPOSURE, 1), (FLICKER, 10), (EXPOSURE[:, None] * FLICKER**0.2, 1)],
    ids=["alike", "views", "photographs", "both"],
)
def test_what_is_unknown_is_told_from_lights_that_were_solved_without_it(scene: SphereScene, exposure: np.ndarray, wanted: int) -> None:
    told = solved(scene, exposure, 0).told
    assert needed(told, 10, MUCH) == wanted
    # Views first, then what photographs differ by besides.
    if wanted == 1:
        of_views = solved(scene, exposure, 1).told
        assert needed(of_views, 10, MUCH) == (10 if np.ndim(exposure) == 2 else 0)


def test_what_strengths_need_to_explain() -> None:
    apart, alike = [0.2, -0.1, -0.1], [0.01, 0.0, -0.01]
    assert needed(Told(apart, 0.0, 0.05, 0.0), 4, SOME) == 1 and needed(Told(apart, 0.0, 0.05, 0.0), 4, MUCH) == 0
    assert needed(Told(alike, 0.0, 0.5, 0.2), 4, MUCH) == 0 and needed(Told(alike, 0.0, 0.0, 0.3), 4, MUCH) == 4
    # Nor are views exposed anew where single photographs explain more.
    assert needed(Told(apart, 0.0, 0.12, 0.11), 4, MUCH) == 1 and needed(Told(apart, 0.0, 0.12, 0.13), 4, MUCH) == 0
    # Lights that have not settled look like photographs that differ; with one light a view's strength is its photograph's.
    assert needed(Told(alike, 0.6, 0.0, 0.5), 4, MUCH) == 0 and needed(Told(alike, 0.0, 0.0, 0.5), 1, MUCH) == 0


def test_strengths_stay_where_what_they_explain_is_gone() -> None:
    told, then = Told(UP_AND_DOWN, 0.0, 0.04, 0.4), Told(UP_AND_DOWN, 0.0, 0.0, 0.0)
    for after, stay in ((0.03, True), (0.047, False), (0.06, False)):
        assert borne_out(told, then, apart(0.05, 4), 0.05, after) is stay
    assert borne_out(told, then, apart(0.05, 1), 0.05, 0.049) and not borne_out(told, then, apart(0.05, 1), 0.05, 0.0499)


def test_strengths_stay_where_they_have_settled() -> None:
    """As in a coarse round of a stone of aluminium: half of what was told is gone, and as much told anew."""
    told, creeping, settled = (Told(UP_AND_DOWN, 0.04, part, part) for part in (0.29, 0.28, 0.01))
    for unknown in (1, 4):
        assert borne_out(told, settled, apart(0.1, unknown), 0.14, 0.12)
        assert not borne_out(told, creeping, apart(0.1, unknown), 0.14, 0.12)


def test_strengths_of_photographs_are_as_far_apart_as_what_they_explain() -> None:
    """As on the hull of bricks of copper, whose wrong shape looks like photographs that differ: nearly all is explained, by strengths that
    are several times as far apart as it takes. What views differ by besides is none of it."""
    told, then = Told(UP_AND_DOWN, 0.04, 0.0, 0.36), Told(UP_AND_DOWN, 0.1, 0.0, 0.02)
    assert borne_out(told, then, apart(0.1, 4), 0.07, 0.02) and not borne_out(told, then, apart(0.19, 4), 0.07, 0.02)
    assert borne_out(told, then, apart(0.1, 4, np.array([[2.0], [0.5]])), 0.07, 0.02)


def apart(spread: float, unknown: int, of_views: np.ndarray | float = 1.0) -> Strengths:
    """Strengths of two views whose logarithms have this standard deviation, times those of the views."""
    each = of_views * np.exp(spread * np.array([[1.0, -1.0, 1.0, -1.0], [-1.0, 1.0, 1.0, -1.0]]))
    return Strengths(list(torch.tensor(each)), unknown)


@pytest.mark.parametrize("wrongly", [Told(UP_AND_DOWN, 0.0, 0.0, 0.9), Told(UP_AND_DOWN, 0.0, 0.9, 0.0)], ids=["photographs", "views"])
def test_strengths_that_leave_as_much_unexplained_are_undone(monkeypatch: pytest.MonkeyPatch, wrongly: Told) -> None:
    tried = []

    def told(*_: object) -> Told:
        # What is told of a trial, which is every other time, says that it has settled.
        tried.append(wrongly)
        return wrongly if len(tried) % 2 else Told(UP_AND_DOWN, 0.0, 0.0, 0.0)

    monkeypatch.setattr("mvps.joint.lighting.told_of_strengths", told)
    settings = SceneSettings(views=4, lights=8, size=72)
    found = reconstruct(render_capture(settings)[0], Settings("made", preset="draft"), None, Progress())
    assert tried and strengths_of(found.lights) is None and not found.metrics["findings"]


def test_a_black_photograph_is_no_flicker(scene: SphereScene) -> None:
    black = np.ones((6, 10))
    black[3, 2] = 0
    told = solved(scene, black, 0).told
    assert needed(told, 10, MUCH) == 0
    information = torch.ones(6, 10, dtype=torch.float64)
    gradient = torch.tensor(FLICKER - 1, dtype=torch.float64)
    each = (gradient - gradient.mean(1, keepdim=True)) ** 2
    assert float(of_photographs(gradient, information)) == pytest.approx(float(each.sum()))
    gradient[3, 2] = -1
    assert float(of_photographs(gradient, information)) < 3 * float(each.sum()) < 0.5


def test_strengths_are_told_from_the_lights_of_a_rig(scene: SphereScene) -> None:
    lights = scene.reconstruction.lights
    rig = Lights(lights.direction, (lights.intensity[0],) * 6, True)
    assert strengths_of(rig) is None and unknown_of(rig) == 0
    brighter = replace(rig, intensity=tuple(e * rig.intensity[0] for e in EXPOSURE))
    of_views = np.broadcast_to((EXPOSURE / EXPOSURE.mean())[:, None], FLICKER.shape)
    np.testing.assert_allclose(strengths_of(brighter), of_views)
    assert unknown_in(of_views) == 1 and unknown_of(brighter) == 6
    assert strengths_of(replace(brighter, one_rig=False)) is None
    again = coloured_lights(grey_lights(brighter, CPU), [channel_ratio(e) for e in brighter.intensity], brighter)
    np.testing.assert_allclose(strengths_of(again), of_views, rtol=1e-6)
    assert unknown_of(again) == 6
    flickers = replace(rig, intensity=tuple(e[:, None] * rig.intensity[0] for e in FLICKER))
    np.testing.assert_allclose(strengths_of(flickers), FLICKER / FLICKER.mean(0))
    assert unknown_of(flickers) == FLICKER.size
    few = (rig.direction[0][:3], *rig.direction[1:])
    others = replace(flickers, direction=few, intensity=(rig.intensity[0][:3], *flickers.intensity[1:]))
    assert strengths_of(others) is None and unknown_of(others) == 0


def test_a_view_that_was_kept_back_is_as_bright_as_the_rig(scene: SphereScene) -> None:
    capture, lights = scene.capture, scene.reconstruction.lights
    frames = [view.camera.rotation for view in capture.views]
    direction = tuple(lights.direction[0] @ frames[0].T @ frame for frame in frames)
    rig = Lights(direction, tuple(e / EXPOSURE.mean() * lights.intensity[0] for e in EXPOSURE), True)
    kept = {view.name: view.lights for view in capture.views}
    last = capture.views[-1].name
    used, held = capture.select({name: numbers for name, numbers in kept.items() if name != last}), capture.select({last: kept[last]})
    of_used = replace(rig, direction=rig.direction[:-1], intensity=rig.intensity[:-1])
    complete = all_lights(capture, used, held, of_used, scene.reconstruction.surface, scene.reconstruction.material, CPU)
    np.testing.assert_allclose(complete.direction[-1], direction[-1], atol=1e-9)
    np.testing.assert_allclose(complete.intensity[-1], lights.intensity[0] / EXPOSURE.mean() * EXPOSURE[:-1].mean(), rtol=1e-6)


@pytest.mark.parametrize(
    ("lights", "spread", "words"), [(1, 0.7, "view by view"), (8, 0.1, "lamps that flicker")], ids=["views", "photographs"]
)
def test_exposures_of_a_capture_are_found_and_said(lights: int, spread: float, words: str) -> None:
    settings = SceneSettings(views=8, lights=8, size=96)
    made = make_scene(settings)
    capture = render_capture(settings, made)[0]
    exposure = np.exp(np.random.default_rng(0).normal(0, spread, (8, lights)))
    views = (
        replace(view, samples=np.rint(view.samples * factors[:, None]).astype(np.uint16))
        for view, factors in zip(capture.views, exposure / exposure.max(), strict=True)
    )
    found = reconstruct(Capture("made", tuple(views)), Settings("made", preset="draft"), None, Progress())
    turned = [angles_deg(a, b) for a, b in zip(found.lights.direction, made.lights.direction, strict=True)]
    # Solved as if all were as bright they are 17 and 2.2 deg off, where all are 0.3.
    assert np.concatenate(turned).mean() < 0.9
    relative = np.broadcast_to(exposure / exposure.mean(0), (8, 8))
    np.testing.assert_allclose(strengths_of(found.lights), relative, rtol=0.03)
    (finding,) = found.metrics["findings"]
    assert finding["about"] == "lights" and finding["mended"] and words in finding["text"]
