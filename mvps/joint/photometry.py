"""The photometric part of a round of Stage II: lights, law, normals and reflectance on a given mesh.

samples (visibility and shadows traced anew, with what surfaces send each other by what the round before solved) -> vertices for fixed
lights -> lights with the vertices eliminated -> vertices -> normals of every view's own pixels (pixels.py)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from mvps.cores import neighbours
from mvps.joint.blocks import Vertices
from mvps.joint.choosing import count_lobes, of_chosen_model
from mvps.joint.fused import vertex_maps
from mvps.joint.grey import grey_lights, tensor32
from mvps.joint.lighting import LIGHT_TIE, solved_lights, vertices_for, with_bounce, with_colours
from mvps.joint.observe import ViewSamples, observe
from mvps.joint.patches import drawn_patches
from mvps.joint.pixels import all_pixel_normals
from mvps.joint.state import State, grey_albedo, lit_by, material_of, relative_residuals, senders_of
from mvps.joint.steps import free_reflectance, lambert_albedo, possible, vertex_step, vertex_steps, with_population
from mvps.joint.strengths import MUCH, SOME
from mvps.joint.thinned import thinned
from mvps.material import POOR_FIT
from mvps.mesh import angles_deg, vertex_normals
from mvps.scene import Capture, CaptureError, Lights, Surface

MATERIAL_STEPS, CARRIED_STEPS = 3, 2

WEAK_TIE = 0.3
"""Standard deviation, radians, of refined normals from the mesh's in the vertices' own steps: it only speaks where samples do not."""


@dataclass(frozen=True)
class Task:
    """What a round is to do. free_lights: solve the lights; free_colours: and their colours; choose: try the components of the model first;
    sharpen: and solve the lobes' sharpness; thinned: pixels, like vertices, under ENOUGH_LIGHTS lights of each view; half: normals of every
    other pixel only; device: of the tensors; eased: lights are solved on fewer vertices."""

    free_lights: bool
    free_colours: bool
    choose: bool
    sharpen: bool
    thinned: bool
    half: bool
    device: torch.device
    eased: bool = False


def _started(
    state: State, capture: Capture, lights: Lights, anchor: NDArray[Any], carried: tuple[Surface, Vertices] | None, device: torch.device
) -> Vertices:
    """Vertices of the new mesh: from the nearest vertex of the last round's, or from the views' photometric stereo."""
    if carried is not None:
        nearest = torch.from_numpy(neighbours(cKDTree(carried[0].vertices), state.surface.vertices)[1]).to(device)
        old = carried[1]
        return Vertices(old.normal[nearest], old.reflectance[nearest], old.scale[nearest])
    seen = [(s.vertex.cpu().numpy(), s.weight.cpu().numpy()) for s in state.views]
    normal, albedo, total = vertex_maps(capture, state.surface, state.maps, seen)
    normal = np.where(total[:, None] > 0, normal, anchor)
    # Under fewer than three lights a view's photometric stereo says nothing: albedo of Lambert's law under the mesh's normals.
    lambert = lambert_albedo(state.views, tensor32(anchor, device), grey_lights(lights, device)).double().cpu().numpy()
    albedo = np.where(total > 0, albedo, lambert)
    level = float(np.median(albedo[albedo > 0])) if (albedo > 0).any() else 1.0
    reflectance = torch.zeros(len(normal), 1 + len(state.law.sharpness), device=device)
    reflectance[:, 0] = tensor32(albedo, device)
    # No sample is an outlier before the first residuals are known.
    return Vertices(tensor32(normal, device), reflectance, torch.full((len(normal),), level, device=device))


def _light_change(a: Lights, b: Lights) -> tuple[float, float]:
    """Mean change of directions (deg) and of intensities (relative)."""
    turned = np.concatenate([angles_deg(p, q) for p, q in zip(a.direction, b.direction, strict=True)])
    before, after = np.concatenate(a.intensity), np.concatenate(b.intensity)
    return float(turned.mean()), float(np.abs(after - before).mean() / before.mean())


def _lit(state: State, capture: Capture, few: list[ViewSamples], part: tuple[Capture, Lights], vertices: Vertices) -> list[ViewSamples]:
    """`few` of the capture, and the state's views of a part of it, with what the vertices' surfaces send to them."""
    sent = senders_of(state, vertices)
    state.views = lit_by(state, state.views, *part, sent)
    return state.views if part[0] is capture else lit_by(state, few, capture, state.lights, sent)


def _least(state: State, vertices: Vertices, first: bool, last: bool) -> float | None:
    """What strengths of views have to explain (`needed`) in a round, the first one or one of the last; None: none is looked for, for what
    differs was found before."""
    if first or float(relative_residuals(state.views, vertices).nanmedian()) > POOR_FIT:
        return MUCH
    return None if last else SOME


def _seen_anew(
    state: State, capture: Capture, carried: tuple[Surface, Vertices] | None, device: torch.device
) -> tuple[tuple[Capture, Lights], Vertices, NDArray[Any]]:
    """The part of the capture that tells vertices, with its lights, of which the state gets its samples on its mesh; its vertices to begin
    with; those that are seen."""
    part, lights = thinned(capture, state.lights)
    state.gathers = {}
    state.views = observe(part, state.surface, lights, device, shadows=state.law.shadows)
    vertices = _started(state, part, lights, vertex_normals(state.surface), carried, device)
    seen = torch.cat([samples.vertex for samples in state.views]).unique().cpu().numpy()
    if not len(seen):
        raise CaptureError(
            f"{capture.name}: wanted a view that sees the object a pixel inside of its mask, given none; photograph thin objects from"
            " nearer, and check masks and poses"
        )
    return (part, lights), vertices, seen


def _told(state: State, before: Tensor, last: Tensor, seen: NDArray[Any]) -> dict[str, float]:
    """What a round came to: of the vertices that are seen, whose normals (V, 3) were `before`, and `last` before the last step."""
    vertices = state.vertices
    assert vertices is not None and vertices.sigma is not None
    turned, settling = (angles_deg(n.cpu().numpy()[seen], vertices.normal.cpu().numpy()[seen]) for n in (before, last))
    stated = np.degrees(vertices.sigma.cpu().numpy()[seen]).clip(max=90.0)  # infinite where no sample counts, which may be most
    return {
        "residual": float(relative_residuals(state.views, vertices).nanmedian()),
        "normal_change_deg": float(np.mean(turned)),
        "last_step_deg": float(np.median(settling)),
        "stated_error_deg": float(np.median(stated)),
        "grazing": state.law.grazing,
        "bounce": state.law.bounce,
        "gleam": state.law.gleam,
    }


def _vertices_again(
    state: State, capture: Capture, carried: tuple[Surface, Vertices] | None, device: torch.device, before: dict[str, float]
) -> dict[str, float]:
    """Vertices on the state's mesh, which a round just moved by little: lights, law and the views' normals stay. What changed; before: in
    that round."""
    under, vertices, seen = _seen_anew(state, capture, carried, device)
    lights = grey_lights(under[1], device)
    free = free_reflectance(tensor32(vertex_normals(state.surface), device), WEAK_TIE, 1 + len(state.law.sharpness))
    start = vertices.normal
    state.views = lit_by(state, state.views, *under, senders_of(state, vertices))
    vertices = vertex_steps(state.views, vertices, lights, state.law, free, CARRIED_STEPS)
    last, free = vertices.normal, with_population(vertices, free)
    state.vertices = possible(vertex_step(state.views, vertices, lights, state.law, free), state.law)
    state.under = under
    # Whether lights have settled is what that round's last step says.
    settled = {name: before[name] for name in ("lights_moving_deg", "light_step_deg")}
    return {**_told(state, start, last, seen), **settled, "light_change_deg": 0.0, "intensity_change": 0.0}


def photometric_round(
    state: State,
    capture: Capture,
    task: Task,
    carried: tuple[Surface, Vertices] | None,
    generator: np.random.Generator,
    again: dict[str, float] | None = None,
) -> dict[str, float]:
    """Vertices, lights and the views' photometric stereo on the state's mesh; what changed. First lights do not count as moving. again:
    what the same changed on this mesh, before it was moved a little; then vertices alone are solved."""
    device, mesh_normal = task.device, vertex_normals(state.surface)
    if again is not None:
        return _vertices_again(state, capture, carried, device, again)
    (part, part_lights), vertices, seen = _seen_anew(state, capture, carried, device)
    some = vertices_for(state.lights, task.free_lights, task.eased)
    patches = drawn_patches(seen, state.surface, mesh_normal, some, generator, device)
    few = state.views
    if part is not capture:
        among = np.zeros(len(mesh_normal), bool)
        among[patches.vertex.cpu().numpy()] = True
        few = observe(capture, state.surface, state.lights, device, among, state.law.shadows)
    choosing = task.choose and not state.trials
    if choosing:
        vertices = of_chosen_model(state, capture, few, vertices, mesh_normal, patches, task.sharpen)
    free = free_reflectance(tensor32(mesh_normal, device), WEAK_TIE, 1 + len(state.law.sharpness))
    before, lights = vertices.normal, grey_lights(part_lights, device)
    relit = partial(_lit, state, capture, few, (part, part_lights))
    # Albedo that is solved as if nothing arrived from other surfaces is too large, and so is what it sends.
    if carried is not None:
        few = relit(vertices)
    vertices = vertex_steps(state.views, vertices, lights, state.law, free, MATERIAL_STEPS if carried is None else CARRIED_STEPS)
    lobed = state.lobed
    count_lobes(state, capture, few, vertices, replace(free, sigma=LIGHT_TIE), patches, choosing)
    if carried is None or state.lobed != lobed:
        few = relit(vertices)
    free = with_population(vertices, free)
    vertices, unknown = with_bounce(state, vertices, lights, free)
    # A first round's albedo was so solved: once more, under what it tells now. Where lobes take part shadows tell nothing.
    if carried is None and not state.lobed:
        few = relit(vertices)
        vertices, unknown = with_bounce(state, vertices, lights, free)
    least = _least(state, vertices, carried is None, task.choose)
    solved, light_step = solved_lights(state, capture, few, vertices, free, patches, task.free_lights, unknown, least)
    moved, state.lights = _light_change(state.lights, solved), solved
    lights = grey_lights(thinned(capture, state.lights)[1], device)
    vertices = vertex_step(state.views, vertices, lights, state.law, free, stated=False)
    last = vertices.normal
    vertices = possible(vertex_step(state.views, vertices, lights, state.law, free), state.law)
    state.vertices = vertices
    if task.free_colours:
        state.lights = with_colours(state, capture, few, patches.vertex)
    state.under = thinned(capture, state.lights)
    of_pixels, their_lights = state.under if task.thinned else (capture, state.lights)
    material = material_of(state, grey_albedo(vertices))
    state.maps = all_pixel_normals(of_pixels, state.surface, material, their_lights, senders_of(state, vertices), device, task.half)
    return {
        **_told(state, before, last, seen),
        "light_change_deg": moved[0],
        "lights_moving_deg": 0.0 if carried is None else moved[0],
        "intensity_change": moved[1],
        "light_step_deg": light_step,
    }
