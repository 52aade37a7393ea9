"""Photographs of a reconstruction: first hits, interpolated material, the image model, cast shadows.

    image(pixel, light) = intensity * (shade(material at the first hit) * residual * (1 - cast_shadow)
                                       + albedo * (bounce * G_0 + gleam * G_1) + gleam * sum_k weight_k * G_2+k)

G is the light that other surfaces send (bounce.py, and where lobes take part gleam.py), residual the factor of a material that has a
neural residual (neural.py).

The shading normal is the material's refined normal; shadows are traced on the mesh.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mvps.camera import view_directions
from mvps.gleam import Senders, Terms, coarse_senders, terms, terms_of_points
from mvps.mesh import normalise
from mvps.neural import factor
from mvps.scene import Bool, Camera, Float, Int, Law, Material, Surface
from mvps.shading import shade
from mvps.visibility import RayCaster, camera_hits, interpolate_all, shadows

SAMPLES_PER_CHUNK = 1 << 18


class Points(NamedTuple):
    """Surface points under n pixels: position, normal, albedo (n, 3), specular_weight (n, lobes[, 3]), confidence (n,), hit (n,);
    share (n,) and code (n, codes) of the neural residual, (n, 0) where there is none."""

    position: Float
    mesh_normal: Float
    normal: Float
    albedo: Float
    specular_weight: Float
    confidence: Float
    hit: Bool
    share: Float
    code: Float

    def part(self, rows: Any) -> Points:
        """Those of these rows."""
        return Points(*(values[rows] for values in self))


RAYS_ACROSS = 2
"""Rays along a pixel's side in pictures that stand beside photographs, whose pixels are means over their area too. Of bunny's views held
out one shows 34.3 dB, two 34.9, three 34.9."""


def within_pixels(camera: Camera, pixels: Int, side: int) -> tuple[Camera, Int]:
    """A camera of `side` times the resolution, and the row and column (side^2, n, 2) of its pixels within pixels (n, 2)."""
    fine = Camera(np.diag([side, side, 1.0]) @ camera.K, camera.rotation, camera.translation, side * camera.height, side * camera.width)
    within = np.stack(np.divmod(np.arange(side**2), side), -1)
    return fine, side * pixels + within[:, None]


def points_under(caster: RayCaster, material: Material, camera: Camera, pixels: Int) -> Points:
    """What the centres of pixels (n, 2), row and column, see. Where nothing is hit, all values are 0 and `hit` is False."""
    surface = caster.surface
    hits = camera_hits(caster, camera, pixels)
    values = (surface.vertices, caster.vertex_normals, material.normal, material.albedo, material.specular_weight, material.confidence)
    residual = material.residual
    nothing: Float = np.zeros((len(material.albedo), 0))
    of_residual = (nothing, nothing) if residual is None else (residual.share, residual.code)
    position, mesh_normal, normal, albedo, weight, confidence, share, code = interpolate_all(surface, hits, *values, *of_residual)
    return Points(position, normalise(mesh_normal), normalise(normal), albedo, weight, confidence, hits.face >= 0, share, code)


def shadow_at(caster: RayCaster, law: Law, points: Points, lights: Float) -> Bool:
    """(n, lights) True where another part of the mesh hides the light (lights, 3) from the point; nowhere where the law has no shadows."""
    if not law.shadows:
        return np.zeros((len(points.position), len(lights)), bool)
    return shadows(caster, points.position, points.mesh_normal, lights)


class Arriving(NamedTuple):
    """Light that other surfaces send (gleam.py), whose law it is, under some lights, towards one camera."""

    law: Law
    sent: Terms

    def at(self, points: Points, lights: slice = slice(None)) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Per unit intensity (points, lights, 3) each, of some of the lights: what a unit of albedo returns, and what the points' lobes
        do."""
        law, G = self.law, self.sent.at(points.position, points.mesh_normal, lights)
        of_albedo = np.float32(law.bounce) * G[:, :, 0]
        if G.shape[2] == 1:
            return of_albedo, np.zeros_like(of_albedo)
        of_albedo += np.float32(law.gleam) * G[:, :, 1]
        weight = points.specular_weight if points.specular_weight.ndim == 3 else points.specular_weight[..., None]
        weight = np.float32(law.gleam) * np.broadcast_to(weight, (*weight.shape[:2], 3)).astype(np.float32)
        return of_albedo, np.einsum("nlkc,nkc->nlc", G[:, :, 2:], weight)


@lru_cache(maxsize=1)
def light_senders(surface: Surface, material: Material) -> Senders | None:
    """What sends light to other parts of the surface; None where the material has no inter-reflection. The last are kept: textures and
    report ask for the same."""
    return coarse_senders(surface, material)


def light_arriving(senders: Senders | None, direction: Float, eye: Float) -> Arriving | None:
    """What arrives from senders under lights direction (lights, 3), for a camera at eye (3,)."""
    return None if senders is None else Arriving(senders.law, terms(senders, direction, eye))


def light_arriving_of_points(senders: Senders | None, position: Float, eye: Float) -> Arriving | None:
    """What arrives from senders under points of light, position (points, 3), per unit of their strength (illumination.py)."""
    return None if senders is None else Arriving(senders.law, terms_of_points(senders, position, eye))


