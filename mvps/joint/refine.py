"""Stage II: lights, normals, reflectance and vertices, in rounds on an ever finer mesh.

A round:  remesh -> samples (visibility and shadows traced anew) -> vertices for fixed lights -> lights with the vertices eliminated
-> vertices -> normals of every view's own pixels (pixels.py) -> agreement of views -> fused positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from mvps.camera import surface_pixel
from mvps.cores import neighbours
from mvps.joint.agreement import Agreement, agreement
from mvps.joint.blocks import Vertices
from mvps.joint.borders import shadow_borders, told_by
from mvps.joint.choosing import TRIAL_VERTICES
from mvps.joint.colours import LobeColour, colours, lobes_in_colour
from mvps.joint.detail import detailed, interpolated
from mvps.joint.fused import face_targets
from mvps.joint.grey import grey_lights
from mvps.joint.lighting import drawn, vertices_for
from mvps.joint.neural import neural_residual
from mvps.joint.observe import channel_ratio, visible_in
from mvps.joint.onward import MOST_GOES_ON, Moves, carried_on
from mvps.joint.photoconsistency import photoconsistency, shown_in
from mvps.joint.photometry import WEAK_TIE, Task, photometric_round
from mvps.joint.pixels import few_lights
from mvps.joint.reflectance import Observed
from mvps.joint.shown import OWN_SHARE, own_normals, shaded_as
from mvps.joint.state import State, grey_albedo, material_of, relative_residuals, senders_in_colour
from mvps.joint.stated import scatter, stated_errors
from mvps.joint.strengths import unknown_of
from mvps.joint.unexplained import unexplained_share
from mvps.joint.unseen import closed_over
from mvps.joint.vertices import Moved, fuse, with_masks
from mvps.material import LARGEST, POOR_FIT, Model, Trial
from mvps.memory import Together, room_for, solved_together
from mvps.mesh import edges, isotropic_remesh, split_edges, unbiased, vertex_normals
from mvps.noise import dark_noise_share, samples_noise
from mvps.scene import Capture, Float, Law, Lights, Material, NormalMap, Surface
from mvps.silhouette import mask_distances

POSITION_FLOOR_PIXELS = 0.05
"""Smallest standard deviation of an agreed position: neighbouring costs share their pixels, so their agreement looks better than it is."""

STILL_DEG = 0.25
"""Mean turn of the lights in their last Gauss-Newton step below which they have settled: near a minimum steps at least halve, so that all
further ones together are no longer than this."""

MOVING_DEG = 1.0
"""Mean turn of the lights in a round from which on what came before has seen other lights than there are: wrong by a degree, they bend
normals by as much. Where the model fits, lights of eight captures turned by 0.06 to 0.9 deg after Stage I, and by 3.8 where four views
leave the hull four pixels off (docs/findings/stage_one.md)."""

MOVING_PIXELS = 0.5
"""Mean move of the vertices in the last round from which on, where lights move too, neither has found its place: 0.40 at most in runs that
came out right, 0.56 to 0.73 in five that did not (docs/findings/stage_one.md)."""

STILL = 0.5
"""The same for the normals' median turn, over their median standard error: further steps are lost in it."""

AT_REST_PIXELS = 0.1
"""What vertices may have to go on in the mean after two rounds on one mesh: 0.06 at most on nine captures that came out right, 0.13 and
0.16 where a bowl's floor stayed bridged (docs/findings/stage_one.md)."""

MOSTLY = 0.6
"""Part of a mesh's edges that creases split, above which the object has more detail than the mesh: halves of these are split once more.
Four captures lie at 0.38 to 0.46 and 0.69 to 0.74 (docs/findings/vertices.md)."""

MOST_REPEATS = 2
"""How often a round is done again whose vertices moved by more than its sweeps reach: what they look for may lie beyond."""

MOST_ONWARD = 1
"""The same where vertices have farther to go: a second round takes them there, and after more of them photographs over hollows that only
digging reaches fit well enough for these not to be found (docs/findings/stage_one.md)."""


@dataclass(frozen=True)
class RoundSettings:
    """One round. edge: mesh edges in pixels; reach: sweep of offsets in pixels, +-; step: of the sweep, pixels; photometric: solve lights
    and vertices' normals and reflectance, or only fuse the views' normals; crease: radians that the normal may turn along an edge before it
    is split; for_detail: left out where the mesh of the round before had enough edges (MOSTLY); fusions: faces turn and move, so that
    other pixels speak for them, and from where a fusion put the surface views agree deeper in hollows; without any the surface stays.
    still: pixels that vertices may have to go on in the mean before the round is done again, where the model fits. carving: single
    photographs say where vertices lie, not the pixels' normals, which in a hollow that is too shallow agree where the surface already
    is."""

    edge: float
    reach: float
    step: float
    photometric: bool = True
    crease: float = np.inf
    for_detail: bool = False
    fusions: int = 3
    still: float = np.inf
    carving: bool = False

    def offsets(self) -> Float:
        """Offsets of the sweep, pixels."""
        return np.arange(-self.reach, self.reach + self.step / 2, self.step)


