"""A sphere of two colours, photographed by the program's own image model: what export, textures, report and render are tested on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh

from mvps.mesh import normalise
from mvps.rendering import photograph
from mvps.scene import Camera, Capture, Lights, Material, Reconstruction, Surface, View
from mvps.visibility import RayCaster, camera_hits, interpolate

RADIUS = 40.0
LEFT, RIGHT = np.array([0.7, 0.2, 0.1]), np.array([0.1, 0.4, 0.6])


class SphereScene(NamedTuple):
    reconstruction: Reconstruction
    capture: Capture


def camera_at(direction: np.ndarray, size: int = 96, distance: float = 400.0) -> Camera:
    """A camera in this direction from the origin, looking at it; the sphere fills four fifths of the image."""
    backward = direction / np.linalg.norm(direction)
    right = normalise(np.cross((0.0, 0.1, 1.0), backward))
    rotation = np.stack([right, np.cross(-backward, right), -backward])
    focal = 0.8 * size / 2 * distance / RADIUS
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(K, rotation, np.array([0, 0, distance]), size, size)


def colours(points: np.ndarray) -> np.ndarray:
    return np.where(points[..., :1] < 0, LEFT, RIGHT)


AXES = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


def make_sphere(
    subdivisions: int = 4,
    coloured_lobes: bool = False,
    seed: int = 0,
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0),
    tint_left: tuple[float, float, float] | None = None,
    seen_from: Sequence[Sequence[float]] = AXES,
    waves: float = 0.1,
    side: int = 1,
) -> SphereScene:
    """Views from these directions, ten lights of one rig; the refined normals are waves on the sphere's, up to about 10 degrees off.

    tint: colour of the lobes where they are coloured, tint_left: of those left, if others; waves: radians; side: rays along a pixel's side.
    """
    rng = np.random.default_rng(seed)
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    surface = Surface(np.array(ball.vertices), np.array(ball.faces))
    outward = normalise(surface.vertices)
    shift = waves * np.sin(surface.vertices[:, [1, 2, 0]] / 8)
    weight = np.full((len(outward), 2), 0.15)
    of_lobes = np.where(surface.vertices[:, :1] < 0, tint_left or tint, tint)
    weight = weight[..., None] * of_lobes[:, None] if coloured_lobes else weight
    material = Material(normalise(outward + shift), colours(surface.vertices), weight, np.array([12.0, 60.0]), np.ones(len(outward)))
    cameras = [camera_at(np.array(d, float)) for d in seen_from]
    tilt = rng.normal(0, 0.5, (10, 2))
    rig = normalise(np.concatenate([tilt, -np.ones((10, 1))], 1))
    intensity = rng.uniform(0.6, 1.4, (10, 3))
    caster, views, directions, maps = RayCaster(surface), [], [], []
    for k, camera in enumerate(cameras):
        pixels = np.indices((camera.height, camera.width)).reshape(2, -1).T
        hits = camera_hits(caster, camera, pixels)
        mask = (hits.face >= 0).reshape(camera.height, camera.width)
        direction = normalise(rig @ camera.rotation)
        radiance = photograph(caster, material, camera, pixels[mask.ravel()], direction, intensity, side=side)
        samples = np.rint((radiance / 2).clip(0, 1) * 65535).astype(np.uint16)
        views.append(View(f"view_{k + 1:02d}", camera, mask, samples, 2 / 65535, 65535, tuple(range(1, 11))))
        directions.append(direction)
        normals = np.full((*mask.shape, 3), np.nan, np.float32)
        normals[mask] = normalise(interpolate(surface, hits, material.normal))[mask.ravel()]
        maps.append(normals)
    reconstruction = Reconstruction(
        surface,
        material,
        Lights(tuple(directions), (intensity,) * len(cameras), True),
        tuple(view.name for view in views),
        tuple(view.lights for view in views),
        tuple(maps),
        {"stages": [{"name": "load", "seconds": 0.125, "peak_memory_mb": 200.5}], "status": {"name": "converged", "text": "1/3: ä"}},
        {"preset": "standard", "third": 1 / 3, "seed": 0},
    )
    return SphereScene(reconstruction, Capture("sphere", tuple(views)))
