"""The photometric part of a round of Stage II: lights, law, normals and reflectance on a given mesh.

samples (visibility and shadows traced anew) -> vertices for fixed lights -> lights with the vertices eliminated -> vertices -> normals
of every view's own pixels (pixels.py)
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mvps.bounce import Gather
from mvps.camera import surface_pixel
from mvps.cores import neighbours
from mvps.gleam import Senders, patches_of, senders, shiny
from mvps.joint.blocks import DirectionalLights, Vertices
from mvps.joint.fused import vertex_maps
from mvps.joint.lights import OfLaw, light_step, subset, told_by_shadows, with_mean_one
from mvps.joint.observe import ViewSamples, channel_ratio, observe, with_gathered
from mvps.joint.patches import VERTICES_OF_PATCH, Patches, drawn_patches
from mvps.joint.pixels import all_pixel_normals
from mvps.joint.reflectance import Observed, light_ratios
from mvps.joint.steps import Anchor, confidence, free_reflectance, lambert_albedo, vertex_step, vertex_steps, with_population
from mvps.joint.thinned import ENOUGH_PHOTOGRAPHS, thinned
from mvps.joint.trial import held_out_errors
from mvps.material import Model, Trial, choose, judged
from mvps.memory import room_for
from mvps.mesh import angles_deg, edges, lengths, normalise, vertex_normals
from mvps.scene import Capture, CaptureError, Float, Law, Lights, Material, NormalMap, Surface

LIGHT_VERTICES, TRIAL_VERTICES = 4000, 1000
"""Vertices, in patches, that stand for all when lights are solved, and when components of the model are tried under enough photographs."""

MATERIAL_STEPS, CARRIED_STEPS = 3, 2
LIGHT_STEPS = 3
WEAK_TIE = 0.3
"""Standard deviation, radians, of refined normals from the mesh's in the vertices' own steps: it only speaks where samples do not."""


LIGHT_TIE = 1.0
"""The same while the lights are solved: as far as a normal may be from another that the same camera sees. Patches hold what normals have in
common (patches.py); ties of single normals hold lights to the mesh's errors."""


@dataclass
class State:
    """What one round hands to the next. noise: of dark pixels (noise.py); under: the photographs, perhaps thinned, that `views` are samples
    of, and their lights; lobed: whether lobes take part in inter-reflection (gleam.py); gathers: what sends light on, without lobes and
    with them, once asked for."""

    surface: Surface
    lights: Lights
    maps: tuple[NormalMap, ...]
    law: Law
    model: Model
    noise: float
    vertices: Vertices | None = None
    gathers: dict[bool, Gather] = field(default_factory=dict)
    lobed: bool = False
    views: list[ViewSamples] = field(default_factory=list)
    under: tuple[Capture, Lights] | None = None
    trials: list[Trial] = field(default_factory=list)


@dataclass(frozen=True)
class Task:
    """What a round is to do. free_lights: solve the lights; choose: try the components of the model first; sharpen: and solve the lobes'
    sharpness; thinned: pixels, like vertices, under ENOUGH_LIGHTS lights of each view; half: normals of every other pixel only; device:
    of the tensors."""

    free_lights: bool
    choose: bool
    sharpen: bool
    thinned: bool
    half: bool
    device: torch.device


def _tensor(values: Any, device: torch.device) -> torch.Tensor:
    return torch.tensor(np.asarray(values), dtype=torch.float32, device=device)


def grey_lights(lights: Lights, device: torch.device) -> list[DirectionalLights]:
    """Directions and mean intensities as tensors."""
    return [
        DirectionalLights(_tensor(d, device), _tensor(e.mean(1), device)) for d, e in zip(lights.direction, lights.intensity, strict=True)
    ]


