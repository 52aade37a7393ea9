"""Errors on held-out samples of the joint problem, for the choice of the reflectance model (material.py).

Of every view each HELD_OUT_EVERY-th light is kept back, other ones in the next view. The rest fits normals and reflectance of some
vertices and what the law has free, lights fixed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from mvps.joint.blocks import DirectionalLights, Vertices, batches, evaluate
from mvps.joint.lights import light_step, told_by_shadows
from mvps.joint.observe import ViewSamples
from mvps.joint.patches import Patches
from mvps.joint.shadowed import in_shadow
from mvps.joint.steps import Anchor, vertex_step
from mvps.material import Model
from mvps.scene import Float, Law

HELD_OUT_EVERY = 5
VERTEX_STEPS, LAW_STEPS = 3, 2


def parted(views: list[ViewSamples]) -> tuple[list[ViewSamples], list[ViewSamples]]:
    """The samples to fit and those kept back, for choosing a model."""
    fitted, kept = [], []
    for i, samples in enumerate(views):
        back = (torch.arange(samples.image.shape[1], device=samples.image.device) + i) % HELD_OUT_EVERY == 0
        dark = samples.dark
        fitted.append(replace(samples, data=samples.data & ~back, dark=None if dark is None else dark & ~back))
        kept.append(replace(samples, data=samples.data & back, dark=None if dark is None else dark & back))
    return fitted, kept


def held_out_errors(
    views: list[ViewSamples],
    start: Vertices,
    lights: list[DirectionalLights],
    anchor: Anchor,
    patches: Patches,
    rotations: list[Tensor],
    law: Law,
    noise: float,
    model: Model,
) -> tuple[Float, Float]:
    """(V,) mean absolute error of a vertex's held-out samples over their mean value, NaN without any, and (V,) of a patch's samples deep in
    shadow, NaN behind the last: what arrives at neighbours is worked out on the same parts of the mesh, and wrong together.

    start: normals and grey albedo to begin with; its lobes are not used. anchor ties the normals, patches keep their mean slope. law: its
    lobes' kind; the model says the rest. noise: of dark pixels (noise.py).
    """
    fitted, kept = parted(views)
    unknowns = 1 + len(model.sharpness)
    reflectance = torch.cat([start.reflectance[:, :1], start.reflectance.new_zeros(len(start.normal), unknowns - 1)], 1)
    state = Vertices(start.normal, reflectance, start.scale)
    free = replace(anchor, reflectance=torch.zeros_like(reflectance), reflectance_sigma=torch.full_like(reflectance, torch.inf))
    law = replace(law, sharpness=model.sharpness, grazing=0.0, bounce=0.0, gleam=0.0)
    for _ in range(VERTEX_STEPS):
        state = vertex_step(fitted, state, lights, law, free, patches=patches)
    law_free = (model.grazing, model.bounce, model.gleam)
    for _ in range(LAW_STEPS if any(law_free) else 0):
        # What is judged is how well samples are predicted.
        law, left = told_by_shadows(fitted, state, lights, law, law_free, noise, times=0)
        _, law = light_step(fitted, state, lights, law, free, patches, rotations, False, False, left)
        for _ in range(2):
            state = vertex_step(fitted, state, lights, law, free, patches=patches)
    shadowed = [in_shadow(samples) for samples in kept]
    return _errors(kept, state, lights, law), _of_patches(shadowed, state, lights, law, patches)


def _errors(views: list[ViewSamples], state: Vertices, lights: list[DirectionalLights], law: Law) -> Float:
    """(V,) mean absolute error over the samples' mean value, NaN for a vertex without any."""
    return _share(*_summed(views, state, lights, law, True))


def _of_patches(views: list[ViewSamples], state: Vertices, lights: list[DirectionalLights], law: Law, patches: Patches) -> Float:
    """(V,) the same of patches, of samples that hold what surfaces send alone; NaN behind the last patch."""
    shares = np.full(len(state.scale), np.nan)
    shares[: patches.count] = _share(*(patches.summed(values) for values in _summed(views, state, lights, law, False)))
    return shares


def _summed(views: list[ViewSamples], state: Vertices, lights: list[DirectionalLights], law: Law, lit: bool) -> tuple[Tensor, Tensor]:
    """(V,) sums of absolute errors and of samples; not lit: these hold what surfaces send alone."""
    error, level = torch.zeros_like(state.scale), torch.zeros_like(state.scale)
    for batch in batches(views, lights):
        index = batch.vertex
        shaded = evaluate(state.normal[index], state.reflectance[index], batch.towards, batch.lights, law, batch.gathered)
        predicted = shaded.predicted if lit else shaded.rest
        batch.added(error, (batch.weight * (predicted - batch.image).abs()).sum(-1))
        batch.added(level, (batch.weight * batch.image).sum(-1))
    return error, level


def _share(error: Tensor, level: Tensor) -> Float:
    """Errors over levels, both (n,); NaN where there is no level."""
    ratio = (error / level).double().cpu().numpy()
    return np.where(level.cpu().numpy() > 0, ratio, np.nan)
