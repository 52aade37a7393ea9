"""Captures at half their size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import mvps.pyramid
from mvps.camera import project
from mvps.pyramid import for_shape, halved
from mvps.scene import Camera, Capture, View


def view(mask: np.ndarray, samples: np.ndarray, saturation: int = 65535, scale: float = 1.0) -> View:
    height, width = mask.shape
    K = np.array([[50.0, 0, 3.3], [0, 50.0, 2.1], [0, 0, 1]])
    camera = Camera(K, np.eye(3), np.array([0.0, 0, 5]), height, width)
    return View("view_01", camera, mask, samples.astype(np.uint16), scale, saturation, tuple(range(1, samples.shape[1] + 1)))


def once(of: View) -> View:
    return halved(Capture("made", (of,))).views[0]


def test_image_coordinates_halve() -> None:
    before = view(np.ones((4, 6), bool), np.ones((24, 1, 3)))
    after, points = once(before), np.array([[0.1, 0.2, 0.3], [-0.2, 0.05, 0.0]])
    assert (after.camera.height, after.camera.width) == (2, 3)
    assert project(after.camera, points)[0] == pytest.approx(project(before.camera, points)[0] / 2)


def test_pixels_are_means_of_their_four_inside_the_mask() -> None:
    mask = np.array([[1, 1, 0, 1], [1, 1, 0, 0]], bool)
    samples = np.repeat(np.array([4, 8, 100, 12, 20])[:, None, None], 3, 2)
    after = once(view(mask, samples))
    assert after.mask.tolist() == [[True, False]]
    assert after.radiance().ravel() == pytest.approx([11] * 3)


def test_odd_sizes_keep_their_last_row_and_column() -> None:
    after = once(view(np.ones((3, 3), bool), np.repeat(np.arange(9)[:, None, None], 3, 2)))
    # Two pixels of the last row are half of a pixel; the corner is a quarter of one.
    assert after.mask.tolist() == [[True, True], [True, False]]
    assert after.radiance()[:, 0, 0] == pytest.approx([2.0, 3.5, 6.5], abs=0.5)


def test_a_clipped_pixel_of_four_is_no_data() -> None:
    samples = np.full((4, 2, 3), 200)
    samples[3, 1, 0] = 255
    after = once(view(np.ones((2, 2), bool), samples, saturation=255, scale=1 / 255))
    assert after.usable().tolist() == [[True, False]]


def test_codes_of_eight_bits_keep_the_two_bits_that_a_mean_of_four_gains() -> None:
    after = once(view(np.ones((2, 2), bool), np.repeat(np.array([3, 3, 3, 4])[:, None, None], 3, 2), saturation=255, scale=1 / 255))
    assert after.radiance() == pytest.approx(np.full((1, 1, 3), 3.25 / 255))


def test_brightest_codes_do_not_overflow() -> None:
    after = once(view(np.ones((2, 2), bool), np.full((4, 1, 3), 65534)))
    assert after.samples.tolist() == [[[65534] * 3]] and after.usable().all()


def test_views_are_halved_while_enough_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mvps.pyramid, "ENOUGH_PIXELS", 16)
    large, small = (Capture("made", (view(np.ones((n, n), bool), np.ones((n * n, 1, 3))),)) for n in (17, 7))
    assert for_shape(small) is small
    assert 16 <= len(for_shape(large).views[0].pixels) < 64
    assert for_shape(large).views[0].mask.shape == (5, 5)


def test_lights_and_names_stay() -> None:
    before = replace(view(np.ones((2, 2), bool), np.ones((4, 3, 3))), lights=(2, 5, 9))
    assert (once(before).name, once(before).lights) == ("view_01", (2, 5, 9))
