"""PJ16's photometric stereo in the parameter domain: lights of all photographs, normal and albedo of all texels.

Lambert's law without shadow, for texel t in photograph l (of any view):   M_tl = b_t . s_l,   b = albedo * normal,
s = intensity * direction, both in the world frame: whatever view a texel is seen from, one b serves all. Missing entries are those of views
that do not see the texel; attached and cast shadows, highlights and what was warped to a wrong place are outliers (Cauchy's weights).

Lights. Given the mesh's normals n_t, albedo a_t and light s_l are in turn the robust least-squares fits to M_tl = a_t n_t . s_l; a texel's
bright level stands for its albedo at first.
Normals. b_t is a robust least-squares fit to all photographs that see the texel, under these lights.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mvps.baselines.pj16_domain import Domain, Warped
from mvps.calibrate import normalised
from mvps.camera import rig_frame
from mvps.cores import on_cores
from mvps.mesh import lengths, normalise
from mvps.pixel_samples import BRIGHT_QUANTILE, SHADOWED
from mvps.scene import RELIABLE, Bool, Float, Int, Lights
from solvers.low_rank import robust_weights, solve_rows

Float32 = NDArray[np.float32]

TEXELS_FOR_LIGHTS = 6000
"""Texels drawn for the lights: three unknowns a light against thousands of equations leave the error to the model, not to sampling."""

LIGHT_SWEEPS = 10
"""With more, lights go on to follow what errors the mesh's normals share with highlights, with fewer they are on the way: of 5, 10 and 20
sweeps, a matt object's lights are 3.6, 2.4 and 1.4 degrees off at the end, those of a partly glossy one (spot) 3.2, 3.3 and 3.6."""

NORMAL_SWEEPS = 5

TEXELS_PER_CHUNK = 1024
"""A square of the atlas: few views see any of it, and its samples stay in the processor's cache."""


class Samples(NamedTuple):
    """Samples of n texels in the photographs of the views that see any of them. image (n, photographs) grey, over the bright level (n,);
    weight (n, photographs), 0 where unseen, clipped or in shadow; noise: of a sample of image; radiance (n, photographs, 3)."""

    image: Float32
    weight: Float32
    bright: Float32
    noise: float
    radiance: Float32
    views: list[int]


def _samples(warped: Warped, texels: Int | slice) -> Samples:
    views = [i for i, facing in enumerate(warped.facing) if facing[texels].any()]
    count = len(warped.facing[0][texels])
    parts = [warped.samples(i, texels) for i in views]
    radiance = np.concatenate([np.zeros((count, 0, 3), np.float32), *parts], axis=1)
    image = radiance.mean(-1)
    facing = [np.repeat(warped.facing[i][texels, None], part.shape[1], 1) for i, part in zip(views, parts, strict=True)]
    weight = np.concatenate([np.zeros((count, 0), np.float32), *facing], axis=1)
    known = (weight > 0) & np.isfinite(image)
    image, radiance = np.where(known, image, 0), np.where(known[..., None], radiance, 0)
    scale = np.float32(np.median([view.scale for view in warped.capture.views]))
    bright = np.maximum(_quantile_of_known(image, known), scale)
    image /= bright[:, None]
    return Samples(image, weight * (known & (image > SHADOWED)), bright, float(np.median(scale / bright)), radiance, views)


def _quantile_of_known(image: Float32, known: Bool) -> Float32:
    """(n,) quantile BRIGHT_QUANTILE of the known entries of every row; 0 where there is none."""
    if not image.shape[1]:
        return np.zeros(len(image), np.float32)
    ordered = np.sort(np.where(known, image, np.inf), axis=1)
    count = known.sum(1)
    place = np.floor(BRIGHT_QUANTILE * np.maximum(count - 1, 0)).astype(np.int64)
    return np.where(count > 0, np.take_along_axis(ordered, place[:, None], 1)[:, 0], 0).astype(np.float32)


def _scaled(lights: Lights) -> list[Float32]:
    """Per view (lights, 3) mean intensity times direction."""
    pairs = zip(lights.direction, lights.intensity, strict=True)
    return [(e.mean(1, keepdims=True) * d).astype(np.float32) for d, e in pairs]


