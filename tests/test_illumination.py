"""mvps.illumination: energy and directions of environments, and what their lights show."""

from __future__ import annotations

import numpy as np
import pytest

from mvps.illumination import Illumination, directions_of, environment_lights, frame_of, turned

UPS = [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, -2.0, 0.5)]


@pytest.mark.parametrize("up", UPS)
def test_directions_cover_the_sphere(up: tuple[float, float, float]) -> None:
    direction, angle = directions_of(32, 64, np.array(up), 0.0)
    assert np.isclose(angle.sum(), 4 * np.pi)
    np.testing.assert_allclose((direction * angle[..., None]).sum((0, 1)), 0, atol=1e-9)
    assert (direction[0] @ up / np.linalg.norm(up) > 0.99).all() and np.allclose(np.linalg.det(frame_of(np.array(up))), 1)


def test_a_turn_is_about_up_and_counter_clockwise() -> None:
    up = np.array([0.0, 0.0, 1.0])
    before, after = (directions_of(8, 16, up, turn)[0][4, 3] for turn in (0.0, 90.0))
    np.testing.assert_allclose(after, [-before[1], before[0], before[2]], atol=1e-12)


@pytest.mark.parametrize("count", [1, 7, 64, 5000])
def test_the_arriving_light_is_kept(count: int) -> None:
    picture = np.random.default_rng(0).exponential(size=(16, 32, 3)).astype(np.float32)
    light = environment_lights(picture, count, np.array([0.0, 0.0, 1.0]))
    _, angle = directions_of(16, 32, np.array([0.0, 0.0, 1.0]), 0.0)
    np.testing.assert_allclose(light.intensity.sum(0), (picture * angle[..., None]).sum((0, 1)) / np.pi, rtol=1e-6)
    assert len(light.direction) == min(count, 16 * 32)


def test_regions_have_about_equal_energy_and_a_sun_gets_a_light_of_its_own() -> None:
    picture = np.full((64, 128, 3), 0.1, np.float32)
    picture[10, 20] = 5000.0
    light = environment_lights(picture, 32, np.array([0.0, 0.0, 1.0]))
    direction, angle = directions_of(64, 128, np.array([0.0, 0.0, 1.0]), 0.0)
    brightest = light.intensity[:, 0].argmax()
    assert light.direction[brightest] @ direction[10, 20] > np.cos(np.radians(3))
    assert np.isclose(light.intensity[brightest, 0], 5000 * angle[10, 20] / np.pi, rtol=0.01)
    others = np.delete(light.intensity[:, 0], brightest)
    assert others.max() < 8 * np.median(others)


@pytest.mark.parametrize("up", UPS)
def test_lights_of_a_turned_environment_are_the_lights_turned(up: tuple[float, float, float]) -> None:
    picture = np.random.default_rng(0).exponential(size=(16, 32, 3)).astype(np.float32)
    still = environment_lights(picture, 32, np.array(up))
    for degrees in (0, 1, 90, 215, -30):
        wanted, found = environment_lights(picture, 32, np.array(up), degrees), turned(still, np.array(up), degrees)
        np.testing.assert_allclose(found.direction, wanted.direction, atol=1e-14)
        np.testing.assert_array_equal(found.intensity, wanted.intensity)
        np.testing.assert_allclose(found.spread, wanted.spread, atol=1e-14)
    np.testing.assert_array_equal(turned(still, np.array(up), 0).direction, still.direction)


def test_a_black_environment_has_no_light() -> None:
    up = np.array([0.0, 0.0, 1.0])
    assert turned(environment_lights(np.zeros((4, 8, 3), np.float32), 8, up), up, 30).direction.shape == (0, 3)


def test_lights_join() -> None:
    sun = Illumination(np.eye(3)[:1], np.ones((1, 3)))
    both = sun.with_also(Illumination(position=np.eye(3)[1:2], strength=np.ones((1, 3))))
    assert (len(both.direction), len(both.intensity), len(both.position), len(both.strength)) == (1, 1, 1, 1)
