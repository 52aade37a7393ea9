"""mvps.checks.black: a camera's black level is found and taken off, photographs without one stay as they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from mvps.checks.black import black_level
from mvps.load import read_capture
from mvps.load.diligent import with_mask
from mvps.scene import Bool, Capture, Float, Truth
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings

Change = Callable[[Float, Bool, int], Float]
"""Of a photograph (height, width, 3), full scale 1, with the object's mask and its number."""

RNG = np.random.default_rng(0)


@cache
def clean() -> tuple[Capture, Truth]:
    return render_capture(SceneSettings(views=3, lights=8, size=80, noise=0.0))


def photographed(folder: Path, change: Change, top: int = 65535) -> Capture:
    """The clean capture with its photographs changed, of 16 or 8 bits."""
    write_capture(*clean(), folder)
    for view in clean()[0].views:
        for light in view.lights:
            path = str(folder / view.name / f"{light:03d}.png")
            image = np.asarray(cv2.imread(path, cv2.IMREAD_UNCHANGED)) / 65535
            values = np.rint(top * np.clip(change(image, view.mask, light), 0, 1))
            cv2.imwrite(path, values.astype(np.uint16 if top > 255 else np.uint8))
    return read_capture(folder)


def by_a_camera(b: float | Float, noise: float = 0.001) -> Change:
    return lambda image, mask, light: b + (1 - np.max(b)) * image + RNG.normal(0, noise, image.shape)


def off_by(capture: Capture, gain: float) -> float:
    """Largest mean of what a view's photographs are off, full scale 1."""
    return max(
        float(np.abs(np.mean(view.samples * view.scale - gain * good.samples * good.scale, axis=(0, 1))).max())
        for view, good in zip(capture.views, clean()[0].views, strict=True)
    )


@pytest.mark.parametrize(("b", "top"), [(0.01, 65535), (0.04, 65535), (0.125, 65535), (0.04, 255)])
def test_it_is_found_and_taken_off(b: float, top: int, tmp_path: Path) -> None:
    given = photographed(tmp_path / "given", by_a_camera(b), top)
    mended, (finding,) = black_level(given)
    assert finding.about == "radiometry" and finding.mended
    assert float(finding.text.split("darker than ")[1].split(" %")[0]) == pytest.approx(100 * b, rel=0.05)
    assert off_by(given, 1 - b) > 0.9 * b and off_by(mended, 1 - b) < max(1e-3, 0.6 / top)
    assert all(view.frame is not None and np.median(view.frame[~view.mask]) / top < 1e-3 for view in mended.views)


def test_every_channel_has_its_own(tmp_path: Path) -> None:
    b = np.array([0.03, 0.04, 0.05])
    mended, found = black_level(photographed(tmp_path / "given", by_a_camera(b)))
    assert found and off_by(mended, 0.95) < 1e-3


def test_clipped_samples_stay_clipped(tmp_path: Path) -> None:
    given = photographed(tmp_path / "given", lambda image, mask, light: by_a_camera(0.05)(1.6 * image, mask, light))
    mended, found = black_level(given)
    assert found and not all(view.usable().all() for view in given.views)
    for before, after in zip(given.views, mended.views, strict=True):
        np.testing.assert_array_equal(before.usable(), after.usable())


def test_photographs_that_are_read_again_have_none_either(tmp_path: Path) -> None:
    mended, _ = black_level(photographed(tmp_path / "given", by_a_camera(0.04)))
    view = mended.views[0]
    grown = with_mask(view, np.asarray(cv2.dilate(view.mask.astype(np.uint8), np.ones((9, 9), np.uint8)), bool))
    beside = grown.samples[~view.mask[grown.mask]]
    assert len(beside) > 100 and beside.mean() * view.scale < 0.002


def stray(image: Float, mask: Bool, light: int) -> Float:
    """A black room: cloth that lamps reach by more or less."""
    return image + 0.02 * (1 + np.cos(light))


def cut_out(image: Float, mask: Bool, light: int) -> Float:
    """Laid on grey."""
    return np.where(mask[..., None], image, 0.05)


def cut_out_under_frontal_light(image: Float, mask: Bool, light: int) -> Float:
    """The same where no part of the object is as dark."""
    return np.where(mask[..., None], 0.1 + image, 0.05)


def before_a_wall(image: Float, mask: Bool, light: int) -> Float:
    return np.where(mask[..., None], image, image[mask].mean())


def as_it_was(image: Float, mask: Bool, light: int) -> Float:
    return image + np.abs(RNG.normal(0, 0.002, image.shape))


@pytest.mark.parametrize("change", [stray, cut_out, cut_out_under_frontal_light, before_a_wall, as_it_was])
def test_photographs_without_stay_as_they_are(change: Change, tmp_path: Path) -> None:
    given = photographed(tmp_path / "given", change)
    after, found = black_level(given)
    assert after is given and not found


def test_without_a_background_nothing_is_told(tmp_path: Path) -> None:
    given = photographed(tmp_path / "given", by_a_camera(0.04))
    everywhere = tuple(with_mask(view, np.ones_like(view.mask)) for view in given.views)
    unknown = tuple(replace(view, files=()) for view in given.views)
    for views in (everywhere, unknown):
        capture = Capture(given.name, views)
        assert black_level(capture)[0] is capture
