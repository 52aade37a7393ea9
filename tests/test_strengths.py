"""Views under one rig whose exposures differ: how bright each is comes out with the lights, and nothing does where they are alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from references import in_patches
from sphere_scene import SphereScene, make_sphere

from mvps.joint.blocks import DirectionalLights, Vertices, evaluate
from mvps.joint.grey import coloured_lights, grey_lights
from mvps.joint.lights import light_step, with_mean_one
from mvps.joint.observe import ViewSamples, channel_ratio, observe
from mvps.joint.steps import free_reflectance, vertex_step
from mvps.joint.strengths import exposed_alike, strengths_in, strengths_of
from mvps.mesh import angles_deg
from mvps.outcome import all_lights
from mvps.progress import Progress
from mvps.reconstruct import Settings, reconstruct
from mvps.scene import Capture, Lights
from mvps.synthetic.scene import make_scene, render_capture
from mvps.synthetic.settings import SceneSettings

CPU = torch.device("cpu")
EXPOSURE = np.array([0.7, 1.3, 1.0, 0.8, 1.5, 0.9])


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(subdivisions=4)


def problem(scene: SphereScene, exposure: np.ndarray) -> tuple[list[ViewSamples], Vertices, list[DirectionalLights], list[torch.Tensor]]:
    """Samples of views that are so many times as bright, true vertices, the lights of one rig, and the views' rotations."""
    r = scene.reconstruction
    direction, intensity = r.lights.direction[0] @ scene.capture.views[0].camera.rotation.T, r.lights.intensity[0]
    rotations = [view.camera.rotation for view in scene.capture.views]
    rig = Lights(tuple(direction @ rotation for rotation in rotations), (intensity,) * len(rotations), True)
    values = np.column_stack([r.material.albedo.mean(1), r.material.specular_weight])
    normal, reflectance = (torch.tensor(a, dtype=torch.float32) for a in (r.material.normal, values))
    vertices = Vertices(normal, reflectance, torch.full((len(values),), 0.01))
    lights = grey_lights(rig, CPU)
    views = [
        replace(samples, image=predicted * float(e))
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


@pytest.mark.parametrize("exposure", [EXPOSURE, np.ones(6)], ids=["different", "alike"])
def test_brightness_of_views_comes_out_with_lights_and_vertices(scene: SphereScene, exposure: np.ndarray) -> None:
    views, vertices, truth, rotations = problem(scene, exposure)
    law, surface = scene.reconstruction.material.law, scene.reconstruction.surface
    views, vertices, anchor, patches = in_patches(surface, views, vertices, free_reflectance(vertices.normal, 0.3, 3))
    lights, found = truth, [1.0] * 6
    for _ in range(10):
        lights, law = light_step(views, vertices, lights, law, anchor, patches, rotations, True, strengths=found)
        found = strengths_in(lights)
        lights, vertices = with_mean_one(lights, vertices)
        for _ in range(2):
            vertices = vertex_step(views, vertices, lights, law, anchor, patches=patches)
    strengths = np.array(found)
    np.testing.assert_allclose(strengths, exposure / exposure.mean(), rtol=0.01)
    assert exposed_alike(found) == (exposure is not EXPOSURE)
    cosine = np.concatenate([(a.direction * b.direction).sum(1).numpy() for a, b in zip(lights, truth, strict=True)])
    assert np.degrees(np.arccos(cosine.clip(max=1))).mean() < 0.5
    # One rig: the same directions and, but for the views' brightness, intensities in the cameras' frames.
    products = [
        (one.direction @ rotation.T * one.intensity[:, None]).numpy() / e
        for one, rotation, e in zip(lights, rotations, strengths, strict=True)
    ]
    np.testing.assert_allclose(products, np.broadcast_to(products[0], np.shape(products)), atol=1e-3)


def test_strengths_are_told_from_the_lights_of_a_rig(scene: SphereScene) -> None:
    lights = scene.reconstruction.lights
    rig = Lights(lights.direction, (lights.intensity[0],) * 6, True)
    assert strengths_of(rig) is None
    brighter = replace(rig, intensity=tuple(e * rig.intensity[0] for e in EXPOSURE))
    np.testing.assert_allclose(strengths_of(brighter), EXPOSURE / EXPOSURE.mean())
    assert strengths_of(replace(brighter, one_rig=False)) is None
    again = coloured_lights(grey_lights(brighter, CPU), [channel_ratio(e) for e in brighter.intensity], brighter)
    np.testing.assert_allclose(strengths_of(again), EXPOSURE / EXPOSURE.mean(), rtol=1e-6)


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


def test_exposures_of_a_capture_are_found_and_said() -> None:
    settings = SceneSettings(views=8, lights=8, size=96)
    made = make_scene(settings)
    capture = render_capture(settings, made)[0]
    exposure = np.exp(np.random.default_rng(0).normal(0, 0.7, 8))
    factors = (exposure / exposure.max()).tolist()
    views = (
        replace(view, samples=np.rint(view.samples * factor).astype(np.uint16)) for view, factor in zip(capture.views, factors, strict=True)
    )
    found = reconstruct(Capture("made", tuple(views)), Settings("made", preset="draft"), None, Progress())
    turned = [angles_deg(a, b) for a, b in zip(found.lights.direction, made.lights.direction, strict=True)]
    # Solved as if all views were as bright they are 17 deg off.
    assert np.concatenate(turned).mean() < 0.5
    np.testing.assert_allclose(strengths_of(found.lights), exposure / exposure.mean(), rtol=0.03)
    (finding,) = found.metrics["findings"]
    assert finding["about"] == "lights" and finding["mended"] and "exposures" in finding["text"]
