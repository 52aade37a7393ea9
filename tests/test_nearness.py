"""mvps.nearness: near lights are told from far ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sphere_scene import RADIUS, SphereScene, make_sphere

from mvps.mesh import lengths
from mvps.nearness import nearness
from mvps.rendering import photograph, points_under
from mvps.scene import Capture, View
from mvps.visibility import ray_caster


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(4)


def under_points(scene: SphereScene, distance: float) -> Capture:
    """The photographs with the falloff of lights at this distance from the object's middle."""
    caster = ray_caster(scene.reconstruction.surface)

    def lit(view: View, direction: np.ndarray) -> View:
        x = points_under(caster, scene.reconstruction.material, view.camera, view.pixels).position
        falloff = distance**2 / lengths(distance * direction[None] - x[:, None]) ** 2
        return replace(view, samples=np.rint(np.minimum(view.samples * falloff[..., None] / 2, 65535)).astype(np.uint16))

    views = zip(scene.capture.views, scene.reconstruction.lights.direction, strict=True)
    return Capture("near", tuple(lit(view, direction) for view, direction in views))


@pytest.mark.parametrize("sizes", [3.0, 10.0])
def test_near_lights_are_told_with_their_distance(scene: SphereScene, sizes: float) -> None:
    r = scene.reconstruction
    found = nearness(under_points(scene, sizes * 2 * RADIUS), r.surface, r.material, r.lights)
    assert found.near and found.slope == pytest.approx(1 / (2 * sizes), rel=0.35)


def test_far_lights_are_not_near(scene: SphereScene) -> None:
    r = scene.reconstruction
    found = nearness(scene.capture, r.surface, r.material, r.lights)
    assert not found.near and abs(found.slope) < 0.002


def test_what_surfaces_send_each_other_is_asked_before_lights_are_said_to_be_near(
    scene: SphereScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    r, asked = scene.reconstruction, []
    near = under_points(scene, 6 * RADIUS)
    by_view = {view.camera: view for view in near.views}

    def explained(*given: Any) -> np.ndarray:
        _, _, camera, pixels, direction, _, arriving = given
        if arriving is None:
            return photograph(*given)
        asked.append(len(direction))
        view = by_view[camera]
        return view.samples[view.pixel_index[tuple(pixels.T)]][:, : len(direction)] * view.scale

    monkeypatch.setattr("mvps.nearness.photograph", explained)
    monkeypatch.setattr("mvps.nearness.light_arriving", lambda senders, *_: senders)
    monkeypatch.setattr("mvps.nearness.light_senders", lambda *_: "senders")
    assert not nearness(near, r.surface, r.material, r.lights).near and asked == [10] * len(near.views)
    asked.clear()
    assert not nearness(scene.capture, r.surface, r.material, r.lights).near and not asked


def test_dark_photographs_say_nothing(scene: SphereScene) -> None:
    r = scene.reconstruction
    dark = Capture("dark", tuple(replace(view, samples=0 * view.samples) for view in scene.capture.views))
    assert nearness(dark, r.surface, r.material, r.lights) == (0.0, 0.0)
