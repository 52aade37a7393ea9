"""Noise, estimated from the photographs themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sphere_scene import SphereScene, make_sphere

from mvps.noise import noise_share
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
