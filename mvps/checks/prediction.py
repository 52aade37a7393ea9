"""How well a photograph is predicted from the other photographs of its view.

With M (pixels, lights) grey values over each pixel's and each light's bright level, the least-squares prediction of every photograph from
all others, each leaving itself out, needs one inverse (the inverse of a Gram matrix holds all its regressions):

    G = M^T M + ridge,     P_k = sum_j c_jk M_j,     c_jk = - (G^-1)_jk / (G^-1)_kk,   c_kk = 0.

No rank is chosen: where few factors explain the images the ridge keeps to these, metals take as many as there are lights. Two ridges are
tried, and a photograph counts by the one that predicts it better: a large one where photographs are few.

Residuals are medians over the pixels that are predicted lit: shadows and highlights are outvoted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.scene import Bool, Float, Int, View
from mvps.values import channel_mean

PIXELS = 400
"""Drawn from a view: the median of its residuals is then known to 1.25 / sqrt(400) = 6 % of their spread."""

BRIGHT_QUANTILE = 0.8
"""A pixel's bright level over the lights, a light's over the pixels: above shadows, below highlights."""

LEVEL_SWEEPS = 3

BRIGHTEST = 2.0
"""Values are cut at twice the bright level: highlights of a few lights would decide least squares."""

LIT = 0.1
"""Pixels count where the prediction is at least this much of the bright level: below lie shadows and what other surfaces send."""

RIDGES = (1e-3, 3e-2)
"""Over the mean of G's diagonal: the variance that sensors, and that models of few factors, leave (a fiftieth to a fifth of the signal)."""

FEWEST_PIXELS = 20
"""Below this many lit pixels a photograph's residual is not known."""


@dataclass(frozen=True, eq=False)
class Sampled:
    """Some pixels of a view. chosen (n,): their places in its list; bright (n, 1) and level (lights,): M is grey value over both, cut;
    values (n, lights): M."""

    view: View
    chosen: Int
    bright: Float
    level: Float
    values: Float


def grey(samples: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Mean over the channels (..., 3), in code values."""
    return channel_mean(samples, np.float32)


def sampled(view: View, pixels: int, generator: np.random.Generator) -> Sampled:
    """Some pixels of a view with the bright levels of pixels and lights, which are found in turn."""
    chosen = np.sort(generator.permutation(len(view.pixels))[:pixels])
    image = grey(view.samples[chosen])
    live = view.usable().any(0)
    level = np.ones(image.shape[1], np.float32)
    for _ in range(LEVEL_SWEEPS):
        bright = _bright(image[:, live] / level[live])
        # A light of less than one code value shows nothing.
        level = np.maximum(np.quantile(image / bright, BRIGHT_QUANTILE, axis=0), 1 / float(np.median(bright))).astype(np.float32)
        level /= np.median(level[live]) if live.any() else np.float32(1)
    bright = _bright(image[:, live] / level[live])
    values = np.where(live, np.minimum(image / bright / level, BRIGHTEST), 0)
    return Sampled(view, chosen, bright, level, values)


def _bright(values: Float) -> Float:
    """(n, 1), at least one code value."""
    if not values.shape[1]:
        return np.ones((len(values), 1), np.float32)
    return np.maximum(np.quantile(values, BRIGHT_QUANTILE, axis=1, keepdims=True), 1).astype(np.float32)


def coefficients(gram: Float, ridge: float) -> Float:
    """(lights, lights) c of the module's docstring for M^T M; columns of lights without values are 0."""
    live = np.diag(gram) > 0
    G = np.where(live, gram, 0) + np.diag(np.where(live, ridge * np.trace(gram) / max(1, int(live.sum())), 1))
    inverse = np.linalg.inv(G)
    c: Float = -inverse / np.diag(inverse)
    np.fill_diagonal(c, 0)
    return c


def medians(residual: Float, counted: Bool) -> Any:
    """(lights,) medians of |residual| (n, lights) over the counted, NaN where they are too few."""
    if not len(residual):
        return np.full(residual.shape[1], np.nan)
    ordered = np.sort(np.where(counted, np.abs(residual), np.inf).T, axis=1)
    count = counted.sum(0)
    middle = np.take_along_axis(ordered, np.minimum(count // 2, len(residual) - 1)[:, None], 1)[:, 0]
    return np.where(count >= FEWEST_PIXELS, middle, np.nan)


def shifted(of: Sampled, shift: tuple[int, int], lights: slice = slice(None)) -> tuple[Int, Float]:
    """Which of the pixels lie on the object when moved by (rows, columns), and M there."""
    height, width = of.view.mask.shape
    row, column = (of.view.pixels[of.chosen] + shift).T
    inside = np.flatnonzero((row >= 0) & (row < height) & (column >= 0) & (column < width))
    places = of.view.pixel_index[row[inside], column[inside]]
    inside, places = inside[places >= 0], places[places >= 0]
    values = grey(of.view.samples[places, lights]) / of.bright[inside] / of.level[lights]
    return inside, np.minimum(values, BRIGHTEST)