def diffuse_shading(normal: Float, towards: Float, direction: Float, grazing: float) -> NDArray[np.float32]:
    """(n, lights) radiance over albedo and intensity of the diffuse part (shading.py); normal, towards (n, 3), direction (lights, 3)."""
    matt = Law((), grazing)
    white, nothing = torch.ones(len(normal), 1), torch.zeros(len(normal), 0)
    n, v, light = (torch.tensor(a, dtype=torch.float32) for a in (normal, towards, direction))
    shaded: NDArray[np.float32] = shade(n, v, light, white, nothing, matt)[..., 0].numpy()
    return shaded


def specular_shading(
    normal: Float, towards: Float, direction: Float, weight: Float, law: Law, spread: Float | None = None
) -> NDArray[np.float32]:
    """(n, lights, 1 or 3) radiance over intensity of the lobes with weights (n, lobes[, 3]); spread (lights,) as in `shading.lobes`, the
    others as in `diffuse_shading`."""
    n, v, light = (torch.tensor(a, dtype=torch.float32) for a in (normal, towards, direction))
    of_channels = torch.tensor(weight if weight.ndim == 3 else weight[..., None], dtype=torch.float32)
    black = torch.zeros(len(n), 1)
    shaded: NDArray[np.float32] = shade(n, v, light, black, of_channels, law, _spread(spread)).numpy()
    return shaded


def _spread(values: Float | None) -> torch.Tensor | None:
    return None if values is None else torch.tensor(values, dtype=torch.float32)


def shaded(points: Points, view: Float, material: Material, direction: Float, spread: Float | None = None) -> NDArray[np.float32]:
    """Radiance over intensity (n, lights, 3) at points seen along view (n, 3) under lights direction (lights, 3), or (n, lights, 3) where
    every point has its own; attached shadows included, cast ones and inter-reflection not. spread (lights,) as in `shading.lobes`."""
    arrays = (points.normal, view, direction, points.albedo, points.specular_weight)
    normal, towards, light, albedo, weight = (torch.tensor(a, dtype=torch.float32) for a in arrays)
    image: NDArray[np.float32] = shade(normal, towards, light, albedo, weight, material.law, _spread(spread)).numpy()
    if material.residual is not None:
        image *= factor(material.residual, points.share, points.code, points.normal, view, direction)[..., None]
    return image


def photograph(
    caster: RayCaster,
    material: Material,
    camera: Camera,
    pixels: Int,
    direction: Float,
    intensity: Float,
    arriving: Arriving | None = None,
    side: int = 1,
) -> NDArray[np.float32]:
    """Radiance (n, lights, 3) of pixels (n, 2) under lights direction, intensity (lights, 3): mean of side^2 rays through each; a ray that
    hits nothing brings 0.

    arriving: inter-reflection under the same lights, for the same camera.
    """
    image = np.zeros((len(pixels), len(direction), 3), np.float32)
    for rays in _lit_rays(caster, material, camera, pixels, direction, side):
        _add_rays(image, rays, material, direction, arriving)
    return image * (intensity / side**2).astype(np.float32)


def photograph_and_gloss(
    caster: RayCaster,
    material: Material,
    camera: Camera,
    pixels: Int,
    direction: Float,
    intensity: Float,
    arriving: Arriving | None,
    side: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """`photograph`, and the part of it that lobes alone send straight from the lights."""
    image, gloss = np.zeros((2, len(pixels), len(direction), 3), np.float32)
    for rays in _lit_rays(caster, material, camera, pixels, direction, side):
        _add_rays(image, rays, material, direction, arriving)
        black = rays.points._replace(albedo=np.zeros_like(rays.points.albedo))
        _add_rays(gloss, rays._replace(points=black), material, direction, None)
    strength = (intensity / side**2).astype(np.float32)
    return image * strength, gloss * strength


class _Rays(NamedTuple):
    """One ray through each of n pixels: what it meets; view (n, 3) towards the camera; lit (n, lights) where no shadow is cast."""

    points: Points
    view: Float
    lit: Bool


def _lit_rays(caster: RayCaster, material: Material, camera: Camera, pixels: Int, direction: Float, side: int) -> Iterator[_Rays]:
    """side^2 rays through each of the pixels (n, 2), under lights direction (lights, 3)."""
    fine, rays = within_pixels(camera, pixels, side)
    for of_rays in rays:
        points = points_under(caster, material, fine, of_rays)
        lit = ~shadow_at(caster, material.law, points, direction)
        yield _Rays(points, view_directions(fine, points.position), lit)


def _add_rays(image: NDArray[np.float32], rays: _Rays, material: Material, direction: Float, arriving: Arriving | None) -> None:
    """Adds to an image (n, lights, 3) what rays bring under lights of unit intensity."""
    step = max(1, SAMPLES_PER_CHUNK // max(1, len(direction)))
    for start in range(0, len(image), step):
        part = slice(start, start + step)
        of_part = rays.points.part(part)
        image[part] += shaded(of_part, rays.view[part], material, direction) * rays.lit[part, :, None]
        if arriving is not None:
            of_albedo, of_lobes = arriving.at(of_part)
            image[part] += of_part.albedo[:, None].astype(np.float32) * of_albedo + of_lobes
