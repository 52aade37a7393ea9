"""mvps.checks.lit: light against darkness, on pictures whose edges are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mvps.checks.lit import Lit, lit_part, missing_parts, moved, steps, stray_parts, threshold
from mvps.scene import Bool, Camera, View

SIZE = 80
CAMERA = Camera(np.array([[500.0, 0, SIZE / 2], [0, 500.0, SIZE / 2], [0, 0, 1]]), np.eye(3), np.array([0, 0, 10.0]), SIZE, SIZE)
ROWS, COLUMNS = np.indices((SIZE, SIZE)) + 0.5


def disc(radius: float, row: float = 40, column: float = 40) -> Bool:
    return np.hypot(ROWS - row, COLUMNS - column) < radius


def photographed(mask: Bool, radius: float = 25.0, hole: float = 0.0) -> View:
    """A ball of this radius, darker towards its rim, whose rim pixels are covered in part, with a hole through it, on noise."""
    distance = np.hypot(ROWS - 40, COLUMNS - 40)
    coverage = np.clip(radius - distance + 0.5, 0, 1) * np.clip(distance - hole + 0.5, 0, 1)
    shade = np.sqrt(np.clip(1 - (distance / (radius + 1)) ** 2, 0.05, 1))
    noise = np.random.default_rng(0).uniform(0, 8, mask.shape)
    frame = (10000 * coverage * shade + noise).astype(np.float32)
    return View("ball", CAMERA, mask, np.zeros((int(mask.sum()), 0, 3), np.uint16), 1 / 65535, 65535, (), frame)


def seen(view: View) -> Lit:
    found = lit_part(view, steps(view.mask))
    assert found is not None
    return found


def test_steps_are_distances_to_the_staircase() -> None:
    mask = np.zeros((5, 6), bool)
    mask[:, 2:4] = True
    np.testing.assert_array_equal(steps(mask)[0], [1.5, 0.5, -0.5, -0.5, 0.5, 1.5])


@pytest.mark.parametrize("dark", [0.0, 4.0])
def test_the_threshold_lies_between_noise_and_object(dark: float) -> None:
    frame = np.full((50, 50), dark, np.float32)
    frame[10:30, 10:30] = np.geomspace(300, 30000, 400).reshape(20, 20)
    assert dark < threshold(frame, 65535) < 300


@pytest.mark.parametrize("pixels", [-6, -3, -1, 0, 1, 3, 6])
def test_a_mask_is_moved_to_where_the_object_ends(pixels: int) -> None:
    view = photographed(disc(25 + pixels))
    found = seen(view)
    assert found.judged and found.off == (pixels != 0)
    assert abs(found.edge + pixels) < 0.75
    if pixels:
        left = (moved(view, steps(view.mask), found) ^ disc(25)).sum()
        assert left < 0.15 * (view.mask ^ disc(25)).sum() + 12


def out_of_focus(view: View, sigma: float) -> View:
    blurred = gaussian_filter(view.frame, sigma)
    return View("ball", CAMERA, view.mask, view.samples, view.scale, view.saturation, (), blurred)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 1.5, 2.0])
def test_a_blurred_edge_is_no_shrunk_mask(sigma: float) -> None:
    soft = out_of_focus(photographed(disc(25)), sigma)
    found = seen(soft)
    assert found.judged and (found.beyond > 1) == (sigma > 1)
    found = found.blurred() if sigma > 1 else found
    assert not found.off
    assert not missing_parts(soft.mask, found), "what a lens lights beside the mask"


@pytest.mark.parametrize("pixels", [-6, -3, -1, 0, 1, 3, 6])
def test_no_mask_makes_sharp_photographs_look_blurred(pixels: int) -> None:
    assert seen(photographed(disc(25 + pixels))).beyond < 1


@pytest.mark.parametrize("sigma", [1.5, 2.0])
def test_a_shrunk_mask_is_found_where_photographs_are_blurred(sigma: float) -> None:
    soft = out_of_focus(photographed(disc(22)), sigma)
    found = seen(soft).blurred()
    assert found.off
    assert (moved(soft, steps(soft.mask), found) ^ disc(25)).sum() < 0.5 * (soft.mask ^ disc(25)).sum()


def test_a_missing_limb_is_found_where_photographs_are_blurred() -> None:
    soft = out_of_focus(photographed(disc(25) & (COLUMNS < 55)), 1.5)
    limb = disc(25) & (COLUMNS >= 55)
    assert any((part & limb).sum() > 0.9 * limb.sum() for part in missing_parts(soft.mask, seen(soft).blurred()))


def test_one_dark_side_does_not_make_a_mask_too_large() -> None:
    view = photographed(disc(25))
    assert view.frame is not None
    frame = np.where((COLUMNS < 28) | (view.frame < 10), view.frame % 8, view.frame)
    shadowed = View("ball", CAMERA, view.mask, view.samples, view.scale, view.saturation, (), frame.astype(np.float32))
    assert not seen(shadowed).off


@pytest.mark.parametrize("grown", [0, 4])
def test_dark_sides_all_around_do_not_make_a_mask_too_large(grown: int) -> None:
    view = photographed(disc(25 + grown))
    assert view.frame is not None
    # Sides with less than a hundredth of the front's light, but more than darkness has.
    sides = (view.frame > 10) * np.random.default_rng(1).uniform(25, 90, view.frame.shape)
    frame = np.where(disc(17), view.frame, view.frame % 8 + sides).astype(np.float32)
    assert threshold(frame, 65535) > 98
    dark = View("stone", CAMERA, view.mask, view.samples, view.scale, view.saturation, (), frame)
    assert seen(dark).judged and seen(dark).off == (grown > 0)
    assert abs(seen(dark).edge + grown) < 0.75


def before_wall(mask: Bool, wall: np.ndarray, radius: float = 25.0) -> View:
    """The ball in front of a wall (height, width) as bright as its middle or so."""
    view = photographed(mask, radius)
    assert view.frame is not None
    coverage = np.clip(radius - np.hypot(ROWS - 40, COLUMNS - 40) + 0.5, 0, 1)
    frame = (view.frame + (1 - coverage) * wall).astype(np.float32)
    return View("ball", CAMERA, mask, view.samples, view.scale, view.saturation, (), frame)


@pytest.mark.parametrize("wall", [5000.0, 12000.0, 30000.0])
@pytest.mark.parametrize("pixels", [-3, 0, 1, 3, 6])
def test_before_a_wall_masks_are_found_too_large_and_never_too_small(pixels: int, wall: float) -> None:
    view = before_wall(disc(25 + pixels), np.broadcast_to(wall * (1 + 0.1 * COLUMNS / SIZE), (SIZE, SIZE)))
    found = seen(view)
    assert found.judged and not found.dark and found.off == (pixels > 0)
    if pixels > 0:
        assert abs(found.edge + pixels) < 0.75
        left = (moved(view, steps(view.mask), found) ^ disc(25)).sum()
        assert left < 0.15 * (view.mask ^ disc(25)).sum() + 12


@pytest.mark.parametrize("wall", [1000.0, 5000.0, 9000.0])
def test_a_wall_as_bright_as_parts_of_the_object_is_not_taken_for_darkness(wall: float) -> None:
    """Where the rim is darker than the wall behind it the mask was taken for too large by up to six pixels."""
    assert not seen(before_wall(disc(25), np.full((SIZE, SIZE), wall))).off


def test_a_patterned_wall_judges_nothing() -> None:
    found = seen(before_wall(disc(28), np.where((ROWS // 4 + COLUMNS // 4) % 2 < 1, 3000.0, 12000.0)))
    assert not found.judged and not found.off


def test_holes_are_missing_where_lit_and_honest_where_dark() -> None:
    ring = disc(25) & ~disc(8)
    assert len(missing_parts(ring, seen(photographed(ring)))) == 1
    assert not missing_parts(ring, seen(photographed(ring, hole=8)))


def test_dark_parts_at_the_rim_are_stray_and_those_inside_are_not() -> None:
    blob = disc(25) | disc(5, 10, 12)
    parts = stray_parts(blob, seen(photographed(blob)))
    assert len(parts) == 1 and (parts[0] == disc(5, 10, 12)).all()
    assert not stray_parts(disc(25), seen(photographed(disc(25), hole=6)))
