"""The rays that train a field: foreground pixels with what is known of them, and a ring around each silhouette.

Local coordinates: (world - centre) / unit. A ray is anchored at its point nearest to the centre, so that distances along it stay small and
exact in single precision:  x(t) = anchor + t direction.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from mvps.camera import pixel_centres, rays
from mvps.field import OccupancyField, SampledField
from mvps.scene import Bool, Camera, Capture, Float, Int, NormalMap

NEAR_ENOUGH = 0.25
"""Distance, pixels, at which a traced ray has arrived: a band of two pixels around it finds the surface."""


class FieldRays(NamedTuple):
    """n rays: anchor, direction (n, 3); normal (n, 3), colour (n, channels) and weight (n,) of their pixels; inside (n,) 1 in the mask;
    stride (n,) the largest of 4, 2, 1 that divides row and column."""

    anchor: Tensor
    direction: Tensor
    normal: Tensor
    colour: Tensor
    weight: Tensor
    inside: Tensor
    stride: Tensor


def _anchored(camera: Camera, pixels: Int, centre: Float, unit: float) -> tuple[Float, Float]:
    origin, direction = rays(camera, pixel_centres(pixels))
    local = (origin - centre) / unit
    return local - direction * (local * direction).sum(-1, keepdims=True), direction


def _stride(pixels: Int) -> Int:
    return np.where((pixels % 4 == 0).all(1), 4, np.where((pixels % 2 == 0).all(1), 2, 1))


def _joined(parts: list[tuple[NDArray[Any], ...]], device: torch.device) -> FieldRays:
    return FieldRays(*(torch.tensor(np.concatenate(column), dtype=torch.float32, device=device) for column in zip(*parts, strict=True)))


class PixelValues(NamedTuple):
    """What rays of a view's foreground pixels (pixels, ...) are compared with: normal (3), colour (channels), weight of the normal; known:
    those that take part."""

    known: Bool
    normal: Float
    colour: Float
    weight: Float


def pixel_rays(capture: Capture, values: Iterable[PixelValues], centre: Float, unit: float, device: torch.device) -> FieldRays:
    """Rays of the foreground pixels of all views."""
    parts: list[tuple[NDArray[Any], ...]] = []
    for view, (known, normal, colour, weight) in zip(capture.views, values, strict=True):
        pixels = view.pixels[known]
        anchor, direction = _anchored(view.camera, pixels, centre, unit)
        parts.append((anchor, direction, normal[known], colour[known], weight[known], np.ones(len(anchor)), _stride(pixels)))
    return _joined(parts, device)


def foreground_rays(capture: Capture, normal_maps: tuple[NormalMap, ...], centre: Float, unit: float, device: torch.device) -> FieldRays:
    """Rays of the foreground pixels with a confidence over 0. Colour is albedo over the mean albedo, and the normal."""
    trusted = sum(float((maps.albedo.mean(1) * maps.confidence).sum()) for maps in normal_maps)
    total = sum(float(maps.confidence.sum()) for maps in normal_maps)
    level = max(trusted / max(total, 1e-12), 1e-12)
    values = (
        PixelValues(maps.confidence > 0, maps.normal, np.concatenate([maps.albedo / level, maps.normal], 1), maps.confidence)
        for maps in normal_maps
    )
    return pixel_rays(capture, values, centre, unit, device)


def ring_pixels(mask: Bool, ring: int) -> Int:
    """(n, 2) row and column of the pixels within `ring` pixels of the mask's boundary, on either side."""
    inside, outside = distance_transform_edt(mask), distance_transform_edt(~mask)
    return np.argwhere(inside + outside < ring + 0.5)


def ring_rays(capture: Capture, centre: Float, unit: float, ring: int, device: torch.device) -> FieldRays:
    """Rays of the pixels around every silhouette."""
    parts: list[tuple[NDArray[Any], ...]] = []
    for view in capture.views:
        pixels = ring_pixels(view.mask, ring)
        anchor, direction = _anchored(view.camera, pixels, centre, unit)
        nothing = np.zeros((len(pixels), 3))
        inside = view.mask[pixels[:, 0], pixels[:, 1]]
        parts.append((anchor, direction, nothing, nothing, np.ones(len(pixels)), inside, _stride(pixels)))
    return _joined(parts, device)


@torch.no_grad()
def trace(field: OccupancyField | SampledField, anchor: Tensor, direction: Tensor, low: Tensor, high: Tensor, through: bool) -> Tensor:
    """(n,) distance of the field's first surface along rays within the box low, high, or of the closest approach where there is none.

    through: the closest approach along the whole ray, not stopping at the first surface.
    """
    safe = torch.where(direction.abs() < 1e-9, 1e-9, direction)
    ends = torch.stack([(low - anchor) / safe, (high - anchor) / safe])
    start, stop = ends.amin(0).amax(1), ends.amax(0).amin(1)
    t = torch.where(start < stop, start, 0)
    best, best_t = torch.full_like(t, torch.inf), t.clone()
    live = (start < stop).nonzero()[:, 0]
    while len(live):
        d = torch.cat([field.signed_distance(anchor[i] + t[i, None] * direction[i]) for i in live.split(1 << 15)])
        better = d < best[live]
        best[live] = torch.where(better, d, best[live])
        best_t[live] = torch.where(better, t[live], best_t[live])
        # A trained field is no exact distance: steps stay a little short, and at least half a pixel long so that every ray ends.
        t[live] = t[live] + (0.9 * d.abs()).clamp_min(1.0 if through else 0.5)
        live = live[((d > NEAR_ENOUGH) | through) & (t[live] < stop[live])]
    return best_t
