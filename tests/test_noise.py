"""Noise, estimated from the photographs themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sphere_scene import SphereScene, make_sphere

from mvps.noise import dark_noise_share, noise_share
from mvps.scene import Capture


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(4)


@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_noise_is_estimated_from_the_photographs(scene: SphereScene, noise: float) -> None:
    rng = np.random.default_rng(0)

    def noisy(view):  # type: ignore[no-untyped-def]
        level = view.samples.mean(2).std() + view.samples.mean()
        # Grey is the mean of three channels.
        added = rng.normal(0, noise * level * np.sqrt(3), view.samples.shape)
        return replace(view, samples=np.clip(view.samples + added + 20000, 0, 65534).astype(np.uint16)), noise * level

    views, sigmas = zip(*map(noisy, scene.capture.views), strict=True)
    shares = [s / np.sqrt((v.samples[:, k].mean(1) ** 2).mean()) for v, s in zip(views, sigmas, strict=True) for k in (0, 5)]
    assert noise_share(Capture("noisy", views)) == pytest.approx(float(np.median(shares)), rel=0.2)


def test_dark_pixels_have_their_own_noise(scene: SphereScene) -> None:
    rng = np.random.default_rng(0)

    def noisy(view):  # type: ignore[no-untyped-def]
        # Five times as much in the light, half of the sphere dark.
        dark = view.pixels[:, 1] < np.median(view.pixels[:, 1])
        level, sigma = np.where(dark, 0.0, 20000.0), np.where(dark, 100.0, 500.0) * np.sqrt(3)
        added = rng.normal(0, 1, view.samples.shape) * sigma[:, None, None]
        return replace(view, samples=np.clip(level[:, None, None] + added, 0, 65534).astype(np.uint16))

    capture = Capture("noisy", tuple(noisy(view) for view in scene.capture.views))
    level = 20000 * np.sqrt(0.5)
    # Where it is dark the half below zero is missing, and the darkest differ least.
    assert 20 < dark_noise_share(capture) * level < 100 < noise_share(capture) * level
