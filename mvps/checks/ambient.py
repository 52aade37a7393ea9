"""Ambient light: an image c_p that every photograph of a view holds besides what its lamp sends,  I_pl = (b_p . s_l)+ + c_p.

Found where no lamp shines. Three factors of the lit samples predict which samples lie in attached shadow, b_p . s_l < 0; there only c and
what other surfaces send is left. The latter grows with the lamp, the former does not: with F_l a low quantile of I_pl over the pixel's
bright level among the shadowed samples of light l, and L_l the light's own level,

    F_l = a + k L_l,       a: ambient light, k: inter-reflection.

A low quantile, because the rest of shadows is penumbra, and noise that is cut at black has half of its values there. Ambient light is
believed where a is more than LEAST and more than twice what k explains, in the median of the views, and the object is no metal, of which
three factors say nothing. Where sides are flat three factors fit a metal too, and what they take for shadows are the tails of its lobes.
These differ from lamp to lamp, where ambient light is the same under all: among the shadowed samples of one pixel

    q = (median deviation from their median) / median

is no more than SAME, in the median of the pixels.

Factors of pixels that hardly share lights may come out with a part of them turned round: what is then predicted to be in shadow is lit.
Such a view says nothing, and is told by the factors of a view that it agrees with, as views under one rig do, since factors leave
a linear map open; or by none.

Taken off: c_p over the bright level as a linear function of b_p / |b_p|, per channel, fitted to the medians of the pixels' shadowed
samples. Ambient light from everywhere falls on a surface smoothly by its direction; what concavities keep out is not modelled. Of a view
that no factors tell it is what the others have, in the median.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mvps.checks.radiometry import is_metal
from mvps.cores import on_cores
from mvps.finding import Finding
from mvps.scene import Bool, Capture, Float, View
from mvps.values import channel_mean
from solvers.low_rank import factorise, solve_rows

FEWEST_LIGHTS = 6
"""Of a view: factors of fewer leave no shadow to be predicted."""

PIXELS = 600
"""Looked at in a view."""

SHADOWED = 0.2
"""Part of a light's level by which a prediction must lie below zero: 12 degrees behind the horizon, more than penumbrae and the factors'
errors."""

LIT = 0.3
"""Samples above this part of the bright level make the factors."""

LOW = 0.1
"""Quantile of the shadowed samples."""

LEAST = 0.01
"""Of a, in bright levels: lights then are off by a third of a degree (docs/findings/checks.md), as much as by all else."""

FEWEST_SHADOWS, FEWEST_OF_LIGHT, FEWEST_OF_PIXEL = 50, 10, 3
"""Shadowed samples of a view, of a light and of a pixel, below which they say nothing."""

CONTRADICTED = 0.3
"""Part of the shadowed samples that may be lit: 0 to 0.15 where factors are right, 0.45 to 0.86 where turned (docs/findings/checks.md)."""

SAME = 0.2
"""Largest q of ambient light: up to 0.22 at a hundredth of the bright level, 0.23 to 0.6 on most metals (docs/findings/checks.md)."""


@dataclass(frozen=True, eq=False)
class _Factors:
    """Pixels' b over their bright level (n, 3), bright (n, 1) and image (n, lights) in radiance; lights' s (lights, 3) and levels
    (lights,); shadowed (n, lights)."""

    b: Float
    bright: Float
    s: Float
    level: Float
    shadowed: Bool
    image: Float


def _factors(view: View, chosen: NDArray[np.int64], s: Float | None = None) -> _Factors:
    """Of some of a view's pixels; with s the lights are known already."""
    image = channel_mean(view.samples[chosen]) * view.scale
    bright = np.maximum(np.quantile(image[:, view.shown], 0.8, axis=1, keepdims=True), view.scale)
    M = image / bright
    known = view.usable()[chosen] & (M > LIT)
    if s is None:
        found = factorise(M, known, 3, floor=1e-3)
        b, s = found.left, found.right
    else:
        b = solve_rows(M, known.astype(np.float64), s)
    with np.errstate(invalid="ignore"):
        level = np.array([np.median(M[known[:, k], k]) if known[:, k].any() else np.inf for k in range(M.shape[1])])
    return _Factors(b, bright, s, level, (b @ s.T < -SHADOWED * level) & view.shown, image)


def _some(view: View) -> NDArray[np.int64]:
    """Pixels by chance, in order."""
    return np.sort(np.random.default_rng(0).permutation(len(view.pixels))[:PIXELS])


def _agreed(f: _Factors) -> bool:
    """Whether what is predicted to be in shadow is dark."""
    lit = f.shadowed & (f.image > LIT * f.bright)
    return bool(lit.sum() <= CONTRADICTED * f.shadowed.sum())


