"""What a camera sees of a reconstruction under any light: the picture and the layers it is made of.

    image = sum over lights of  visibility * E * shade(material)  +  what it returns of what other surfaces send (bounce.py, gleam.py)

Every layer is the mean over SUBPIXELS rays a pixel, those that miss the surface left out; coverage is the part of them that meet it.
With many lights each ray takes its share of them, times the number of rays: neighbours of one pixel see nearly the same point, so
the mean is that under all lights at the price of one ray. Where a ray of a pixel misses, its share would be missing too, so the others
take all lights; those are the few pixels along an outline. The layer of shadows is the light that is hidden over that which would arrive,
each a mean over the rays: shares of the lights are not as strong as each other.

Pixels are worked on a part at a time: memory grows with the picture's own values only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.camera import view_directions
from mvps.gleam import Senders
from mvps.illumination import Illumination
from mvps.mesh import lengths
from mvps.rendering import (
    RAYS_ACROSS,
    Arriving,
    Points,
    light_arriving,
    light_arriving_of_points,
    points_under,
    shaded,
    shadow_at,
    specular_shading,
    within_pixels,
)
from mvps.scene import Bool, Camera, Float, Int, Material
from mvps.visibility import RayCaster

Layer = NDArray[np.float32]

SUBPIXELS = RAYS_ACROSS**2
"""Rays a pixel, in a square."""

MANY_LIGHTS = 16
"""Lights from which each ray takes a share of them: shares of four still surround the object."""

SAMPLES_PER_CHUNK = 1 << 21
"""Points times lights worked on at a time."""

PIXELS_AT_A_TIME = 1 << 17
"""Some 150 MB of rays and of what they meet."""

LIGHTS_AT_A_TIME = 64
"""A multiple of SUBPIXELS: shares of parts are parts of shares."""

ARRIVING_KEPT = 16
"""Of such parts of the lights, what surfaces send each other, for the next pixels: 19 MB each with lobes."""

Sent = Callable[[int], Arriving | None]
"""What other surfaces send under the LIGHTS_AT_A_TIME lights from this one on, or under the points of light where it is below 0."""


def rendered(
    caster: RayCaster, material: Material, camera: Camera, light: Illumination, layers: Sequence[str], senders: Senders | None = None
) -> tuple[dict[str, Layer], Layer]:
    """Layers (height, width[, 3]) by name, 0 where nothing is, and coverage (height, width) in [0, 1].

    image, specular: linear radiance; albedo; normals: refined ones, world frame; depth: along the optical axis, world units; shadow: part
    of the arriving light that other parts of the surface hide; confidence.

    senders: what sends light on (rendering.light_senders), for inter-reflection; None: without.
    """
    pixels = camera.height * camera.width
    coverage, means = np.zeros(pixels, np.float32), dict[str, Layer]()
    sent = _sending(senders, light, camera.centre)
    for start in range(0, pixels, PIXELS_AT_A_TIME):
        part = np.arange(start, min(start + PIXELS_AT_A_TIME, pixels))
        found, coverage[part] = _of_pixels(caster, material, camera, part, light, layers, sent)
        for name, values in found.items():
            means.setdefault(name, np.zeros((pixels, *values.shape[1:]), np.float32))[part] = values
    shape = (camera.height, camera.width)
    return {name: values.reshape(*shape, *values.shape[1:]) for name, values in means.items()}, coverage.reshape(shape)


def _sending(senders: Senders | None, light: Illumination, eye: Float) -> Sent:
    """What arrives from senders, towards a camera at eye (3,)."""

    @lru_cache(maxsize=ARRIVING_KEPT)
    def sent(first: int) -> Arriving | None:
        if first < 0:
            return light_arriving_of_points(senders, light.position, eye)
        return light_arriving(senders, light.direction[first : first + LIGHTS_AT_A_TIME], eye)

    return sent


def _of_pixels(
    caster: RayCaster, material: Material, camera: Camera, pixels: Int, light: Illumination, layers: Sequence[str], sent: Sent
) -> tuple[dict[str, Layer], Layer]:
    """Layers (n[, 3]) of pixels (n,), counted along the rows, 0 where nothing is hit, and coverage (n,)."""
    fine, rays = within_pixels(camera, np.stack(np.divmod(pixels, camera.width), -1), RAYS_ACROSS)
    points = points_under(caster, material, fine, rays.reshape(-1, 2))
    found: dict[str, NDArray[Any]] = {"albedo": points.albedo, "normals": points.normal, "confidence": points.confidence}
    found["depth"] = np.where(points.hit, (points.position @ camera.rotation.T + camera.translation)[:, 2], 0)
    hit = points.hit.reshape(SUBPIXELS, -1)
    lit = {"image", "specular", "shadow"} & set(layers)
    # Hidden light, and what would arrive.
    found |= {name: np.zeros((hit.size, 2 if name == "shadow" else 3)) for name in lit}
    for rays, share in _groups(hit, len(light.direction)) if lit else ():
        of_rays = _lit(caster, material, camera, points.part(rays), light, share, sent)
        for name in lit:
            found[name][rays] = of_rays[name]
    count = np.maximum(hit.sum(0), 1).astype(np.float32)

    def mean(values: Float) -> Layer:
        total: Layer = values.astype(np.float32).reshape(*hit.shape, *values.shape[1:]).sum(0)
        total /= count if total.ndim == 1 else count[:, None]
        return total

    means = {name: mean(found[name]) for name in layers}
    if "normals" in means:
        means["normals"] /= np.maximum(lengths(means["normals"])[:, None], 1e-6).astype(np.float32)
    if "shadow" in means:
        hidden, arriving = means["shadow"].T
        means["shadow"] = hidden / np.maximum(arriving, np.float32(1e-12))
    return means, hit.mean(0, dtype=np.float32)


def _groups(hit: Bool, lights: int) -> list[tuple[Int, slice]]:
    """Rays (SUBPIXELS, n) that hit something, as numbers of them, and the lights that each group takes."""
    if lights < MANY_LIGHTS:
        return [(np.flatnonzero(hit), slice(None))]
    covered = hit.all(0)
    groups = [(k * hit.shape[1] + np.flatnonzero(covered), slice(k, None, SUBPIXELS)) for k in range(SUBPIXELS)]
    return [*groups, (np.flatnonzero(hit & ~covered), slice(None))]


def _lit(
    caster: RayCaster, material: Material, camera: Camera, points: Points, light: Illumination, share: slice, sent: Sent
) -> dict[str, Float]:
    """image, specular (n, 3) and shadow (n, 2), hidden light and what would arrive, under a share of the lights, which stands for all of
    them, and all points of light."""
    n = len(points.position)
    found: dict[str, Float] = {"image": np.zeros((n, 3)), "specular": np.zeros((n, 3)), "shadow": np.zeros((n, 2))}
    at_a_time = len(range(LIGHTS_AT_A_TIME)[: len(light.direction)][share])
    step = max(1, SAMPLES_PER_CHUNK // max(1, at_a_time, len(light.position)))
    for start in range(0, n, step):
        part = slice(start, start + step)
        for name, values in _lit_part(caster, material, camera, points.part(part), light, share, sent).items():
            found[name][part] = values
    return found


def _lit_part(
    caster: RayCaster, material: Material, camera: Camera, points: Points, light: Illumination, share: slice, sent: Sent
) -> dict[str, Float]:
    view = view_directions(camera, points.position)
    image, specular = np.zeros((len(view), 3)), np.zeros((len(view), 3))
    flux = np.zeros((len(view), 2))
    for start in range(0, len(light.direction), LIGHTS_AT_A_TIME):
        some = slice(start, start + LIGHTS_AT_A_TIME)
        direction, intensity, wide = (a[some][share] for a in (light.direction, light.intensity, light.spread))
        if not len(direction):
            continue
        intensity = intensity * (share.step or 1)
        shadow = shadow_at(caster, material.law, points, direction)
        image += np.einsum("nlc,nl,lc->nc", shaded(points, view, material, direction, wide), ~shadow, intensity)
        lobes = specular_shading(points.normal, view, direction, points.specular_weight, material.law, wide)
        specular += np.einsum("nlc,nl,lc->nc", np.broadcast_to(lobes, (*shadow.shape, 3)), ~shadow, intensity)
        arriving = np.maximum(points.normal @ direction.T, 0) * intensity.mean(1)
        flux += np.stack([(arriving * shadow).sum(1), arriving.sum(1)], 1)
        image += _sent(sent(start), points, intensity, share)
    if len(light.position):
        image += _sent(sent(-1), points, light.strength)
    for position, strength in zip(light.position, light.strength, strict=True):
        apart = position - points.position
        distance = lengths(apart)[:, None]
        towards, intensity = apart / distance, strength / distance**2
        shadow = _shadow_of_point(caster, points, towards, distance[:, 0]) if material.law.shadows else np.zeros(len(view), bool)
        image += shaded(points, view, material, towards[:, None])[:, 0] * ~shadow[:, None] * intensity
        lobes_only = points._replace(albedo=np.zeros_like(points.albedo), share=np.zeros_like(points.share))
        specular += shaded(lobes_only, view, material, towards[:, None])[:, 0] * ~shadow[:, None] * intensity
        arriving = np.maximum((points.normal * towards).sum(1), 0) * intensity.mean(1)
        flux += np.stack([arriving * shadow, arriving], 1)
    return {"image": image, "specular": specular, "shadow": flux}


def _sent(arriving: Arriving | None, points: Points, strength: Float, share: slice = slice(None)) -> Float:
    """(n, 3) radiance that points return of what other surfaces send them, under a share of the lights, of this strength (lights, 3)."""
    if arriving is None:
        return np.zeros_like(points.albedo)
    of_albedo, of_lobes = arriving.at(points, share)
    sent: Float = np.einsum("nlc,lc->nc", points.albedo[:, None] * of_albedo + of_lobes, strength)
    return sent


def _shadow_of_point(caster: RayCaster, points: Points, towards: Float, distance: Float) -> Bool:
    """(n,) whether something stands between a point and a light at this distance along towards (n, 3)."""
    shadow = np.zeros(len(towards), bool)
    above = np.flatnonzero((points.mesh_normal * towards).sum(1) > 0)
    origins = points.position[above] + caster.offset * points.mesh_normal[above]
    shadow[above] = caster.first_hits(origins, towards[above]).distance < distance[above]
    return shadow
