"""mvps.viewpoints: cameras look where they should."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from sphere_scene import make_sphere

from mvps.camera import project
from mvps.scene import CaptureError, Surface
from mvps.viewpoints import look_at, read_cameras, turntable


@pytest.mark.parametrize("eye", [(5.0, 1, 2), (0, 0, 9), (0, 0, -9)])
def test_the_target_is_in_the_middle_and_up_is_up(eye: tuple[float, float, float]) -> None:
    target, up = np.array([0.0, 0, 0.5]), np.array([0.0, 0, 1])
    camera = look_at(np.array(eye), target, up, 80, 60, 40.0)
    image, depth = project(camera, target)
    np.testing.assert_allclose(image, [40, 30], atol=1e-9)
    assert np.isclose(depth, np.linalg.norm(target - eye)) and np.isclose(np.linalg.det(camera.rotation), 1)
    np.testing.assert_allclose(camera.centre, eye, atol=1e-9)
    if eye[0]:
        assert project(camera, target + 0.1 * up)[0][1] < 30


def test_an_eye_at_its_target_is_refused() -> None:
    with pytest.raises(ValueError, match="wanted an eye away"):
        look_at(np.zeros(3), np.zeros(3), np.array([0.0, 0, 1]), 8, 8)


@pytest.mark.parametrize(("width", "height"), [(100, 100), (160, 90)])
def test_a_turntable_shows_all_of_the_object(width: int, height: int) -> None:
    ball = make_sphere(2).reconstruction.surface
    surface = Surface(ball.vertices * (1, 2, 3) + 7, ball.faces)
    cameras = turntable(surface, 5, 20.0, np.array([0.0, 0, 1]), width, height)
    for camera in cameras:
        image, depth = project(camera, surface.vertices)
        assert (depth > 0).all() and (image >= 0).all() and (image <= (width, height)).all()
    centres = np.array([camera.centre - 7 for camera in cameras])
    np.testing.assert_allclose(np.degrees(np.arcsin(centres[:, 2] / np.linalg.norm(centres, axis=1))), 20, atol=1e-6)
    np.testing.assert_allclose(centres.mean(0)[:2], 0, atol=1e-9)


def test_cameras_come_back_from_a_file(tmp_path: Path) -> None:
    camera = look_at(np.array([5.0, 1, 2]), np.zeros(3), np.array([0.0, 0, 1]), 80, 60)
    record = {"name": "a", "K": camera.K.tolist(), "rotation": camera.rotation.tolist(), "translation": camera.translation.tolist()}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"cameras": [record | {"width": 80, "height": 60}]}))
    (found,) = read_cameras(path).values()
    np.testing.assert_array_equal(found.rotation, camera.rotation)
    assert (found.width, found.height) == (80, 60)


@pytest.mark.parametrize(
    "text", ["", "[]", '{"cameras": []}', '{"cameras": [{"name": "a"}]}', '{"cameras": [1]}', '{"cameras": {"a": 1}}', "\xff", "[" * 100000]
)
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(CaptureError, match=r"cameras.json: wanted a list"):
        read_cameras(path)


def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path, tmp_path / "nowhere"):
        with pytest.raises(CaptureError, match=f"{path}: wanted a list .* given a file that cannot be read"):
            read_cameras(path)


@pytest.mark.parametrize(
    "change", [{"name": "../escaped"}, {"name": "/tmp/a"}, {"name": "a/b"}, {"name": ""}, {"width": 1e999}, {"height": 0}, {"width": 99999}]
)
def test_names_and_sizes_that_make_no_file_are_refused(tmp_path: Path, change: dict[str, object]) -> None:
    """A name is a part of a file's name: one with a folder in it would be written elsewhere."""
    camera = look_at(np.array([5.0, 1, 2]), np.zeros(3), np.array([0.0, 0, 1]), 80, 60)
    record = {"name": "a", "K": camera.K.tolist(), "rotation": camera.rotation.tolist(), "translation": camera.translation.tolist()}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"cameras": [record | {"width": 80, "height": 60} | change]}))
    with pytest.raises(CaptureError, match=r"cameras.json: wanted a list"):
        read_cameras(path)
