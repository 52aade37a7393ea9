"""Whether lights are so near that directional ones are wrong.

A point of light at distance d from the object's middle, along l, sends a point at x the intensity

    1 / |d l - x|^2  =  (1 + 2 l . x / d + ...) / d^2,

so that the logarithm of a photograph over its prediction under a directional light grows with 2 l . x, by 1 / d. Of that the solved lights,
albedo and normals take up most (nine tenths for lights at three and at ten times the object's size), not all: what is left has one sign.
What surfaces send each other may do the same, so where photographs say near they are asked again with it in the prediction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mvps.cores import on_cores
from mvps.gleam import Senders
from mvps.material import CERTAIN
from mvps.mesh import lengths
from mvps.rendering import light_arriving, light_senders, photograph, points_under
from mvps.scene import Capture, Float, Lights, Material, Surface, View
from mvps.visibility import ray_caster

PIXELS, FEWEST = 150, 30
"""Of a view that are asked, and that must be lit for a photograph to say something."""

LIT = 0.3
"""Of a pixel's bright level, from which it counts as lit: below, inter-reflection and penumbrae weigh."""

LIGHTS = 8
"""Of a view that are asked again: what arrives from all other surfaces takes as long as a texture's light."""

NEAR = 0.004
"""Slope that a photographed object in a light stage leaves (0.006, docs/method.md), less its error; lights at ten times the object's size
leave 0.014, sound captures -0.02 to 0.003 but for light between surfaces, and for one of metal."""


class Nearness(NamedTuple):
    """Median slope over the photographs, in radii of the object, and its standard error."""

    slope: float
    error: float

    @property
    def near(self) -> bool:
        """Whether lights are near beyond chance."""
        return self.slope > max(NEAR, CERTAIN * self.error)


def nearness(capture: Capture, surface: Surface, material: Material, lights: Lights) -> Nearness:
    """Of a solved capture; lights: of its photographs, in its order."""
    found = _told(capture, surface, material, lights, None)
    senders = light_senders(surface, material) if found.near else None
    return found if senders is None else _told(capture, surface, material, lights, senders)


def _told(capture: Capture, surface: Surface, material: Material, lights: Lights, senders: Senders | None) -> Nearness:
    """By all lights without what surfaces send each other, or by some with it."""
    caster = ray_caster(surface)
    centre = (surface.vertices.min(0) + surface.vertices.max(0)) / 2
    radius = float(lengths(surface.vertices - centre).max())

    def of_view(view: View, direction: Float, intensity: Float) -> list[float]:
        chosen = np.sort(np.random.default_rng(0).permutation(len(view.pixels))[:PIXELS])
        asked = slice(None, None, 1 if senders is None else max(1, len(direction) // LIGHTS))
        direction, intensity, arriving = direction[asked], intensity[asked], light_arriving(senders, direction[asked], view.camera.centre)
        points = points_under(caster, material, view.camera, view.pixels[chosen])
        predicted = photograph(caster, material, view.camera, view.pixels[chosen], direction, intensity, arriving).mean(-1)
        image = view.samples[chosen][:, asked].mean(-1) * view.scale
        bright = np.quantile(predicted, 0.8, axis=1, keepdims=True)
        lit = view.usable()[chosen][:, asked] & points.hit[:, None] & (predicted > LIT * bright) & (image > 0)
        along = 2 * ((points.position - centre) / radius) @ direction.T
        return [_slope(along[lit[:, k], k], np.log(image[lit[:, k], k] / predicted[lit[:, k], k])) for k in range(len(direction))]

    slopes = np.concatenate(on_cores(of_view, capture.views, lights.direction, lights.intensity))
    slopes = slopes[np.isfinite(slopes)]
    if not len(slopes):
        return Nearness(0.0, 0.0)
    middle = float(np.median(slopes))
    return Nearness(middle, float(1.4826 * np.median(np.abs(slopes - middle)) / np.sqrt(len(slopes))))


def _slope(x: Float, y: Float) -> float:
    """Of y over x (n,), far values of y counting little; NaN where there are too few."""
    if len(x) < FEWEST:
        return float("nan")
    x, y = x - np.median(x), y - np.median(y)
    weight = 1 / (1 + (y / (3 * np.median(np.abs(y)) + 1e-9)) ** 2)
    return float((weight * x * y).sum() / max(float((weight * x * x).sum()), 1e-12))
