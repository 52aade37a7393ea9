"""Noise, estimated from the photographs themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sphere_scene import SphereScene, make_sphere

from mvps.noise import dark_noise_share, noise_share
from mvps.scene import Capture, View


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


def dim_below(scene: SphereScene, level: float) -> Capture:
    """Upper halves of the masks at this level with noise of 100, lower ones at 20000 with noise of 500, in grey."""
    rng = np.random.default_rng(0)

    def of_view(view: View) -> View:
        dim = view.pixels[:, 1] < np.median(view.pixels[:, 1])
        values = rng.normal(0, 1, view.samples.shape) * np.where(dim, 100, 500)[:, None, None] * np.sqrt(3)
        return replace(view, samples=np.clip(values + np.where(dim, level, 20000)[:, None, None], 0, 65534).astype(np.uint16))

    return Capture("dim", tuple(of_view(view) for view in scene.capture.views))


def test_dark_pixels_have_their_own_noise(scene: SphereScene) -> None:
    assert dark_noise_share(dim_below(scene, 2000)) * 20000 * np.sqrt(0.5) == pytest.approx(100, rel=0.2)


def test_of_noise_at_zero_less_than_half_is_left(scene: SphereScene) -> None:
    # 0.58 of it without what would be below zero, and the darkest pixels are those that differ least.
    assert 20 < dark_noise_share(dim_below(scene, 0)) * 20000 * np.sqrt(0.5) < 58
