"""A curve that was left in the photographs: found and undone.

Where a pixel is lit, Lambert's law gives photographs of three factors (calibrate.py), I_pl = b_p . s_l. A display's curve,
I -> I^(1/2.2) and its like, breaks that. So, with residuals in codes, what the photographs were recorded in,

    rho(curve) = median |M - three factors| / (dM / dcode),   M = curve^-1(code) over the pixel's bright level,

is least for the curve that was left in. (In M itself an exponent that flattens or stretches photographs gains by that alone, and of flat
faces, whose few normals are three factors under any curve, the noise decides: Box and Cox 1964.) Codes and radiances of a photograph are
taken over their bright level in it: under lights of unequal strength a curve would else make the strongest all there is, which few factors
explain. So rho depends neither on exposure nor albedo nor on the lights' strengths, and the samples that count, the brightest of each
pixel, are the same for all curves. A curve is believed where undoing it lowers rho clearly, over all views and in most of them: gloss and
inter-reflection do not look like one. Of metals, which no three factors explain, none is believed (correlation.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from mvps.calibrate import is_metallic
from mvps.checks.prediction import BRIGHT_QUANTILE
from mvps.cores import on_cores
from mvps.correlation import is_glossy
from mvps.finding import Finding
from mvps.hull import hull_grid, visual_hull
from mvps.pbr import linear_of_srgb
from mvps.relief.silhouette import inflated_normals
from mvps.scene import Capture, Float, View
from solvers.low_rank import factorise

Curve = Callable[[Float], Float]
"""From code values to radiance, both over full scale."""


def power(exponent: float) -> Curve:
    """code^exponent."""

    return lambda code: np.asarray(code, np.float64) ** exponent


LINEAR = power(1.0)

CURVES: Mapping[str, Curve] = MappingProxyType(
    {"sRGB": linear_of_srgb, "gamma 2.2": power(2.2), "gamma 1.8": power(1.8), "gamma 2.4": power(2.4)}
)
"""Those of displays and of files for them."""

BETTER = 1.25
"""Factor of rho: the variance falls by a third. On linear captures undoing a curve makes rho 1.3 to 8 times as large
(docs/findings/checks.md)."""

FEWEST_LIGHTS = 8
"""Of a view: six of them lit leave three residuals a pixel."""

LIT_SHARE = 0.9
"""Of a pixel's samples: the darkest are shadows."""

FEWEST_KNOWN, KNOWN_SHARE = 6, 0.1
"""Samples of a pixel that leave three residuals, and the part of the pixels that have so many, from which a view tells: under raking lamps
most pixels are lit by three to five, which three factors fit whatever they are."""

PIXELS, VIEWS, SWEEPS = 300, 8, 6
"""Looked at: rho is a median of some thousand samples a view."""

ALL_SWEEPS = 20
"""Where six speak for a curve: until factors of flat faces, which hardly tell the third, have come to rest."""

GROWN = 1e-3
"""Half the relative step of the difference quotient that stands for a curve's derivative."""

FULL = 65535


def over_its_level(image: Float) -> Float:
    """Values (pixels, lights), each light's over their bright level."""
    level: Float = np.quantile(image, BRIGHT_QUANTILE, axis=0)
    return image / np.maximum(level, 1e-12)


def _rho(view: View, curve: Curve, sweeps: int) -> float:
    """rho of a view's photographs with a curve undone, over pixels' bright codes."""
    chosen = np.sort(np.random.default_rng(0).permutation(len(view.pixels))[:PIXELS])
    codes = view.samples[chosen][:, view.shown]
    radiance = curve(codes * view.scale).mean(-1)
    darker, brighter = (curve(codes * (view.scale * (1 + step))).mean(-1) for step in (-GROWN, GROWN))
    image, code = over_its_level(radiance), over_its_level(codes.mean(-1))
    known = (codes < view.saturation).all(-1) & (codes.min(-1) > 0)
    known &= np.argsort(np.argsort(code, axis=1), axis=1) >= (1 - LIT_SHARE) * codes.shape[1]
    # Three factors fit fewer whatever they are.
    known &= known.sum(1, keepdims=True) >= FEWEST_KNOWN
    if known.any(1).mean() < KNOWN_SHARE:
        return float("nan")
    factors = factorise(image / _bright(image), known, 3, sweeps, floor=1e-4)
    left = np.abs(image / _bright(image) - factors.left @ factors.right.T)
    # In logarithms of both, which do without levels.
    growth = (brighter - darker) / (2 * GROWN * np.maximum(radiance, 1e-12))
    in_codes = left * _bright(image) / np.maximum(image * growth, 1e-12) * code / _bright(code)
    return float(np.median(in_codes[known]))


