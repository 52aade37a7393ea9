"""mvps.correlation: lights of metals and of matte surfaces, from normals that are a few degrees off."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvps.correlation import (
    TOWARDS_CAMERA,
    alike_in_all_views,
    directions,
    glossy_lights,
    is_glossy,
    lamps_of_a_glossy_surface,
    searched,
    sphere,
)
from mvps.mesh import angles_deg, normalise

RNG = np.random.default_rng(0)
TRUE_NORMAL = directions(6000)[directions(6000)[:, 2] < -0.1]
NORMAL = normalise(TRUE_NORMAL + RNG.normal(0, 0.12, TRUE_NORMAL.shape))
LIGHT = normalise(np.concatenate([RNG.normal(0, 0.6, (12, 2)), -np.ones((12, 1))], axis=1))
INTENSITY = RNG.uniform(0.5, 2, 12)
ALBEDO = RNG.uniform(0.3, 1, (len(NORMAL), 1))


def photographed(sharpness: float, body: float) -> np.ndarray:
    """(n, lights) of patches of albedo whose lobe has this sharpness, beside this part of diffuse light."""
    half = normalise(LIGHT + TOWARDS_CAMERA)
    lobe = np.exp(sharpness * (TRUE_NORMAL @ half.T - 1)) if sharpness else 0
    image: np.ndarray = ALBEDO * np.maximum(TRUE_NORMAL @ LIGHT.T, 0) * (body + lobe) * INTENSITY
    return image


@pytest.mark.parametrize("sharpness", [8.0, 20.0, 60.0])
def test_lights_of_a_metal(sharpness: float) -> None:
    image = photographed(sharpness, 0.0)
    assert is_glossy([image], [NORMAL], np.random.default_rng(0))
    found = glossy_lights(image, NORMAL)
    assert angles_deg(normalise(found), LIGHT).mean() < 5
    level = np.linalg.norm(found, axis=1) / INTENSITY
    assert level.std() / level.mean() < 0.15


def test_a_matte_object_is_none() -> None:
    image = photographed(0.0, 1.0)
    assert not is_glossy([image], [NORMAL], np.random.default_rng(0))
    assert angles_deg(searched(image, NORMAL, False)[0], LIGHT).mean() < 5
    assert not is_glossy([photographed(60.0, 0.7)], [NORMAL], np.random.default_rng(0))


def test_each_view_may_have_lights_of_its_own() -> None:
    images = [photographed(20.0, 0.0)[:, :6], photographed(20.0, 0.0)[:, 6:]]
    assert is_glossy(images, [NORMAL, NORMAL], np.random.default_rng(0))


def test_a_photograph_without_light_has_finite_lights() -> None:
    image = photographed(20.0, 0.0)
    image[:, 3] = 0
    found = glossy_lights(image, NORMAL)
    assert np.isfinite(found).all() and (np.linalg.norm(found, axis=1) > 0).all()


ROTATIONS = [Rotation.from_euler("y", 60 * k, degrees=True).as_matrix() for k in range(6)]


def photographed_from(rotation: np.ndarray, light: np.ndarray) -> np.ndarray:
    """(n, lights) of a metal ball in a view, of lights (lights, 3) in the world's frame."""
    seen = light @ rotation.T
    half = normalise(seen + TOWARDS_CAMERA)
    image: np.ndarray = ALBEDO * np.maximum(TRUE_NORMAL @ seen.T, 0) * np.exp(20 * (TRUE_NORMAL @ half.T - 1)) * INTENSITY
    return image


def test_lamps_around_a_metal_that_stand_still_while_the_camera_moves() -> None:
    lamps = sphere(12)
    found = lamps_of_a_glossy_surface([photographed_from(R, lamps) for R in ROTATIONS], [NORMAL] * 6, ROTATIONS)
    assert found is not None and angles_deg(normalise(found), lamps).mean() < 5
    level = np.linalg.norm(found, axis=1) / INTENSITY
    assert level.std() / level.mean() < 0.15
    images = [photographed_from(R, lamps) for R in ROTATIONS]
    images[2][:, 3:5] = np.nan
    without = lamps_of_a_glossy_surface(images, [NORMAL] * 6, ROTATIONS)
    assert without is not None and angles_deg(normalise(without), lamps).mean() < 5
    # A rig that moves with the camera, lights that are others in every view, and normals that are none tell no such lamps.
    assert lamps_of_a_glossy_surface([photographed(20.0, 0.0)] * 6, [NORMAL] * 6, ROTATIONS) is None
    others = [photographed_from(R, normalise(RNG.normal(size=(12, 3)))) for R in ROTATIONS]
    assert lamps_of_a_glossy_surface(others, [NORMAL] * 6, ROTATIONS) is None
    wrong = normalise(RNG.normal(size=NORMAL.shape))
    assert lamps_of_a_glossy_surface([photographed_from(R, lamps) for R in ROTATIONS], [wrong] * 6, ROTATIONS) is None


def test_whether_views_of_a_metal_share_lights_that_move_with_the_camera() -> None:
    alike, views = photographed(20.0, 0.0), len(ROTATIONS)
    assert alike_in_all_views([alike] * views, [NORMAL] * views, True) is True
    # Of what was left out nothing is said.
    without = alike.copy()
    without[:, 3] = np.nan
    assert alike_in_all_views([alike, without, alike], [NORMAL] * 3, True) is True
    others = [photographed_from(np.eye(3), normalise(np.column_stack([RNG.normal(0, 0.6, (12, 2)), -np.ones(12)]))) for _ in ROTATIONS]
    assert alike_in_all_views(others, [NORMAL] * views, True) is False
    assert alike_in_all_views([alike] * views, [normalise(RNG.normal(size=NORMAL.shape))] * views, True) is None
