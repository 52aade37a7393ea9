"""Scenes that are hard: few or odd lights, odd materials, odd shapes, cameras that cut the object, lights that are near.

A scene is that of mvps.synthetic with one part replaced. Lengths are in units of half the extent; the object then fills the ball of
radius 1, of which a radius is seen as 0.45 of the image's width at most.

Near light   a point light at p = distance * direction from the object's centre, as strong there as the directional one it replaces:
             the light at x comes along (p - x) / |p - x| and is distance^2 / |p - x|^2 times as strong.
Radiosity    B = a (E + G B) on the vertices: albedo a, direct light E, and G the mean over rays that leave a vertex with the cosine's
             density of B where they first hit, nothing where they hit nothing (Goral et al. 1984). Bodies send light, highlights do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.sparse as sp
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mvps.camera import view_directions
from mvps.mesh import normalise, vertex_normals
from mvps.rendering import photograph, points_under, shaded
from mvps.scene import Camera, Capture, Float, Int, Lights, Material, Surface, Truth
from mvps.synthetic.scene import Photograph, Scene, make_cameras, make_lights, make_scene, render_capture
from mvps.synthetic.settings import SceneSettings
from mvps.synthetic.shape import make_material
from mvps.visibility import RayCaster, camera_hits, cast_shadow, interpolate

BASE = SceneSettings(views=8, lights=10, size=128)

Change = Callable[[Scene], Scene]


def rendered(settings: SceneSettings = BASE, change: Change | None = None, take: Photograph | None = None) -> tuple[Capture, Truth]:
    """The settings' scene, changed, photographed."""
    scene = make_scene(settings)
    return render_capture(settings, scene if change is None else change(scene), take)


# ------------------------------------------------------------------------------------------------ lights


def lit(scene: Scene, direction: Float, intensity: Float) -> Scene:
    """Under one rig of lights: direction (lights, 3) in DiLiGenT's camera frame (x right, y up, z to the camera), intensity (lights, 3)."""
    in_camera = normalise(direction) * (1, -1, -1)
    lights = Lights(tuple(in_camera @ c.rotation for c in scene.cameras), (intensity / intensity.mean(),) * len(scene.cameras), True)
    return replace(scene, lights=lights)


def in_one_plane(scene: Scene) -> Scene:
    """Lights along an arc from 50 degrees left to 50 degrees right, all in the plane y = 0 of the camera."""
    intensity = scene.lights.intensity[0]
    angle = np.radians(np.linspace(-50, 50, len(intensity)))
    return lit(scene, np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], -1), intensity)


def unequal(scene: Scene, ratio: float) -> Scene:
    """The strongest light `ratio` times as strong as the weakest, evenly spaced in the logarithm."""
    count = len(scene.lights.intensity[0])
    steps = np.random.default_rng(0).permutation(count) / (count - 1)
    intensity = np.repeat(ratio ** steps[:, None], 3, 1)
    return replace(scene, lights=replace(scene.lights, intensity=(intensity / intensity.mean(),) * len(scene.cameras)))


def coloured(scene: Scene) -> Scene:
    """Red, green, blue, yellow ... lights: every channel between 0.1 and 1."""
    intensity = np.random.default_rng(0).uniform(0.1, 1, scene.lights.intensity[0].shape)
    return replace(scene, lights=replace(scene.lights, intensity=(intensity / intensity.mean(),) * len(scene.cameras)))


def lamps(scene: Scene, count: int) -> Scene:
    """Lamps on all sides of the object that stand still while the camera moves: many are behind the object, of which a view sees rims."""
    k = np.arange(count)
    height, azimuth = 1 - 2 * (k + 0.5) / count, np.pi * (3 - np.sqrt(5)) * k
    direction = np.stack([np.sqrt(1 - height**2) * np.cos(azimuth), np.sqrt(1 - height**2) * np.sin(azimuth), height], -1)
    intensity = np.exp(0.35 * np.random.default_rng(0).normal(size=(count, 1))) * np.ones(3)
    views = len(scene.cameras)
    return replace(scene, lights=Lights((direction,) * views, (intensity / intensity.mean(),) * views, True, True))


def near(distance: float) -> Photograph:
    """Photographs under point lights this far (world units) from the world's origin, in the directions of the scene's lights."""

    def take(
        caster: RayCaster,
        material: Material,
        camera: Camera,
        pixels: Int,
        direction: Float,
        intensity: Float,
    ) -> NDArray[np.float32]:
        points = points_under(caster, material, camera, pixels)
        view = view_directions(camera, points.position)
        image = np.zeros((len(pixels), len(direction), 3), np.float32)
        for k, towards in enumerate(direction):
            path = distance * towards - points.position
            light, falloff = normalise(path), distance**2 / (path**2).sum(-1)
            free = ~caster.occluded(points.position + caster.offset * points.mesh_normal, light)
            image[:, k] = shaded(points, view, material, light[:, None])[:, 0]
            image[:, k] *= (free * falloff * points.hit)[:, None]
        return image * intensity.astype(np.float32)

    return take