def _bright(values: Float) -> Float:
    """(n, 1) bright level of pixels over the lights."""
    level: Float = np.maximum(np.quantile(values, BRIGHT_QUANTILE, axis=1, keepdims=True), 1e-12)
    return level


def _log_rho(views: list[View], curve: Curve, sweeps: int) -> NDArray[np.float64]:
    return np.log(np.maximum(on_cores(lambda view: _rho(view, curve, sweeps), views), 1e-6))


def some_views(capture: Capture, lights: int) -> list[View]:
    """VIEWS of the capture's, or fewer, evenly spread over those of at least so many lights."""
    enough = [view for view in capture.views if int(view.shown.sum()) >= lights]
    return [enough[i] for i in np.unique(np.linspace(0, max(len(enough) - 1, 0), min(VIEWS, len(enough))).round().astype(int))]


def left_in(capture: Capture) -> tuple[str, float] | None:
    """The name of the curve that was left in all photographs, and by which factor undoing it lowers rho; None where there is none."""
    some = some_views(capture, FEWEST_LIGHTS)
    if not some:
        return None
    quick, one_of_them = (_log_rho(some, curve, SWEEPS) for curve in (LINEAR, CURVES["gamma 2.2"]))
    # The curves are alike: where one of them is no better than none, neither is another.
    if np.isnan(quick).all() or not np.nanmean(quick - one_of_them) > 0:
        return None
    linear = _log_rho(some, LINEAR, ALL_SWEEPS)
    better = {name: linear - _log_rho(some, curve, ALL_SWEEPS) for name, curve in CURVES.items()}
    name = max(better, key=lambda name: float(np.nanmean(better[name])))
    gain = float(np.nanmean(better[name]))
    if gain < np.log(BETTER) or np.nanmedian(better[name] > 0) < 1:
        return None
    return name, float(np.exp(gain))


def linear(view: View, curve: Curve) -> View:
    """The view with a curve undone, its samples of 16 bits whatever they were: eight would lose the dark ones."""
    codes = np.arange(FULL + 1)
    table = np.rint(FULL * curve(np.minimum(codes * view.scale, 1.0))).astype(np.uint16)
    return replace(view, samples=table[view.samples], scale=1 / FULL, saturation=int(table[view.saturation]))


def is_metal(capture: Capture) -> bool:
    """Whether the object is one, by its hull; of a single view by its inflated silhouette."""
    if len(capture.views) < 2:
        view = capture.views[0]
        image = np.where(view.shown, view.samples.mean(-1) * view.scale, np.nan)
        return is_glossy([image], [inflated_normals(view.mask)], np.random.default_rng(0))
    return is_metallic(capture, visual_hull(hull_grid(capture)), 0)


def curve_undone(capture: Capture) -> tuple[Capture, list[Finding]]:
    """The capture with linear samples, where a curve was left in all of its photographs."""
    found = left_in(capture)
    # Sharper highlights look like a metal's to three factors, so of metals nothing is believed.
    if found is None or is_metal(capture):
        return capture, []
    name, factor = found
    views = tuple(linear(view, CURVES[name]) for view in capture.views)
    text = f"the photographs are not linear: three factors fit {factor:.1f} times as well without the curve {name}; undone"
    return Capture(capture.name, views), [Finding("radiometry", "all views", text, True)]