@dataclass(frozen=True)
class RefineSettings:
    """rounds: in order; free_lights: solve the lights; free_colours: and their colours; final: this is the result, so the components of the
    reflectance model are chosen by held-out lights in the first round, and colours are solved; in_full: the lobes' sharpness is solved too,
    and the pixels' normals of the last round use all lights (thinned.py); for_field: Stage I goes on from here, which wants lights and
    normals but not the surface, so the last round leaves it; half: normals of every other pixel only (pixels.py), enough where edges are of
    two pixels and more, or for Stage I, which draws fewer rays than there are pixels; detail: the result's mesh is finer than the last
    round's (detail.py); eased: lights are solved on fewer vertices, and stay, like the pixels' normals, where a round is done again;
    goes_on: how far earlier rounds' moves did (onward.py); model: all that the reflectance may have."""

    rounds: tuple[RoundSettings, ...]
    free_lights: bool = True
    free_colours: bool = True
    final: bool = False
    in_full: bool = False
    for_field: bool = False
    half: bool = False
    detail: bool = False
    eased: bool = False
    goes_on: float = MOST_GOES_ON
    model: Model = LARGEST


@dataclass(frozen=True, eq=False)
class Refined:
    """surface, material and lights; maps: per view its pixels' normals; per round what changed; whether the last step was small, in words,
    and a sentence; unexplained (V,): what the model leaves of a vertex's samples, root mean squares as a share of the signal, NaN where no
    view sees it (unexplained.py); in_light (V,): the same of those in the light alone; carried: the surface with what its vertices were
    solved to, from which later rounds may go on."""

    surface: Surface
    material: Material
    lights: Lights
    maps: tuple[NormalMap, ...]
    law: Law
    trials: list[Trial]
    rounds: list[dict[str, float]]
    status: str
    text: str
    unexplained: Float
    in_light: Float
    carried: tuple[Surface, Vertices] | None = None


def _observed(state: State) -> tuple[Observed, Lights]:
    """What the round observed, in grey, and its photographs' lights."""
    assert state.vertices is not None and state.under is not None
    photographs, lights = state.under
    grey = grey_lights(lights, state.vertices.normal.device)
    return Observed(photographs, state.surface, state.views, state.vertices, grey, state.law), lights


def _back(start: Float, surface: Surface) -> Float:
    """By how much (V,) the surface's vertices would move along their normals back to where they were, start (V, 3)."""
    back: Float = ((start - surface.vertices) * vertex_normals(surface)).sum(1)
    return back


def _agreement_of(state: State, capture: Capture, seen: list[Any], settings: RoundSettings, pixel: float) -> Callable[[Surface], Agreement]:
    """Where views agree that vertices lie, of the round's surface wherever it has moved since."""
    offsets, start, normals = settings.offsets() * pixel, state.surface.vertices, state.maps
    # Normals of views of few lights are the mesh's own (pixels.py) and agree wherever it is.
    if not (settings.carving or few_lights(capture)):
        return lambda surface: agreement(capture, surface, normals, seen, offsets)
    photographs = [] if state.vertices is None else shown_in(*_observed(state))

    def agreed(surface: Surface) -> Agreement:
        back = _back(start, surface)
        held = Agreement(back, np.full(len(back), pixel))
        return held.joined(photoconsistency(photographs, surface, offsets), POSITION_FLOOR_PIXELS * pixel) if photographs else held

    return agreed


def _told_by_shadows(state: State, pixel: float) -> Callable[[Surface], Agreement]:
    """Where borders of cast shadows say that vertices lie, of the round's surface wherever it has moved since."""
    start = state.surface.vertices
    told = Agreement.unknown(len(start))
    if state.vertices is not None and state.law.shadows:
        told = told_by(shadow_borders(_observed(state)[0], pixel), state.surface, pixel)
    return lambda surface: replace(told, offset=told.offset + _back(start, surface))


def _moved(
    surface: Surface, otherwise: Float, state: State, capture: Capture, seen: list[Any], settings: RoundSettings, pixel: float
) -> Moved:
    """The surface moved to where views and masks agree, with the views' normals; what no view sees follows smoothly. otherwise (V, 3):
    normals where no view sees."""
    floor = POSITION_FLOOR_PIXELS * pixel
    distance = mask_distances(capture)
    factor, agreement_of, by_shadows = None, _agreement_of(state, capture, seen, settings, pixel), _told_by_shadows(state, pixel)
    for _ in range(settings.fusions):
        agreed = agreement_of(surface).joined(by_shadows(surface), floor)
        agreed = with_masks(agreed, capture, surface, distance, floor)
        place = surface.vertices + agreed.offset[:, None] * vertex_normals(surface)
        target = face_targets(capture, surface, state.maps, seen, otherwise)
        surface, factor = fuse(surface, target.normal, agreed, target.sigma, factor)
    return Moved(closed_over(unbiased(surface), seen, capture, distance), place, agreed.sigma)


