"""Captures at half their size."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import mvps.pyramid
from mvps.camera import pixel_footprint, project
from mvps.coarse import coarse
from mvps.measures import distance_to
from mvps.plan import Parts
from mvps.progress import Progress
from mvps.pyramid import halved, halvings, levels
from mvps.reconstruct import Settings, reconstruct
from mvps.scene import Camera, Capture, View
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings


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


def test_odd_sizes_keep_half_of_the_half_pixels() -> None:
    after = once(view(np.ones((3, 3), bool), np.repeat(np.array([1, 3, 5, 5, 7, 9, 2, 2, 8])[:, None, None], 3, 2)))
    # Two pixels are half of the right and lower ones, one of which the lot falls on; one is a quarter of the corner.
    assert after.mask.tolist() == [[True, False], [True, False]] and after.radiance().ravel() == pytest.approx([4] * 3 + [2] * 3)
    wide = once(view(np.ones((1, 4), bool), np.repeat(np.array([1, 3, 5, 9])[:, None, None], 3, 2)))
    assert wide.mask.tolist() == [[True, False]] and wide.radiance().ravel() == pytest.approx([2] * 3)


@pytest.mark.parametrize("angle", [0, 20, 45, 70, 90, 135])
def test_masks_neither_grow_nor_shrink(angle: float) -> None:
    """The mean over edges at all places in their pixels, per length of the edge."""
    direction = np.radians(angle)
    rows, columns = np.indices((128, 128)) + 0.5
    across = (rows - 64) * np.sin(direction) + (columns - 64) * np.cos(direction)
    masks = [across < shift for shift in np.arange(0, 4, 0.25)]
    grown = [4 * once(view(mask, np.ones((mask.sum(), 1, 3)))).mask.sum() - float(mask.sum()) for mask in masks]
    assert abs(np.mean(grown)) / 128 < 0.05


def test_clipped_pixels_do_not_count_and_most_of_them_are_no_data() -> None:
    samples = np.full((4, 2, 3), 200)
    samples[3, 0, 1] = 255
    samples[1:, 1, 0] = 255
    after = once(view(np.ones((2, 2), bool), samples, saturation=255, scale=1 / 255))
    assert after.usable().tolist() == [[True, False]]
    assert after.radiance()[0, 0] == pytest.approx([200 / 255] * 3)


def test_codes_of_eight_bits_keep_the_two_bits_that_a_mean_of_four_gains() -> None:
    after = once(view(np.ones((2, 2), bool), np.repeat(np.array([3, 3, 3, 4])[:, None, None], 3, 2), saturation=255, scale=1 / 255))
    assert after.radiance() == pytest.approx(np.full((1, 1, 3), 3.25 / 255))


def test_brightest_codes_do_not_overflow() -> None:
    after = once(view(np.ones((2, 2), bool), np.full((4, 1, 3), 65534)))
    assert after.samples.tolist() == [[[65534] * 3]] and after.usable().all()


def test_views_are_halved_while_enough_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mvps.pyramid, "ENOUGH_PIXELS", 16)
    large, small, corner = (view(np.ones((n, n), bool), np.ones((n * n, 1, 3))) for n in (17, 7, 3))
    assert [level.views[0].mask.shape for level in levels(Capture("made", (large,)))] == [(17, 17), (9, 9), (5, 5)]
    assert len(levels(Capture("made", (large,)))[-1].views[0].pixels) >= 16
    assert halvings(Capture("made", (small,))) == 0 and len(levels(Capture("made", (small,)))) == 1
    # A view of nine pixels would be left with two and with one.
    views = tuple(replace(of, name=f"view_{k:02d}") for k, of in enumerate((large, large, corner)))
    assert halvings(Capture("made", views)) == 0


def test_lights_and_names_stay() -> None:
    before = replace(view(np.ones((2, 2), bool), np.ones((4, 3, 3))), lights=(2, 5, 9))
    assert (once(before).name, once(before).lights) == ("view_01", (2, 5, 9))


def test_a_large_capture_is_found_at_half_its_size_and_ends_at_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    capture, truth = render_capture(SceneSettings(views=5, lights=8, size=96))
    wanted = int(np.median([len(of.pixels) for of in capture.views])) // 4
    monkeypatch.setattr(mvps.pyramid, "ENOUGH_PIXELS", wanted)
    progress = Progress()
    made = reconstruct(capture, Settings("made"), None, progress)
    stages = {str(one["name"]): str(one.get("status")) for one in progress.stages}
    assert "48 x 48" in stages["half size"]
    assert [picture.shape for picture in made.normal_maps] == [(96, 96, 3)] * 5
    # A coarse round at full size before the rounds of the preset; vertices of an edge of two pixels of the level and of the photographs.
    vertices = [int(one["vertices"]) for one in made.metrics["rounds"]]
    assert vertices[-1] > 2.5 * vertices[2] and len(vertices) >= 5
    pixel = pixel_footprint([of.camera for of in capture.views], truth.surface.vertices.mean(0))
    assert np.abs(distance_to(made.surface.vertices[made.material.confidence > 0], truth.surface)[0]).mean() < 0.5 * pixel


def test_of_two_halvings_each_level_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lowest level finds the shape, the next pulls it, and moves are told in pixels of the photographs."""
    capture = render_capture(SceneSettings(views=5, lights=8, size=96))[0]
    monkeypatch.setattr(mvps.pyramid, "ENOUGH_PIXELS", min(len(of.pixels) for of in capture.views) // 16)
    seen: list[tuple[str, int]] = []

    def stage_two(name: str, of: Capture, *_: object) -> SimpleNamespace:
        seen.append((name, of.views[0].camera.width))
        return SimpleNamespace(surface=None, carried=None, rounds=[{"residual": 0.01, "vertex_change_px": 0.1}])

    monkeypatch.setattr("mvps.coarse.stage_two", stage_two)
    monkeypatch.setattr("mvps.coarse.replace", lambda of, **_: of)
    monkeypatch.setattr("mvps.coarse.shaped", lambda *_: (stage_two("shape", _[0]), [{"vertex_change_px": 0.5}]))
    _, rounds = coarse(capture, Settings("made"), None, Parts(), Progress(), lambda _, make: make())
    assert seen == [("first refinement", 24), ("shape", 24), ("refinement at 48 x 48", 48)]
    assert [one["vertex_change_px"] for one in rounds] == pytest.approx([4 * 0.5, 2 * 0.1])
