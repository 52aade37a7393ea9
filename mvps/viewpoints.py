"""Cameras for new pictures: looking at something, around an object, read from a file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mvps.inputs import JSON_LIMIT, parsed_json, read_file
from mvps.mesh import lengths, normalise
from mvps.scene import Camera, CaptureError, Float, Surface

FIELD_OF_VIEW = 30.0
"""Degrees across the shorter side of the image: a long lens's, which shows objects without distortion."""

NAME = re.compile(r"[\w+-][\w .+-]{0,99}")
"""Of a camera: a part of a file's name, in no other folder, that shells and video encoders take as it is."""

LARGEST_SIDE = 16384
"""Pixels of an image."""

MARGIN = 1.05
"""Free space around an object that fills the image."""


def look_at(eye: Float, target: Float, up: Float, width: int, height: int, field_of_view: float = FIELD_OF_VIEW) -> Camera:
    """A camera at `eye` (3,) looking at `target` (3,), with `up` (3,) upwards in the image; field_of_view: degrees across the shorter side.

    ValueError where the eye is at the target, or `up` is no direction.
    """
    up = _upwards(up)
    if lengths(np.asarray(target, float) - eye) == 0:
        raise ValueError(f"camera: wanted an eye away from its target, given both at {tuple(np.asarray(eye).tolist())}")
    forward = normalise(np.asarray(target, float) - eye)
    right = np.cross(forward, up)
    if lengths(right) < 1e-6:
        # Straight up or down any direction will do.
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right = normalise(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = min(width, height) / 2 / np.tan(np.radians(field_of_view) / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(K, rotation, -rotation @ np.asarray(eye, float), height, width)


def _upwards(up: Float) -> Float:
    """(3,) unit. ValueError where it is no direction."""
    if lengths(np.asarray(up, float)) == 0:
        raise ValueError(f"up: wanted a direction, given {tuple(np.asarray(up).tolist())}")
    return normalise(np.asarray(up, float))


def ball_around(surface: Surface) -> tuple[Float, float]:
    """Centre of the surface's box and the distance of its farthest vertex from there."""
    centre = (surface.vertices.min(0) + surface.vertices.max(0)) / 2
    return centre, float(lengths(surface.vertices - centre).max())


def turntable(
    surface: Surface, frames: int, elevation_deg: float, up: Float, width: int, height: int, field_of_view: float = FIELD_OF_VIEW
) -> list[Camera]:
    """Cameras evenly around the surface, so far away that it just fills the image from everywhere."""
    centre, radius = ball_around(surface)
    up = _upwards(up)
    first = normalise(np.cross(up, np.eye(3)[np.abs(up).argmin()]))
    second = np.cross(up, first)
    distance = MARGIN * radius / np.sin(np.radians(field_of_view) / 2)
    elevation = np.radians(elevation_deg)
    turns = 2 * np.pi * np.arange(frames) / frames
    sides = np.cos(elevation) * (np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * second) + np.sin(elevation) * up
    return [look_at(centre + distance * side, centre, up, width, height, field_of_view) for side in sides]


def read_cameras(path: Path) -> dict[str, Camera]:
    """Cameras by name from JSON: {"cameras": [{"name", "K" 3x3, "rotation" 3x3, "translation" 3, "width", "height"}, ...]} with
    camera_from_world in OpenCV axes and the first pixel's centre at (0.5, 0.5). Names become parts of files' names, so they are letters,
    digits, spaces and . _ + -. CaptureError where it is none."""
    form = 'a list "cameras" of objects with name, K, rotation, translation, width and height'
    try:
        records = parsed_json(read_file(path, JSON_LIMIT))["cameras"]
        cameras = {_name(record): _camera(record) for record in records}
    except OSError as error:
        raise CaptureError(f"{path}: wanted {form}, given a file that cannot be read ({error.strerror}); check the path") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise CaptureError(f"{path}: wanted {form}, given something else ({error}); see the help of --cameras") from error
    if not cameras or len(cameras) != len(records):
        raise CaptureError(f"{path}: wanted {form}, with different names, given {len(records)} cameras; correct the file")
    return cameras


def cameras_record(cameras: Mapping[str, Camera]) -> dict[str, Any]:
    """What `read_cameras` reads."""
    return {
        "cameras": [
            {"name": name, "K": of.K.tolist(), "rotation": of.rotation.tolist(), "translation": of.translation.tolist()}
            | {"width": of.width, "height": of.height}
            for name, of in cameras.items()
        ]
    }


def _camera(record: dict[str, Any]) -> Camera:
    K, rotation, translation = (np.array(record[key], float) for key in ("K", "rotation", "translation"))
    width, height = int(record["width"]), int(record["height"])
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise ValueError(f"an image of {width} x {height}, not 1 to {LARGEST_SIDE} pixels wide and high")
    return Camera(K, rotation, translation, height, width)


def _name(record: dict[str, Any]) -> str:
    name = str(record["name"])
    if not NAME.fullmatch(name):
        raise ValueError(f"the name {name!r}, not letters, digits, spaces and . _ + -")
    return name
