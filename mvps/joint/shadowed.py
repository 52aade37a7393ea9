"""How strongly surfaces light each other, from samples deep in cast shadow: they hold what other surfaces send, and nothing else.

    I = e (b a G_0 + g (a G_1 + sum_k w_k G_2+k))          (gleam.py)

Samples in the light tell b and g only as far as normals cannot: in a hollow, light between its walls looks like a shallower one without it
(Nayar et al. 1991), so that b = 0 fits a hollow that is too shallow. In shadow there is nothing to take its place. b and g minimise

    sum w |I - b x - g y|,     x, y the derivatives,     b, g >= 0

which up to half of the samples may contradict (least absolute deviations, by reweighting: Schlossmacher 1973): where the mesh is wrong,
what it thinks in shadow is lit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import nnls

from mvps.joint.blocks import DirectionalLights, Vertices, batches, evaluate
from mvps.joint.observe import ViewSamples
from mvps.scene import Float, Law

LEAST_SAMPLES = 100
"""Where there are fewer, samples in the light have their say: single ones are off by as much as the strength itself (docs/method.md),
which so many know to 10 %."""

REWEIGHTINGS = 20
LEAST_RESIDUAL = 1e-3
"""Over the samples' mean, below which a residual weighs no more."""

RIDGE = 1e-9
"""Of the normal equations, over their diagonal: terms that are alike share."""


def in_shadow(samples: ViewSamples) -> ViewSamples:
    """The samples deep in cast shadow as the data, of the pairs that have any."""
    if samples.dark is None:
        return replace(samples, data=torch.zeros_like(samples.data))
    some = samples.of_pairs(samples.dark.any(1).nonzero()[:, 0])
    assert some.dark is not None
    return replace(some, data=some.dark)


def of_shadows(
    views: list[ViewSamples], vertices: Vertices, lights: list[DirectionalLights], law: Law, free: tuple[bool, bool]
) -> tuple[float, float] | None:
    """Bounce and gleam, of which those that are not `free` stay; None where too few samples tell."""
    dark = [in_shadow(samples) for samples in views]
    if not any(free) or sum(int(samples.data.sum()) for samples in dark) < LEAST_SAMPLES:
        return None
    columns: list[list[torch.Tensor]] = [[], [], [], []]
    for batch in batches(dark, lights):
        index, some = batch.vertex, batch.weight > 0
        shaded = evaluate(vertices.normal[index], vertices.reflectance[index], batch.towards, batch.lights, law, batch.gathered)
        for column, values in zip(columns, (shaded.indirect, shaded.gleamed, batch.image, batch.weight), strict=True):
            column.append(values[some])
    *terms, image, weight = (torch.cat(column).double().cpu().numpy() for column in columns)
    known = np.array([law.bounce, law.gleam])
    wanted = np.array(free) & np.array([bool(term.any()) for term in terms])
    if not wanted.any():
        return None
    A, left = np.stack(terms, 1), image - np.stack(terms, 1)[:, ~wanted] @ known[~wanted]
    known[wanted] = _least_deviations(A[:, wanted], left, weight)
    return float(known[0]), float(known[1])


def _least_deviations(A: Float, b: Float, weight: Float) -> Float:
    """x >= 0 (k,) that minimises sum weight |b - A x|, for A (n, k)."""
    least, w = LEAST_RESIDUAL * float(np.abs(b).mean()) + 1e-300, weight
    x = np.zeros(A.shape[1])
    for _ in range(REWEIGHTINGS):
        H, g = A.T @ (w[:, None] * A), A.T @ (w * b)
        L = np.linalg.cholesky(H + np.diag(RIDGE * np.diagonal(H)))
        x = nnls(L.T, np.linalg.solve(L, g))[0]
        w = weight / np.maximum(np.abs(b - A @ x), least)
    return np.asarray(x)