def coloured_lights(grey: list[DirectionalLights], ratios: list[Float], one_rig: bool) -> Lights:
    """Lights from directions, mean intensities and channel ratios (lights, 3)."""
    directions = [normalise(of_view.direction.double().cpu().numpy()) for of_view in grey]
    intensities = [of_view.intensity.double().cpu().numpy()[:, None] * r for of_view, r in zip(grey, ratios, strict=True)]
    return Lights(tuple(directions), tuple(intensities), one_rig)


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
    lambert = lambert_albedo(state.views, _tensor(anchor, device), grey_lights(lights, device)).double().cpu().numpy()
    albedo = np.where(total > 0, albedo, lambert)
    level = float(np.median(albedo[albedo > 0])) if (albedo > 0).any() else 1.0
    reflectance = torch.zeros(len(normal), 1 + len(state.law.sharpness), device=device)
    reflectance[:, 0] = _tensor(albedo, device)
    # No sample is an outlier before the first residuals are known.
    return Vertices(_tensor(normal, device), reflectance, torch.full((len(normal),), level, device=device))


def drawn(views: list[ViewSamples], count: int, generator: np.random.Generator) -> torch.Tensor:
    """Indices of a random part of the vertices that are seen, in order."""
    seen = torch.cat([samples.vertex for samples in views]).unique()
    order = generator.permutation(len(seen))[:count]
    drawn: torch.Tensor = seen[torch.from_numpy(np.sort(order)).to(seen.device)]
    return drawn


def _of_chosen_model(
    state: State, capture: Capture, few: list[ViewSamples], start: Vertices, mesh_normal: Float, patches: Patches, sharpen: bool
) -> Vertices:
    """Puts the components of the reflectance model on trial; the state keeps those that earn their place, and the account. The vertices
    with the lobes that stay."""
    device, law = patches.vertex.device, state.law
    tie = free_reflectance(_tensor(mesh_normal, device), LIGHT_TIE, 1)
    # Light by way of lobes is tried when their weights are known.
    state.lobed = False
    lit = _lit(state, few, capture, state.lights, _senders(state, start))
    errors = _errors(state, capture, lit, start, tie, patches)
    kept, state.trials = choose(state.model, lambda model: np.stack(errors(model)), sharpen)
    state.model = replace(kept, gleam=state.model.gleam)
    state.law = replace(law, sharpness=kept.sharpness, grazing=law.grazing * kept.grazing, bounce=law.bounce * kept.bounce)
    stay = [k for k, trial in enumerate(state.trials[: len(law.sharpness)]) if trial.kept]
    return replace(start, reflectance=start.reflectance[:, torch.tensor([0, *(1 + k for k in stay)], device=device)])


