"""mvps.load: ground truth and given lights are read into the world frame, or complained about."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import trimesh
from tiny_capture import HEIGHT, VIEWS, WIDTH, mask, rotation, tiny_capture

from mvps.load import read_calibrated_lights, read_capture, read_truth
from mvps.scene import Capture, CaptureError


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return tiny_capture(tmp_path / "tiny")


@pytest.fixture
def with_truth(capture: Path) -> Path:
    """The tiny capture with normals, lights that stand still in the camera's frame, and a mesh."""
    for view in range(1, VIEWS + 1):
        folder = capture / f"view_{view:02d}"
        normals = np.zeros((HEIGHT, WIDTH, 3))
        normals[mask() > 127] = (0.6, 0, 0.8)
        normals[3, 4] = 0
        scipy.io.savemat(folder / "Normal_gt.mat", {"Normal_gt": normals})
        np.savetxt(folder / "light_directions.txt", [[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]])
        np.savetxt(folder / "light_intensities.txt", [[1, 2, 3], [2, 2, 2], [4, 4, 4]])
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False).export(capture / "mesh_Gt.ply")
    return capture


def test_truth_is_in_the_world_frame(with_truth: Path) -> None:
    truth = read_truth(with_truth)
    assert truth.views == ("view_01", "view_02") and truth.surface is not None
    for number, name in enumerate(truth.views, 1):
        # DiLiGenT's z towards the camera is minus the optical axis, its y up is minus the image's y.
        axes = rotation(number).T @ np.diag([1, -1, -1])
        np.testing.assert_allclose(truth.direction[name], np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]]) @ axes.T, atol=1e-12)
        normals = truth.normals[name]
        known = (mask() > 127) & ~((np.arange(HEIGHT)[:, None] == 3) & (np.arange(WIDTH) == 4))
        np.testing.assert_array_equal(np.isfinite(normals).all(-1), known)
        np.testing.assert_allclose(normals[known], np.broadcast_to(axes @ [0.6, 0, 0.8], (known.sum(), 3)), atol=1e-6)
        np.testing.assert_array_equal(truth.intensity[name], [[1, 2, 3], [2, 2, 2], [4, 4, 4]])


def test_what_is_absent_is_absent(capture: Path) -> None:
    truth = read_truth(capture)
    assert (dict(truth.normals), dict(truth.direction), dict(truth.intensity), truth.surface) == ({}, {}, {}, None)
    shutil.rmtree(capture / "view_02")
    assert read_truth(capture).views == ("view_01",)


