"""What the model leaves of a vertex's photographs, in the light and where it says cast shadow.

With w the weight of a pair of vertex and view, s the scale of a vertex's residuals in the light (blocks.py), f the share of a light that a
photograph shows to reach the vertex and q R what it would then bring (borders.py),

    u^2 = (s^2 sum_light w + sum_shadow w (f q R)^2) / (sum_light w I^2 + sum_shadow w I^2)

over samples in the light and over those deep in cast shadow. What looks lit and should not be is shaded by something that is not there: a
hollow that is bridged, or a part of one that still stands in the way. Where one view alone sees a place, its normal and albedo fit nearly
any samples in the light, and shadows are all that speaks against its depth.
"""

from __future__ import annotations

import numpy as np

from mvps.cores import on_cores
from mvps.joint.borders import shown_light
from mvps.joint.observe import ViewSamples
from mvps.joint.reflectance import Observed
from mvps.scene import Float


def _in_light(of: Observed, i: int) -> Float:
    """(2, V) of the samples of view i what is left, and the signal."""
    samples = of.views[i]
    square = of.vertices.scale.double()[samples.vertex] ** 2 * samples.data.sum(1)
    signal = (samples.image.double() ** 2 * samples.data).sum(1)
    return _on_vertices(of, samples, square.cpu().numpy(), signal.cpu().numpy())


def _in_shadow(of: Observed, i: int) -> Float:
    """The same of those deep in cast shadow."""
    samples = of.views[i]
    if samples.dark is None:
        return np.zeros((2, len(of.surface.vertices)))
    shown = shown_light(of, i)
    told = samples.dark.cpu().numpy() & shown.clear
    left, signal = (shown.share * shown.whole).astype(np.float64), samples.image.double().cpu().numpy()
    return _on_vertices(of, samples, *((told * values**2).sum(1) for values in (left, signal)))


def _on_vertices(of: Observed, samples: ViewSamples, *of_pairs: Float) -> Float:
    """(2, V) sums over a vertex's pairs, by their weights."""
    index, weight = samples.vertex.cpu().numpy(), samples.weight.double().cpu().numpy()
    return np.stack([np.bincount(index, weight * values, len(of.surface.vertices)) for values in of_pairs])


def _with_shadow(samples: ViewSamples) -> ViewSamples:
    """Only the pairs that have samples deep in shadow."""
    return samples if samples.dark is None else samples.of_pairs(samples.dark.any(1).nonzero()[:, 0])


def unexplained_share(of: Observed) -> Float:
    """u (V,) above; NaN where no sample tells."""
    dark = of._replace(views=[_with_shadow(samples) for samples in of.views])
    every = range(len(of.views))
    left, signal = np.sum(on_cores(lambda i: _in_light(of, i), every) + on_cores(lambda i: _in_shadow(dark, i), every), axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(signal > 0, np.sqrt(left / signal), np.nan)
