"""A round's lights and law: solved on the vertices of some patches (lights.py), and what shadows tell of the law (shadowed.py)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from mvps.camera import rig_frame, surface_pixel
from mvps.joint.blocks import DirectionalLights, Vertices
from mvps.joint.colours import light_ratios
from mvps.joint.grey import coloured_lights, grey_lights, tensor32
from mvps.joint.lights import OfLaw, light_step, subset, told_by_shadows, told_of_strengths, with_mean_one
from mvps.joint.observe import ViewSamples, channel_ratio
from mvps.joint.patches import Patches
from mvps.joint.reflectance import Observed
from mvps.joint.state import State, relative_residuals
from mvps.joint.steps import Anchor, possible, vertex_step
from mvps.joint.strengths import Strengths, Told, as_bright, borne_out, needed, strengths_in, strengths_of, unknown_in
from mvps.memory import room_for, solved_together
from mvps.mesh import angles_deg, edges, lengths
from mvps.scene import Capture, Law, Lights, Surface

LIGHT_VERTICES = 4000
"""Vertices, in patches, that stand for all when lights are solved."""

FEWER_VERTICES = 2000
"""The same on the way, under photographs that abound."""

MOST_TOGETHER = 640
"""Twenty views' 32: solved for together with LIGHT_VERTICES they take a fifth of a GB (memory.py), and a second and a half a round."""

LIGHT_STEPS = 3
"""Gauss-Newton steps a round: near a minimum steps at least halve (refine.py)."""

LIGHT_TIE = 1.0
"""Standard deviation, radians, of refined normals from the mesh's while lights are solved: as far as a normal may be from another that the
same camera sees. Patches hold what normals have in common (patches.py); ties of single normals hold lights to the mesh's errors."""


def drawn(views: list[ViewSamples], count: int, generator: np.random.Generator) -> torch.Tensor:
    """Indices of a random part of the vertices that are seen, in order."""
    seen = torch.cat([samples.vertex for samples in views]).unique()
    order = generator.permutation(len(seen))[:count]
    drawn: torch.Tensor = seen[torch.from_numpy(np.sort(order)).to(seen.device)]
    return drawn


def of_one_normal(surface: Surface, normal: torch.Tensor, pixel: float, sharpest: float) -> torch.Tensor:
    """(V,) how far a pixel at each vertex shows one normal: 1 / (1 + s d^2), where d radians is what normals (V, 3) change by along a pixel
    and s the sharpness of the object's sharpest lobe, which that spread of normals makes duller by this factor (Toksvig 2005)."""
    pairs = edges(surface)
    # Neighbours within half a pixel share their samples: what they differ by is not seen.
    length = np.maximum(lengths(surface.vertices[pairs[:, 0]] - surface.vertices[pairs[:, 1]]) / pixel, 0.5)
    ends = torch.tensor(pairs, device=normal.device)
    change = (normal[ends[:, 0]] - normal[ends[:, 1]]).square().sum(1) / tensor32(length, normal.device) ** 2
    total, count = torch.zeros_like(normal[:, 0]), torch.zeros_like(normal[:, 0])
    for end in ends.T:
        total.index_add_(0, end, change)
        count.index_add_(0, end, torch.ones_like(change))
    return 1 / (1 + sharpest * (total / count.clamp_min(1)))


