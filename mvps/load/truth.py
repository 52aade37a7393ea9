"""Ground truth of a capture in the layout of DiLiGenT-MV: read only where the user asks for it.

CAPTURE/view_01/Normal_gt.mat           Normal_gt (height, width, 3), DiLiGenT camera frame
CAPTURE/view_01/light_directions.txt    a unit vector per light, DiLiGenT camera frame
CAPTURE/view_01/light_intensities.txt   red, green, blue per light
CAPTURE/mesh_Gt.ply                     world frame and units

x_world = rotation^T DILIGENT_FROM_CAMERA^T x_diligent

with the rotation of the camera as it is used: lamps and normals are measured with the camera, and turn with it where it is moved. Where
photographs are used without their lens's distortion normals are, too.
"""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from mvps.camera import DILIGENT_FROM_CAMERA
from mvps.distortion import straightener
from mvps.inputs import DAMAGED
from mvps.load.calibration import LARGEST, read_calibration
from mvps.load.diligent import view_folders
from mvps.load.images import TEXT_LIMIT, complaint, read_bytes, read_mask
from mvps.load.matfile import numbers_of, read_variables
from mvps.mesh import normalise, without_unused_vertices
from mvps.scene import Camera, Capture, Float, Lights, Surface, Truth

ONE_RIG_TOLERANCE = 1e-3
"""Radians between two views' light directions that still count as the same: the files print 4 digits or more."""


def read_truth(path: str | Path, cameras: Mapping[str, Camera] = MappingProxyType({})) -> Truth:
    """The ground truth that lies in a capture's folder; what is absent there is absent in the result.

    cameras: of views, by name, whose cameras are not those of the files any longer. Raises CaptureError about files that are there and
    wrong.
    """
    root = Path(path)
    calibration = read_calibration(root)
    present = [int(f.name[5:]) for f in root.glob("view_*") if f.is_dir() and f.name[5:].isdecimal()]
    folders = view_folders(root, calibration, [n for n in present if n in calibration.rotation] or None)
    normals, direction, intensity = {}, {}, {}
    for number, folder in folders.items():
        rotation = cameras[folder.name].rotation if folder.name in cameras else calibration.rotation[number]
        world_from_diligent = _world_from_diligent(rotation)
        if os.path.lexists(folder / "Normal_gt.mat"):
            normals[folder.name] = _normals(folder, world_from_diligent)
            recorded = calibration.camera(number, *normals[folder.name].shape[:2])
            if folder.name in cameras and recorded.distortion != cameras[folder.name].distortion:
                normals[folder.name] = _straightened(normals[folder.name], recorded)
        if os.path.lexists(folder / "light_directions.txt"):
            direction[folder.name] = _directions(folder) @ world_from_diligent.T
        if os.path.lexists(folder / "light_intensities.txt"):
            intensity[folder.name] = _table(folder / "light_intensities.txt", positive=True)
        known = [len(of[folder.name]) for of in (direction, intensity) if folder.name in of]
        if len(set(known)) > 1:
            raise complaint(
                folder / "light_intensities.txt", f"{known[0]} lines, as light_directions.txt has", f"{known[1]}", "add the rest"
            )
    mesh = root / "mesh_Gt.ply"
    return Truth(
        views=tuple(folder.name for folder in folders.values()),
        normals=normals,
        direction=direction,
        intensity=intensity,
        surface=_surface(mesh) if os.path.lexists(mesh) else None,
    )


def read_calibrated_lights(path: str | Path, capture: Capture) -> Lights:
    """The lights given with a capture, for the views and lights that `capture` holds, matched by their numbers.

    Directions in the world frame, by the capture's own cameras; intensities divided by their mean over all lights and channels.
    CaptureError where a file or a light is missing.
    """
    root = Path(path)
    directions, intensities, in_camera = [], [], []
    for view in capture.views:
        folder = root / view.name
        tables = _directions(folder), _table(folder / "light_intensities.txt", positive=True)
        for name, table in zip(("light_directions.txt", "light_intensities.txt"), tables, strict=True):
            if len(table) < max(view.lights):
                wanted = f"a line for each of {max(view.lights)} lights"
                raise complaint(folder / name, wanted, f"{len(table)} lines", "add the missing lights")
        rows = np.array(view.lights) - 1
        in_camera.append(tables[0][rows])
        directions.append(in_camera[-1] @ _world_from_diligent(view.camera.rotation).T)
        intensities.append(tables[1][rows])
    mean = np.concatenate(intensities).mean()
    numbered = all(view.lights == capture.views[0].lights for view in capture.views)
    with_camera, in_world = numbered and _alike(in_camera), numbered and _alike(directions)
    fixed = in_world and not with_camera
    return Lights(tuple(directions), tuple(table / mean for table in intensities), with_camera or fixed, fixed)