RAYS_BETWEEN, BOUNCES = 128, 6
"""Of radiosity: rays of a vertex, and how often light is sent on (mean albedo 0.4: what is left is below 0.01)."""


@lru_cache(maxsize=1)
def sent_between(caster: RayCaster) -> sp.csr_matrix:
    """G (V, V) of a mesh."""
    normal, rng, n = caster.vertex_normals, np.random.default_rng(0), len(caster.vertex_normals)
    # A point of the unit sphere around the tip of the normal lies in a direction of the cosine's density.
    direction = normalise(np.repeat(normal, RAYS_BETWEEN, 0) + normalise(rng.normal(size=(n * RAYS_BETWEEN, 3))))
    hits = caster.first_hits(np.repeat(caster.surface.vertices + caster.offset * normal, RAYS_BETWEEN, 0), direction)
    rows, columns = np.repeat(np.arange(n), 3 * RAYS_BETWEEN), caster.surface.faces[np.maximum(hits.face, 0)].ravel()
    return sp.csr_matrix((hits.barycentric.ravel() / RAYS_BETWEEN, (rows, columns)), (n, n))


def lit_between(
    caster: RayCaster,
    material: Material,
    camera: Camera,
    pixels: Int,
    direction: Float,
    intensity: Float,
) -> NDArray[np.float32]:
    """Photographs of an object whose parts light each other."""
    G, n = sent_between(caster), len(material.albedo)
    direct = np.maximum(caster.vertex_normals @ direction.T, 0) * ~cast_shadow(caster, np.arange(n), direction)
    albedo, arrives = material.albedo[:, None], np.zeros((n, len(direction), 3))
    for _ in range(BOUNCES):
        arrives = (G @ (albedo * (direct[..., None] + arrives)).reshape(n, -1)).reshape(arrives.shape)
    more = interpolate(caster.surface, camera_hits(caster, camera, pixels), albedo * arrives)
    image = photograph(caster, material, camera, pixels, direction, intensity)
    return image + (more * intensity).astype(np.float32)


# ------------------------------------------------------------------------------------------------ materials


def made_of(scene: Scene, albedo: float | None, weight: tuple[float, ...] | None = None, sharpness: tuple[float, ...] = ()) -> Scene:
    """Albedo times a factor (None: as it is) that makes its mean so; lobes of one weight everywhere (None: as they are)."""
    material = scene.material
    if albedo is not None:
        material = replace(material, albedo=material.albedo * (albedo / material.albedo.mean()))
    if weight is not None:
        weights = np.tile(np.array(weight), (len(material.albedo), 1))
        material = replace(material, specular_weight=weights, sharpness=np.array(sharpness))
    return replace(scene, material=material)


# ------------------------------------------------------------------------------------------------ shapes


def shaped_as(surface: Surface, settings: SceneSettings = BASE, arc: float = 2 * np.pi) -> Scene:
    """The settings' scene with another object: its ball (radius 1 around the origin) gets the settings' extent. arc: of the cameras."""
    material_rng, light_rng = (np.random.default_rng((settings.seed, part)) for part in (1, 2))
    material = make_material(surface.vertices, vertex_normals(surface), settings.strength, material_rng)
    vertices = surface.vertices * settings.extent / 2
    cameras = make_cameras(settings, vertices, arc)
    return Scene(Surface(vertices, surface.faces), material, cameras, make_lights(settings, cameras, light_rng))


def surface_of(*parts: trimesh.Trimesh) -> Surface:
    """Parts that may overlap as one surface, centred and scaled into the unit ball; edges of 0.03 (2 pixels of BASE) at most."""
    whole: Any = trimesh.util.concatenate([part.subdivide_to_size(0.03, max_iter=20) for part in parts])
    middle = whole.bounds.mean(0)
    radius = np.linalg.norm(whole.vertices - middle, axis=-1).max()
    return Surface((whole.vertices - middle) / radius, whole.faces)


def sphere() -> Surface:
    """A ball."""
    return surface_of(trimesh.creation.icosphere(subdivisions=5))


def slab() -> Surface:
    """A plate on its narrow side, a tenth as thick as wide."""
    return surface_of(trimesh.creation.box((1.6, 0.16, 1.2)))


ARC = np.radians(120)
"""Of the cameras in front of a sheet."""