def vertices_for(lights: Lights, free_lights: bool, eased: bool) -> int:
    """How many vertices, in patches, stand for all in a round that solves the lights, or the law alone. Of lights that a view has to itself
    only vertices that it sees tell: as many times more as there are views, while all their lights together are not too many."""
    some = FEWER_VERTICES if eased else LIGHT_VERTICES
    if lights.one_rig or not free_lights:
        return some
    return some * max(1, min(len(lights.direction), MOST_TOGETHER // sum(map(len, lights.direction))))


class _Solved(NamedTuple):
    """Lights before the last step, lights, law, vertices and strengths after it."""

    before: list[DirectionalLights]
    lights: list[DirectionalLights]
    law: Law
    part: Vertices
    strengths: Strengths | None


def _unexplained(views: list[ViewSamples], vertices: Vertices) -> float:
    """What is left of the vertices' samples, in the median, as a share of their signal."""
    return float(relative_residuals(views, vertices).nanmedian())


def solved_lights(
    state: State,
    capture: Capture,
    few: list[ViewSamples],
    vertices: Vertices,
    anchor: Anchor,
    patches: Patches,
    free_lights: bool,
    of_law: OfLaw,
    least: float | None,
) -> tuple[Lights, float]:
    """The lights solved on the vertices of some patches, which are solved along; mean turn of the directions in the last step, deg.
    least: of `needed`, by which photographs under one rig get strengths that are solved as well, where these explain what they should.
    None: no more than they have.

    Samples count by how far they are of one normal: along folds that pixels do not resolve, lights would make up for the model's error.
    """
    pixel = surface_pixel(capture, state.surface)
    single = of_one_normal(state.surface, vertices.normal, pixel, max(state.law.sharpness, default=1.0))
    few = [replace(samples, weight=samples.weight * single[samples.vertex]) for samples in few]
    few, part, tie = subset(few, vertices, replace(anchor, sigma=LIGHT_TIE), patches.vertex)
    rotations = [tensor32(rig_frame(state.lights, view.camera), patches.vertex.device) for view in capture.views]
    lights = grey_lights(state.lights, patches.vertex.device)
    rig = state.lights.one_rig
    known = strengths_of(state.lights)
    strengths = None if known is None else strengths_in(lights, unknown_in(known))

    def stepped(so_far: _Solved, steps: int) -> _Solved:
        before, lights, law, part, strengths = so_far
        for _ in range(steps):
            before = lights
            lights, law = light_step(few, part, lights, law, tie, patches, rotations, rig, free_lights, of_law, strengths)
            strengths = strengths and strengths_in(lights, strengths.unknown)
            lights, part = with_mean_one(lights, part)
            for _ in range(2):
                part = vertex_step(few, part, lights, law, tie, patches=patches)
        return _Solved(before, lights, law, part, strengths)

    def told_of(solved: _Solved) -> Told:
        so_far = solved.strengths or as_bright(solved.lights)
        return told_of_strengths(few, solved.part, solved.lights, solved.law, tie, patches, rotations, of_law, so_far)

    found = stepped(_Solved(lights, lights, state.law, part, strengths), LIGHT_STEPS)
    told = told_of(found) if least is not None and free_lights and rig else None
    while told is not None and least is not None:
        unknown = needed(told, len(found.lights[0].intensity), least)
        if unknown <= (found.strengths.unknown if found.strengths else 0):
            break
        together = state.together._replace(lights=solved_together(state.lights, unknown * len(lights)))
        room_for(len(state.surface.vertices), together=together)
        # Lights that were solved as if all were as bright are solved again, from farther off than a round's steps begin.
        trial = stepped(found._replace(strengths=replace(found.strengths or as_bright(found.lights), unknown=unknown)), 2 * LIGHT_STEPS)
        then = told_of(trial)
        assert trial.strengths is not None
        if not borne_out(told, then, trial.strengths, *(_unexplained(few, one.part) for one in (found, trial))):
            break
        found, told, state.together = trial, then, together
    before, lights, state.law = found.before, found.lights, found.law
    turned = [angles_deg(a.direction.cpu().numpy(), b.direction.cpu().numpy()) for a, b in zip(before, lights, strict=True)]
    solved = coloured_lights(lights, [channel_ratio(e) for e in state.lights.intensity], state.lights)
    return solved, float(np.concatenate(turned).mean())


def with_bounce(state: State, vertices: Vertices, lights: list[DirectionalLights], free: Anchor) -> tuple[Vertices, OfLaw]:
    """The state's law with the bounce that shadows tell, the vertices with it, and what of the law is left to solve."""
    unknown = (state.model.grazing, state.model.bounce, state.lobed)
    # Of all vertices: few of those drawn for the lights lie deep in shadow.
    law, left = told_by_shadows(state.views, vertices, lights, state.law, unknown, state.noise)
    if left == unknown:
        return vertices, unknown
    # Albedo that was solved without what arrives from other surfaces is too large, and the bounce too small for it.
    vertices = possible(vertex_step(state.views, vertices, lights, law, free, stated=False), law)
    state.law, left = told_by_shadows(state.views, vertices, lights, law, unknown, state.noise)
    return vertices, left


def with_colours(state: State, capture: Capture, few: list[ViewSamples], some: torch.Tensor) -> Lights:
    """The lights with colours from some vertices."""
    assert state.vertices is not None
    rows = [samples.of_vertices(some, len(state.vertices.normal)) for samples in few]
    ratios, grey = [channel_ratio(e) for e in state.lights.intensity], grey_lights(state.lights, some.device)
    ratios = light_ratios(Observed(capture, state.surface, rows, state.vertices, grey, state.law), ratios, state.lights.one_rig)
    return coloured_lights(grey, ratios, state.lights)
