"""mvps.nearness: near lights are told from far ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sphere_scene import RADIUS, SphereScene, make_sphere

from mvps.mesh import lengths
from mvps.nearness import nearness
from mvps.rendering import points_under
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


def test_dark_photographs_say_nothing(scene: SphereScene) -> None:
    r = scene.reconstruction
    dark = Capture("dark", tuple(replace(view, samples=0 * view.samples) for view in scene.capture.views))
    assert nearness(dark, r.surface, r.material, r.lights) == (0.0, 0.0)
