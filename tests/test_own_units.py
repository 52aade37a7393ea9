"""The unit of the world: which one it is does not matter, not even in the last bits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sphere_scene import RADIUS, make_sphere

from mvps.own_units import FAR, STEP, in_own_units, object_place, own_length, own_units
from mvps.progress import Progress
from mvps.reconstruct import Settings, reconstruct
from mvps.scene import Capture, Float


def in_unit(capture: Capture, unit: float) -> Capture:
    """The same capture where a length of one is `unit`."""
    cameras = [replace(view.camera, translation=view.camera.translation * unit) for view in capture.views]
    return Capture(capture.name, tuple(view.taken_by(camera) for view, camera in zip(capture.views, cameras, strict=True)))


@pytest.mark.parametrize("unit", [1e-6, 0.0254, 10.0, 1e6])
def test_the_same_cameras_in_any_unit_are_the_same_numbers(unit: float) -> None:
    capture = make_sphere(3).capture
    translations = []
    for one in (capture, in_unit(capture, unit)):
        length, origin = units = own_units(one)
        own = in_own_units(one, units)
        assert (origin == 0).all()
        assert own_length([view.camera for view in own.views]) == pytest.approx(1)
        for view, before in zip(own.views, one.views, strict=True):
            assert np.abs(view.camera.translation * length - before.camera.translation).max() < STEP * length
            assert view.samples is before.samples
        translations.append(np.stack([view.camera.translation for view in own.views]))
    assert (translations[0] == translations[1]).all()


def from_afar(capture: Capture, away: Float) -> Capture:
    """The same capture where everything is farther from the world's origin by this (3,)."""
    cameras = [replace(v.camera, translation=v.camera.translation - v.camera.rotation @ away) for v in capture.views]
    return Capture(capture.name, tuple(view.taken_by(camera) for view, camera in zip(capture.views, cameras, strict=True)))


def test_the_object_is_where_the_cameras_look() -> None:
    capture = make_sphere(6).capture
    for away in (np.zeros(3), np.array([3.0, -2, 50])):
        place, size = object_place(from_afar(capture, away))
        assert np.linalg.norm(place - away) < 0.05 * size and size == pytest.approx(2 * RADIUS, rel=0.1)


@pytest.mark.parametrize("sizes", [0.0, 5.0, 100.0, 1e6])
def test_from_wherever_a_result_is_the_same(sizes: float) -> None:
    capture = make_sphere(4).capture
    away = np.array([0.6, 0.0, -0.8]) * sizes * object_place(capture)[1]
    there = from_afar(capture, away)
    assert (own_units(there).origin != 0).any() == (sizes > FAR)
    here, moved = (reconstruct(one, Settings("ball", "draft"), None, Progress()) for one in (capture, there))
    off = [np.abs(np.linalg.norm(of, axis=1) - RADIUS).mean() for of in (here.surface.vertices, moved.surface.vertices - away)]
    assert off[1] < 1.15 * off[0]


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
