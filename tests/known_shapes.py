"""Shapes, views, lights and photographs whose errors are known in closed form."""

from __future__ import annotations

import igl
import numpy as np

from mvps import measures
from mvps.mesh import vertex_normals
from mvps.rendering import RAYS_ACROSS, photograph
from mvps.scene import Camera, Capture, Lights, Material, Reconstruction, Surface, Truth, View
from mvps.visibility import RayCaster

K = np.array([[400.0, 0, 32], [0, 400.0, 32], [0, 0, 1]])
SIX_SIDES = [np.array(r, float) for r in ([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], [[0, -1, 0], [0, 0, -1], [1, 0, 0]])]


def sphere(radius: float, divisions: int = 4) -> Surface:
    v = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    f = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(divisions):
        v, f = igl.upsample(v, f)
        v /= np.linalg.norm(v, axis=-1, keepdims=True)
    return Surface(radius * v, f)


def plane(x0: float, x1: float, z: float, cells: int = 8) -> Surface:
    """A rectangle over [x0, x1] x [-20, 20] at height z, its normal +z."""
    x, y = np.linspace(x0, x1, cells + 1), np.linspace(-20, 20, cells + 1)
    v = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((cells + 1, cells + 1), z)], -1).reshape(-1, 3)
    i = np.arange(cells * (cells + 1)).reshape(cells, cells + 1)[:, :-1].ravel()
    a, b, c, d = i, i + cells + 1, i + cells + 2, i + 1
    return Surface(v, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]))


def camera(rotation: np.ndarray, distance: float = 500.0) -> Camera:
    return Camera(K, rotation, np.array([0.0, 0.0, distance]), 64, 64)


LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])


def view(name: str, cam: Camera, mask: np.ndarray, samples: np.ndarray | None = None) -> View:
    samples = np.zeros((int(mask.sum()), 0, 3), np.uint16) if samples is None else samples
    return View(name, cam, mask, samples, 1 / 65535, 65535, tuple(range(1, samples.shape[1] + 1)))


def seen(surface: Surface, rotations: list[np.ndarray]) -> Capture:
    """Views of a surface with their true masks."""
    caster = RayCaster(surface)
    views = []
    for i, rotation in enumerate(rotations):
        full = view("all", camera(rotation), np.ones((64, 64), bool))
        mask = np.isfinite(measures.mesh_normals(caster, full)).all(-1)
        views.append(view(f"view_{i + 1:02d}", full.camera, mask))
    return Capture("test", tuple(views))


def tilted(normals: np.ndarray, degrees: float) -> np.ndarray:
    """Every normal turned by so much about an axis perpendicular to it."""
    across = np.cross(normals, (0.36, 0.48, 0.8))
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    return np.cos(np.radians(degrees)) * normals + np.sin(np.radians(degrees)) * across


def ring(count: int) -> np.ndarray:
    """Unit vectors in the plane z = 0."""
    t = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(t), np.sin(t), 0 * t], -1)


def lights(direction: np.ndarray, intensity: np.ndarray) -> dict[measures.Photograph, measures.Light]:
    return {("view_01", k + 1): (direction[k], intensity[k]) for k in range(len(direction))}


def photographed(noise: float, gain: float) -> tuple[Surface, Material, dict[measures.Photograph, measures.Light], Capture]:
    """Two views of a ball under three lights with noise, and its lights, `gain` times too bright."""
    ball = sphere(20)
    n = len(ball.vertices)
    material = Material(vertex_normals(ball), np.full((n, 3), (0.5, 0.4, 0.6)), np.full((n, 1), 0.1), np.array([20.0]), np.ones(n))
    rng, caster, views, known = np.random.default_rng(0), RayCaster(ball), [], {}
    for v in seen(ball, [LOOKING_DOWN, SIX_SIDES[0]]).views:
        # Near the camera: hardly a pixel so dark that noise is cut off at zero.
        direction = np.array([[0, 0, -1.0], [0.1, 0, -np.sqrt(0.99)], [0, 0.1, -np.sqrt(0.99)]]) @ v.camera.rotation
        intensity = np.array([[1, 1, 1], [0.7, 0.8, 0.9], [1.2, 1.1, 1.0]])
        image = photograph(caster, material, v.camera, v.pixels, direction, intensity, side=RAYS_ACROSS)
        noisy = np.clip(image + rng.normal(0, noise, image.shape), 0, 1)
        views.append(view(v.name, v.camera, v.mask, np.rint(noisy * 65535).astype(np.uint16)))
        known |= {(v.name, k + 1): (direction[k], gain * intensity[k]) for k in range(3)}
    return ball, material, known, Capture("test", tuple(views))


def reconstruction(settings: dict[str, object]) -> tuple[Reconstruction, Capture, Truth]:
    ball, material, known, capture = photographed(0.01, gain=1.0)
    names = tuple(v.name for v in capture.views)
    maps = {v.name: measures.mesh_normals(RayCaster(ball), v).astype(np.float32) for v in capture.views}
    direction, intensity = ({name: np.stack([known[name, k][part] for k in (1, 2, 3)]) for name in names} for part in (0, 1))
    both = Lights(tuple(direction.values()), tuple(intensity.values()), False)
    made = Reconstruction(ball, material, both, names, ((1, 2, 3),) * 2, tuple(maps.values()), {}, settings)
    return made, capture, Truth(names, maps, direction, intensity, ball)