def sheet(height: float) -> Surface:
    """A square of paper, open at its edges and without a back, in waves of this height; upright, facing the middle of ARC."""
    ticks = np.linspace(-0.68, 0.68, 69)
    y, z = np.meshgrid(ticks, ticks, indexing="ij")
    x = height * np.sin(7 * y + 2 * np.sin(3 * z)) * np.cos(6 * z)
    middle = ARC * (BASE.views - 1) / (2 * BASE.views)
    points = np.stack([x * np.cos(middle) - y * np.sin(middle), x * np.sin(middle) + y * np.cos(middle), z], -1).reshape(-1, 3)
    corner = (np.arange(68)[:, None] * 69 + np.arange(68)).ravel()
    faces = np.concatenate([np.stack([corner, corner + 69, corner + 70], -1), np.stack([corner, corner + 70, corner + 1], -1)])
    return Surface(points / np.linalg.norm(points, axis=-1).max(), faces)


def bowl() -> Surface:
    """A bowl as deep as wide, open to the top, its wall a tenth of its radius thick."""
    angle, height = np.linspace(-np.pi / 2, 0, 64), np.linspace(0, 1, 40)[1:]
    outside = np.concatenate([np.stack([np.cos(angle), np.sin(angle)], -1), np.stack([np.ones_like(height), height], -1)])
    inside = outside * (0.9, 1) + np.where(outside[:, 1:] < 0, -0.1 * outside * (0, 1), 0)
    outline = np.concatenate([outside, inside[::-1]])
    # The axis is met twice, below and inside: a revolution wants radius 0 there.
    outline[[0, -1], 0] = 0
    return surface_of(trimesh.creation.revolve(outline, sections=240))


def touching() -> Surface:
    """Two balls side by side that touch."""
    balls = [trimesh.creation.icosphere(subdivisions=5, radius=0.505) for _ in range(2)]
    for ball, x in zip(balls, (-0.5, 0.5), strict=True):
        ball.apply_translation((x, 0, 0))
    return surface_of(*balls)


def chain() -> Surface:
    """Two rings, one through the other, that do not touch."""
    rings = [trimesh.creation.torus(0.45, 0.08, major_sections=160, minor_sections=48) for _ in range(2)]
    rings[0].apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    for ring, x in zip(rings, (-0.25, 0.25), strict=True):
        ring.apply_translation((x, 0, 0))
    return surface_of(*rings)


def rods(width: float, size: int = BASE.size) -> Surface:
    """A ball with eight rods, this many pixels of an image of `size` pixels wide and 0.4 of the object's radius long."""
    radius = width / (0.9 * size)
    parts = [trimesh.creation.icosphere(subdivisions=5, radius=0.6)]
    for k in range(8):
        azimuth, height = 2 * np.pi * k / 8, (-0.5, 0.4)[k % 2]
        towards = normalise(np.array([np.cos(azimuth), np.sin(azimuth), height]))
        parts.append(trimesh.creation.cylinder(radius, sections=16, segment=(0.5 * towards, towards)))
    return surface_of(*parts)


def rings(width: float, size: int = BASE.size) -> Surface:
    """A ball with three upright rings, this many pixels of an image of `size` pixels thick and 0.6 of the object's radius across."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
    parts = [ball]
    for k in range(3):
        ring = trimesh.creation.torus(0.3, width / (0.9 * size), major_sections=64, minor_sections=16)
        ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
        ring.apply_translation((0.6, 0, 0))
        ring.apply_transform(trimesh.transformations.rotation_matrix(2 * np.pi * k / 3, (0, 0, 1)))
        parts.append(ring)
    return surface_of(*parts)


# ------------------------------------------------------------------------------------------------ cameras


def zoomed(scene: Scene, factor: float) -> Scene:
    """Focal lengths times a factor: with more than 1.11 the images cut the object."""
    cameras = tuple(
        replace(c, K=np.diag([factor, factor, 1.0]) @ c.K + (1 - factor) * c.K * [[0, 0, 1], [0, 0, 1], [0, 0, 0]]) for c in scene.cameras
    )
    return replace(scene, cameras=cameras)


def from_above(scene: Scene) -> Scene:
    """Every third and fourth camera 45 degrees higher, up to 85 above the equator, with its rig."""
    higher = Rotation.from_euler("x", 45, degrees=True).as_matrix()
    cameras, directions = [], []
    for k, (camera, direction) in enumerate(zip(scene.cameras, scene.lights.direction, strict=True)):
        rotation = higher @ camera.rotation if k % 4 > 1 else camera.rotation
        cameras.append(replace(camera, rotation=rotation))
        directions.append(direction @ camera.rotation.T @ rotation)
    return replace(scene, cameras=tuple(cameras), lights=replace(scene.lights, direction=tuple(directions)))
