"""Photometric stereo of one view with known lights: robust Lambertian normals and albedo per pixel.

    minimise over b   sum_l w_l rho(I_l - b . s_l),     b = albedo * normal,  s_l = intensity_l * direction_l     (Woodham 1980)

on the grey image, each light's channels divided by their intensities and averaged. rho is Cauchy's; samples that are saturated are
left out, samples in attached shadow (n . l <= 0) too, since Lambert's law is not linear there, and samples much darker than the fit
(cast shadow) or brighter (highlight) are outvoted. Albedo per channel is then the robust ratio of radiance to shading.

Confidence (scene.py) is of the normal's standard deviation from the normal equations, residual scale included.

float64: the least eigenvalue of the normal equations from which a pixel counts, 1e-6, is below float32's rounding of the largest, about a
third of the number of lights.
"""

from __future__ import annotations

from math import ceil, floor

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from mvps.camera import pixel_centres, rays
from mvps.cores import on_cores
from mvps.pixel_samples import channel_shares
from mvps.scene import RELIABLE, Capture, Float, Lights, NormalMap, View
from solvers.least_squares import ascending, cauchy_weights, weighted_rows

SWEEPS = 4
PIXELS_PER_CHUNK = 4096


def normal_maps(capture: Capture, lights: Lights, device: torch.device) -> tuple[NormalMap, ...]:
    """`normal_map` of every view on its own, on all cores."""
    torch.set_num_threads(1)

    def of_view(view: View, direction: Float, intensity: Float) -> NormalMap:
        return normal_map(view, direction, intensity, device)

    return tuple(on_cores(of_view, capture.views, lights.direction, lights.intensity))


def normal_map(view: View, direction: Float, intensity: Float, device: torch.device) -> NormalMap:
    """Normals (world frame), albedo and confidence of a view's foreground pixels under lights direction, intensity (lights, 3)."""

    def tensor(values: Float) -> Tensor:
        return torch.tensor(values, dtype=torch.float64, device=device)

    noise = float(view.scale / np.mean(intensity))
    # Of photographs that were left out nothing is known, least of all that they are bright.
    shown: slice | list[int] = slice(None) if view.shown.all() or not view.shown.any() else np.flatnonzero(view.shown).tolist()
    light, per_channel = tensor(direction[shown]), tensor(view.scale / intensity[shown])
    shares = tensor(channel_shares(intensity[shown] / intensity[shown].mean(1, keepdims=True)))
    towards, usable = tensor(-rays(view.camera, pixel_centres(view.pixels))[1]), view.usable(shown)
    columns: list[tuple[Tensor, ...]] = []
    for start in range(0, len(view.pixels), PIXELS_PER_CHUNK):
        part = slice(start, start + PIXELS_PER_CHUNK)
        radiance = torch.from_numpy(view.samples[part][:, shown].astype(np.float32)).to(device) * per_channel
        known = torch.from_numpy(usable[part]).to(device).double()
        columns.append(tuple(values.float() for values in pixels_solved(radiance, known, light, towards[part], noise, shares)))
    normal, albedo, confidence = (torch.cat(column).cpu().numpy() for column in zip(*columns, strict=True))
    return NormalMap(normal, albedo, confidence)


def pixels_solved(
    radiance: Tensor, known: Tensor, light: Tensor, towards: Tensor, noise: float, shares: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Normals, albedo (n, 3) and confidence (n,) for radiance over intensity (n, lights, 3), where it is known (n, lights), the lights'
    directions (lights, 3) and those to the camera (n, 3); float64. noise: of a sample over intensity; shares (lights, 3): of the channels
    in what is grey."""
    radiance = radiance * shares
    red, green, blue = radiance.unbind(-1)
    b, weight, sigma = _solve((red + green + blue) / 3, known, light, noise)
    length = b.norm(dim=1, keepdim=True)
    solved = (length[:, 0] > noise) & sigma.isfinite()
    unit = torch.where(solved[:, None], b / length.clamp_min(1e-300), towards)
    # A visible point faces the camera: a normal past the horizon is turned back onto it.
    beyond = (unit * towards).sum(1, keepdim=True).clamp_max(0)
    normal = normalize(unit - beyond * towards, dim=1)
    confidence = torch.where(solved, 1 / (1 + (sigma / RELIABLE) ** 2), 0.0)
    return normal, _albedo(radiance, (normal @ light.T).clamp_min(0), weight, shares), confidence


def _quantile(rows: Tensor, share: float) -> Tensor:
    """(m, 1) quantiles of rows (m, n), interpolated between neighbours."""
    place = share * (rows.shape[1] - 1)
    ordered = ascending(rows)
    low, high = (ordered[:, index, None] for index in (floor(place), ceil(place)))
    return torch.lerp(low, high, place - floor(place))


def _solve(image: Tensor, known: Tensor, light: Tensor, noise: float) -> tuple[Tensor, Tensor, Tensor]:
    """Robust b (n, 3), final weights (n, lights) and standard deviation of the normal (n,), infinite where three lights are missing."""
    weight = known * (image > 0.1 * _quantile(image, 0.8))
    for _ in range(SWEEPS):
        b = weighted_rows(image, weight, light, ridge=1e-6)
        shading = b @ light.T
        weight = cauchy_weights(image - shading, known * (shading > 0), noise)
    variance = (weight * (image - shading) ** 2).sum(1) / (weight.sum(1) - 3).clamp_min(1)
    gram = (weight @ (light[:, :, None] * light[:, None, :]).view(-1, 9)).view(-1, 3, 3)
    smallest = torch.linalg.eigvalsh(gram)[:, 0]
    length = b.norm(dim=1)
    enough = ((weight > 0.1).sum(1) >= 3) & (smallest > 1e-6) & (length > 0)
    sigma = ((variance + noise**2) / torch.where(enough, smallest, 1.0)).sqrt() / torch.where(enough, length, 1.0)
    return b, weight, torch.where(enough, sigma, torch.inf)


def _albedo(radiance: Tensor, shading: Tensor, weight: Tensor, shares: Tensor) -> Tensor:
    """(n, 3) least-squares albedo per channel of radiance times shares (n, lights, 3) for given shading (n, lights)."""
    weighted = weight * shading
    square = weighted * shading
    denominator = square.sum(1, keepdim=True) if bool((shares == 1).all()) else square @ shares
    return ((weighted[:, None] @ radiance)[:, 0] / denominator.clamp_min(1e-12)).clamp_min(0)
