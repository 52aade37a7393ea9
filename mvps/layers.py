"""What a camera sees of a reconstruction under any light: the picture and the layers it is made of.

    image = sum over lights of  visibility * E * shade(material)  +  albedo * what other surfaces send (bounce.py)

Every layer is the mean over SUBPIXELS rays a pixel, those that miss the surface left out; coverage is the part of them that meet it.
With many lights each ray takes its share of them, times the number of rays: neighbours of one pixel see nearly the same point, so
the mean is that under all lights at the price of one ray.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mvps.camera import view_directions
from mvps.gleam import Senders
from mvps.illumination import Illumination
from mvps.mesh import lengths
from mvps.rendering import Arriving, Points, light_arriving, light_arriving_of_points, points_under, shaded, shadow_at, specular_shading
from mvps.scene import Bool, Camera, Float, Int, Material
from mvps.visibility import RayCaster

Layer = NDArray[np.float32]

SUBPIXELS = 4
"""Rays a pixel, in a square."""

MANY_LIGHTS = 16
"""Lights from which each ray takes a share of them: shares of four still surround the object."""

SAMPLES_PER_CHUNK = 1 << 21
"""Points times lights worked on at a time."""


def rendered(
    caster: RayCaster, material: Material, camera: Camera, light: Illumination, layers: Sequence[str], senders: Senders | None = None
) -> tuple[dict[str, Layer], Layer]:
    """Layers (height, width[, 3]) by name, 0 where nothing is, and coverage (height, width) in [0, 1].

    image, specular: linear radiance; albedo; normals: refined ones, world frame; depth: along the optical axis, world units; shadow: part
    of the arriving light that other parts of the surface hide; confidence.

    senders: what sends light on (rendering.light_senders), for inter-reflection; None: without.
    """
    side = int(np.sqrt(SUBPIXELS))
    fine = Camera(np.diag([side, side, 1.0]) @ camera.K, camera.rotation, camera.translation, side * camera.height, side * camera.width)
    sums: dict[str, Layer] = {}
    count = np.zeros((camera.height, camera.width), np.float32)
    for k in range(SUBPIXELS):
        row, column = divmod(k, side)
        pixels = side * np.argwhere(np.ones(count.shape, bool)) + (row, column)
        share = _share(light, k)
        found, hit = _of_pixels(caster, material, fine, pixels, share, layers, senders)
        count += hit.reshape(count.shape)
        for name, values in found.items():
            whole = values.reshape(*count.shape, *values.shape[1:])
            sums[name] = sums[name] + whole if name in sums else whole
    over = np.maximum(count, np.float32(1))
    means: dict[str, Layer] = {name: np.divide(total, over[..., None] if total.ndim == 3 else over) for name, total in sums.items()}
    if "normals" in means:
        means["normals"] /= np.maximum(lengths(means["normals"])[..., None], 1e-6).astype(np.float32)
    return means, count / np.float32(SUBPIXELS)


def _share(light: Illumination, k: int) -> Illumination:
    """The k-th ray's part of the lights."""
    if len(light.direction) < MANY_LIGHTS:
        return light
    some = slice(k, None, SUBPIXELS)
    return Illumination(light.direction[some], SUBPIXELS * light.intensity[some], light.position, light.strength, light.spread[some])


def _of_pixels(
    caster: RayCaster, material: Material, camera: Camera, pixels: Int, light: Illumination, layers: Sequence[str], senders: Senders | None
) -> tuple[dict[str, Layer], Bool]:
    """Layers (n[, 3]) of pixels (n, 2), 0 where nothing is hit, and where something is."""
    points = points_under(caster, material, camera, pixels)
    hit = np.flatnonzero(points.hit)
    seen = points.part(hit)
    found: dict[str, Float] = {"albedo": seen.albedo, "normals": seen.normal, "confidence": seen.confidence}
    found["depth"] = (seen.position @ camera.rotation.T + camera.translation)[:, 2]
    if {"image", "specular", "shadow"} & set(layers):
        found |= _lit(caster, material, camera, seen, light, senders)

    def spread(values: Float) -> Layer:
        whole = np.zeros((len(pixels), *values.shape[1:]), np.float32)
        whole[hit] = values
        return whole

    return {name: spread(found[name]) for name in layers}, points.hit


def _lit(
    caster: RayCaster, material: Material, camera: Camera, points: Points, light: Illumination, senders: Senders | None
) -> dict[str, Float]:
    """image, specular (n, 3) and shadow (n,)."""
    view = view_directions(camera, points.position)
    image, specular = np.zeros((len(view), 3)), np.zeros((len(view), 3))
    hidden, arriving = np.zeros(len(view)), np.zeros(len(view))
    step = max(1, SAMPLES_PER_CHUNK // max(1, len(view)))
    for start in range(0, len(light.direction), step):
        direction, intensity, wide = (a[start : start + step] for a in (light.direction, light.intensity, light.spread))
        shadow = shadow_at(caster, material.law, points, direction)
        image += np.einsum("nlc,nl,lc->nc", shaded(points, view, material, direction, wide), ~shadow, intensity)
        lobes = specular_shading(points.normal, view, direction, points.specular_weight, material.law, wide)
        specular += np.einsum("nlc,nl,lc->nc", np.broadcast_to(lobes, (*shadow.shape, 3)), ~shadow, intensity)
        flux = np.maximum(points.normal @ direction.T, 0) * intensity.mean(1)
        hidden, arriving = hidden + (flux * shadow).sum(1), arriving + flux.sum(1)
        image += _sent(light_arriving(senders, direction, camera.centre), points, intensity)
    if len(light.position):
        image += _sent(light_arriving_of_points(senders, light.position, camera.centre), points, light.strength)
    for position, strength in zip(light.position, light.strength, strict=True):
        apart = position - points.position
        distance = lengths(apart)[:, None]
        towards, intensity = apart / distance, strength / distance**2
        shadow = _shadow_of_point(caster, points, towards, distance[:, 0]) if material.law.shadows else np.zeros(len(view), bool)
        image += shaded(points, view, material, towards[:, None])[:, 0] * ~shadow[:, None] * intensity
        lobes_only = points._replace(albedo=np.zeros_like(points.albedo), share=np.zeros_like(points.share))
        specular += shaded(lobes_only, view, material, towards[:, None])[:, 0] * ~shadow[:, None] * intensity
        flux = np.maximum((points.normal * towards).sum(1), 0) * intensity.mean(1)
        hidden, arriving = hidden + flux * shadow, arriving + flux
    return {"image": image, "specular": specular, "shadow": hidden / np.maximum(arriving, 1e-12)}


def _sent(arriving: Arriving | None, points: Points, strength: Float) -> Float:
    """(n, 3) radiance that points return of what other surfaces send them, under lights of this strength (lights, 3)."""
    if arriving is None:
        return np.zeros_like(points.albedo)
    of_albedo, of_lobes = arriving.at(points)
    sent: Float = np.einsum("nlc,lc->nc", points.albedo[:, None] * of_albedo + of_lobes, strength)
    return sent


def _shadow_of_point(caster: RayCaster, points: Points, towards: Float, distance: Float) -> Bool:
    """(n,) whether something stands between a point and a light at this distance along towards (n, 3)."""
    shadow = np.zeros(len(towards), bool)
    above = np.flatnonzero((points.mesh_normal * towards).sum(1) > 0)
    origins = points.position[above] + caster.offset * points.mesh_normal[above]
    shadow[above] = caster.first_hits(origins, towards[above]).distance < distance[above]
    return shadow
