"""mvps.checks.silhouettes: faults of masks and views are found by name and mended; what is sound stays as it is, sample for sample."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter

import mvps.checks.silhouettes
from mvps.checks.silhouettes import silhouettes
from mvps.load import read_capture
from mvps.own_units import object_place
from mvps.scene import Bool, Camera, Capture, Material, Surface, View
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import make_scene, render_capture
from mvps.synthetic.settings import SceneSettings

VIEWS, THIRD = 8, "view_03"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A made capture of 8 views x 4 lights x 96 x 96 pixels."""
    place = tmp_path_factory.mktemp("made") / "capture"
    write_capture(*render_capture(SceneSettings(views=VIEWS, lights=4, size=96)), place)
    return place


@pytest.fixture(scope="module")
def sound(folder: Path) -> Capture:
    return read_capture(folder)


@pytest.fixture(scope="module")
def standing(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Capture]:
    """The object on a lit column, which no mask holds."""
    settings = SceneSettings(views=VIEWS, lights=4, size=96)
    scene = make_scene(settings)
    cameras = tuple(replace(camera, K=camera.K * [[0.8, 1, 1], [1, 0.8, 1], [1, 1, 1]]) for camera in scene.cameras)
    column = trimesh.creation.cylinder(12, segment=((0, 0, scene.surface.vertices[:, 2].min() + 3), (0, 0, -110)), sections=48)
    rows = np.append(np.arange(len(scene.surface.vertices)), np.zeros(len(column.vertices), int))
    grey, normal = scene.material.albedo[rows], np.concatenate([scene.material.normal, column.vertex_normals])
    both = Surface(
        np.concatenate([scene.surface.vertices, column.vertices]),
        np.concatenate([scene.surface.faces, len(scene.surface.vertices) + column.faces]),
    )
    of_both = Material(normal, grey, scene.material.specular_weight[rows], scene.material.sharpness, scene.material.confidence[rows])
    alone = render_capture(settings, replace(scene, cameras=cameras))[0]
    place = tmp_path_factory.mktemp("standing") / "capture"
    write_capture(*render_capture(settings, replace(scene, cameras=cameras, surface=both, material=of_both)), place)
    for view in alone.views:
        cv2.imwrite(str(place / view.name / "mask.png"), view.mask.astype(np.uint8) * 255)
    return place, read_capture(place)


def with_masks(folder: Path, sound: Capture, edit: Callable[[Bool], Bool], only: str = "") -> Capture:
    """The capture read with other masks, in all views or in one."""
    for view in sound.views:
        mask = edit(view.mask) if only in ("", view.name) else view.mask
        cv2.imwrite(str(folder / view.name / "mask.png"), mask.astype(np.uint8) * 255)
    try:
        return read_capture(folder)
    finally:
        for view in sound.views:
            cv2.imwrite(str(folder / view.name / "mask.png"), view.mask.astype(np.uint8) * 255)


def wrong(capture: Capture, sound: Capture) -> int:
    """Pixels in which masks differ."""
    return sum(int((a.mask != b.mask).sum()) for a, b in zip(capture.views, sound.views, strict=True))


def disc(mask: Bool, row: float, column: float, radius: float) -> Bool:
    rows, columns = np.indices(mask.shape)
    return (rows - row) ** 2 + (columns - column) ** 2 <= radius**2


def without_limb(mask: Bool) -> Bool:
    """Without the tenth of the mask that lies farthest along its longest direction."""
    pixels = np.argwhere(mask)
    along = (pixels - pixels.mean(0)) @ np.linalg.svd(pixels - pixels.mean(0), full_matrices=False)[2][0]
    cut = mask.copy()
    cut[tuple(pixels[along > np.quantile(along, 0.9)].T)] = False
    return cut


def headless(mask: Bool) -> Bool:
    """Without its upper fifth."""
    rows = np.flatnonzero(mask.any(1))
    return mask & (np.arange(len(mask)) > rows[0] + 0.2 * np.ptp(rows))[:, None]


def with_holes(mask: Bool) -> Bool:
    row, column = np.argwhere(mask).mean(0)
    return mask & ~disc(mask, row, column, 4) & ~disc(mask, row + 12, column + 6, 3)


def with_blob(mask: Bool) -> Bool:
    return mask | disc(mask, 10, 12, 5)


def test_a_sound_capture_stays_as_it_is(sound: Capture) -> None:
    left, findings = silhouettes(sound)
    assert left is sound and not findings


def test_masks_of_blurred_photographs_stay_as_they_are(folder: Path, tmp_path: Path) -> None:
    place = shutil.copytree(folder, tmp_path / "blurred")
    for path in place.glob("view_*/[0-9]*.png"):
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        cv2.imwrite(str(path), gaussian_filter(image.astype(np.float64), (1.5, 1.5, 0)).astype(np.uint16))
    capture = read_capture(place)
    left, findings = silhouettes(capture)
    assert left is capture and not findings


