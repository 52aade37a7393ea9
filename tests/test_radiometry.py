"""mvps.checks.radiometry: a curve left in the files is named and undone, linear photographs stay as they are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from mvps.checks.photographs import photographs
from mvps.checks.radiometry import CURVES, LINEAR, SWEEPS, _rho, curve_undone, is_metal, left_in, linear
from mvps.load import read_capture
from mvps.scene import Capture
from mvps.synthetic.scene import make_scene, render_capture
from mvps.synthetic.settings import SceneSettings


@cache
def made(seed: int, strength: float = 1.0, **other: float) -> Capture:
    return render_capture(replace(SceneSettings(views=4, lights=16, size=96, seed=seed, strength=strength), **other))[0]


def encoded(capture: Capture, name: str, bits: int) -> Capture:
    """The capture with a curve put on, by looking each code up in the table of the curve."""
    full = 2**bits - 1
    radiance = CURVES[name](np.arange(full + 1) / full)
    codes = np.searchsorted(radiance, np.arange(65536) / 65535).clip(0, full).astype(np.uint16)
    views = (replace(view, samples=codes[view.samples], scale=1 / full, saturation=int(codes[view.saturation])) for view in capture.views)
    return Capture(capture.name, tuple(views))


@pytest.mark.parametrize(
    "capture",
    [made(0), made(1, 0.0), made(2, 3.0), made(4, lights=10, intensity_spread=1.5)],
    ids=["gloss", "matt", "much gloss", "unequal lights"],
)
def test_linear_photographs_stay_as_they_are(capture: Capture) -> None:
    after, found = curve_undone(capture)
    assert not found and after is capture


@pytest.mark.parametrize(("name", "bits"), [("gamma 2.2", 8), ("sRGB", 8), ("gamma 2.2", 16), ("gamma 2.4", 16)])
def test_a_curve_is_undone(name: str, bits: int) -> None:
    capture = made(0)
    after, found = curve_undone(encoded(capture, name, bits))
    assert len(found) == 1 and found[0].mended and "not linear" in found[0].text
    for view, true in zip(after.views, capture.views, strict=True):
        assert view.scale == 1 / 65535
        lit = true.usable() & view.usable()
        # One curve may be taken for a neighbour of it: within that, and a code of 8 bits, radiance is as it was.
        error = np.abs(view.radiance() - true.radiance())[lit]
        assert np.median(error) < 0.04 and np.median(error) < 0.3 * np.median(np.abs(true.radiance() ** (1 / 2.2) - true.radiance())[lit])


def test_a_metal_has_no_curve_and_no_black_photographs() -> None:
    settings = SceneSettings(views=8, lights=10, size=128, exposure=0.98)
    scene = make_scene(settings)
    weight = np.tile([0.4, 1.0], (len(scene.material.albedo), 1))
    metal = replace(scene.material, albedo=0 * scene.material.albedo, specular_weight=weight)
    capture, _ = render_capture(settings, replace(scene, material=metal))
    assert left_in(capture) is not None, "three factors alone would be taken in"
    for check in (curve_undone, photographs):
        _, found = check(capture)
        assert not found


@pytest.mark.parametrize(("name", "view", "metal"), [("buddha", 1, True), ("buddha", 7, True), ("spot", 1, False), ("ball", 1, False)])
def test_a_single_view_tells_a_metal_by_its_silhouette(captures: Path, name: str, view: int, metal: bool) -> None:
    """Of a knot of gold, path traced, undoing gamma 2.4 made three factors fit 1.4 times as well."""
    assert is_metal(read_capture(captures / name, [view])) is metal


@pytest.mark.parametrize("name", CURVES)
def test_what_was_clipped_stays_clipped(name: str) -> None:
    views = encoded(made(0), name, 8).views
    view = min(views, key=lambda view: view.usable().mean())
    assert not view.usable().all()
    assert np.array_equal(linear(view, CURVES[name]).usable(), view.usable())


def test_few_lights_say_nothing() -> None:
    capture = encoded(made(0), "sRGB", 8)
    few = capture.select({view.name: view.lights[:5] for view in capture.views})
    assert curve_undone(few) == (few, [])


def test_pixels_that_few_lamps_light_say_nothing() -> None:
    """Three factors fit four samples whatever they are: under raking lamps a curve passed for left in."""
    capture = made(0)
    views = []
    for view in capture.views:
        order = np.argsort(np.argsort(-view.samples.mean(-1), axis=1), axis=1)
        views.append(replace(view, samples=np.where((order < 4)[..., None], view.samples, 0).astype(np.uint16)))
    raking = Capture(capture.name, tuple(views))
    assert left_in(raking) is None and np.isnan([_rho(view, LINEAR, SWEEPS) for view in views]).all()