def test_points_without_a_face_are_no_part_of_the_true_surface(with_truth: Path) -> None:
    corners = [[-1e4, 0, 0], [0, 0, 0], [1, 0, 0], [5, 5, 5], [0, 1, 0]]
    trimesh.Trimesh(corners, [[1, 2, 4]], process=False).export(with_truth / "mesh_Gt.ply")
    surface = read_truth(with_truth).surface
    assert surface is not None
    np.testing.assert_array_equal(surface.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(surface.faces, [[0, 1, 2]])


def test_calibrated_lights_are_matched_by_number(with_truth: Path) -> None:
    lights = read_calibrated_lights(with_truth, read_capture(with_truth, lights={"view_01": [3], "view_02": [1, 2]}))
    everything = read_truth(with_truth)
    np.testing.assert_allclose(lights.direction[0], everything.direction["view_01"][[2]])
    np.testing.assert_allclose(lights.direction[1], everything.direction["view_02"][[0, 1]])
    mean = (12 + 6 + 6) / 9
    np.testing.assert_allclose(lights.intensity[1], np.array([[1, 2, 3], [2, 2, 2]]) / mean)
    assert np.concatenate(lights.intensity).mean() == pytest.approx(1)
    assert not lights.one_rig


def test_lights_as_windows_writes_them(with_truth: Path) -> None:
    capture = read_capture(with_truth)
    before = read_calibrated_lights(with_truth, capture)
    for table in with_truth.glob("view_*/light_*.txt"):
        table.write_bytes(b"\xef\xbb\xbf" + table.read_bytes().replace(b"\n", b"\r\n"))
    after = read_calibrated_lights(with_truth, capture)
    for name in ("direction", "intensity"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


@pytest.mark.parametrize(("angle", "one_rig"), [(0.0, True), (5e-4, True), (2e-3, False)])
def test_one_rig_within_a_milliradian(with_truth: Path, angle: float, one_rig: bool) -> None:
    turned = [[np.sin(angle), 0, np.cos(angle)], [0.6, 0, 0.8], [0, 0.6, 0.8]]
    np.savetxt(with_truth / "view_02" / "light_directions.txt", turned)
    assert read_calibrated_lights(with_truth, read_capture(with_truth)).one_rig is one_rig


def test_lights_that_stand_still_while_the_camera_moves(with_truth: Path) -> None:
    in_world = np.array([[0.6, 0, 0.8], [0, 0.6, 0.8], [0, 0, 1]])
    for number in (1, 2):
        axes = rotation(number).T @ np.diag([1, -1, -1])
        np.savetxt(with_truth / f"view_{number:02d}" / "light_directions.txt", in_world @ axes, fmt="%.9f")
    lights = read_calibrated_lights(with_truth, read_capture(with_truth))
    assert lights.one_rig and lights.fixed
    np.testing.assert_allclose(lights.direction[1], in_world, atol=1e-8)


TRUTH_COMPLAINTS: list[tuple[str, bytes | None, str]] = [
    ("light_directions.txt", b"", "0 bytes"),
    ("light_directions.txt", b"1 2 x\n", "three numbers per line"),
    ("light_directions.txt", b"\xff\xfe", "three numbers per line"),
    ("light_directions.txt", b"1 0\n0 1\n", "three finite numbers per line"),
    ("light_directions.txt", b"0 0 1\n0 nan 1\n", "three finite numbers per line"),
    ("light_directions.txt", b"0 0 1\n0 0 2\n", "wanted unit vectors, given one of length 2 in line 2"),
    ("light_intensities.txt", b"1 1 1\n1 0 1\n", "three finite positive numbers"),
    ("Normal_gt.mat", b"garbage" * 50, "wanted a MATLAB file"),
    ("../mesh_Gt.ply", b"garbage", "wanted a triangle mesh as PLY"),
]


@pytest.mark.parametrize(("name", "content", "words"), TRUTH_COMPLAINTS)
def test_complaint_about_the_truth(with_truth: Path, name: str, content: bytes, words: str) -> None:
    (with_truth / "view_02" / name).write_bytes(content)
    with pytest.raises(CaptureError, match=words) as caught:
        read_truth(with_truth)
    assert Path(name).name in str(caught.value)


def test_complaints_about_the_shape_of_the_truth(with_truth: Path) -> None:
    scipy.io.savemat(with_truth / "view_01" / "Normal_gt.mat", {"Normal_gt": np.zeros((2, 2, 3))})
    with pytest.raises(CaptureError, match=r"Normal_gt of shape \(12, 16, 3\) as in mask.png, given double of shape \(2, 2, 3\)"):
        read_truth(with_truth)
    scipy.io.savemat(with_truth / "view_01" / "Normal_gt.mat", {"other": 1})
    with pytest.raises(CaptureError, match="a variable Normal_gt"):
        read_truth(with_truth)


def test_complaints_about_calibrated_lights(with_truth: Path) -> None:
    capture = read_capture(with_truth)
    (with_truth / "view_02" / "light_intensities.txt").write_text("1 1 1\n1 1 1\n")
    with pytest.raises(CaptureError, match=r"light_intensities.txt: wanted a line for each of 3 lights, given 2 lines"):
        read_calibrated_lights(with_truth, capture)
    (with_truth / "view_02" / "light_directions.txt").unlink()
    with pytest.raises(CaptureError, match=r"light_directions.txt: wanted three numbers per light, given no such file"):
        read_calibrated_lights(with_truth, capture)


def test_truth_and_given_lights_turn_with_a_camera_that_was_turned(with_truth: Path) -> None:
    capture = read_capture(with_truth)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    views = [replace(v, camera=replace(v.camera, rotation=v.camera.rotation @ turn.T)) for v in capture.views]
    before, after = read_truth(with_truth), read_truth(with_truth, {v.name: v.camera for v in views})
    given = read_calibrated_lights(with_truth, Capture(capture.name, tuple(views)))
    assert given.one_rig
    for k, name in enumerate(before.views):
        np.testing.assert_allclose(after.direction[name], before.direction[name] @ turn.T, atol=1e-12)
        np.testing.assert_allclose(given.direction[k], after.direction[name], atol=1e-12)


def test_fewer_intensities_than_directions(with_truth: Path) -> None:
    np.savetxt(with_truth / "view_02" / "light_intensities.txt", [[1, 2, 3]])
    with pytest.raises(CaptureError, match=r"wanted 3 lines, as light_directions\.txt has, given 1"):
        read_truth(with_truth)
