"""Stage II: lights, normals, reflectance and vertices, in rounds on an ever finer mesh.

A round:  remesh -> samples (visibility and shadows traced anew) -> vertices for fixed lights -> lights with the vertices eliminated
-> vertices -> normals of every view's own pixels (pixels.py) -> agreement of views -> fused positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mvps.bounce import PATCH_EDGES, Gather, Sources, gather, sources_on
from mvps.camera import pixel_footprint
from mvps.joint.blocks import DirectionalLights, Vertices
from mvps.joint.fused import face_targets, vertex_maps
from mvps.joint.lights import light_step, subset, with_mean_one
from mvps.joint.observe import ViewSamples, channel_ratio, observe, visible_in, with_gathered
from mvps.joint.pixels import OWN_LIGHTS, all_pixel_normals
from mvps.joint.reflectance import colours
from mvps.joint.steps import Anchor, confidence, free_reflectance, lambert_albedo, vertex_step, with_population
from mvps.joint.trial import held_out_errors
from mvps.joint.vertices import Agreement, agreement, fuse
from mvps.material import Model, Trial, candidates, choose
from mvps.mesh import edges, isotropic_remesh, mean_edge_length, normalise, split_edges, vertex_normals
from mvps.scene import Capture, CaptureError, Float, Law, Lights, Material, NormalMap, Surface

SHARPNESS = (8.0, 32.0, 128.0)
"""Lobes' sharpness: half-value widths of 24, 12 and 6 degrees of the half vector, roughness about 0.7, 0.5 and 0.35 of a GGX lobe."""

NORMAL_SIGMA = 0.03
"""Standard deviation of the views' normals, radians, in the fusion with positions: half of all pixels are better than 1 to 2 degrees."""

POSITION_FLOOR_PIXELS = 0.1
"""Smallest standard deviation of an agreed position: neighbouring costs share their pixels, so their agreement looks better than it is."""

COST_SMOOTHINGS = 2
FUSIONS = 2
TRIAL_VERTICES = 1000
MATERIAL_STEPS, CARRIED_STEPS = 3, 2
LIGHT_STEPS = 3
WEAK_TIE = 0.3
"""Standard deviation, radians, of refined normals from the mesh's in the vertices' own steps: it only speaks where samples do not."""

LIGHT_TIE = 0.01
"""The same while the lights are solved. What all vertices' normals have in common is known from the mesh far better than from images, whose
model is wrong alike for all of them; noise of single vertices averages out."""

STILL_DEG = 0.25
"""Mean change of normals in the last Gauss-Newton step, and of lights in the last round, below which they have settled: Gauss-Newton at
least halves its steps near a minimum, so that all further steps together are no longer than this."""

POOR_FIT = 0.1
"""Relative residual above which the model is said to fit badly: albedo and lobes leave 1 to 4 % on matte and glossy objects."""


@dataclass(frozen=True)
class RoundSettings:
    """One round. edge: mesh edges in pixels; reach: sweep of offsets in pixels, +-; step: of the sweep, pixels; photometric: solve
    lights and vertices' normals and reflectance, or only fuse the views' normals; crease: radians that the normal may turn along an edge
    before it is split."""

    edge: float
    reach: float
    step: float
    photometric: bool = True
    crease: float = np.inf

    def offsets(self) -> Float:
        """Offsets of the sweep, pixels."""
        return np.arange(-self.reach, self.reach + self.step / 2, self.step)


@dataclass(frozen=True)
class RefineSettings:
    """rounds: in order; light_vertices: vertices that stand for all when the lights are solved; free_lights: solve the lights; choose: the
    components of the reflectance model by held-out lights, in the first round."""

    rounds: tuple[RoundSettings, ...]
    light_vertices: int = 2000
    free_lights: bool = True
    choose: bool = False


@dataclass(frozen=True, eq=False)
class Refined:
    """surface, material and lights; maps: per view its pixels' normals; per round what changed; status in words, and a sentence."""

    surface: Surface
    material: Material
    lights: Lights
    maps: tuple[NormalMap, ...]
    law: Law
    trials: list[Trial]
    rounds: list[dict[str, float]]
    status: str
    text: str


@dataclass
class _State:
    """What one round hands to the next."""

    surface: Surface
    lights: Lights
    maps: tuple[NormalMap, ...]
    law: Law
    vertices: Vertices | None = None
    coarse: Gather | None = None
    views: list[ViewSamples] = field(default_factory=list)
    model: Model = field(default_factory=lambda: Model(SHARPNESS, True, True))
    trials: list[Trial] = field(default_factory=list)


