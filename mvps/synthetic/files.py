"""A capture and its ground truth in the layout of DiLiGenT-MV (see mvps/load): the same values give the same bytes."""

from __future__ import annotations

import io
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.camera import DILIGENT_FROM_CAMERA
from mvps.mesh import vertex_normals
from mvps.meshfile import PlyMesh, ply_bytes
from mvps.scene import Capture, CaptureError, Surface, Truth, View


def checked_place(folder: Path) -> Path:
    """The absolute path of a folder that is new or empty. CaptureError where something is in the way."""
    place = Path(folder).resolve()
    if place.exists() and (not place.is_dir() or any(place.iterdir())):
        raise CaptureError(f"{place}: wanted a new or empty folder, given something that is there; give another --out or empty this one")
    return place


def write_capture(capture: Capture, truth: Truth, folder: Path) -> None:
    """Write a capture and its truth, as `render_capture` makes them, whole or not at all. CaptureError as `checked_place`."""
    place = checked_place(folder)
    place.parent.mkdir(parents=True, exist_ok=True)
    writing = place.with_name(f".{place.name}.{os.getpid()}.writing")
    writing.mkdir()
    try:
        (writing / "scene.json").write_text(json.dumps({"pixel_center": 0.5}) + "\n", encoding="utf-8")
        (writing / "Calib_Results.mat").write_bytes(_calibration(capture))
        if truth.surface is not None:
            (writing / "mesh_Gt.ply").write_bytes(_mesh(truth.surface))
        for view in capture.views:
            _write_view(view, truth, writing / view.name)
        writing.replace(place)
    finally:
        if writing.exists():
            shutil.rmtree(writing)


def _mat(values: dict[str, Any]) -> bytes:
    """A MATLAB file. Its first 116 bytes are free text, where scipy puts the date: the same values must give the same bytes."""
    from scipy.io import savemat

    file = io.BytesIO()
    savemat(file, values)
    return b"MATLAB 5.0 MAT-file".ljust(116) + file.getvalue()[116:]


def _calibration(capture: Capture) -> bytes:
    values: dict[str, Any] = {}
    for view in capture.views:
        i = int(view.name.rpartition("_")[2])
        values |= {f"KK_{i}": view.camera.K, f"Rc_{i}": view.camera.rotation, f"Tc_{i}": view.camera.translation[:, None]}
        if view.camera.distortion:
            values[f"kc_{i}"] = np.array(view.camera.distortion)[:, None]
    return _mat(values)


def _mesh(surface: Surface) -> bytes:
    grey = np.full(surface.vertices.shape, 128, np.uint8)
    return ply_bytes(PlyMesh(surface.vertices, vertex_normals(surface), grey, surface.faces), "ground truth")


def _png(image: NDArray[Any]) -> bytes:
    """The image as PNG. cv2.imwrite would do, but for names that are no text, on which it ends the process, and full disks, of which it
    says nothing."""
    import cv2

    return cv2.imencode(".png", image)[1].tobytes()


def _write_view(view: View, truth: Truth, folder: Path) -> None:
    folder.mkdir()
    diligent_from_world = DILIGENT_FROM_CAMERA @ view.camera.rotation
    names = [f"{light:03d}.png" for light in view.lights]
    for k, name in enumerate(names):
        image = np.zeros((*view.mask.shape, 3), np.uint16)
        image[view.mask] = view.samples[:, k, ::-1]
        (folder / name).write_bytes(_png(image))
    (folder / "mask.png").write_bytes(_png(view.mask.astype(np.uint8) * 255))
    (folder / "filenames.txt").write_text("\n".join(names) + "\n", encoding="utf-8")
    tables = {
        "light_directions.txt": truth.direction[view.name] @ diligent_from_world.T,
        "light_intensities.txt": truth.intensity[view.name],
    }
    for name, table in tables.items():
        np.savetxt(folder / name, table, fmt="%.9g")
    normals = np.nan_to_num(truth.normals[view.name] @ diligent_from_world.T)
    (folder / "Normal_gt.mat").write_bytes(_mat({"Normal_gt": normals}))