def _remeshed(
    surface: Surface, settings: RoundSettings, before: RoundSettings | None, carried: tuple[Surface, Vertices] | None, pixel: float
) -> tuple[Surface, float]:
    """The surface with edges as the round wants them, and the part of them that creases split. before: the last round, whose mesh stays
    where it has the same edges."""
    if before is None or before.edge != settings.edge:
        surface = isotropic_remesh(surface, settings.edge * pixel)
    if carried is None or not np.isfinite(settings.crease):
        return surface, 0.0
    nearest = neighbours(cKDTree(carried[0].vertices), surface.vertices)[1]
    normal = carried[1].normal.double().cpu().numpy()[nearest]
    ends = normal[edges(surface)]
    creased = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) > settings.crease
    return split_edges(surface, creased), float(creased.mean())


def _in_detail(result: Refined, capture: Capture, told: Moved, seen: list[Any]) -> Refined:
    """The result on a mesh that is finer than its last round's."""
    finer = detailed(capture, told, result.maps, seen)
    material, unexplained, in_light = interpolated(result.material, finer), finer.share @ result.unexplained, finer.share @ result.in_light
    return replace(result, surface=finer.surface, material=material, unexplained=unexplained, in_light=in_light)


def _task(settings: RefineSettings, last: bool, device: torch.device) -> Task:
    """What a round is to do, the last one or another."""
    thinned = not (settings.in_full and last)
    free = settings.free_lights, settings.free_colours
    return Task(*free, settings.final, settings.in_full, thinned, settings.half, device, settings.eased)


def _together(lights: Lights, settings: RefineSettings) -> Together:
    """What the equations of the lights have, which may all be known."""
    unknown = solved_together(lights, unknown_of(lights)) if settings.free_lights else 0
    return Together(unknown, vertices_for(lights, settings.free_lights, settings.eased))


def refine(
    capture: Capture,
    surface: Surface,
    lights: Lights,
    maps: tuple[NormalMap, ...],
    law: Law,
    settings: RefineSettings,
    seed: int,
    device: torch.device,
    on_round: Callable[[int, dict[str, float]], None],
    carried: tuple[Surface, Vertices] | None = None,
) -> Refined:
    """Stage II from a rough surface, lights and the views' photometric stereo under these lights.

    carried: what earlier rounds ended with, on another mesh of the object.
    on_round(number from 1, what changed) is called after each round.
    """
    generator = np.random.default_rng(seed)
    torch.set_num_threads(1)
    pixel = surface_pixel(capture, surface)
    noise, together = dark_noise_share(capture), _together(lights, settings)
    state = State(surface, lights, maps, law, settings.model, noise, lobed=law.gleam > 0, together=together)
    account: list[dict[str, float]] = []
    before, pending = None, list(settings.rounds)
    last: Moves | float = settings.goes_on
    repeats = 0
    while pending:
        round_settings = pending.pop(0)
        if not isinstance(last, Moves):
            state.surface, creased = _remeshed(state.surface, round_settings, before, carried, pixel)
        room_for(len(state.surface.vertices), together=state.together)
        if np.isfinite(round_settings.crease) and creased <= MOSTLY:
            pending = [later for later in pending if not later.for_detail]
        mesh_normal = vertex_normals(state.surface)
        leaves_surface = (settings.for_field and not pending) or not round_settings.fusions
        if round_settings.photometric:
            task = _task(settings, not pending, device)
            on_mesh = account[-1] if isinstance(last, Moves) and settings.eased else None
            changes = photometric_round(state, capture, task, carried, generator, on_mesh)
            seen = [s.vertex.cpu().numpy() for s in state.views]
        else:
            seen, changes = [index for index, _ in visible_in(capture, state.surface)], {}
        moved, told = state.surface, None
        if not leaves_surface:
            told = _moved(state.surface, mesh_normal, state, capture, seen, round_settings, pixel)
            moved = told.surface
        by_any = np.isin(np.arange(len(moved.vertices)), np.concatenate(seen))
        moved, moves = carried_on(state.surface, moved, by_any, last)
        changes["goes_on"] = moves.goes_on
        # One round says nothing of the next.
        changes["left_px"] = moves.left / pixel if isinstance(last, Moves) else 0.0
        shift = np.linalg.norm(moved.vertices - state.surface.vertices, axis=1)
        changes["vertex_change_px"] = float(shift.mean() / pixel)
        far = changes["vertex_change_px"] > round_settings.reach
        # Where the model does not fit, single photographs pull vertices elsewhere.
        moving = moves.left > round_settings.still * pixel and changes.get("residual", np.inf) <= POOR_FIT
        again = (far and repeats < MOST_REPEATS) or (moving and repeats < MOST_ONWARD)
        pending, repeats = ([round_settings, *pending], repeats + 1) if again else (pending, 0)
        state.surface = moved
        last = moves if again and not far else moves.goes_on
        if state.vertices is not None:
            carried = (moved, state.vertices)
        # What has moved so far is meshed anew.
        before = None if far and again else round_settings
        account.append({"round": float(len(account) + 1), "vertices": float(len(shift)), "creased": creased, **changes})
        on_round(len(account), account[-1])
    result = replace(finished(state, settings, account, generator), carried=carried)
    if told is not None and settings.detail:
        result = _in_detail(result, capture, told, seen)
    return replace(result, material=shaded_as(result.material, result.surface)) if settings.final else result


