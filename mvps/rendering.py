"""Photographs of a reconstruction: first hits, interpolated material, the image model, cast shadows.

    image(pixel, light) = intensity * shade(material at the first hit) * (1 - cast_shadow)

The shading normal is the material's refined normal; shadows are traced on the mesh.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mvps.camera import view_directions
from mvps.mesh import normalise
from mvps.scene import Bool, Camera, Float, Int, Material
from mvps.shading import shade
from mvps.visibility import RayCaster, camera_hits, interpolate

SAMPLES_PER_CHUNK = 1 << 18


class Points(NamedTuple):
    """Surface points under n pixels: position, normal, albedo (n, 3), specular_weight (n, lobes[, 3]), confidence (n,), hit (n,)."""

    position: Float
    mesh_normal: Float
    normal: Float
    albedo: Float
    specular_weight: Float
    confidence: Float
    hit: Bool


def points_under(caster: RayCaster, material: Material, camera: Camera, pixels: Int) -> Points:
    """What the centres of pixels (n, 2), row and column, see. Where nothing is hit, all values are 0 and `hit` is False."""
    surface = caster.surface
    hits = camera_hits(caster, camera, pixels)
    values = (surface.vertices, caster.vertex_normals, material.normal, material.albedo, material.specular_weight, material.confidence)
    position, mesh_normal, normal, albedo, weight, confidence = (interpolate(surface, hits, v) for v in values)
    return Points(position, normalise(mesh_normal), normalise(normal), albedo, weight, confidence, hits.face >= 0)


def shadow_at(caster: RayCaster, points: Points, lights: Float, offset: float) -> Bool:
    """(n, lights) True where another part of the mesh hides the light (lights, 3) from the point. Offset: see visibility.py."""
    rows, columns = np.nonzero((points.mesh_normal @ lights.T > 0) & points.hit[:, None])
    origins = points.position + offset * points.mesh_normal
    shadow = np.zeros((len(points.hit), len(lights)), bool)
    shadow[rows, columns] = caster.occluded(origins[rows], lights[columns])
    return shadow


def photograph(
    caster: RayCaster,
    material: Material,
    camera: Camera,
    pixels: Int,
    direction: Float,
    intensity: Float,
    offset: float,
) -> NDArray[np.float32]:
    """Radiance (n, lights, 3) at the centres of pixels (n, 2) under lights direction, intensity (lights, 3); 0 where nothing is hit."""
    points = points_under(caster, material, camera, pixels)
    view = view_directions(camera, points.position)
    lit = ~shadow_at(caster, points, direction, offset)
    image = np.empty((len(pixels), len(direction), 3), np.float32)
    light = torch.tensor(direction, dtype=torch.float32)
    sharpness = torch.tensor(material.sharpness, dtype=torch.float32)
    step = max(1, SAMPLES_PER_CHUNK // max(1, len(direction)))
    for start in range(0, len(pixels), step):
        part = slice(start, start + step)
        arrays = (points.normal, view, points.albedo, points.specular_weight)
        normal, towards, albedo, weight = (torch.tensor(a[part], dtype=torch.float32) for a in arrays)
        shaded = shade(normal, towards, light, albedo, weight, sharpness).numpy()
        image[part] = shaded * intensity.astype(np.float32) * lit[part, :, None]
    return image
