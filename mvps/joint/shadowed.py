"""How strongly diffuse surfaces light each other, from samples deep in cast shadow: they hold what other surfaces send, and nothing else.

    I = b x,     x = a e G_0          (bounce.py)

Samples in the light tell b only as far as normals cannot: in a hollow, light between its walls looks like a shallower one without it (Nayar
et al. 1991), so that b = 0 fits a hollow that is too shallow. In shadow there is nothing to take its place. b minimises

    sum w |I - b x|,

the median of I / x with the weights w x, which up to half of them may contradict: where the mesh is wrong, what it thinks in shadow is lit.

Where lobes take part (gleam.py) two strengths would have to be told apart, which shadows cannot (docs/method.md).
"""

from __future__ import annotations

from dataclasses import replace

import torch

from mvps.joint.blocks import DirectionalLights, Vertices, batches, evaluate
from mvps.joint.observe import ViewSamples
from mvps.scene import Law

LEAST_SAMPLES = 100
"""Where there are fewer, samples in the light have their say: single ones are off by as much as the strength itself (docs/method.md),
which so many know to 10 %."""


def in_shadow(samples: ViewSamples) -> ViewSamples:
    """The samples deep in cast shadow as the data, of the pairs that have any."""
    if samples.dark is None:
        return replace(samples, data=torch.zeros_like(samples.data))
    some = samples.of_pairs(samples.dark.any(1).nonzero()[:, 0])
    assert some.dark is not None
    return replace(some, data=some.dark)


def bounce_in_shadow(views: list[ViewSamples], vertices: Vertices, lights: list[DirectionalLights], law: Law) -> float | None:
    """The bounce that shadows tell; None where too few do."""
    ratios, weights = [], []
    for batch in batches([in_shadow(samples) for samples in views], lights):
        index = batch.vertex
        shaded = evaluate(vertices.normal[index], vertices.reflectance[index], batch.towards, batch.lights, law, batch.gathered)
        some = (batch.weight > 0) & (shaded.indirect > 0)
        sent = shaded.indirect[some].double()
        ratios.append(batch.image[some].double() / sent)
        weights.append(batch.weight[some].double() * sent)
    if sum(len(ratio) for ratio in ratios) < LEAST_SAMPLES:
        return None
    ratio, order = torch.cat(ratios).sort()
    summed = torch.cat(weights)[order].cumsum(0)
    return float(ratio[torch.searchsorted(summed, summed[-1] / 2)])
