"""mvps.checks.photographs: what does not belong is found by its name, what does belong stays as it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from sphere_scene import camera_at

from mvps.checks.photographs import RELATED, photographs
from mvps.joint.colours import _ratios
from mvps.pixel_samples import colour_ratios
from mvps.scene import Capture, View
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings

VIEW, LIGHT = 4, 5
"""Places of the photograph that is spoilt."""

Samples = NDArray[np.uint16]


@pytest.fixture(scope="module")
def clean() -> Capture:
    return render_capture(SceneSettings(views=8, lights=16, size=128))[0]


def spoilt(capture: Capture, change: Callable[[Samples, View], None]) -> Capture:
    views = list(capture.views)
    samples = views[VIEW].samples.copy()
    change(samples, views[VIEW])
    views[VIEW] = replace(views[VIEW], samples=samples)
    return Capture(capture.name, tuple(views))


def image_of(view: View, samples: Samples, light: int) -> Samples:
    image = np.zeros((*view.mask.shape, 3), np.uint16)
    image[view.mask] = samples[:, light]
    return image


def moved(samples: Samples, view: View) -> None:
    samples[:, LIGHT] = np.roll(image_of(view, samples, LIGHT), (3, 6), (0, 1))[view.mask]


def black(samples: Samples, view: View) -> None:
    samples[:, LIGHT] //= 1000


def flashed(samples: Samples, view: View) -> None:
    samples[:, LIGHT] = np.minimum(samples[:, LIGHT] + samples.mean(1), view.saturation - 1).astype(np.uint16)


def other_view(capture: Capture) -> Callable[[Samples, View], None]:
    def change(samples: Samples, view: View) -> None:
        other = capture.views[0]
        samples[:, LIGHT] = image_of(other, other.samples, LIGHT)[view.mask]

    return change


def swapped(samples: Samples, view: View) -> None:
    samples[:, [LIGHT, 9]] = samples[:, [9, LIGHT]]


@pytest.mark.parametrize(
    "settings",
    [
        SceneSettings(views=6, lights=12, size=96),
        SceneSettings(views=6, lights=12, size=96, seed=1, free_lights=True),
        SceneSettings(views=4, lights=6, size=96, seed=2, strength=2, noise=0.02),
        SceneSettings(views=3, lights=3, size=64, seed=3),
        SceneSettings(views=6, lights=12, size=96, seed=1, intensity_spread=1.5),
    ],
)
def test_clean_captures_stay_as_they_are(settings: SceneSettings) -> None:
    capture, _ = render_capture(settings)
    after, found = photographs(capture)
    assert after is capture and not found


@pytest.mark.parametrize(
    ("change", "words"), [(moved, "moved by about 6 pixels to the right and 3 down"), (black, "black"), (flashed, "second")]
)
def test_a_spoilt_photograph_is_found_and_left_out(clean: Capture, change: Callable[[Samples, View], None], words: str) -> None:
    after, found = photographs(spoilt(clean, change))
    assert [one.where for one in found] == [f"view_{VIEW + 1:02d}/{LIGHT + 1:03d}"]
    assert words in found[0].text and found[0].mended
    shown = np.stack([view.shown for view in after.views])
    assert not shown[VIEW, LIGHT] and shown.sum() == shown.size - 1


def test_a_photograph_from_another_view_is_found(clean: Capture) -> None:
    after, found = photographs(spoilt(clean, other_view(clean)))
    assert [one.where for one in found] == [f"view_{VIEW + 1:02d}/{LIGHT + 1:03d}"]
    assert "another view" in found[0].text
    assert not after.views[VIEW].shown[LIGHT]


def test_photographs_of_a_rig_that_changed_places_are_put_back(clean: Capture) -> None:
    after, found = photographs(spoilt(clean, swapped))
    assert {one.where for one in found} == {f"view_{VIEW + 1:02d}/006", f"view_{VIEW + 1:02d}/010"}
    assert np.array_equal(after.views[VIEW].samples, clean.views[VIEW].samples)
    assert all(a.samples is b.samples for i, (a, b) in enumerate(zip(clean.views, after.views, strict=True)) if i != VIEW)


def test_what_was_left_out_does_not_colour_the_lights(clean: Capture) -> None:
    left = clean.without({clean.views[0].name: [3]}).views[0]
    whole, ratio = colour_ratios(clean.views[0]), colour_ratios(left)
    assert np.allclose(np.delete(ratio, 2, 0), np.delete(whole, 2, 0), atol=0.01) and np.allclose(ratio[2], 1)


def test_lights_of_which_no_sample_speaks_are_white() -> None:
    sums = [(np.array([[2.0, 2.2, 1.8], [0.0, 0.0, 0.0]]), np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]))]
    ratios = _ratios(sums, one_rig=False)[0]
    assert np.isfinite(ratios).all() and (ratios > 0).all() and np.allclose(ratios.mean(1), 1)


def smooth_ball(rng: np.random.Generator, odd: bool) -> View:
    """A white ball under twelve lights from the front; odd: one photograph holds a smooth light of its own beside its lamp's."""
    row, column = np.indices((96, 96)) - 47.5
    mask = np.hypot(row, column) < 40
    normal = np.stack([column, -row, np.sqrt(np.maximum(40**2 - row**2 - column**2, 0))], -1)[mask] / 40
    light = rng.normal(size=(12, 3)) * (0.5, 0.5, 0) + (0, 0, 1)
    image = np.maximum(normal @ (light / np.linalg.norm(light, axis=1, keepdims=True)).T, 0)
    if odd:
        image[:, LIGHT] += 0.3 * np.sin(4 * normal[:, 0] + 1) * np.cos(4 * normal[:, 1])
    code = 20000 * np.maximum(image + 0.003 * rng.normal(size=image.shape), 0)
    samples = np.repeat(code.astype(np.uint16)[..., None], 3, axis=-1)
    return View("view", camera_at(np.array([0.0, 0.0, 1.0])), mask, samples, 1 / 65535, 65535, tuple(range(1, 13)))


@pytest.mark.parametrize("related", [1.0, RELATED])
def test_a_smooth_object_under_another_light_is_no_other_object(related: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Moving it changes little and it has no edges, but its light and dark lie where they are predicted."""
    monkeypatch.setattr("mvps.checks.photographs.RELATED", related)
    rng = np.random.default_rng(0)
    capture = Capture("ball", tuple(replace(smooth_ball(rng, k == VIEW), name=f"view_{k}") for k in range(6)))
    told = [one.where for one in photographs(capture)[1] if "another object" in one.text]
    assert told == ([f"view_{VIEW}/{LIGHT + 1:03d}"] if related == 1 else [])


@pytest.mark.parametrize(("one", "other"), [(3, 7), (5, 8), (2, 12)])
def test_photographs_under_a_weak_and_a_strong_lamp_change_places(clean: Capture, one: int, other: int) -> None:
    """Each in the units of the lamp that it was taken under, which are three times the other's."""
    bright = np.where(np.arange(16) % 2 == one % 2, 1.0, 1 / 3)[:, None]
    capture = Capture(clean.name, tuple(replace(view, samples=np.rint(view.samples * bright).astype(np.uint16)) for view in clean.views))

    def exchanged(samples: Samples, _: View) -> None:
        samples[:, [one, other]] = samples[:, [other, one]]

    after, found = photographs(spoilt(capture, exchanged))
    assert len(found) == 2 and all("put in its place" in of.text for of in found)
    for view, wanted in zip(after.views, capture.views, strict=True):
        np.testing.assert_array_equal(view.samples, wanted.samples)
