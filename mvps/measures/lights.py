"""Lights and their errors, and which photographs and views a result has not seen.

Directions       angle(a, b) as for normals (mesh.angles_deg), both in the world frame.
Intensities      one scale for all lights and channels, s = (e . t) / (e . e); error = mean |s e - t| / t (Chen et al. 2019, eq. 8).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mvps.mesh import angles_deg
from mvps.scene import Capture, Float, Lights, Reconstruction, Truth

Photograph = tuple[str, int]
"""A photograph: the name of its view and the number of its light, counted from 1."""

Light = tuple[Float, Float]
"""Direction (3,), unit, world frame, and RGB intensity (3,)."""


def by_photograph(lights: Lights, views: Sequence[str], numbers: Sequence[Sequence[int]]) -> dict[Photograph, Light]:
    """The lights of `views`, by the photograph they lit; numbers: per view those of its lights, in the order of `lights`."""
    return {
        (view, number): (lights.direction[i][k], lights.intensity[i][k])
        for i, view in enumerate(views)
        for k, number in enumerate(numbers[i])
    }


def true_lights(truth: Truth) -> dict[Photograph, Light]:
    """The true lights, by the photograph they lit, of the views of which anything is known; NaN for what is not."""
    lights: dict[Photograph, Light] = {}
    for view in truth.views:
        known = truth.direction.get(view, truth.intensity.get(view, np.zeros((0, 3))))
        unknown = np.full(known.shape, np.nan)
        pairs = zip(truth.direction.get(view, unknown), truth.intensity.get(view, unknown), strict=True)
        lights |= {(view, k): light for k, light in enumerate(pairs, 1)}
    return lights


def light_errors(estimated: Mapping[Photograph, Light], truth: Mapping[Photograph, Light]) -> dict[str, float]:
    """Mean and largest angle in degrees and relative intensity error, each over all photographs of which both know it.

    Directions are in the world frame; intensities are compared up to one scale for all. What the truth knows of no photograph that was
    estimated gives no figures.
    """
    common = [photograph for photograph in estimated if photograph in truth]
    if not common:
        return {}
    direction, intensity = (np.stack(rows) for rows in zip(*(estimated[photograph] for photograph in common), strict=True))
    true_direction, true_intensity = (np.stack(rows) for rows in zip(*(truth[photograph] for photograph in common), strict=True))
    errors: dict[str, float] = {}
    known = np.isfinite(true_direction).all(1)
    if known.any():
        angle = angles_deg(direction[known], true_direction[known])
        errors |= {"light_error_deg": float(angle.mean()), "light_error_max_deg": float(angle.max())}
    known = np.isfinite(true_intensity).all(1)
    if known.any():
        given, true = intensity[known], true_intensity[known]
        scale = float((given * true).sum() / (given**2).sum())
        errors["intensity_error"] = float((np.abs(scale * given - true) / true).mean())
    return errors


def held_out_views(reconstruction: Reconstruction) -> tuple[str, ...]:
    """Names of the views in the result that were held out (settings: hold_out_views, numbers counted from 1)."""
    numbers = {str(number) for number in reconstruction.settings.get("hold_out_views") or []}
    # A result may have views of other names, which no number means.
    return tuple(view for view in reconstruction.views if view.rpartition("_")[2].lstrip("0") in numbers)


def unseen_views(reconstruction: Reconstruction, capture: Capture) -> frozenset[str]:
    """Names of the capture's views that the result was not reconstructed from: held out, or not in it at all."""
    held_out = held_out_views(reconstruction)
    return frozenset(v.name for v in capture.views if v.name in held_out or v.name not in reconstruction.views)


def held_out_photographs(reconstruction: Reconstruction) -> dict[Photograph, Light]:
    """All photographs of held-out views and those of held-out lights (settings: hold_out_lights) in the others, with their lights."""
    views, numbers = held_out_views(reconstruction), reconstruction.settings.get("hold_out_lights") or []
    lights = by_photograph(reconstruction.lights, reconstruction.views, reconstruction.light_names)
    return {(view, number): light for (view, number), light in lights.items() if view in views or number in numbers}
