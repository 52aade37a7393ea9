"""Normals that another program sees in model.glb, against true ones.

At the first hit of every pixel's ray on the file's mesh, as glTF 2.0 says (3.9.3, additional textures): with n, t the interpolated normal
and tangent, b = w (n x t), and c the normal map's colour there, bilinear,

    normal = c'_r t + c'_g b + c'_b n,      c' = 2 c - 1
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from glb import Array, Model, read_glb

from mvps.load import read_capture, read_truth
from mvps.mesh import angles_deg, normalise
from mvps.scene import Int, Surface
from mvps.visibility import Hits, camera_hits, interpolate, ray_caster


def normals_at(model: Model, surface: Surface, hits: Hits) -> tuple[Array, Array]:
    """(n, 3) unit normals with the normal map, and without it, at hits on the model's own mesh."""
    normal, tangent, uv = (interpolate(surface, hits, of.astype(float)) for of in (model.normal, model.tangent, model.uv))
    n = normalise(normal)
    t = normalise(tangent[:, :3] - (tangent[:, :3] * n).sum(1, keepdims=True) * n)
    b = np.cross(n, t) * np.sign(tangent[:, 3:])
    place = (uv * np.array(model.bump.shape[1::-1]) - 0.5).astype(np.float32)
    # OpenCV's maps have 32767 rows at most.
    parts = [cv2.remap(model.bump, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for x, y in _rows(place)]
    c = 2 * np.concatenate(parts).reshape(-1, 3) - 1
    return normalise(c[:, :1] * t + c[:, 1:2] * b + c[:, 2:] * n), n


def _rows(place: Array, most: int = 30000) -> list[tuple[Array, Array]]:
    """Coordinates (n, 2) as pairs of columns, as long as OpenCV takes."""
    return [(place[k : k + most, :1], place[k : k + most, 1:]) for k in range(0, len(place), most)]


def model_normal_errors(file: Path, capture: Path) -> dict[str, float]:
    """Mean errors, degrees, at the pixels of all views that have true normals: `model_normal_error_deg`, and `..._without_map_deg`."""
    model, truth = read_glb(file), read_truth(capture)
    surface = Surface(model.position, np.asarray(model.faces, np.int64))
    caster, found = ray_caster(surface), []
    for view in read_capture(capture, lights=[1]).views:
        true = truth.normals[view.name][view.mask] if view.name in truth.normals else np.full((len(view.pixels), 3), np.nan)
        known = np.isfinite(true).all(1)
        hits = camera_hits(caster, view.camera, view.pixels[known])
        hit: Int = np.flatnonzero(hits.face >= 0)
        seen = Hits(hits.face[hit], hits.barycentric[hit], hits.distance[hit])
        found.append([angles_deg(of, true[known][hit].astype(float)) for of in normals_at(model, surface, seen)])
    mapped, bare = (float(np.concatenate(of).mean()) for of in zip(*found, strict=True))
    return {"model_normal_error_deg": mapped, "model_normal_error_without_map_deg": bare}