@pytest.mark.parametrize("lights", [[1], [2, 6, 10, 14, 18]])
@pytest.mark.parametrize("name", ["bunny", "armadillo", "buddha"])
def test_captures_stay_as_they_are(captures: Path, name: str, lights: list[int]) -> None:
    """Five views each, under few lights too: then a side of the object may be in the dark."""
    capture = read_capture(captures / name, [1, 5, 9, 13, 17], lights)
    left, findings = silhouettes(capture)
    assert left is capture and not findings


@pytest.mark.parametrize(("pixels", "only"), [(-6, THIRD), (-3, ""), (-1, ""), (1, ""), (1, THIRD), (3, ""), (6, THIRD)])
def test_masks_that_are_off_are_moved_to_the_objects_edge(folder: Path, sound: Capture, pixels: int, only: str) -> None:
    change = binary_dilation if pixels > 0 else binary_erosion
    bad = with_masks(folder, sound, lambda mask: change(mask, iterations=abs(pixels)), only)
    mended, findings = silhouettes(bad)
    assert wrong(mended, sound) < 0.1 * wrong(bad, sound)
    assert (findings[0].about, findings[0].where, findings[0].mended) == ("mask", only or "all views", True)
    assert ("larger" if pixels > 0 else "smaller") in findings[0].text


@pytest.mark.parametrize(("edit", "only"), [(without_limb, THIRD), (with_holes, ""), (with_blob, THIRD)])
def test_parts_of_masks_are_mended(folder: Path, sound: Capture, edit: Callable[[Bool], Bool], only: str) -> None:
    bad = with_masks(folder, sound, edit, only)
    mended, findings = silhouettes(bad)
    assert wrong(mended, sound) <= 0.02 * wrong(bad, sound)
    assert len(findings) == 1 and findings[0].about == "mask" and findings[0].mended
    assert findings[0].where == (only or ", ".join(view.name for view in sound.views))
    for view, true in zip(mended.views, sound.views, strict=True):
        both = view.mask & true.mask
        np.testing.assert_array_equal(view.samples[both[view.mask]], true.samples[both[true.mask]])


def test_a_lit_stand_that_no_mask_holds_stays_out(standing: tuple[Path, Capture]) -> None:
    left, findings = silhouettes(standing[1])
    assert left is standing[1] and not findings


def test_a_limb_is_given_back_beside_a_lit_stand(standing: tuple[Path, Capture]) -> None:
    bad = with_masks(*standing, headless, THIRD)
    mended, findings = silhouettes(bad)
    assert wrong(mended, standing[1]) <= 0.05 * wrong(bad, standing[1])
    assert [(one.about, one.where, one.mended) for one in findings] == [("mask", THIRD, True)]


def test_a_limb_that_two_of_ten_masks_lack_is_given_back(tmp_path: Path) -> None:
    """Each leaves no room for what the other lacks; all other masks show it."""
    place = tmp_path / "capture"
    write_capture(*render_capture(SceneSettings(views=10, lights=4, size=96)), place)
    whole = read_capture(place)

    for view in whole.views:
        mask = headless(view.mask) if view.name in (THIRD, "view_06") else view.mask
        cv2.imwrite(str(place / view.name / "mask.png"), mask.astype(np.uint8) * 255)
    bad = read_capture(place)
    assert wrong(silhouettes(bad)[0], whole) <= 0.05 * wrong(bad, whole)


def test_what_masks_lack_is_given_back_after_a_wrong_view_is_left_out(folder: Path, sound: Capture) -> None:
    bad = with_masks(folder, sound, without_limb, THIRD)
    views = [posed(view, sound.views[1]) if view.name == "view_06" else view for view in bad.views]
    left, _ = silhouettes(Capture("two faults", tuple(views)))
    assert "view_06" not in {view.name for view in left.views}
    third = next(view for view in left.views if view.name == THIRD)
    assert (third.mask ^ sound.views[2].mask).sum() <= 0.05 * (bad.views[2].mask ^ sound.views[2].mask).sum()


def posed(view: View, like: View) -> View:
    return replace(view, camera=like.camera)


@pytest.mark.parametrize("like", [0, 3])
def test_a_view_with_anothers_pose_is_left_out(sound: Capture, like: int) -> None:
    views = [posed(view, sound.views[like]) if view.name == THIRD else view for view in sound.views]
    left, findings = silhouettes(Capture("swapped", tuple(views)))
    assert [view.name for view in left.views] == [view.name for view in sound.views if view.name != THIRD]
    assert [(one.about, one.where, one.mended) for one in findings] == [("pose", THIRD, True)]


def shaken(capture: Capture, pixels: float) -> Capture:
    """Every camera moved aside, so that the object's projection moves by so many pixels."""
    rng = np.random.default_rng(0)
    views = []
    for view in capture.views:
        angle, pixel = rng.uniform(0, 2 * np.pi), view.camera.translation[2] / view.camera.focal_length
        moved = view.camera.translation + pixels * pixel * np.array([np.cos(angle), np.sin(angle), 0])
        views.append(replace(view, camera=replace(view.camera, translation=moved)))
    return Capture("shaken", tuple(views))


