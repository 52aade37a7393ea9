"""Calib_Results.mat and scene.json -> cameras.

    Calib_Results.mat   KK (3, 3), or KK_i per view; Rc_i (3, 3), Tc_i (3, 1): camera_from_world of view i, OpenCV axes
    scene.json          optional; "pixel_center": image coordinate c of the first pixel's centre (absent: 0)

An image coordinate of the file plus (0.5 - c) is ours, whose first pixel's centre is at 0.5: so is the principal point.
MATLAB files are read by scipy, which unpacks only the variables asked for, and only after their shapes were checked.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from scipy.io.matlab import MatReadError

from mvps.load.images import complaint, read_bytes
from mvps.scene import Camera, CaptureError, Float

MAT_ERRORS = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    NotImplementedError,
    OverflowError,
    MemoryError,
    EOFError,
    MatReadError,
    struct.error,
    zlib.error,
)
"""What scipy raises on damaged MAT files and on HDF5-based ones (version 7.3)."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calib_Results.mat and scene.json. K, rotation, translation by view number; K in our pixel convention."""

    path: Path
    K: Mapping[int, Float]
    rotation: Mapping[int, Float]
    translation: Mapping[int, Float]
    shared_K: bool

    def camera(self, number: int, height: int, width: int) -> Camera:
        """The camera of a view, height x width pixels; CaptureError where the numbers are none of a camera."""
        try:
            return Camera(self.K[number], self.rotation[number], self.translation[number], height, width)
        except ValueError as error:
            raise CaptureError(f"{self.path}, view {number}: {error}; export the calibration again") from None


def read_calibration(root: Path) -> Calibration:
    """Cameras of all views that Calib_Results.mat knows."""
    if not root.is_dir():
        raise complaint(root, "a capture's folder", "a file" if root.exists() else "no such folder", "check the path")
    path = root / "Calib_Results.mat"
    read_bytes(path, "the cameras' calibration", "see the capture layout in the README", 1)
    shapes = _mat_shapes(path)
    numbers = sorted(int(m[1]) for m in (re.fullmatch(r"Rc_([1-9]\d*)", name) for name in shapes) if m)
    if not numbers:
        raise complaint(path, "Rc_1, Tc_1 and so on", f"only {sorted(shapes) or 'nothing'}", "export the extrinsics of every view")
    shared = not any(f"KK_{n}" in shapes for n in numbers)
    K_names = {n: "KK" if shared else f"KK_{n}" for n in numbers}
    names = {*K_names.values(), *(f"{kind}_{n}" for kind in ("Rc", "Tc") for n in numbers)}
    for name in sorted(names):
        wanted = ((3, 1), (1, 3)) if name.startswith("Tc") else ((3, 3),)
        if name not in shapes:
            raise complaint(path, name, f"a file without it (it holds {len(shapes)} variables)", "export the calibration of every view")
        if tuple(shapes[name]) not in wanted:
            raise complaint(path, f"{name} of shape {wanted[0]}", f"shape {tuple(shapes[name])}", "export the calibration again")
    arrays = {name: _numbers(path, name, value) for name, value in read_mat(path, sorted(names)).items()}
    shift = np.eye(3)
    shift[:2, 2] = 0.5 - _pixel_centre(root / "scene.json")
    return Calibration(
        path,
        {n: shift @ arrays[K_names[n]] for n in numbers},
        {n: arrays[f"Rc_{n}"] for n in numbers},
        {n: arrays[f"Tc_{n}"].reshape(3) for n in numbers},
        shared,
    )


def _mat_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a MAT file's variables, read without their contents."""
    try:
        return {name: shape for name, shape, _ in scipy.io.whosmat(path)}
    except MAT_ERRORS as error:
        raise _unreadable_mat(path, error) from None


def read_mat(path: Path, names: Sequence[str]) -> dict[str, Any]:
    """Those variables of a MAT file (no other is unpacked); CaptureError where it is damaged or one is missing."""
    try:
        loaded = scipy.io.loadmat(path, variable_names=list(names))
    except MAT_ERRORS as error:
        raise _unreadable_mat(path, error) from None
    for name in names:
        if name not in loaded:
            raise complaint(path, f"a variable {name}", f"a file without it ({path.stat().st_size} bytes)", "export it again")
    return {name: loaded[name] for name in names}


def _unreadable_mat(path: Path, error: Exception) -> CaptureError:
    given = f"one that cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
    return complaint(path, "a MATLAB file", given, "copy it again, or save it in MATLAB with save(..., '-v7')")


def _numbers(path: Path, name: str, value: Any) -> Float:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu" or not np.isfinite(value).all():
        raise complaint(path, f"finite real numbers in {name}", f"{np.asarray(value).tolist()}", "export the calibration again")
    return value.astype(np.float64)


def _pixel_centre(path: Path) -> float:
    """Image coordinate of the first pixel's centre: 0 (Caltech toolbox) unless scene.json says otherwise."""
    if not path.exists():
        return 0.0
    try:
        scene = json.loads(read_bytes(path, "a JSON object", "remove the file if it is not needed"))
    except ValueError as error:
        if isinstance(error, CaptureError):
            raise
        raise complaint(path, "a JSON object", f"text that is none ({error})", "correct or remove the file") from None
    if not isinstance(scene, dict):
        raise complaint(path, "a JSON object", type(scene).__name__, "correct or remove the file")
    value = scene.get("pixel_center", 0)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise complaint(path, "a number as pixel_center", repr(value), "use 0, 0.5 or 1: the image coordinate of the first pixel's centre")
    return float(value)