def _alike(directions: list[Float]) -> bool:
    """Whether all views' directions (lights, 3) are the first one's. The chord of an angle this small is the angle."""
    return all(np.linalg.norm(of_view - directions[0], axis=-1).max() <= ONE_RIG_TOLERANCE for of_view in directions)


def _world_from_diligent(rotation: Float) -> Float:
    world_from_diligent: Float = rotation.T @ DILIGENT_FROM_CAMERA.T
    return world_from_diligent


def _normals(folder: Path, world_from_diligent: Float) -> NDArray[np.float32]:
    path = folder / "Normal_gt.mat"
    mask = read_mask(folder / "mask.png")
    read_bytes(path, "a MATLAB file", "copy it again", 1)
    found = read_variables(path, mask.size * 3 * 8, "Normal_gt").get("Normal_gt")
    if found is None or found.shape != (*mask.shape, 3):
        given = "a file without it" if found is None else f"{found.kind} of shape {found.shape}"
        raise complaint(path, f"a variable Normal_gt of shape {(*mask.shape, 3)} as in mask.png", given, "export it again")
    local = numbers_of(path, "Normal_gt", found)
    if (np.abs(local) > LARGEST).any():
        raise complaint(path, "unit normals", "one that is longer than any number in a calibration", "export it again")
    world = local.astype(np.float64) @ world_from_diligent.T
    length = np.linalg.norm(world, axis=-1, keepdims=True)
    world = np.divide(world, length, out=np.full_like(world, np.nan), where=length > 0)
    world[~mask] = np.nan
    return np.asarray(world, np.float32)


def _straightened(normals: NDArray[np.float32], recorded: Camera) -> NDArray[np.float32]:
    """Normals (height, width, 3) on the pixels of a pinhole in place of those of a camera with a lens."""
    known = np.isfinite(normals[..., 0])
    weighted = np.concatenate([np.nan_to_num(normals), known[..., None]], -1, dtype=np.float32)
    found = straightener(recorded)(weighted)
    straight: NDArray[np.float32] = normalise(found[..., :3]).astype(np.float32)
    straight[found[..., 3] <= 0.5] = np.nan
    return straight


def _directions(folder: Path) -> Float:
    """(lights, 3) unit, DiLiGenT camera frame."""
    path = folder / "light_directions.txt"
    table = _table(path, positive=False)
    length = np.linalg.norm(table, axis=-1, keepdims=True)
    # Rounding to the 2 digits that any file prints moves a unit vector's length by less than this.
    if np.abs(length - 1).max() > 0.02:
        line = int(np.abs(length - 1).argmax()) + 1
        raise complaint(path, "unit vectors", f"one of length {length[line - 1, 0]:.4g} in line {line}", "normalise the directions")
    unit: Float = table / length
    return unit


def _table(path: Path, positive: bool) -> Float:
    """(lights, 3) finite numbers."""
    text = read_bytes(path, "three numbers per light", "provide the file, or leave the calibrated lights out", most=TEXT_LIMIT)
    try:
        table = np.array([[float(word) for word in line.split()] for line in text.decode("utf-8-sig").splitlines() if line.strip()])
    except ValueError as error:
        raise complaint(path, "three numbers per line", f"text that is none ({error})", "correct the file") from None
    if table.ndim != 2 or table.shape[1] != 3 or not (np.abs(table) < LARGEST).all() or (positive and (table <= 0).any()):
        wanted = "three finite " + ("positive " if positive else "") + "numbers per line"
        raise complaint(path, wanted, f"a table of shape {table.shape}, smallest {table.min(initial=np.inf):.4g}", "correct the file")
    return table


def _surface(path: Path) -> Surface:
    data = read_bytes(path, "a triangle mesh as PLY", "copy or export it again")
    import trimesh

    try:
        # Without a folder to look in and without materials no other file is opened.
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type="ply", process=False, skip_materials=True)
        # Scanners leave single points, which are no part of the surface, its size or its vertices.
        return without_unused_vertices(Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces)))
    except (*DAMAGED, AssertionError) as error:
        raise complaint(
            path, "a triangle mesh as PLY", f"one that cannot be read ({str(error)[:200]})", "copy or export it again"
        ) from None
