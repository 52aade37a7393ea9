"""The noise of photographs, from themselves.

Noise is estimated from second differences of the photographs along rows (a smooth surface has hardly any: Immerkaer 1996),
sigma = median |I(x - 1) - 2 I(x) + I(x + 1)| / (0.6745 sqrt(6)); vertices interpolate between four pixels, which leaves two thirds of it.
"""

from __future__ import annotations

import numpy as np

from mvps.cores import on_cores
from mvps.once import once_for
from mvps.scene import Capture, View
from mvps.values import channel_mean

INTERPOLATED = 2 / 3
"""Part of the pixels' noise that is left between four of them, root mean square over all places."""

DARK = 0.1
"""Of the pixels, those where a photograph is darkest: most objects have more in shadow."""

LIGHTS_ASKED = 4
"""Photographs of each view from which its noise is estimated."""


def noise_share(capture: Capture) -> float:
    """Standard deviation of the grey photographs' noise over the root mean square of their signal; median over photographs."""
    return _share(capture, 1.0)


def dark_noise_share(capture: Capture) -> float:
    """The same of the darkest pixels, DARK of each photograph: where hardly any light arrives noise is weaker, and without what of it
    would be below zero."""
    return _share(capture, DARK)


def _share(capture: Capture, part: float) -> float:
    """The same of the darkest `part` of each photograph's pixels."""
    found = [share for shares in on_cores(lambda view: _shares(view, part), capture.views) for share in shares]
    return float(np.median(found)) if found else 0.0


@once_for
def _shares(view: View, part: float) -> list[float]:
    """The same of some photographs of a view."""
    shares = []
    for k in range(0, len(view.lights), max(1, len(view.lights) // LIGHTS_ASKED)):
        if not view.usable([k]).any():
            continue
        image = np.full(view.mask.shape, np.nan)
        image[view.mask] = np.where(view.usable([k])[:, 0], channel_mean(view.samples[:, k]), np.nan)
        second = image[:, :-2] - 2 * image[:, 1:-1] + image[:, 2:]
        around = image[:, :-2] + image[:, 1:-1] + image[:, 2:]
        known = np.isfinite(second)
        second, around = second[known], around[known]
        level = np.sqrt(np.nanmean(image**2))
        if len(second) and level > 0:
            second = second[around <= np.quantile(around, part)]
            shares.append(float(np.median(np.abs(second)) / (0.6745 * np.sqrt(6)) / level))
    return shares


def samples_noise(capture: Capture) -> float:
    """`noise_share` of vertices' samples, which are interpolated between pixels."""
    return INTERPOLATED * noise_share(capture)