def chosen_device(device: str) -> str:
    """ "cpu" or "cuda" for auto, cpu or cuda; CaptureError where cuda is asked for and not there."""
    if device == "cuda" and not torch.cuda.is_available():
        raise CaptureError("--device: wanted a CUDA device, given a machine on which torch finds none; use --device cpu or auto")
    return "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"


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
    state: _State, capture: Capture, anchor: NDArray[Any], carried: tuple[Surface, Vertices] | None, device: torch.device
) -> Vertices:
    """Vertices of the new mesh: from the nearest vertex of the last round's, or from the views' photometric stereo."""
    if carried is not None:
        nearest = torch.from_numpy(cKDTree(carried[0].vertices).query(state.surface.vertices)[1])
        old = carried[1]
        return Vertices(old.normal[nearest], old.reflectance[nearest], old.scale[nearest])
    seen = [(s.vertex.cpu().numpy(), s.weight.cpu().numpy()) for s in state.views]
    normal, albedo, total = vertex_maps(capture, state.surface, state.maps, seen)
    normal = np.where(total[:, None] > 0, normal, anchor)
    # Under fewer than three lights a view's photometric stereo says nothing: albedo of Lambert's law under the mesh's normals.
    lambert = lambert_albedo(state.views, _tensor(anchor, device), grey_lights(state.lights, device)).double().cpu().numpy()
    albedo = np.where(total > 0, albedo, lambert)
    level = float(np.median(albedo[albedo > 0])) if (albedo > 0).any() else 1.0
    reflectance = torch.zeros(len(normal), 1 + len(state.law.sharpness), device=device)
    reflectance[:, 0] = _tensor(albedo, device)
    # No sample is an outlier before the first residuals are known.
    return Vertices(_tensor(normal, device), reflectance, torch.full((len(normal),), level, device=device))


def _some(
    views: list[ViewSamples], vertices: Vertices, anchor: Anchor, count: int, generator: np.random.Generator
) -> tuple[list[ViewSamples], Vertices, Anchor]:
    """The problem on a random part of the vertices that are seen."""
    seen = torch.cat([samples.vertex for samples in views]).unique()
    order = generator.permutation(len(seen))[:count]
    return subset(views, vertices, anchor, seen[torch.from_numpy(np.sort(order)).to(seen.device)])


def _choose_model(
    state: _State, capture: Capture, start: Vertices, anchor: Anchor, generator: np.random.Generator, device: torch.device
) -> None:
    """Puts the components of the reflectance model on trial; the state keeps those that earn their place, and the account."""
    few, part, tie = _some(state.views, start, anchor, TRIAL_VERTICES, generator)
    rotations = [_tensor(view.camera.rotation, device) for view in capture.views]
    lights = grey_lights(state.lights, device)
    state.model, state.trials = choose(candidates(SHARPNESS), lambda model: held_out_errors(few, part, lights, tie, rotations, model))
    law = state.law
    state.law = Law(state.model.sharpness, law.grazing * state.model.grazing, law.bounce * state.model.bounce)


def _solve_lights(
    state: _State,
    vertices: Vertices,
    anchor: Anchor,
    capture: Capture,
    settings: RefineSettings,
    generator: np.random.Generator,
    device: torch.device,
) -> Lights:
    """The lights solved on a random part of the vertices, which are solved along."""
    few, part, tie = _some(state.views, vertices, anchor, settings.light_vertices, generator)
    rotations = [_tensor(view.camera.rotation, device) for view in capture.views]
    lights = grey_lights(state.lights, device)
    free = (settings.free_lights, state.model.grazing, state.model.bounce)
    for _ in range(LIGHT_STEPS):
        lights, state.law = light_step(few, part, lights, state.law, tie, rotations, state.lights.one_rig, free)
        lights, part = with_mean_one(lights, part)
        for _ in range(2):
            part = vertex_step(few, part, lights, state.law, tie)
    return coloured_lights(lights, [channel_ratio(e) for e in state.lights.intensity], state.lights.one_rig)


def _angle_deg(a: Any, b: Any) -> Float:
    degrees: Float = np.degrees(np.arccos(np.clip((np.asarray(a) * np.asarray(b)).sum(-1), -1, 1)))
    return degrees


def light_change(a: Lights, b: Lights) -> tuple[float, float]:
    """Mean change of directions (deg) and of intensities (relative)."""
    turned = np.concatenate([_angle_deg(p, q) for p, q in zip(a.direction, b.direction, strict=True)])
    before, after = np.concatenate(a.intensity), np.concatenate(b.intensity)
    return float(turned.mean()), float(np.abs(after - before).mean() / before.mean())


def _sources(state: _State, vertices: Vertices) -> Sources | None:
    """The patches that send light, with the vertices' albedo; None where inter-reflection is not modelled."""
    if state.coarse is None or not state.model.bounce:
        return None
    return sources_on(state.coarse, state.surface, vertices.reflectance[:, 0].double().cpu().numpy())


