"""Stage II of one view: lights, reflectance and the normals of pixels in turn with the surface that these normals integrate to.

A round:  lights and photometric stereo by Lambert's law -> bas-relief (bas_relief.py) -> normals integrated -> the photometric part of a
round on that mesh (photometry.py), whose patches keep the mesh's mean slopes. There is no second view to move vertices by.

Lambert's law is wrong where lobes shine, by which lights and normals turn together (docs/findings/one_view.md), and no later step turns
them back far enough. So every round but the first starts anew, from the photographs without the lobes

    I_pl - s_l cast_pl sum_k w_pk D_k(n_p, h_pl)

of the round before, whose lights are known up to the 3 x 3 ambiguity alone. A round that fits much worse than the best before is undone.

The law has all lobes from the start and no more: what resolves the bas-relief cannot be on trial under lights that are off by a bas-relief
(on trial, spot's and two made captures' lobes were refused, and their normals ended at 7 to 8 degrees in place of 3 to 4), and the diffuse
term's change at grazing angles turns all normals together as a bas-relief does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
import torch

from mvps.joint.bas_relief import bas_relief, turned
from mvps.joint.photometry import Task, photometric_round
from mvps.joint.refine import Refined, RefineSettings, finished
from mvps.joint.state import State, grey_albedo, material_of
from mvps.mesh import edges, lengths, neighbour_sums
from mvps.noise import dark_noise_share
from mvps.rendering import photograph
from mvps.scene import Capture, Float, Law, Lights, Material, NormalMap, Surface, View, less_confident
from mvps.visibility import ray_caster

ROUNDS = {"draft": 2, "standard": 4, "fine": 6}
"""By preset."""

WORSE = np.sqrt(2)
"""Times the least residual of the rounds before from which a round is undone and the last: twice the variance, as where one rig is believed
(calibrate.py). Where lobes were not understood, what is left without them is worse than the photographs."""

T = TypeVar("T")


@dataclass(frozen=True)
class Start(Generic[T]):
    """What a round starts from: lights, normals and albedo of the pixels under them, and how the lights came to be."""

    lights: Lights
    maps: NormalMap
    resolved: T


def _without_relief(
    capture: Capture, lights: Lights, maps: NormalMap, law: Law, generator: np.random.Generator, device: torch.device
) -> tuple[Lights, NormalMap]:
    """Lights and normals after the bas-relief that fits the photographs best."""
    direction, intensity = lights.direction[0], lights.intensity[0]
    grey = maps.albedo.mean(1).astype(np.float64)
    normal = maps.normal.astype(np.float64)
    G = bas_relief(capture.views[0], normal, grey, (direction, intensity), law, generator, device)
    moved, albedo, turned_direction, strength = turned(G, normal, grey, direction, intensity.mean(1))
    colour = intensity / intensity.mean(1, keepdims=True)
    share = np.where(grey > 0, albedo / np.maximum(grey, 1e-300), 1.0)
    solved = np.where(maps.confidence[:, None] > 0, moved, normal).astype(np.float32)
    solved /= lengths(solved)[:, None]
    return replace(lights, direction=(turned_direction,), intensity=(strength[:, None] * colour,)), NormalMap(
        solved, (maps.albedo * share[:, None]).astype(np.float32), maps.confidence
    )


def without_lobes(view: View, surface: Surface, material: Material, lights: Lights) -> View:
    """The view's photographs less what the material's lobes send; clipped samples stay as they are."""
    dark = replace(material, albedo=np.zeros_like(material.albedo))
    lobes = photograph(ray_caster(surface), dark, view.camera, view.pixels, lights.direction[0], lights.intensity[0])
    body = np.rint(np.maximum(view.samples - lobes / np.float32(view.scale), 0)).astype(np.uint16)
    return replace(view, samples=np.where(view.samples < view.saturation, body, view.samples))


def refine_view(
    capture: Capture,
    start: Start[T],
    again: Callable[[View, Lights, NormalMap], Start[T]],
    law: Law,
    settings: RefineSettings,
    rounds: int,
    seed: int,
    device: torch.device,
    integrated: Callable[[Float, Float], Surface],
    on_round: Callable[[int, dict[str, float]], None],
) -> tuple[Refined, Start[T]]:
    """Rounds from lights and photometric stereo of the capture's only view, and what the last one that was kept started from.

    again: a start from the view without its lobes, and the lights and normals of the round before. integrated: the surface of normals
    (pixels, 3), world, with confidence (pixels,). settings: whose rounds are not used, one view has its own kind.
    """
    model = replace(settings.model, sharpness=law.sharpness, grazing=False, bounce=False, gleam=False)
    generator, view = np.random.default_rng(seed), capture.views[0]
    torch.set_num_threads(1)
    state: State | None = None
    account: list[dict[str, float]] = []
    for number in range(1, rounds + 1):
        following = start
        if state is not None:
            assert state.vertices is not None
            material = material_of(state, grey_albedo(state.vertices))
            following = again(without_lobes(view, state.surface, material, state.lights), state.lights, state.maps[0])
        lights, maps = following.lights, following.maps
        if settings.free_lights:
            lights, maps = _without_relief(capture, lights, maps, law if state is None else state.law, generator, device)
        surface = integrated(maps.normal, maps.confidence)
        # The round before stays as it is: it may be what is kept.
        if state is None:
            attempt = State(surface, lights, (maps,), law, model, dark_noise_share(capture))
        else:
            attempt = replace(state, surface=surface, lights=lights, maps=(maps,))
        task = Task(settings.free_lights, settings.free_colours, False, False, False, False, device)
        changes = photometric_round(attempt, capture, task, None, generator)
        if changes["residual"] > WORSE * min((before["residual"] for before in account), default=np.inf):
            break
        state, start = attempt, following
        moves = {"vertex_change_px": 0.0, "left_px": 0.0}
        account.append({"round": float(number), "vertices": float(len(surface.vertices)), **changes, **moves})
        on_round(number, account[-1])
    assert state is not None
    refined = finished(state, settings, account, generator)
    material = replace(refined.material, confidence=with_rim(refined.material.confidence, state.surface))
    material = _contradicted(material, capture, state, generator, device) if settings.free_lights else material
    return replace(refined, material=material), start


def with_rim(confidence: Float, surface: Surface) -> Float:
    """Confidence (V,) of a surface all of which the camera sees: at the outline, where pixels show the background too and none speaks for a
    vertex, the normal is what integration makes of its neighbours', and its variance their mean."""
    known, ends = confidence > 0, edges(surface)
    variance = np.where(known, 1 / np.where(known, confidence, 1) - 1, 0)
    total, count = neighbour_sums(np.stack([variance, known], 1), ends).T
    beside = ~known & (count > 0)
    return np.where(beside, 1 / (1 + total / np.maximum(count, 1)), confidence)


def _contradicted(material: Material, capture: Capture, state: State, generator: np.random.Generator, device: torch.device) -> Material:
    """The material, confident no more than what its normals and those after one more bas-relief contradict each other by, of which either
    may be right: of the square of their difference half is either's error, and half of that of either tangential component."""
    lights, maps = state.lights, state.maps[0]
    direction, intensity = lights.direction[0], lights.intensity[0]
    normal, grey = maps.normal.astype(np.float64), maps.albedo.mean(1).astype(np.float64)
    G = bas_relief(capture.views[0], normal, grey, (direction, intensity), state.law, generator, device)
    own = material.normal
    moved = turned(G, own, np.ones(len(own)), direction, intensity.mean(1))[0]
    return replace(material, confidence=less_confident(material.confidence, ((moved - own) ** 2).sum(1) / 4))
