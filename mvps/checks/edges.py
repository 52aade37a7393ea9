"""Where the edges of a photograph lie, against those of its view's other photographs.

Edges are where albedo or normal change: in the same places under every light, whatever the reflectance. The correlation (Spearman's, of
ranks, so that no single highlight decides) of a photograph's contrast |dI/dx| + |dI/dy| with the median of the others' is largest where
the photograph lies on the others.
"""

from __future__ import annotations

import numpy as np

from mvps.checks.prediction import grey
from mvps.scene import Float, View

PIXELS = 2000
"""Of the object: a correlation is then known to 1 / sqrt(2000) = 2 %."""


def ranks(values: Float) -> Float:
    """(n,) place of each of the values (n,) in their order, equal ones at the middle of theirs. (scipy.stats takes 0.3 s to load.)"""
    _, at, count = np.unique(values, return_inverse=True, return_counts=True)
    middle: Float = (np.cumsum(count) - (count - 1) / 2)[at]
    return middle


def agreement(view: View, light: int, reach: int) -> Float:
    """(2 reach + 1, 2 reach + 1) correlation of a photograph, moved by -reach .. reach (rows, columns), with the view's others."""
    height, width = view.mask.shape
    row, column = view.pixels.T
    own = np.arange(len(row))
    right = view.pixel_index[row, np.minimum(column + 1, width - 1)]
    below = view.pixel_index[np.minimum(row + 1, height - 1), column]
    inner = np.flatnonzero((right >= 0) & (below >= 0) & (right != own) & (below != own))
    some = inner[:: max(1, len(inner) // PIXELS)]
    others = grey(view.samples[:, [k for k in np.flatnonzero(view.usable().any(0)) if k != light]])
    others /= np.maximum(np.quantile(others[some], 0.8, axis=0), 1)
    wanted = np.median(np.abs(others[right[some]] - others[some]) + np.abs(others[below[some]] - others[some]), axis=1)
    image = grey(view.samples[:, light])
    contrast = np.full(view.mask.shape, np.nan)
    contrast[row[inner], column[inner]] = ranks(np.abs(image[right[inner]] - image[inner]) + np.abs(image[below[inner]] - image[inner]))
    padded = np.pad(contrast, reach, constant_values=np.nan)
    rank = ranks(wanted)
    found = np.zeros((2 * reach + 1, 2 * reach + 1))
    for i, j in np.ndindex(found.shape):
        moved = padded[row[some] + i, column[some] + j]
        on = np.isfinite(moved)
        a, b = (values[on] - values[on].mean() if on.any() else np.zeros(0) for values in (moved, rank))
        norm = float(np.sqrt((a @ a) * (b @ b)))
        found[i, j] = a @ b / norm if norm > 0 else 0.0
    return found