def _gathered(state: _State, vertices: Vertices) -> list[ViewSamples]:
    """The samples with what other surfaces send to them."""
    sources = _sources(state, vertices)
    return state.views if sources is None else with_gathered(state.views, state.surface, sources, state.law.bounce, state.lights)


def _photometric_round(
    state: _State,
    capture: Capture,
    settings: RefineSettings,
    carried: tuple[Surface, Vertices] | None,
    generator: np.random.Generator,
    device: torch.device,
) -> dict[str, float]:
    """Vertices, lights and the views' photometric stereo on the state's mesh; what changed."""
    state.views = observe(capture, state.surface, state.lights, device)
    mesh_normal = vertex_normals(state.surface)
    vertices = _started(state, capture, mesh_normal, carried, device)
    lights = grey_lights(state.lights, device)
    if state.coarse is None:
        state.coarse = gather(state.surface, PATCH_EDGES * mean_edge_length(state.surface))
    if settings.choose and not state.trials:
        tie = free_reflectance(_tensor(mesh_normal, device), LIGHT_TIE, 1)
        state.views = _gathered(state, vertices)
        _choose_model(state, capture, vertices, tie, generator, device)
        vertices = replace(vertices, reflectance=vertices.reflectance[:, : 1 + len(state.law.sharpness)])
    free = free_reflectance(_tensor(mesh_normal, device), WEAK_TIE, 1 + len(state.law.sharpness))
    before = vertices.normal
    for _ in range(MATERIAL_STEPS if carried is None else CARRIED_STEPS):
        vertices = vertex_step(state.views, vertices, lights, state.law, free)
    if state.model.bounce:
        state.views = _gathered(state, vertices)
    free = with_population(state.views, vertices, lights, state.law, free)
    solved = _solve_lights(state, vertices, replace(free, sigma=LIGHT_TIE), capture, settings, generator, device)
    moved = light_change(state.lights, solved)
    state.lights = solved
    lights = grey_lights(solved, device)
    for _ in range(2):
        last = vertices.normal
        vertices = vertex_step(state.views, vertices, lights, state.law, free)
    state.vertices = vertices
    grey = vertices.reflectance[:, :1].double().cpu().numpy().repeat(3, axis=1)
    state.maps = all_pixel_normals(capture, state.surface, _material(state, grey), state.lights, _sources(state, vertices))
    seen = torch.cat([s.vertex for s in state.views]).unique().cpu().numpy()
    turned, settling = (_angle_deg(n.cpu().numpy()[seen], vertices.normal.cpu().numpy()[seen]) for n in (before, last))
    return {
        "residual": relative_residual(state.views, vertices),
        "light_change_deg": moved[0],
        "intensity_change": moved[1],
        "normal_change_deg": float(np.mean(turned)),
        "last_step_deg": float(np.mean(settling)),
        "grazing": state.law.grazing,
        "bounce": state.law.bounce,
    }


def relative_residual(views: list[ViewSamples], vertices: Vertices) -> float:
    """Median over vertices of the residuals' standard deviation over the root mean square of the vertex's samples."""
    square = torch.zeros_like(vertices.scale)
    weight = torch.zeros_like(vertices.scale)
    for samples in views:
        for part in samples.chunks():
            data = samples.data[part] * samples.weight[part, None]
            square.index_add_(0, samples.vertex[part], (data * samples.image[part] ** 2).sum(1))
            weight.index_add_(0, samples.vertex[part], data.sum(1))
    seen = weight > 0
    level = (square[seen] / weight[seen]).sqrt().clamp_min(1e-12)
    return float((vertices.scale[seen] / level).median())


def _moved(surface: Surface, otherwise: Float, state: _State, capture: Capture, seen: list[Any], reach: Float, pixel: float) -> Surface:
    """The surface moved to where views agree, with their normals. otherwise (V, 3): normals where no view sees; reach: offsets, pixels."""
    if min(len(view.lights) for view in capture.views) < OWN_LIGHTS:
        # Normals of such views are the mesh's own (pixels.py) and agree wherever it is.
        agreed = Agreement(np.zeros(len(surface.vertices)), np.full(len(surface.vertices), pixel))
    else:
        agreed = agreement(capture, surface, state.maps, seen, reach * pixel, COST_SMOOTHINGS)
    # Faces turn and move, so that other pixels speak for them: twice.
    for _ in range(FUSIONS):
        outward = vertex_normals(surface)
        target = face_targets(capture, surface, state.maps, seen, otherwise)
        moved = fuse(surface, target, agreed, NORMAL_SIGMA, POSITION_FLOOR_PIXELS * pixel)
        agreed = Agreement(agreed.offset - ((moved.vertices - surface.vertices) * outward).sum(1), agreed.sigma)
        surface = moved
    return surface