def _coloured(state: State, settings: RefineSettings, generator: np.random.Generator) -> Material:
    """The material with albedo and lobes in the photographs' colours, a neural residual, if allowed, where that helps, the stated error,
    and normals without pixels' blur."""
    observed, lights = _observed(state)
    ratios = [channel_ratio(e) for e in lights.intensity]
    kind = LobeColour.WHITE
    if state.law.sharpness:
        kind, trials = lobes_in_colour(observed, ratios, drawn(state.views, TRIAL_VERTICES, generator))
        state.trials.extend(trials)
    albedo, tint = colours(observed, ratios, kind)
    # What arrives from coloured surfaces has a colour, with which their albedo would be too strong.
    sent = senders_in_colour(state, albedo)
    if sent is not None:
        albedo, tint = colours(observed, ratios, kind, sent)
    residual = None
    if settings.model.neural:
        trial, residual = neural_residual(observed, relative_residuals(observed.views, observed.vertices), POOR_FIT, generator)
        state.trials.append(trial)
    material = material_of(state, albedo, None if kind is LobeColour.WHITE else tint)
    told = scatter(observed, samples_noise(observed.capture))
    normal = own_normals(material.normal, told.noise, observed)
    certain = stated_errors(told, normal, state.surface, OWN_SHARE, WEAK_TIE, len(observed.views) == 1)
    certain = np.where(np.isfinite(albedo).all(1), certain, 0)
    return replace(material, normal=normal, confidence=certain, residual=residual)


def finished(state: State, settings: RefineSettings, account: list[dict[str, float]], generator: np.random.Generator) -> Refined:
    """What the rounds came to; in colour if that is final."""
    assert state.vertices is not None
    material = _coloured(state, settings, generator) if settings.final else material_of(state, grey_albedo(state.vertices))
    status, text = _settled(account)
    left = unexplained_share(_observed(state)[0]), relative_residuals(state.views, state.vertices).double().cpu().numpy()
    return Refined(state.surface, material, state.lights, state.maps, state.law, state.trials, account, status, text, *left)


def _settled(account: list[dict[str, float]]) -> tuple[str, str]:
    """Status and a sentence, from the last change alone."""
    last = account[-1]
    enough = STILL * last["stated_error_deg"]
    # Where normals are known to some degrees only, so are the lights that they were solved with.
    enough_light = max(STILL_DEG, enough)
    if last["last_step_deg"] > enough or last["light_step_deg"] > enough_light:
        return "not settled", (
            f"In the last step normals still turned by {last['last_step_deg']:.2f} deg (settled below {enough:.2f}, half their standard"
            f" error), lights by {last['light_step_deg']:.2f} deg (settled below {enough_light:.2f}); a finer preset does more rounds."
        )
    if last["lights_moving_deg"] > MOVING_DEG and last["vertex_change_px"] > MOVING_PIXELS:
        return "not settled", (
            f"In the last round lights still turned by {last['lights_moving_deg']:.1f} deg and vertices moved by"
            f" {last['vertex_change_px']:.2f} px (settled below {MOVING_DEG:g} or {MOVING_PIXELS}): the shape was found under other"
            " lights; more views help, or lights that all views share."
        )
    if last["left_px"] > AT_REST_PIXELS:
        return "not settled", (
            f"After the last rounds vertices have {last['left_px']:.2f} px to go in the mean (settled below {AT_REST_PIXELS}):"
            " hollows may be deeper than they came out; views that look into them help."
        )
    return "converged", (
        f"In the last step normals turned by {last['last_step_deg']:.2f} deg, lights by {last['light_step_deg']:.2f} deg,"
        f" vertices by {last['vertex_change_px']:.2f} px."
    )
