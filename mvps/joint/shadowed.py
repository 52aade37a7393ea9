"""How strongly diffuse surfaces light each other, from samples deep in cast shadow: they hold what other surfaces send, and nothing else.

    I = b x,     x = a e G_0          (bounce.py)

Samples in the light tell b only as far as normals cannot: in a hollow, light between its walls looks like a shallower one without it
(Nayar et al. 1991), so that b = 0 fits a hollow that is too shallow. In shadow there is nothing to take its place. b is the median of I / x
with the weights

    w min(I, (2 b x)^2 / I)

of the pair w and the sample. Weights x would minimise sum w |I - b x|, but x, worked out on a mesh that is not yet right, is known less
well than I, and they favour samples whose x is too large: with errors of a factor exp(+-s) b comes out exp(-s^2) times too small
(regression dilution). Weights I favour neither. But where the mesh is wrong, what it thinks in shadow is lit: the farther a sample is
beyond twice what b predicts, the less it counts.

Where lobes take part (gleam.py) two strengths would have to be told apart, which shadows cannot (docs/method.md).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mvps.joint.blocks import DirectionalLights, Vertices, batches, evaluate
from mvps.joint.observe import ViewSamples
from mvps.scene import Law

LEAST_SAMPLES = 100
"""Where there are fewer, samples in the light have their say: single ones are off by as much as the strength itself (docs/method.md),
which so many know to 10 %."""

TIMES = 3
"""That weights are renewed: from weights x on, with errors of a factor 1.5, the fourth renewal changes b by less than a per cent."""


def in_shadow(samples: ViewSamples) -> ViewSamples:
    """The samples deep in cast shadow as the data, of the pairs that have any."""
    if samples.dark is None:
        return replace(samples, data=torch.zeros_like(samples.data))
    some = samples.of_pairs(samples.dark.any(1).nonzero()[:, 0])
    assert some.dark is not None
    return replace(some, data=some.dark)


def bounce_in_shadow(views: list[ViewSamples], vertices: Vertices, lights: list[DirectionalLights], law: Law) -> float | None:
    """The bounce that shadows tell; None where too few do."""
    shown, sending, weights = [], [], []
    for batch in batches([in_shadow(samples) for samples in views], lights):
        index = batch.vertex
        shaded = evaluate(vertices.normal[index], vertices.reflectance[index], batch.towards, batch.lights, law, batch.gathered)
        some = (batch.weight > 0) & (shaded.indirect > 0)
        shown.append(batch.image[some].double())
        sending.append(shaded.indirect[some].double())
        weights.append(batch.weight[some].double())
    if sum(len(part) for part in shown) < LEAST_SAMPLES:
        return None
    image, sent, weight = (torch.cat(parts) for parts in (shown, sending, weights))
    ratio, order = (image / sent).sort()
    image, sent, weight = image[order].clamp_min(0), sent[order], weight[order]
    bounce, tiny = _middle(ratio, weight * sent), torch.finfo(image.dtype).tiny
    for _ in range(TIMES):
        bounce = _middle(ratio, weight * torch.minimum(image, (2 * bounce * sent) ** 2 / image.clamp_min(tiny)))
    return bounce


def _middle(ordered: Tensor, weight: Tensor) -> float:
    """The median of ordered values with weights; 0 where no weight is left."""
    summed = weight.cumsum(0)
    return float(ordered[torch.searchsorted(summed, summed[-1] / 2)]) if float(summed[-1]) > 0 else 0.0
