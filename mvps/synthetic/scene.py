"""Scenes from settings, and photographs of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvps.mesh import normalise
from mvps.scene import Bool, Camera, Capture, Float, Lights, Material, Surface, Truth, View
from mvps.synthetic.settings import SceneSettings
from mvps.synthetic.shape import Shape, make_material, mesh_of
from mvps.visibility import camera_hits, interpolate, ray_caster

SUPERSAMPLING = 2
"""Rays per pixel along each axis."""

WHITE = 2**16 - 1
"""Largest code value of the 16-bit images; radiance 1."""

Photograph = Callable[..., NDArray[np.float32]]
"""Takes photographs, with the first six arguments of `mvps.rendering.photograph`."""


@dataclass(frozen=True, eq=False)
class Scene:
    """An object under lights in front of cameras: everything there is to know before a photograph is taken."""

    surface: Surface
    material: Material
    cameras: tuple[Camera, ...]
    lights: Lights


def make_cameras(settings: SceneSettings, vertices: Float, arc: float = 2 * np.pi) -> tuple[Camera, ...]:
    """Cameras evenly around the z axis or along an arc of it (radians), in turn 15 and 40 degrees above the equator, ten extents away,
    looking at the origin.

    All have the focal length at which the vertices (V, 3), seen from everywhere, just leave the outer 5 % of the images free.
    """
    distance = 10 * settings.extent
    poses = []
    for i in range(settings.views):
        azimuth, elevation = arc * i / settings.views, np.radians((15, 40)[i % 2])
        backward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        right = normalise(np.cross(-backward, (0.0, 0.0, 1.0)))
        poses.append(np.stack([right, np.cross(-backward, right), -backward]))
    local = [vertices @ rotation.T + (0, 0, distance) for rotation in poses]
    slope = max(float(np.abs(points[:, :2] / points[:, 2:]).max()) for points in local)
    focal, middle = 0.45 * settings.size / slope, settings.size / 2
    K = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
    return tuple(Camera(K, rotation, np.array([0.0, 0.0, distance]), settings.size, settings.size) for rotation in poses)


def make_lights(settings: SceneSettings, cameras: tuple[Camera, ...], rng: np.random.Generator) -> Lights:
    """A lattice of equal areas on the cap around the direction to the camera; one for all views, or one turned by chance for each."""
    k = np.arange(settings.lights)
    golden = np.pi * (3 - np.sqrt(5))

    def rig() -> tuple[Float, Float]:
        jitter = rng.uniform(0.2, 0.8, settings.lights)
        cosine = 1 - (k + jitter) / settings.lights * (1 - np.cos(np.radians(settings.spread)))
        azimuth, sine = golden * k + rng.uniform(0, 2 * np.pi), np.sqrt(1 - cosine**2)
        # Camera frame: the direction to the camera is -z.
        direction = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), -cosine], -1)
        colour = 1 + 0.03 * rng.normal(size=(settings.lights, 3))
        return direction, np.exp(settings.intensity_spread * rng.normal(size=(settings.lights, 1))) * colour

    rigs = [rig() for _ in cameras] if settings.free_lights else [rig()] * len(cameras)
    mean = np.mean([intensity for _, intensity in rigs])
    directions = tuple(d @ camera.rotation for (d, _), camera in zip(rigs, cameras, strict=True))
    return Lights(directions, tuple(intensity / mean for _, intensity in rigs), not settings.free_lights)


def make_scene(settings: SceneSettings) -> Scene:
    """The scene before any photograph is taken. The object fits into a ball of diameter `extent` around the origin."""
    shape_rng, material_rng, light_rng = (np.random.default_rng((settings.seed, part)) for part in range(3))
    # Edges of the mesh are about as long as a pixel is wide; beyond 256 cells memory grows and the eye sees no difference.
    surface, normal = mesh_of(Shape(shape_rng), min(256, settings.size))
    centre = (surface.vertices.min(0) + surface.vertices.max(0)) / 2
    radius = np.linalg.norm(surface.vertices - centre, axis=-1).max()
    local = (surface.vertices - centre) / radius
    material = make_material(local, normal, settings.strength, material_rng)
    vertices = local * settings.extent / 2
    cameras = make_cameras(settings, vertices)
    return Scene(Surface(vertices, surface.faces), material, cameras, make_lights(settings, cameras, light_rng))


def _supersampled(camera: Camera) -> Camera:
    """The same camera with SUPERSAMPLING^2 pixels for each."""
    K = np.diag([SUPERSAMPLING, SUPERSAMPLING, 1.0]) @ camera.K
    return Camera(K, camera.rotation, camera.translation, SUPERSAMPLING * camera.height, SUPERSAMPLING * camera.width)


def photograph_scene(
    scene: Scene, take: Photograph | None = None
) -> tuple[tuple[Bool, ...], tuple[NDArray[np.float32], ...], tuple[NDArray[np.float32], ...]]:
    """What every camera sees, without noise and clipping; `take` replaces `mvps.rendering.photograph`.

    Per view: mask (height, width), where the pixel's centre sees the object; radiance (pixels, lights, 3) of the mask's pixels, each
    the mean over its sub-pixels; normals (height, width, 3) at the pixels' centres, world frame, NaN outside the mask.
    """
    from mvps.rendering import photograph

    take = take or photograph
    caster = ray_caster(scene.surface)
    sub = np.stack(np.meshgrid(range(SUPERSAMPLING), range(SUPERSAMPLING), indexing="ij"), -1).reshape(-1, 2)
    masks, radiances, normal_maps = [], [], []
    for camera, direction, intensity in zip(scene.cameras, scene.lights.direction, scene.lights.intensity, strict=True):
        hits = camera_hits(caster, camera, np.indices((camera.height, camera.width)).reshape(2, -1).T)
        mask = (hits.face >= 0).reshape(camera.height, camera.width)
        normals = normalise(interpolate(scene.surface, hits, scene.material.normal)).astype(np.float32)
        normals[hits.face < 0] = np.nan
        pixels = (SUPERSAMPLING * np.argwhere(mask)[:, None] + sub).reshape(-1, 2)
        fine = take(caster, scene.material, _supersampled(camera), pixels, direction, intensity)
        masks.append(mask)
        radiances.append(fine.reshape(-1, len(sub), *fine.shape[1:]).mean(1))
        normal_maps.append(normals.reshape(camera.height, camera.width, 3))
    return tuple(masks), tuple(radiances), tuple(normal_maps)


def render_capture(settings: SceneSettings, scene: Scene | None = None, take: Photograph | None = None) -> tuple[Capture, Truth]:
    """The capture and its ground truth. `scene` replaces the one that the settings describe (its cameras and lights too), `take` the
    renderer (`photograph_scene`)."""
    scene = scene or make_scene(settings)
    masks, radiances, normal_maps = photograph_scene(scene, take)
    white = float(np.quantile(np.concatenate([r.ravel() for r in radiances]), settings.exposure))
    noise_rng = np.random.default_rng((settings.seed, 3))
    views = []
    for i, (camera, mask, radiance) in enumerate(zip(scene.cameras, masks, radiances, strict=True)):
        noisy = radiance / white + noise_rng.normal(0, settings.noise, radiance.shape)
        samples = np.rint(np.clip(noisy, 0, 1) * WHITE).astype(np.uint16)
        views.append(View(f"view_{i + 1:02d}", camera, mask, samples, 1 / WHITE, WHITE, tuple(range(1, radiance.shape[1] + 1))))
    names = tuple(view.name for view in views)
    per_view = [dict(zip(names, arrays, strict=True)) for arrays in (normal_maps, scene.lights.direction, scene.lights.intensity)]
    truth = Truth(names, per_view[0], per_view[1], per_view[2], scene.surface)
    return Capture(f"synthetic_{settings.seed}", tuple(views)), truth