def _errors(
    state: State, capture: Capture, few: list[ViewSamples], start: Vertices, anchor: Anchor, patches: Patches
) -> Callable[[Model], tuple[Float, Float]]:
    """The errors on held-out samples, lit and in shadow, under a model, of the vertices of the first patches."""
    # Of few photographs more vertices: a component stays by how many samples speak for it, not by luck of those drawn.
    more = max(1.0, ENOUGH_PHOTOGRAPHS / sum(samples.image.shape[1] for samples in few))
    patches = patches.first(int(more * TRIAL_VERTICES) // VERTICES_OF_PATCH)
    few, part, tie = subset(few, start, anchor, patches.vertex)
    rotations = [_tensor(view.camera.rotation, patches.vertex.device) for view in capture.views]
    return partial(
        held_out_errors, few, part, grey_lights(state.lights, patches.vertex.device), tie, patches, rotations, state.law, state.noise
    )


def _count_lobes(
    state: State, capture: Capture, few: list[ViewSamples], vertices: Vertices, anchor: Anchor, patches: Patches, choosing: bool
) -> None:
    """Whether lobes take part in inter-reflection, for the state: where they return enough and, while the model is chosen, where that
    predicts held-out samples better."""
    wanted = state.model.gleam
    state.lobed = wanted and shiny(state.law, *_reflectance(vertices))
    name = "inter-reflection of lobes"
    if choosing and state.lobed:
        start = time.perf_counter()
        lit = _lit(state, few, capture, state.lights, _senders(state, vertices))
        errors = _errors(state, capture, lit, vertices, anchor, patches)
        # Shadows do not tell what lobes send from what diffuse surfaces do.
        trial = judged(name, errors(replace(state.model, gleam=False))[0], errors(state.model)[0])
        state.trials.append(replace(trial, seconds=time.perf_counter() - start))
        state.lobed = trial.kept
    elif choosing and wanted:
        state.trials.append(Trial(f"{name}: not tried, they return little", False, 0.0, 0.0, 0.0))
    if choosing:
        state.model = replace(state.model, gleam=state.lobed)
    state.law = replace(state.law, gleam=state.law.gleam * state.lobed)


def of_one_normal(surface: Surface, normal: torch.Tensor, pixel: float, sharpest: float) -> torch.Tensor:
    """(V,) how far a pixel at each vertex shows one normal: 1 / (1 + s d^2), where d radians is what normals (V, 3) change by along a pixel
    and s the sharpness of the object's sharpest lobe, which that spread of normals makes duller by this factor (Toksvig 2005)."""
    pairs = edges(surface)
    # Neighbours within half a pixel share their samples: what they differ by is not seen.
    length = np.maximum(lengths(surface.vertices[pairs[:, 0]] - surface.vertices[pairs[:, 1]]) / pixel, 0.5)
    ends = torch.from_numpy(pairs).to(normal.device)
    change = (normal[ends[:, 0]] - normal[ends[:, 1]]).square().sum(1) / _tensor(length, normal.device) ** 2
    total, count = torch.zeros_like(normal[:, 0]), torch.zeros_like(normal[:, 0])
    for end in ends.T:
        total.index_add_(0, end, change)
        count.index_add_(0, end, torch.ones_like(change))
    return 1 / (1 + sharpest * (total / count.clamp_min(1)))


def _solve_lights(
    state: State,
    capture: Capture,
    few: list[ViewSamples],
    vertices: Vertices,
    anchor: Anchor,
    patches: Patches,
    free_lights: bool,
    of_law: OfLaw,
) -> tuple[Lights, float]:
    """The lights solved on the vertices of some patches, which are solved along; mean turn of the directions in the last step, deg.

    Samples count by how far they are of one normal: along folds that pixels do not resolve, lights would make up for the model's error.
    """
    pixel = surface_pixel(capture, state.surface)
    single = of_one_normal(state.surface, vertices.normal, pixel, max(state.law.sharpness, default=1.0))
    few = [replace(samples, weight=samples.weight * single[samples.vertex]) for samples in few]
    few, part, tie = subset(few, vertices, anchor, patches.vertex)
    rotations = [_tensor(view.camera.rotation, patches.vertex.device) for view in capture.views]
    lights = grey_lights(state.lights, patches.vertex.device)
    before = lights
    for _ in range(LIGHT_STEPS):
        before = lights
        lights, state.law = light_step(few, part, lights, state.law, tie, patches, rotations, state.lights.one_rig, free_lights, of_law)
        lights, part = with_mean_one(lights, part)
        for _ in range(2):
            part = vertex_step(few, part, lights, state.law, tie, patches=patches)
    turned = [angles_deg(a.direction.cpu().numpy(), b.direction.cpu().numpy()) for a, b in zip(before, lights, strict=True)]
    solved = coloured_lights(lights, [channel_ratio(e) for e in state.lights.intensity], state.lights.one_rig)
    return solved, float(np.concatenate(turned).mean())


def _with_bounce(state: State, vertices: Vertices, lights: list[DirectionalLights], free: Anchor) -> tuple[Vertices, OfLaw]:
    """The state's law with the bounce that shadows tell, the vertices with it, and what of the law is left to solve."""
    unknown = (state.model.grazing, state.model.bounce, state.lobed)
    # Of all vertices: few of those drawn for the lights lie deep in shadow.
    law, left = told_by_shadows(state.views, vertices, lights, state.law, unknown, state.noise)
    if left == unknown:
        return vertices, unknown
    # Albedo that was solved without what arrives from other surfaces is too large, and the bounce too small for it.
    vertices = vertex_step(state.views, vertices, lights, law, free, stated=False)
    state.law, left = told_by_shadows(state.views, vertices, lights, law, unknown, state.noise)
    return vertices, left


def _with_colours(state: State, capture: Capture, few: list[ViewSamples], some: torch.Tensor) -> Lights:
    """The lights with colours from some vertices."""
    assert state.vertices is not None
    rows = [samples.of_vertices(some, len(state.vertices.normal)) for samples in few]
    ratios, grey = [channel_ratio(e) for e in state.lights.intensity], grey_lights(state.lights, some.device)
    ratios = light_ratios(Observed(capture, state.surface, rows, state.vertices, grey, state.law), ratios, state.lights.one_rig)
    return coloured_lights(grey, ratios, state.lights.one_rig)


def light_change(a: Lights, b: Lights) -> tuple[float, float]:
    """Mean change of directions (deg) and of intensities (relative)."""
    turned = np.concatenate([angles_deg(p, q) for p, q in zip(a.direction, b.direction, strict=True)])
    before, after = np.concatenate(a.intensity), np.concatenate(b.intensity)
    return float(turned.mean()), float(np.abs(after - before).mean() / before.mean())


def _senders(state: State, vertices: Vertices) -> Senders | None:
    """What sends light on, by the vertices' reflectance; None where inter-reflection is not modelled."""
    if not (state.model.bounce or state.lobed):
        return None
    if state.lobed not in state.gathers:
        of = state.gathers[state.lobed] = patches_of(state.surface, state.lobed)
        room_for(len(state.surface.vertices), len(of.normal) * state.lobed)
    albedo, weight = _reflectance(vertices)
    return senders(state.gathers[state.lobed], state.surface, state.law, albedo, weight if state.lobed else None)


def _lit(state: State, views: list[ViewSamples], of: Capture, lights: Lights, sent: Senders | None) -> list[ViewSamples]:
    """The samples with what other surfaces send to them."""
    return views if sent is None else with_gathered(views, of, state.surface, sent, lights)


def _reflectance(vertices: Vertices) -> tuple[Float, Float]:
    """Albedo (V,) and weights (V, lobes)."""
    values = vertices.reflectance.double().cpu().numpy()
    return values[:, 0], values[:, 1:]


def photometric_round(
    state: State, capture: Capture, task: Task, carried: tuple[Surface, Vertices] | None, generator: np.random.Generator
) -> dict[str, float]:
    """Vertices, lights and the views' photometric stereo on the state's mesh; what changed."""
    device = task.device

    part, part_lights = thinned(capture, state.lights)
    state.views = observe(part, state.surface, part_lights, device, shadows=state.law.shadows)
    mesh_normal = vertex_normals(state.surface)
    vertices = _started(state, part, part_lights, mesh_normal, carried, device)
    seen = torch.cat([samples.vertex for samples in state.views]).unique().cpu().numpy()
    patches = drawn_patches(seen, state.surface, mesh_normal, LIGHT_VERTICES, generator, device)
    few = state.views
    if part is not capture:
        among = np.zeros(len(mesh_normal), bool)
        among[patches.vertex.cpu().numpy()] = True
        few = observe(capture, state.surface, state.lights, device, among, state.law.shadows)

    choosing = task.choose and not state.trials
    if choosing:
        vertices = _of_chosen_model(state, capture, few, vertices, mesh_normal, patches, task.sharpen)
    free = free_reflectance(_tensor(mesh_normal, device), WEAK_TIE, 1 + len(state.law.sharpness))
    before, lights = vertices.normal, grey_lights(part_lights, device)
    vertices = vertex_steps(state.views, vertices, lights, state.law, free, MATERIAL_STEPS if carried is None else CARRIED_STEPS)
    _count_lobes(state, capture, few, vertices, replace(free, sigma=LIGHT_TIE), patches, choosing)
    sent = _senders(state, vertices)
    state.views = _lit(state, state.views, part, part_lights, sent)
    few = state.views if part is capture else _lit(state, few, capture, state.lights, sent)
    free = with_population(vertices, free)
    vertices, unknown = _with_bounce(state, vertices, lights, free)
    tie = replace(free, sigma=LIGHT_TIE)
    solved, light_step = _solve_lights(state, capture, few, vertices, tie, patches, task.free_lights, unknown)
    moved = light_change(state.lights, solved)
    state.lights = solved
    lights = grey_lights(thinned(capture, state.lights)[1], device)
    vertices = vertex_step(state.views, vertices, lights, state.law, free, stated=False)
    last = vertices.normal
    vertices = vertex_step(state.views, vertices, lights, state.law, free)
    state.vertices = vertices
    state.lights = _with_colours(state, capture, few, patches.vertex)
    state.under = thinned(capture, state.lights)
    of_pixels, their_lights = state.under if task.thinned else (capture, state.lights)
    material = material_of(state, grey_albedo(vertices))
    state.maps = all_pixel_normals(of_pixels, state.surface, material, their_lights, _senders(state, vertices), device, task.half)
    turned, settling = (angles_deg(n.cpu().numpy()[seen], vertices.normal.cpu().numpy()[seen]) for n in (before, last))
    assert vertices.sigma is not None
    stated = np.degrees(vertices.sigma.cpu().numpy()[seen])
    return {
        "residual": float(relative_residuals(state.views, vertices).nanmedian()),
        "light_change_deg": moved[0],
        "intensity_change": moved[1],
        "normal_change_deg": float(np.mean(turned)),
        "light_step_deg": light_step,
        "last_step_deg": float(np.median(settling)),
        "stated_error_deg": float(np.median(stated)),
        "grazing": state.law.grazing,
        "bounce": state.law.bounce,
        "gleam": state.law.gleam,
    }


def grey_albedo(vertices: Vertices) -> Float:
    """(V, 3) grey albedo, NaN where no sample says anything."""
    assert vertices.sigma is not None
    albedo = torch.where(vertices.sigma.isfinite(), vertices.reflectance[:, 0], torch.nan)
    return albedo.double().cpu().numpy()[:, None].repeat(3, axis=1)


def relative_residuals(views: list[ViewSamples], vertices: Vertices) -> torch.Tensor:
    """(V,) the residuals' standard deviation over the root mean square of the vertex's samples; NaN without samples."""
    square = torch.zeros_like(vertices.scale)
    weight = torch.zeros_like(vertices.scale)
    for samples in views:
        for part in samples.chunks():
            data = samples.data[part] * samples.weight[part, None]
            square.index_add_(0, samples.vertex[part], (data * samples.image[part] ** 2).sum(1))
            weight.index_add_(0, samples.vertex[part], data.sum(1))
    seen = weight > 0
    level = (square[seen] / weight[seen]).sqrt().clamp_min(1e-12)
    relative = torch.full_like(vertices.scale, torch.nan)
    relative[seen] = vertices.scale[seen] / level
    return relative


def material_of(state: State, albedo: Float) -> Material:
    """The material on all vertices; where no view sees one it takes the nearest seen vertex's reflectance and the mesh's normal."""
    assert state.vertices is not None
    vertices, known = state.vertices, np.isfinite(albedo).all(1)
    if not known.any():
        raise CaptureError("lights: wanted some that reach the object, given none under which a view sees it lit; check their directions")
    nearest = np.arange(len(albedo))
    nearest[~known] = np.flatnonzero(known)[neighbours(cKDTree(state.surface.vertices[known]), state.surface.vertices[~known])[1]]
    normal = normalise(vertices.normal.double().cpu().numpy())
    normal[~known] = vertex_normals(state.surface)[~known]
    weight = vertices.reflectance[:, 1:].double().cpu().numpy()[nearest]
    certain = confidence(vertices).double().cpu().numpy()
    certain, law = np.where(known, certain, 0), state.law
    return Material(
        normal, albedo[nearest], weight, np.array(law.sharpness), certain, law.grazing, law.bounce, law.microfacet, law.shadows, law.gleam
    )
