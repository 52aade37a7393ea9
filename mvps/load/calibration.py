"""Calib_Results.mat and scene.json -> cameras.

    Calib_Results.mat   KK (3, 3), or KK_i per view; Rc_i (3, 3), Tc_i (3, 1): camera_from_world of view i, OpenCV axes;
                        optional kc (5, 1), or kc_i: distortion of the lens (distortion.py)
    scene.json          optional; "pixel_center": image coordinate c of the first pixel's centre (absent: 0)

An image coordinate of the file plus (0.5 - c) is ours, whose first pixel's centre is at 0.5: so is the principal point.
Variables are unpacked only after their shapes were checked (matfile.py).
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvps.inputs import parsed_json
from mvps.load.images import TEXT_LIMIT, complaint, read_bytes
from mvps.load.matfile import Variable, numbers_of, read_variables
from mvps.scene import Camera, CaptureError, Float

CAMERA_BYTES = 9 * 8
"""Of the largest of its variables."""

LARGEST = 1e10
"""Numbers of a calibration are smaller in any unit of length: squares of areas still fit single precision (1e38)."""

LARGEST_OF_LENS = 1e4
"""With such a k5 what lies a fifth of the focal length from the middle moves by two thirds of that, as no lens does."""

SHAPES = {"KK": ((3, 3),), "Rc": ((3, 3),), "Tc": ((3, 1), (1, 3)), "kc": ((5, 1), (1, 5), (4, 1), (1, 4))}
"""By the first letters of a variable's name."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calib_Results.mat and scene.json. K, rotation, translation, distortion by view number; K in our pixel convention."""

    path: Path
    K: Mapping[int, Float]
    rotation: Mapping[int, Float]
    translation: Mapping[int, Float]
    distortion: Mapping[int, tuple[float, ...]]
    shared_K: bool

    def camera(self, number: int, height: int, width: int) -> Camera:
        """The camera of a view, height x width pixels; CaptureError where the numbers are none of a camera."""
        try:
            return Camera(self.K[number], self.rotation[number], self.translation[number], height, width, self.distortion[number])
        except ValueError as error:
            raise CaptureError(f"{self.path}, view {number}: {error}; export the calibration again") from None


def read_calibration(root: Path) -> Calibration:
    """Cameras of all views that Calib_Results.mat knows."""
    if not root.is_dir():
        raise complaint(root, "a capture's folder", "a file" if root.exists() else "no such folder", "check the path")
    path = root / "Calib_Results.mat"
    read_bytes(path, "the cameras' calibration", "see the capture layout in the README", 1)
    variables = read_variables(path, CAMERA_BYTES)
    numbers = sorted(int(m[1]) for m in (re.fullmatch(r"Rc_([1-9]\d{0,5})", name) for name in variables) if m)
    if not numbers:
        few = sorted(variables)[:8] or "nothing"
        raise complaint(path, "Rc_1, Tc_1 and so on", f"only {few}", "export the extrinsics of every view")
    shared = not any(f"KK_{n}" in variables for n in numbers)
    K_names = {n: "KK" if shared else f"KK_{n}" for n in numbers}
    lenses = {n: name for n in numbers if (name := f"kc_{n}" if f"kc_{n}" in variables else "kc") in variables}
    names = {*K_names.values(), *lenses.values(), *(f"{kind}_{n}" for kind in ("Rc", "Tc") for n in numbers)}
    for name in sorted(names):
        wanted = SHAPES[name[:2]]
        if name not in variables:
            raise complaint(path, name, f"a file without it (it holds {len(variables)} variables)", "export the calibration of every view")
        if variables[name].shape not in wanted:
            what_to_try = "remove it if photographs are undistorted" if name.startswith("kc") else "export the calibration again"
            raise complaint(path, f"{name} of shape {wanted[0]}", f"shape {variables[name].shape}", what_to_try)
    arrays = {name: _numbers(path, name, variables[name]) for name in sorted(names)}
    shift = np.eye(3)
    shift[:2, 2] = 0.5 - _pixel_centre(root / "scene.json")
    return Calibration(
        path,
        {n: shift @ arrays[K_names[n]] for n in numbers},
        {n: arrays[f"Rc_{n}"] for n in numbers},
        {n: arrays[f"Tc_{n}"].reshape(3) for n in numbers},
        {n: tuple(arrays[lenses[n]].ravel().tolist()) if n in lenses else () for n in numbers},
        shared,
    )


def _numbers(path: Path, name: str, variable: Variable) -> Float:
    value = numbers_of(path, name, variable)
    largest = LARGEST_OF_LENS if name.startswith("kc") else LARGEST
    if value.dtype.kind not in "fiu" or not (np.abs(value) < largest).all():
        raise complaint(path, f"finite real numbers in {name}, below {largest:g}", f"{value.tolist()}", "export the calibration again")
    return value.astype(np.float64)


def _pixel_centre(path: Path) -> float:
    """Image coordinate of the first pixel's centre: 0 (Caltech toolbox) unless scene.json says otherwise."""
    # A link to nowhere is a file that is missing, not one that was never meant to be there.
    if not os.path.lexists(path):
        return 0.0
    try:
        scene = parsed_json(read_bytes(path, "a JSON object", "remove the file if it is not needed", most=TEXT_LIMIT))
    except ValueError as error:
        if isinstance(error, CaptureError):
            raise
        raise complaint(path, "a JSON object", f"text that is none ({error})", "correct or remove the file") from None
    if not isinstance(scene, dict):
        raise complaint(path, "a JSON object", type(scene).__name__, "correct or remove the file")
    value = scene.get("pixel_center", 0)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
        given = repr(value)[:40]
        raise complaint(path, "a number as pixel_center, from 0 to 1", given, "use the image coordinate of the first pixel's centre")
    return float(value)
