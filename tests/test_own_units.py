"""The unit of the world: which one it is does not matter, not even in the last bits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sphere_scene import make_sphere

from mvps.own_units import STEP, in_lengths, own_length
from mvps.progress import Progress
from mvps.reconstruct import Settings, reconstruct
from mvps.scene import Capture


def in_unit(capture: Capture, unit: float) -> Capture:
    """The same capture where a length of one is `unit`."""
    cameras = [replace(view.camera, translation=view.camera.translation * unit) for view in capture.views]
    return Capture(capture.name, tuple(view.taken_by(camera) for view, camera in zip(capture.views, cameras, strict=True)))


@pytest.mark.parametrize("unit", [1e-6, 0.0254, 10.0, 1e6])
def test_the_same_cameras_in_any_unit_are_the_same_numbers(unit: float) -> None:
    capture = make_sphere(3).capture
    translations = []
    for one in (capture, in_unit(capture, unit)):
        length = own_length([view.camera for view in one.views])
        own = in_lengths(one, length)
        assert own_length([view.camera for view in own.views]) == pytest.approx(1)
        for view, before in zip(own.views, one.views, strict=True):
            assert np.abs(view.camera.translation * length - before.camera.translation).max() < STEP * length
            assert view.samples is before.samples
        translations.append(np.stack([view.camera.translation for view in own.views]))
    assert (translations[0] == translations[1]).all()


def test_cameras_in_one_place_have_a_length_too() -> None:
    view = make_sphere(3).capture.views[0]
    assert own_length([view.camera, view.camera]) == pytest.approx(np.linalg.norm(view.camera.centre))
    at_origin = replace(view.camera, translation=np.zeros(3))
    assert own_length([at_origin, at_origin]) == 1.0


def test_a_result_is_the_same_in_any_unit() -> None:
    """But for the last bits of its vertices, which are in that unit."""
    capture = make_sphere(4).capture
    here, there = (reconstruct(one, Settings("ball", "draft"), None, Progress()) for one in (capture, in_unit(capture, 10)))
    assert (here.surface.faces == there.surface.faces).all() and (here.material.normal == there.material.normal).all()
    assert np.abs(there.surface.vertices / 10 - here.surface.vertices).max() < 1e-12 * np.ptp(here.surface.vertices)
    assert all((a == b).all() for a, b in zip(here.lights.direction, there.lights.direction, strict=True))