def _remeshed(surface: Surface, settings: RoundSettings, carried: tuple[Surface, Vertices] | None, pixel: float) -> Surface:
    """The surface with edges as the round wants them."""
    surface = isotropic_remesh(surface, settings.edge * pixel)
    if carried is None or not np.isfinite(settings.crease):
        return surface
    nearest = cKDTree(carried[0].vertices).query(surface.vertices)[1]
    normal = carried[1].normal.double().cpu().numpy()[nearest]
    ends = normal[edges(surface)]
    return split_edges(surface, np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) > settings.crease)


def refine(
    capture: Capture,
    surface: Surface,
    lights: Lights,
    maps: tuple[NormalMap, ...],
    law: Law,
    settings: RefineSettings,
    seed: int,
    device: str,
    on_round: Callable[[int, dict[str, float]], None],
) -> Refined:
    """Stage II from a rough surface, lights and the views' photometric stereo under these lights.

    on_round(number from 1, what changed) is called after each round.
    """
    generator = np.random.default_rng(seed)
    on = torch.device(device)
    torch.set_num_threads(1)
    pixel = pixel_footprint([view.camera for view in capture.views], surface.vertices.mean(0))
    state = _State(surface, lights, maps, law)
    carried: tuple[Surface, Vertices] | None = None
    account: list[dict[str, float]] = []
    for number, round_settings in enumerate(settings.rounds, start=1):
        state.surface = _remeshed(state.surface, round_settings, carried, pixel)
        mesh_normal = vertex_normals(state.surface)
        if round_settings.photometric:
            changes = _photometric_round(state, capture, settings, carried, generator, on)
            seen = [s.vertex.cpu().numpy() for s in state.views]
        else:
            seen, changes = [index for index, _ in visible_in(capture, state.surface)], {}
        moved = _moved(state.surface, mesh_normal, state, capture, seen, round_settings.offsets(), pixel)
        shift = np.linalg.norm(moved.vertices - state.surface.vertices, axis=1)
        changes["vertex_change_px"] = float(shift.mean() / pixel)
        state.surface = moved
        if state.vertices is not None:
            carried = (moved, state.vertices)
        account.append({"round": float(number), "vertices": float(len(shift)), **changes})
        on_round(number, account[-1])
    return _finished(state, capture, account, on)


def _finished(state: _State, capture: Capture, account: list[dict[str, float]], device: torch.device) -> Refined:
    assert state.vertices is not None
    ratios = [channel_ratio(e) for e in state.lights.intensity]
    grey = grey_lights(state.lights, device)
    albedo, ratios = colours(capture, state.surface, state.views, state.vertices, grey, state.law, ratios, state.lights.one_rig)
    lights = coloured_lights(grey, ratios, state.lights.one_rig)
    material = _material(state, albedo)
    status, text = _verdict(account)
    return Refined(state.surface, material, lights, state.maps, state.law, state.trials, account, status, text)


def _material(state: _State, albedo: Float) -> Material:
    """The material on all vertices; where no view sees one it takes the nearest seen vertex's reflectance and the mesh's normal."""
    assert state.vertices is not None
    vertices, known = state.vertices, np.isfinite(albedo).all(1)
    nearest = np.arange(len(albedo))
    nearest[~known] = np.flatnonzero(known)[cKDTree(state.surface.vertices[known]).query(state.surface.vertices[~known])[1]]
    normal = normalise(vertices.normal.double().cpu().numpy())
    normal[~known] = vertex_normals(state.surface)[~known]
    weight = vertices.reflectance[:, 1:].double().cpu().numpy()[nearest]
    certain = confidence(vertices).double().cpu().numpy()
    certain, law = np.where(known, certain, 0), state.law
    return Material(normal, albedo[nearest], weight, np.array(law.sharpness), certain, law.grazing, law.bounce)


def _verdict(account: list[dict[str, float]]) -> tuple[str, str]:
    """Status and a sentence, from residual and last change alone."""
    last = account[-1]
    if last["residual"] > POOR_FIT:
        return "poor fit", (
            f"The model fits badly: it leaves {100 * last['residual']:.0f} % of the images' signal unexplained (good fits leave under"
            f" {100 * POOR_FIT:.0f} %). Expect wrong normals and lights; metals and mirrors are likely reasons, as are wrong masks"
            " or poses."
        )
    if max(last["last_step_deg"], last["light_change_deg"]) > STILL_DEG:
        return "not settled", (
            f"In the last step normals still turned by {last['last_step_deg']:.2f} deg, in the last round lights by"
            f" {last['light_change_deg']:.2f} deg (settled below {STILL_DEG} deg); a finer preset does more rounds."
        )
    return "converged", (
        f"Residual {100 * last['residual']:.1f} % of the images' signal; in the last step normals turned by"
        f" {last['last_step_deg']:.2f} deg, in the last round lights by {last['light_change_deg']:.2f} deg,"
        f" vertices by {last['vertex_change_px']:.2f} px."
    )