def test_small_errors_of_all_poses_are_left_alone(sound: Capture) -> None:
    capture = shaken(sound, 3)
    left, findings = silhouettes(capture)
    assert left is capture and not findings


def test_what_no_view_alone_explains_is_said_and_left(sound: Capture) -> None:
    """Half of the views with the poses of others: no one to leave out."""
    views = [posed(view, sound.views[(at + 3) % VIEWS]) if at % 2 else view for at, view in enumerate(sound.views)]
    capture = Capture("mixed", tuple(views))
    left, findings = silhouettes(capture)
    assert left is capture
    assert [(one.where, one.mended) for one in findings] == [("all views", False)]


def opposite(capture: Capture) -> Capture:
    """The third view with the pose of one from about the other side, where an object's outline is its mirror image: hulls cannot tell."""
    return Capture("opposite", tuple(posed(view, capture.views[6]) if view.name == THIRD else view for view in capture.views))


def test_of_two_views_with_one_pose_lines_of_sight_tell_the_wrong_one(sound: Capture) -> None:
    left, findings = silhouettes(opposite(sound))
    assert [view.name for view in left.views] == [view.name for view in sound.views if view.name != THIRD]
    assert [(one.where, one.mended) for one in findings] == [(THIRD, True)]


def test_of_two_views_with_one_pose_both_are_named_where_nothing_tells(sound: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mvps.checks.silhouettes, "_wrong", lambda cones, among, suspects: None)
    capture = opposite(sound)
    left, findings = silhouettes(capture)
    assert left is capture
    assert [(one.where, one.mended) for one in findings] == [(THIRD, False), ("view_07", False)]


def test_where_the_others_do_not_agree_either_no_view_is_left_out(sound: Capture) -> None:
    capture = opposite(shaken(sound, 1.5))
    left, findings = silhouettes(capture)
    assert left is capture
    assert [(one.where, one.mended) for one in findings] == [("all views", False)]


def test_what_the_image_cuts_off_is_no_contradiction(sound: Capture) -> None:
    def cut(view: View) -> View:
        columns = np.flatnonzero(view.mask.any(0))
        start = int(columns[0]) + (columns[-1] - columns[0]) // 3
        camera, K = view.camera, view.camera.K.copy()
        K[0, 2] -= start
        kept = view.pixels[:, 1] >= start
        narrower = Camera(K, camera.rotation, camera.translation, camera.height, camera.width - start)
        return View(view.name, narrower, view.mask[:, start:], view.samples[kept], view.scale, view.saturation, view.lights)

    views = tuple(cut(view) if k == 0 else view for k, view in enumerate(sound.views))
    assert silhouettes(Capture("cut", views))[1] == []


@pytest.mark.parametrize("away", [0.0, 1000.0])
def test_cameras_side_by_side_are_no_twins_however_far_from_the_origin(sound: Capture, away: float) -> None:
    first = sound.views[0]
    place, size = object_place(sound)
    camera = first.camera
    aside = replace(camera, translation=camera.translation + np.array([0.05 * size, 0, 0]))
    moved = replace(first, camera=aside, mask=np.roll(first.mask, 6, 1), name="view_02")

    def from_afar(view: View) -> View:
        return view.taken_by(replace(view.camera, translation=view.camera.translation - view.camera.rotation @ np.full(3, away * size)))

    where = place + away * size, size
    assert not mvps.checks.silhouettes._twins([from_afar(first), from_afar(moved)], *where)
    assert mvps.checks.silhouettes._twins([from_afar(first), from_afar(replace(moved, camera=camera))], *where)
    nearer = replace(moved, camera=replace(camera, K=camera.K * [[1.5, 1, 1], [1, 1.5, 1], [1, 1, 1]]))
    assert not mvps.checks.silhouettes._twins([from_afar(first), from_afar(nearer)], *where), "two zooms from one place"


def test_close_ups_may_be_in_the_majority() -> None:
    """Six of nine views show the head alone, four times as large: their masks' middles are not the object's."""
    settings = SceneSettings(views=9, lights=2, size=96)
    scene = make_scene(settings)
    larger = [camera.K * [[4, 1, 1], [1, 4, 1], [1, 1, 1]] + [[0, 0, 0], [0, 0, 112], [0, 0, 0]] for camera in scene.cameras]
    cameras = tuple(replace(camera, K=K) if i % 3 else camera for i, (camera, K) in enumerate(zip(scene.cameras, larger, strict=True)))
    capture = render_capture(settings, replace(scene, cameras=cameras))[0]
    assert sum(view.mask[-1].any() for view in capture.views) == 6
    after, found = silhouettes(capture)
    assert not found and all(a is b for a, b in zip(after.views, capture.views, strict=True))
