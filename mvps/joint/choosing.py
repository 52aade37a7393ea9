"""The components of the reflectance model on trial (material.py, trial.py), for a round's state."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from mvps.gleam import shiny
from mvps.joint.blocks import Vertices
from mvps.joint.grey import grey_lights, tensor32
from mvps.joint.lighting import LIGHT_TIE
from mvps.joint.lights import subset
from mvps.joint.observe import ViewSamples
from mvps.joint.patches import VERTICES_OF_PATCH, Patches
from mvps.joint.state import State, lit_by, reflectance_of, senders_of
from mvps.joint.steps import Anchor, free_reflectance
from mvps.joint.thinned import ENOUGH_PHOTOGRAPHS
from mvps.joint.trial import held_out_errors
from mvps.material import Model, Trial, choose, judged
from mvps.scene import Capture, Float

TRIAL_VERTICES = 1000
"""Vertices, in patches, that stand for all when components are tried under enough photographs."""


def of_chosen_model(
    state: State, capture: Capture, few: list[ViewSamples], start: Vertices, mesh_normal: Float, patches: Patches, sharpen: bool
) -> Vertices:
    """Puts the components of the reflectance model on trial; the state keeps those that earn their place, and the account. The vertices
    with the lobes that stay."""
    device, law = patches.vertex.device, state.law
    tie = free_reflectance(tensor32(mesh_normal, device), LIGHT_TIE, 1)
    # Light by way of lobes is tried when their weights are known.
    state.lobed = False
    lit = lit_by(state, few, capture, state.lights, senders_of(state, start))
    errors = errors_of(state, capture, lit, start, tie, patches)
    kept, state.trials = choose(state.model, lambda model: np.stack(errors(model)), sharpen)
    state.model = replace(kept, gleam=state.model.gleam)
    state.law = replace(law, sharpness=kept.sharpness, grazing=law.grazing * kept.grazing, bounce=law.bounce * kept.bounce)
    stay = [k for k, trial in enumerate(state.trials[: len(law.sharpness)]) if trial.kept]
    return replace(start, reflectance=start.reflectance[:, torch.tensor([0, *(1 + k for k in stay)], device=device)])


def errors_of(
    state: State, capture: Capture, few: list[ViewSamples], start: Vertices, anchor: Anchor, patches: Patches
) -> Callable[[Model], tuple[Float, Float]]:
    """The errors on held-out samples, lit and in shadow, under a model, of the vertices of the first patches."""
    # Of few photographs more vertices: a component stays by how many samples speak for it, not by luck of those drawn.
    more = max(1.0, ENOUGH_PHOTOGRAPHS / sum(samples.image.shape[1] for samples in few))
    patches = patches.first(int(more * TRIAL_VERTICES) // VERTICES_OF_PATCH)
    few, part, tie = subset(few, start, anchor, patches.vertex)
    rotations = [tensor32(view.camera.rotation, patches.vertex.device) for view in capture.views]
    return partial(
        held_out_errors, few, part, grey_lights(state.lights, patches.vertex.device), tie, patches, rotations, state.law, state.noise
    )


def count_lobes(
    state: State, capture: Capture, few: list[ViewSamples], vertices: Vertices, anchor: Anchor, patches: Patches, choosing: bool
) -> None:
    """Whether lobes take part in inter-reflection, for the state: where they return enough and, while the model is chosen, where that
    predicts held-out samples better."""
    wanted = state.model.gleam
    state.lobed = wanted and shiny(state.law, *reflectance_of(vertices))
    name = "inter-reflection of lobes"
    if choosing and state.lobed:
        start = time.perf_counter()
        lit = lit_by(state, few, capture, state.lights, senders_of(state, vertices))
        errors = errors_of(state, capture, lit, vertices, anchor, patches)
        # Shadows do not tell what lobes send from what diffuse surfaces do.
        trial = judged(name, errors(replace(state.model, gleam=False))[0], errors(state.model)[0])
        state.trials.append(replace(trial, seconds=time.perf_counter() - start))
        state.lobed = trial.kept
    elif choosing and wanted:
        state.trials.append(Trial(f"{name}: not tried, they return little", False, 0.0, 0.0, 0.0))
    if choosing:
        state.model = replace(state.model, gleam=state.lobed)
    state.law = replace(state.law, gleam=state.law.gleam * state.lobed)
