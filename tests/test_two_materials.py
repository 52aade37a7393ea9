"""mvps.two_materials: lights of one view of metals and the like, by what all of their patches have in common."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mvps.camera import pixel_centres, rays
from mvps.exemplars import matched
from mvps.mesh import angles_deg, normalise
from mvps.relief.ambiguity import outer_band
from mvps.scene import Camera, Float, View
from mvps.two_materials import lights_by_materials, materials_under

SIZE, RADIUS, LIGHTS, CPU = 48, 22, 16, torch.device("cpu")
TURNED = Rotation.from_rotvec([0.3, 1.0, -0.5]).as_matrix()
CAMERA = Camera(np.array([[600.0, 0, SIZE / 2], [0, 600, SIZE / 2], [0, 0, 1]]), TURNED, np.array([0.0, 0, 10]), SIZE, SIZE)
ACROSS = (np.indices((SIZE, SIZE))[::-1] + 0.5 - SIZE / 2).transpose(1, 2, 0) / RADIUS
MASK = (ACROSS**2).sum(-1) < 1
BALL = np.column_stack([ACROSS[MASK], -np.sqrt(1 - (ACROSS[MASK] ** 2).sum(-1))])
"""Normals of a ball, camera frame."""

RNG = np.random.default_rng(0)
TRUE = normalise(np.concatenate([RNG.normal(0, 0.5, (LIGHTS, 2)), -np.ones((LIGHTS, 1))], 1))
STRENGTH = RNG.uniform(0.6, 1.4, LIGHTS)
METAL, CHALK = np.ones(len(BALL), bool), np.zeros(len(BALL), bool)


def photographed(metal: np.ndarray, exposure: float = 1.0, error: float = 0.02) -> View:
    """A ball of metal (pixels,), a lobe with the tails of microfacets (shading.py) and no body, with chalk elsewhere; noise in parts of a
    value."""
    towards = -rays(CAMERA, pixel_centres(np.argwhere(MASK)))[1] @ TURNED.T
    half = normalise(towards[:, None] + TRUE)
    tails = (1 + 5 * (1 - (half * BALL[:, None]).sum(2) ** 2)) ** -2
    lobe = np.where(metal[:, None], tails / (half * towards[:, None]).sum(2) ** 2, 0.4)
    value = np.maximum(BALL @ TRUE.T, 0) * lobe * STRENGTH * (1 + error * np.random.default_rng(1).normal(size=(len(BALL), LIGHTS)))
    scale = value.max() / 60000
    samples = np.repeat(np.rint(value / scale)[..., None], 3, 2).astype(np.uint16)
    return View("view_01", CAMERA, MASK, samples, exposure * scale, 65535, tuple(range(1, LIGHTS + 1)))


def rough_lights(spread: float = 0.2) -> Float:
    """Lights that are some ten degrees and a fifth off, each in its own way."""
    draw = np.random.default_rng(2)
    away = normalise(TRUE + draw.normal(0, spread, TRUE.shape))
    found: Float = away * (STRENGTH * np.exp(draw.normal(0, spread, LIGHTS)))[:, None]
    return found


def errors(lights: Float) -> tuple[float, float]:
    """Mean degrees, and mean part of an intensity."""
    strength = np.linalg.norm(lights, axis=1) / STRENGTH
    return float(angles_deg(normalise(lights), TRUE).mean()), float(np.abs(strength / np.median(strength) - 1).mean())


@pytest.mark.parametrize("part", [1, 2])
def test_lights_of_metal_and_of_half_metal(part: int) -> None:
    view = photographed(np.arange(len(BALL)) % part == 0)
    before = errors(rough_lights())
    found, variance = lights_by_materials(view, rough_lights(), BALL, outer_band(view), CPU, 0)
    after = errors(found)
    assert before[0] > 10 and after[0] < 0.4 * before[0]
    assert before[1] > 0.12 and after[1] < 0.04
    assert 0 < np.degrees(np.sqrt(variance)) < 5


def test_lights_are_the_same_whatever_the_exposure_and_change_with_the_seed_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvps.two_materials.TOGETHER", 30)
    view, outline = photographed(METAL), outer_band(photographed(METAL))
    found, variance = lights_by_materials(view, rough_lights(), BALL, outline, CPU, 0)
    again, same = lights_by_materials(view, rough_lights(), BALL, outline, CPU, 0)
    assert (found == again).all() and variance == same
    exposed = lights_by_materials(photographed(METAL, 1e6), 1e6 * rough_lights(), BALL, outline, CPU, 0)[0]
    assert angles_deg(normalise(exposed), normalise(found)).max() < 1e-6
    other = lights_by_materials(view, rough_lights(), BALL, outline, CPU, 1)[0]
    assert 0 < angles_deg(normalise(other), normalise(found)).max() < 10


def test_without_an_outline_and_with_black_and_clipped_pixels_all_is_finite(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvps.two_materials.TOGETHER", 30)
    view = photographed(METAL)
    samples = view.samples.copy()
    samples[:300], samples[300:600] = 0, 65535
    found, variance = lights_by_materials(replace(view, samples=samples), rough_lights(), BALL, np.zeros(0, int), CPU, 0)
    assert np.isfinite(found).all() and np.isfinite(variance)


def test_of_four_lights_nothing_is_asked() -> None:
    """They tell no normal, body and lobe."""
    whole = photographed(METAL)
    view = replace(whole, samples=whole.samples[:, :4], lights=whole.lights[:4])
    found, variance = lights_by_materials(view, rough_lights()[:4], BALL, outer_band(view), CPU, 0)
    assert (found == rough_lights()[:4]).all() and variance > 0
    assert (materials_under(view, TRUE[:4] @ TURNED, np.ones((4, 3)), CPU) == 1).all()


def test_materials_under_given_lights_tell_normals() -> None:
    """A fourth of the pixels is of chalk."""
    metal = np.arange(len(BALL)) % 4 > 0
    view, direction, intensity = photographed(metal), TRUE @ TURNED, np.repeat(STRENGTH[:, None], 3, 1)
    weights = materials_under(view, direction, intensity, CPU)
    assert weights.shape == (2, 4) and (weights >= 0).all()
    body = weights[:, 0] / weights.sum(1)
    assert body.min() < 0.1 and body.max() > 0.6
    normal = matched(view, direction, intensity, weights, np.arange(len(BALL)), CPU)[0] @ TURNED.T
    off, towards = angles_deg(normal, BALL), BALL[:, 2] < -0.5
    assert off[towards & metal].mean() < 5 and off[towards & ~metal].mean() < 3