def lights_on(domain: Domain, warped: Warped, start: Lights, seed: int) -> Lights:
    """The lights of all photographs for which the domain's mesh, with its own normals and free albedo, looks most like them."""
    seen = np.flatnonzero(np.max(warped.facing, axis=0) > 0)
    chosen = np.sort(np.random.default_rng(seed).permutation(seen)[:TEXELS_FOR_LIGHTS])
    samples = _samples(warped, chosen)
    scaled = _scaled(start)
    n, image = domain.normal[chosen].astype(np.float32), samples.image
    s: NDArray[Any] = solve_rows(image.T, samples.weight.T, n)
    weight = samples.weight
    for _ in range(LIGHT_SWEEPS):
        shading = n @ s.T
        lit = samples.weight * (shading > 0)
        weighted = weight * lit * shading
        albedo = (weighted * image).sum(1) / np.maximum((weighted * shading).sum(1), np.finfo(np.float32).tiny)
        residual = image - albedo[:, None] * shading
        # A light that is far off is an outlier to every texel: its scale is that of its own residuals.
        s = solve_rows(image.T, robust_weights(residual.T, lit.T, samples.noise), albedo[:, None] * n)
        weight = robust_weights(residual, lit, samples.noise).astype(np.float32)
    ends = np.cumsum([len(scaled[i]) for i in samples.views])[:-1]
    for i, solved in zip(samples.views, np.split(s, ends), strict=True):
        # A black photograph tells nothing of its light.
        scaled[i] = np.where(lengths(solved)[:, None] > 0, solved, scaled[i]).astype(np.float32)
    return _as_lights(warped, scaled, start)


def _as_lights(warped: Warped, scaled: list[Float32], start: Lights) -> Lights:
    """Lights of `scaled`, per view (lights, 3); of one rig, their mean over the views in its frame. Colours as in `start`."""
    rotations = [rig_frame(start, view.camera) for view in warped.capture.views]
    if start.one_rig:
        rig = np.mean([s @ R.T for s, R in zip(scaled, rotations, strict=True)], axis=0)
        scaled = [rig @ R for R in rotations]
    ratio = [e / e.mean(1, keepdims=True) for e in start.intensity]
    intensity = [lengths(s)[:, None] * r for s, r in zip(scaled, ratio, strict=True)]
    return normalised([normalise(s.astype(np.float64)) for s in scaled], intensity, start.one_rig, start.fixed)


class TexelNormals(NamedTuple):
    """normal (n, 3) unit, world frame, the mesh's where not solved; confidence (n,), 0 there; albedo (n, 3)."""

    normal: Float
    confidence: Float
    albedo: Float


def texel_normals(domain: Domain, warped: Warped, lights: Lights) -> TexelNormals:
    """Normal and albedo of every texel of the domain under these lights."""
    scaled = _scaled(lights)
    count = len(domain.position)

    def of_part(start: int) -> tuple[Float, Float, Float]:
        part = slice(start, min(start + TEXELS_PER_CHUNK, count))
        samples = _samples(warped, part)
        s = np.concatenate([np.zeros((0, 3), np.float32), *(scaled[i] for i in samples.views)])
        return _solved(samples, s, domain.normal[part])

    parts = on_cores(of_part, range(0, count, TEXELS_PER_CHUNK))
    return TexelNormals(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _solved(samples: Samples, s: Float32, outward: Float) -> tuple[Float, Float, Float]:
    """Normal (n, 3), confidence (n,) and albedo (n, 3) under the lights s (photographs, 3); outward (n, 3): the mesh's normals."""
    if not len(s):
        return outward, np.zeros(len(outward)), np.zeros_like(outward)
    image, known = samples.image, samples.weight
    weight = known
    for _ in range(NORMAL_SWEEPS):
        b = solve_rows(image, weight, s, ridge=1e-6)
        shading = b @ s.T
        weight = robust_weights(image - shading, known * (shading > 0), samples.noise).astype(np.float32)
    length = lengths(b)
    gram = (weight @ (s[:, :, None] * s[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
    least = np.linalg.eigvalsh(gram)[:, 0]
    # The photographs of a view share the errors of its warp and much of those of Lambert's law: they count as one.
    shared = image.shape[1] / len(samples.views)
    variance = shared * (weight * (image - shading) ** 2).sum(1) / np.maximum((weight > 0).sum(1) - 3, 1)
    enough = ((weight > 0).sum(1) > 3) & (least > 1e-5 * gram.trace(axis1=1, axis2=2)) & ((b * outward).sum(1) > 0)
    sigma = np.sqrt((variance + samples.noise**2) / np.where(enough, least, 1)) / np.where(enough, length, 1)
    normal = np.where(enough[:, None], normalise(b.astype(np.float64)), outward)
    confidence = np.where(enough, 1 / (1 + (sigma / RELIABLE) ** 2), 0)
    shading = (normal.astype(np.float32) @ s.T).clip(0)
    weighted = weight * shading
    bottom = np.maximum((weighted * shading).sum(1), np.finfo(np.float32).tiny)
    albedo = np.einsum("nl,nlc->nc", weighted, samples.radiance) / bottom[:, None]
    return normal, confidence.astype(np.float64), albedo.clip(0).astype(np.float64)
