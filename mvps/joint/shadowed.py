"""How strongly diffuse surfaces light each other, from samples deep in cast shadow: they hold what other surfaces send, and nothing else.

    I = b x,     x = a e G_0          (bounce.py)

Samples in the light tell b only as far as normals cannot: in a hollow, light between its walls looks like a shallower one without it
(Nayar et al. 1991), so that b = 0 fits a hollow that is too shallow. In shadow there is nothing to take its place. b is the median of I / x
with the weights

    w min(I, (2 b x)^2 / I)

of the pair w and the sample. Weights x would minimise sum w |I - b x|, but x, worked out on a mesh that is not yet right, is known less
well than I, and they favour samples whose x is too large: with errors of a factor exp(+-s) b comes out exp(-s^2) times too small
(regression dilution). Weights I favour neither. But where the mesh is wrong, what it thinks in shadow is lit: the farther a sample is
beyond twice what b predicts, the less it counts. That breaks down where half of what should be dark is lit: b grows with every renewal, and
what counts with it. Then the median point would return more light than it receives, and weights x, of which such samples have little, tell
b.

Pixels are never below zero, so that samples, interpolated between them, hold some of their noise where nothing arrives. Samples with
x / albedo over BEYOND_NOISE standard deviations of it would hardly be misled, but are those whose x came out too large, and tell too
small a b: so all samples tell it, unless it is over FAR times what those do.

Where lobes take part (gleam.py) two strengths would have to be told apart, which shadows cannot (docs/findings/shadows.md).
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from mvps.joint.blocks import DirectionalLights, Vertices, batches, evaluate
from mvps.joint.observe import ViewSamples
from mvps.scene import Law

LEAST_SAMPLES = 100
"""Where there are fewer, samples in the light have their say: single ones are off by as much as the strength itself, which so many
know to 10 % (docs/findings/shadows.md)."""

FAR = 2.0
"""Times what b predicts, beyond which a sample counts less, and times what samples beyond the noise say, beyond which all of them are not
believed: as far as what arrives is worked out wrongly on a mesh on its way (docs/findings/shadows.md)."""

BEYOND_NOISE = 3.0
"""Standard deviations of dark pixels' noise (noise.py): of noise without what is below zero, of which 0.58 is left, with a mean of 0.4 of
what there was (docs/findings/shadows.md)."""

TIMES = 3
"""That weights are renewed: from weights x on, with errors of a factor 1.5, the fourth renewal changes b by less than a per cent."""

OCTAVES, STEPS = 20, 512
"""Ratios are counted over so many octaves below and above what returns all light, in steps of a seventh of a per cent."""


def in_shadow(samples: ViewSamples) -> ViewSamples:
    """The samples deep in cast shadow as the data, of the pairs that have any."""
    if samples.dark is None:
        return replace(samples, data=torch.zeros_like(samples.data))
    some = samples.of_pairs(samples.dark.any(1).nonzero()[:, 0])
    assert some.dark is not None
    return replace(some, data=some.dark)


def bounce_in_shadow(
    views: list[ViewSamples],
    vertices: Vertices,
    lights: list[DirectionalLights],
    law: Law,
    noise: float,
    times: int = TIMES,
    most: float = math.inf,
) -> float | None:
    """The bounce that shadows tell; None where too few beyond the noise do. A median of ratios I / x, counted in steps:
    samples are too many to be kept.

    noise: standard deviation of dark pixels' over the root mean square of samples in the light (noise.py).
    times: that weights are renewed; 0 leaves weights x, with which b, too small, predicts samples best (least absolute errors).
    most: beyond which b cannot be, so that weights are not renewed.
    """
    sending = vertices.reflectance[:, 0]
    albedo = float(sending[sending > 0].median()) if bool((sending > 0).any()) else 1.0
    least = BEYOND_NOISE * noise * _level(views) * albedo
    of_all, of_sure, count = *vertices.reflectance.new_zeros(2, 2 * OCTAVES * STEPS, dtype=torch.float64), 0
    for batch in batches([in_shadow(samples) for samples in views], lights):
        index = batch.vertex
        shaded = evaluate(vertices.normal[index], vertices.reflectance[index], batch.towards, batch.lights, law, batch.gathered)
        some = (batch.weight > 0) & (shaded.indirect > 0)
        sent = shaded.indirect[some].double()
        octave = (batch.image[some] * albedo / sent).log2().clamp(-OCTAVES, OCTAVES).nan_to_num(-OCTAVES)
        step, share = ((octave + OCTAVES) * STEPS).long().clamp_max(len(of_all) - 1), batch.weight[some].double() * sent
        sure = sent > least
        of_all.index_add_(0, step, share)
        of_sure.index_add_(0, step[sure], share[sure])
        count += int(sure.sum())
    if count < LEAST_SAMPLES:
        return None
    by_all, by_sure = _strength(of_all, times), _strength(of_sure, times)
    believed, told = (by_all, of_all) if by_all <= FAR * by_sure else (by_sure, of_sure)
    return (believed if believed <= most * albedo else _strength(told, 0)) / albedo


def _strength(told: Tensor, times: int) -> float:
    """b over the albedo from weights x, counted by ratios I / x, after so many renewals."""
    ratio = 2 ** ((torch.arange(len(told), device=told.device) + 0.5) / STEPS - OCTAVES).double()
    bounce = _middle(ratio, told)
    for _ in range(times):
        # Weights x min(r, (FAR b)^2 / r), r the ratio.
        bounce = _middle(ratio, told * torch.minimum(ratio, (FAR * bounce) ** 2 / ratio))
    return bounce


def _level(views: list[ViewSamples]) -> float:
    """Root mean square of the samples in the light."""
    squares = sum(float(torch.where(samples.data, samples.image, 0).square().sum(dtype=torch.float64)) for samples in views)
    return float((squares / max(sum(int(samples.data.sum()) for samples in views), 1)) ** 0.5)


def _middle(ordered: Tensor, weight: Tensor) -> float:
    """The median of ordered values with weights."""
    summed = weight.cumsum(0)
    return float(ordered[torch.searchsorted(summed, summed[-1] / 2)])
