"""Distortion that a calibration gives: undone where photographs show it, left alone where they do not, said where nobody can tell."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvps.checks.lens import bent, lens, straightened
from mvps.distortion import free_of_lens, seen_at
from mvps.load import read_truth
from mvps.mesh import angles_deg
from mvps.scene import Camera, Capture
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))

from hard import damage

BENT = (0.7, -0.4, 0.01, -0.02, 0.1)


@pytest.fixture(scope="module")
def clean() -> Capture:
    return render_capture(SceneSettings(views=6, lights=3, size=96))[0]


def with_lens(capture: Capture, pixels: float) -> Capture:
    """The capture with a calibration whose lens bends the rim by so many pixels."""
    return damage.lens_given(capture, pixels, np.random.default_rng(0))


def through_lens(capture: Capture, pixels: float) -> Capture:
    """The same, with photographs as the lens shows them."""
    return damage.lens(capture, pixels, np.random.default_rng(0))


@pytest.mark.parametrize("skew", [0.0, 12.0])
def test_the_two_maps_are_inverse_to_each_other(skew: float) -> None:
    K = np.array([[150.0, skew, 40], [0, 160, 30], [0, 0, 1]])
    column, row = seen_at(Camera(K, np.eye(3), np.zeros(3), 60, 80, (1e-9, 0, 0, 0, 0)))
    np.testing.assert_allclose(column, np.broadcast_to(np.arange(80), column.shape), atol=1e-3)
    np.testing.assert_allclose(row, np.broadcast_to(np.arange(60)[:, None], row.shape), atol=1e-3)
    camera = Camera(K, np.eye(3), np.zeros(3), 60, 80, BENT)
    column, row = seen_at(camera)
    seen = np.stack([column, row], -1).reshape(-1, 2) + 0.5
    straight = np.stack(np.meshgrid(np.arange(80), np.arange(60)), -1).reshape(-1, 2) + 0.5
    assert np.abs(seen - straight).max() > 1
    np.testing.assert_allclose(free_of_lens(camera, seen), straight, atol=0.02)


def test_the_lens_is_browns() -> None:
    camera = Camera(np.array([[150.0, 0, 40], [0, 160, 30], [0, 0, 1]]), np.eye(3), np.zeros(3), 60, 80, BENT)
    column, row = seen_at(camera)
    x, y = (10.5 - 40) / 150, (50.5 - 30) / 160
    r2, (k1, k2, k3, k4, k5) = x * x + y * y, BENT
    radial = 1 + k1 * r2 + k2 * r2**2 + k5 * r2**3
    moved_x = x * radial + 2 * k3 * x * y + k4 * (r2 + 2 * x * x)
    moved_y = y * radial + k3 * (r2 + 2 * y * y) + 2 * k4 * x * y
    assert column[50, 10] == pytest.approx(150 * moved_x + 40 - 0.5, abs=1e-3)
    assert row[50, 10] == pytest.approx(160 * moved_y + 30 - 0.5, abs=1e-3)


@pytest.mark.parametrize("pixels", [2.5, -4.0])
def test_photographs_that_show_the_lens_are_undistorted(clean: Capture, pixels: float) -> None:
    given = through_lens(clean, pixels)
    mended, (finding,) = lens(given)
    assert finding.mended and "photographs were undistorted" in finding.text
    for before, after, true in zip(given.views, mended.views, clean.views, strict=True):
        assert not after.camera.distortion and after.files == ()
        assert (after.mask != true.mask).sum() < 0.4 * (before.mask != true.mask).sum()
        both = after.mask & true.mask
        off = after.samples[both[after.mask]].astype(float) - true.samples[both[true.mask]]
        assert np.median(np.abs(off)) < 0.05 * np.median(true.samples)


@pytest.mark.parametrize("pixels", [2.5, -2.5])
def test_photographs_without_it_stay(clean: Capture, pixels: float) -> None:
    given = with_lens(clean, pixels)
    kept, findings = lens(given)
    assert kept is given and not findings


@pytest.mark.parametrize(("views", "pixels"), [(2, 4.0), (1, 4.0), (6, 0.5)])
def test_what_nobody_can_tell_is_said_and_stays(clean: Capture, views: int, pixels: float) -> None:
    given = through_lens(Capture("few", clean.views[:views]), pixels)
    kept, (finding,) = lens(given)
    assert kept is given and finding.mended and "taken as free of it" in finding.text


@pytest.mark.parametrize("pixels", [0.0, 0.1])
def test_a_lens_that_bends_less_than_masks_tell_is_none(clean: Capture, pixels: float) -> None:
    given = with_lens(clean, pixels)
    assert bent(given.views[0]) == pytest.approx(pixels, rel=0.3, abs=1e-6)
    assert lens(given) == (given, [])


def test_clipped_samples_stay_clipped(clean: Capture) -> None:
    view = with_lens(clean, 3.0).views[0]
    samples = view.samples.copy()
    samples[:, 1] = view.saturation
    after = straightened(replace(view, samples=samples))
    assert not after.usable([1]).any() and after.usable([0]).all()


def test_what_is_clipped_lower_is_no_brighter_than_that(clean: Capture) -> None:
    view = with_lens(clean, 3.0).views[0]
    view = replace(view, samples=np.minimum(view.samples, 4095), saturation=4095)
    after = straightened(view)
    assert not view.usable().all() and not after.usable().all() and after.samples.max() == 4095


def test_true_normals_of_photographs_that_show_the_lens_are_straightened(tmp_path: Path) -> None:
    clean, truth = render_capture(SceneSettings(views=1, lights=2, size=96))
    given = through_lens(clean, 3.0)
    (camera,), (mask,) = [view.camera for view in given.views], [view.mask for view in given.views]
    name, (rows, columns) = clean.views[0].name, np.indices(mask.shape)
    free = free_of_lens(camera, np.stack([columns, rows], -1).reshape(-1, 2) + 0.5)
    column, row = np.floor(free).astype(int).clip(0, 95).T
    seen = np.where(mask[..., None], truth.normals[name][row, column].reshape(*mask.shape, 3), np.nan)
    write_capture(given, replace(truth, normals={name: seen}), tmp_path / "capture")
    as_photographed = read_truth(tmp_path / "capture").normals[name]
    straight = read_truth(tmp_path / "capture", {name: clean.views[0].camera}).normals[name]
    assert np.isfinite(straight[clean.views[0].mask]).all(-1).mean() > 0.97
    both = np.isfinite(as_photographed).all(-1) & np.isfinite(straight).all(-1) & clean.views[0].mask
    before, after = (float(np.mean(angles_deg(of[both].astype(float), truth.normals[name][both]))) for of in (as_photographed, straight))
    assert before > 2 and after < 0.4 * before
    np.testing.assert_array_equal(read_truth(tmp_path / "capture", {name: camera}).normals[name], as_photographed)