def _told(views: Sequence[View]) -> list[_Factors | None]:
    """Factors of some pixels of every view, its own or by another's lights; None where none agrees with its photographs."""
    own = on_cores(lambda view: _factors(view, _some(view)), views)
    right = [f if _agreed(f) else None for f in own]

    def by_others(k: int) -> _Factors | None:
        others = (f.s for f, view in zip(right, views, strict=True) if f is not None and view.lights == views[k].lights)
        return next((f for f in (_factors(views[k], _some(views[k]), s) for s in others) if _agreed(f)), None)

    return [by_others(k) if f is None else f for k, f in enumerate(right)]


def _line(f: _Factors) -> tuple[float, float, float]:
    """a, k times the mean level, and q; NaN where shadows are too few."""
    count, several = f.shadowed.sum(0), f.shadowed.sum(1) >= FEWEST_OF_PIXEL
    enough = count >= FEWEST_OF_LIGHT
    if count.sum() < FEWEST_SHADOWS or enough.sum() < 3 or not several.any():
        return float("nan"), float("nan"), float("nan")
    M = f.image / f.bright
    low = np.array([np.quantile(M[f.shadowed[:, k], k], LOW) for k in np.flatnonzero(enough)])
    level = f.level[enough]
    weight = np.sqrt(count[enough])
    columns = np.column_stack([np.ones_like(level), level]) * weight[:, None]
    a, k = np.linalg.lstsq(columns, low * weight, rcond=None)[0]
    dark = np.where(f.shadowed, M, np.nan)[several]
    middle = np.nanmedian(dark, axis=1, keepdims=True)
    q = np.nanmedian(np.abs(dark - middle), axis=1) / np.maximum(middle[:, 0], np.finfo(np.float64).tiny)
    return float(a), float(k * level.mean()), float(np.median(q))


def _enough(capture: Capture) -> list[View]:
    """Views of enough lights."""
    return [view for view in capture.views if int(view.shown.sum()) >= FEWEST_LIGHTS]


def _share(factors: Sequence[_Factors | None]) -> float:
    """a of the module's docstring; 0 where it is not to be believed or cannot be told."""
    nothing = (float("nan"),) * 3
    lines = np.array([nothing if f is None else _line(f) for f in factors]).reshape(-1, 3)
    told = np.isfinite(lines[:, 0])
    if not told.any() or told.mean() < 0.5:
        return 0.0
    a, k, q = np.median(lines[told], axis=0)
    return float(a) if a > LEAST and a > 2 * abs(k) and q <= SAME else 0.0


def _bright(view: View, channel: int) -> Float:
    """(n,) bright level of a channel's pixels, code values."""
    bright: Float = np.maximum(np.quantile(view.samples[..., channel][:, view.shown].astype(np.float32), 0.8, axis=1), 1)
    return bright


def _by_direction(view: View, s: Float) -> Float:
    """(3, n) ambient light of the pixels over their bright level, by channel. s: of lights that agree with the view."""
    f = _factors(view, np.arange(len(view.pixels)), s)
    towards = np.column_stack([np.ones(len(f.b)), f.b / np.maximum(np.linalg.norm(f.b, axis=1, keepdims=True), 1e-12)])
    dark = np.flatnonzero(f.shadowed.any(1))
    found = []
    for channel in range(3):
        of_dark = np.where(f.shadowed[dark], view.samples[dark, :, channel].astype(np.float32), np.nan)
        seen = np.nanmedian(of_dark, axis=1) / _bright(view, channel)[dark]
        line = np.linalg.lstsq(towards[dark], seen, rcond=None)[0]
        found.append(np.maximum(towards @ line, 0))
    return np.array(found)


def _taken_off(view: View, of_bright: Float) -> View:
    """The view without its ambient image, of_bright (3, n) or (3, 1) times the bright levels."""
    values = view.samples.astype(np.float32)
    for channel in range(3):
        values[..., channel] -= (of_bright[channel] * _bright(view, channel))[:, None].astype(np.float32)
    less = np.rint(np.maximum(values, 0)).astype(np.uint16)
    # What is no data stays so.
    return replace(view, samples=np.where(view.usable()[..., None], less, view.samples))


def ambient(capture: Capture) -> tuple[Capture, list[Finding]]:
    """The capture without ambient light, where there is some."""
    enough = _enough(capture)
    factors = _told(enough)
    share = _share(factors)
    if not share or is_metal(capture):
        return capture, []
    told = [(view, f) for view, f in zip(enough, factors, strict=True) if f is not None]
    of_bright = dict(zip((view.name for view, _ in told), on_cores(lambda one: _by_direction(one[0], one[1].s), told), strict=True))
    usual = np.median([np.median(of_view, axis=1) for of_view in of_bright.values()], axis=0)[:, None]
    taken = {view.name: _taken_off(view, of_bright.get(view.name, usual)) for view in enough}
    views = tuple(taken.get(view.name, view) for view in capture.views)
    text = (
        f"where no lamp shines photographs are {100 * share:.1f} % as bright as where it does, whatever the lamp: there was ambient light;"
        " what every photograph has of it was taken off"
    )
    return Capture(capture.name, views), [Finding("radiometry", "all views", text, True)]
