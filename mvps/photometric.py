"""Photometric stereo of one view with known lights: robust Lambertian normals and albedo per pixel.

    minimise over b   sum_l w_l rho(I_l - b . s_l),     b = albedo * normal,  s_l = intensity_l * direction_l     (Woodham 1980)

on the grey image, each light's channels divided by their intensities and averaged. rho is Cauchy's; samples that are saturated are
left out, samples in attached shadow (n . l <= 0) too, since Lambert's law is not linear there, and samples much darker than the fit
(cast shadow) or brighter (highlight) are outvoted. Albedo per channel is then the robust ratio of radiance to shading.

Confidence (scene.py) is of the normal's standard deviation from the normal equations, residual scale included.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mvps.camera import pixel_centres, rays
from mvps.scene import RELIABLE, Float, NormalMap, View
from solvers.low_rank import robust_weights, solve_rows

SWEEPS = 4
PIXELS_PER_CHUNK = 4096


def grey(view: View, intensity: Float, part: slice) -> NDArray[np.float64]:
    """(n, lights) mean over channels of radiance over intensity (lights, 3)."""
    image: NDArray[np.float64] = (view.samples[part] * (view.scale / intensity)).mean(-1)
    return image


def normal_map(view: View, direction: Float, intensity: Float) -> NormalMap:
    """Normals (world frame), albedo and confidence of a view's foreground pixels under lights direction, intensity (lights, 3)."""
    pixels = len(view.pixels)
    normal, albedo, confidence = np.empty((pixels, 3)), np.empty((pixels, 3)), np.empty(pixels)
    noise = float(view.scale / np.mean(intensity))
    towards = -rays(view.camera, pixel_centres(view.pixels))[1]
    usable = view.usable()
    for start in range(0, pixels, PIXELS_PER_CHUNK):
        part = slice(start, min(start + PIXELS_PER_CHUNK, pixels))
        known = usable[part].astype(np.float64)
        b, weight, sigma = _solve(grey(view, intensity, part), known, direction, noise)
        length = np.linalg.norm(b, axis=1, keepdims=True)
        solved = (length[:, 0] > noise) & np.isfinite(sigma)
        unit = np.where(solved[:, None], b / np.maximum(length, 1e-300), towards[part])
        # A visible point faces the camera: a normal past the horizon is turned back onto it.
        beyond = np.minimum((unit * towards[part]).sum(1), 0)
        unit = unit - beyond[:, None] * towards[part]
        normal[part] = unit / np.linalg.norm(unit, axis=1, keepdims=True)
        confidence[part] = np.where(solved, 1 / (1 + (sigma / RELIABLE) ** 2), 0)
        albedo[part] = _albedo(view, part, np.maximum(normal[part] @ direction.T, 0), intensity, weight)
    return NormalMap(normal.astype(np.float32), albedo.astype(np.float32), confidence.astype(np.float32))


def _solve(image: Float, known: Float, direction: Float, noise: float) -> tuple[Float, Float, Float]:
    """Robust b (n, 3), final weights (n, lights) and standard deviation of the normal (n,), infinite where three lights are missing."""
    weight = known * (image > 0.1 * np.quantile(image, 0.8, axis=1, keepdims=True))
    for _ in range(SWEEPS):
        b = solve_rows(image, weight, direction, ridge=1e-6)
        shading = b @ direction.T
        lit = known * (shading > 0)
        weight = robust_weights(image - shading, lit, noise)
    total = weight.sum(1)
    variance = (weight * (image - shading) ** 2).sum(1) / np.maximum(total - 3, 1)
    pairs = (direction[:, :, None] * direction[:, None, :]).reshape(-1, 9)
    gram = (weight @ pairs).reshape(-1, 3, 3)
    smallest = np.linalg.eigvalsh(gram)[:, 0]
    length = np.linalg.norm(b, axis=1)
    enough = ((weight > 0.1).sum(1) >= 3) & (smallest > 1e-6) & (length > 0)
    sigma = np.sqrt((variance + noise**2) / np.where(enough, smallest, 1)) / np.where(enough, length, 1)
    return b, weight, np.where(enough, sigma, np.inf)


def _albedo(view: View, part: slice, shading: Float, intensity: Float, weight: Float) -> Float:
    """(n, 3) least-squares albedo per channel for given shading (n, lights)."""
    radiance = view.samples[part] * (view.scale / intensity)
    denominator = np.maximum((weight * shading**2).sum(1), 1e-12)
    albedo: Float = np.maximum(np.einsum("pl,plc->pc", weight * shading, radiance) / denominator[:, None], 0)
    return albedo
