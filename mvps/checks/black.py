"""A black level that was left in: a constant that a camera adds to what every pixel holds, lit or not, and raw converters take off.

    code = b + radiance / scale

Where no lamp reaches, beside the object, photographs show b alone. With Z the places of the background that are darkest in the mean over a
view's photographs, and v_j the mean of photograph j over Z, b is the least v_j of some photographs of some views. It is believed where

    median v_j <= (1 + SAME) b      whatever lamp shines, for light that strays into dark places changes with the lamp: in real photographs
                                    without a black level from one to twenty-fold and more (docs/findings/checks.md);
    b - 3 sigma <= DARKEST quantile of the object's samples: what was cut out and laid on grey is darker itself somewhere;
    3 sigma < b: black levels are there for noise to have room below; cut off at black, noise alone is 0.4 to 0.8 sigma in the mean;
    sixteen bits are not all the same over Z: no camera is so free of noise, but what was painted is;
    b > LEAST of the bright level.

sigma is half of what lies between the quantiles of 16 and 84 % of a photograph's values over Z, of one channel.

Looked for before anything else that trusts values: outlines against a dark wall, curves, ambient light.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt, uniform_filter

from mvps.checks.prediction import BRIGHT_QUANTILE
from mvps.cores import on_cores
from mvps.finding import Finding
from mvps.load.images import decode, read_header
from mvps.scene import Bool, Capture, Float, View
from mvps.values import channel_mean

WINDOW = 9
"""Pixels across, over which the background is averaged before its darkest places are chosen: by single pixels noise would choose them. As
far from the mask, nothing of the object is in it."""

DARK, FEWEST = 0.05, 50
"""Part of the background that Z is, and its least number of pixels."""

VIEWS, PHOTOGRAPHS = 4, 6
"""Looked at, and of each view."""

SAME = 0.25
"""Of b: noise of v_j is below a hundredth of it, stray light beside it a part of it."""

NOISE = 3.0
"""sigma."""

DARKEST = 1e-3
"""Of the object's samples; their least would be chosen by noise."""

BITS_8 = 1 / 255
"""Scale of photographs of eight bits, whose steps may hide noise."""

PIXELS = 2000
"""Of an object that are looked at, or more."""

LEAST = 2e-3
"""Of the bright level: a tenth of a degree of the lights (docs/findings/checks.md)."""


class _Dark(NamedTuple):
    """What a view's photographs show where they are darkest: v_j (photographs, 3) and sigma, radiance; whether it was painted."""

    level: Float
    sigma: float
    painted: bool


def black_level(capture: Capture) -> tuple[Capture, list[Finding]]:
    """The capture without its black level, where there is one."""
    told = [view for view in capture.views if view.files and view.frame is not None]
    chosen = [told[i] for i in np.unique(np.linspace(0, len(told) - 1, min(VIEWS, len(told))).astype(int))] if told else []
    objects = [_of_object(view) for view in chosen]
    # Most captures have none, which this tells at once.
    if any(np.quantile(_frame(view), DARK) * view.scale <= LEAST * bright for view, (bright, _) in zip(chosen, objects, strict=True)):
        return capture, []
    found = [one for one in on_cores(_dark, chosen) if one is not None]
    if not found or any(one.painted for one in found):
        return capture, []
    level = np.concatenate([one.level for one in found])
    b, grey = level.min(0), level.mean(1)
    least, noise = float(grey.min()), NOISE * float(np.median([one.sigma for one in found]))
    # Where noise is less, a step of the code is as far as the darkest samples may be off.
    below = least - noise - max(view.scale for view in chosen)
    if least < noise or np.median(grey) > (1 + SAME) * least or any(darkest < below for _, darkest in objects):
        return capture, []
    views = tuple(_without(view, b) for view in capture.views)
    text = (
        f"photographs are nowhere darker than {100 * least:.2g} % of full scale, whatever lamp shines: a black level was left in; taken off"
    )
    return Capture(capture.name, views), [Finding("radiometry", "all views", text, True)]


def _of_object(view: View) -> tuple[float, float]:
    """Bright level and DARKEST quantile of the object's samples, radiance, by some of its pixels."""
    some = channel_mean(view.samples[:: max(1, len(view.samples) // PIXELS), view.shown])
    bright, darkest = np.quantile(some, (BRIGHT_QUANTILE, DARKEST)) * view.scale
    return float(bright), float(darkest)


def _frame(view: View) -> Float:
    """(height, width) mean code values."""
    assert view.frame is not None
    return view.frame


def _dark(view: View) -> _Dark | None:
    """What some of a view's photographs show at Z; None where there is too little background."""
    beside = distance_transform_edt(~view.mask) > WINDOW
    if DARK * beside.sum() < FEWEST:
        return None
    mean = uniform_filter(_frame(view).astype(np.float64), WINDOW)
    dark: Bool = beside & (mean <= np.quantile(mean[beside], DARK))
    some = np.unique(np.linspace(0, len(view.files) - 1, min(PHOTOGRAPHS, len(view.files))).astype(int))
    values = [decode(view.files[k], read_header(view.files[k]))[dark] * view.scale for k in some]
    low, high = np.quantile(values, (0.16, 0.84), axis=1)
    painted = view.scale < BITS_8 and bool((np.ptp(values, axis=(0, 1)) == 0).all())
    return _Dark(np.array([one.mean(0) for one in values]), float(np.median(high - low)) / 2, painted)


def _without(view: View, b: Float) -> View:
    """The view without this level (3,), radiance, its files' too where they are read again."""
    red, green, blue = (round(float(one / view.scale)) for one in b)
    black = np.array([red, green, blue], np.uint16)
    less = np.maximum(view.samples, black) - black
    frame = None if view.frame is None else np.maximum(view.frame - np.float32(black.mean()), 0)
    # What is no data stays so.
    samples = np.where(view.usable()[..., None], less, view.samples)
    return replace(view, samples=samples, frame=frame, black=(red, green, blue))
