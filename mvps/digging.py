"""Hollows that Stage I and photographs left, dug (hollows.py): wide ones first, pit into pit, then single pits.

Whether they stay is for the photographs to say, of which the model must then explain more: of the whole object where hollows are wide,
within the balls that were dug where they are small.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mvps.noise import samples_noise
from mvps.passes import stage_one, stage_two
from mvps.progress import Progress
from mvps.scene import Capture, Float

if TYPE_CHECKING:
    from mvps.joint.refine import Refined, RefineSettings
    from mvps.reconstruct import Settings
    from mvps.scene import SignedDistanceGrid

WORTHWHILE = 0.9
"""Of the mean share that was unexplained, what is left at most where hollows that were dug stay. Another coarse round alone leaves 0.9 to
0.96 of it (docs/findings/hollows.md)."""

DEPTHS = (1.0, 0.5)
"""Of pits, over the width of the patch: half as deep where as deep as wide is not better."""

HIDDEN = 0.2
"""Mean depth, pixels, of the hollows that may be hidden where nothing fits (hollows.py) from which they are dug for. Seven captures without
hollows that Stage I leaves are at 0.02 to 0.1, a vessel and a bowl at 1.2 and 1.4 (docs/findings/hollows.md)."""

LEFT = 0.1
"""The same after a dig: no more than objects without any have."""

PITS = 0.01
"""Mean depth, pixels, of pits from which they are dug: runs with other seeds differ by up to as much (docs/findings/hollows.md)."""

HALVED = 0.5
"""Of the misfit of pits, what is left at most where they stay; after one round its root, for another to be worth it. 0.19 to 0.40 was left
of what hid a hollow, 0.58 and more of what did not or of a deeper one, and 0.64 to 1.0 by a round without digging
(docs/findings/hollows.md)."""

MOST_TURNS = 6
"""As long as it helps, each of them."""


def hollowed(
    capture: Capture, grid: SignedDistanceGrid, found: Refined, settings: Settings, of_turn: RefineSettings, progress: Progress
) -> tuple[Refined, list[dict[str, float]]]:
    """Stage II with hollows dug that neither Stage I nor photographs reach (hollows.py), and the rounds that this took; as it was found
    where there are none, or where the model explains no more of the photographs with them.

    Pits are dug one into the other while that helps, each after a single round: what still moves is dug anew. Then Stage I goes on from
    their bottoms, whose normals it now has.
    """
    from mvps.camera import surface_pixel
    from mvps.device import chosen_device
    from mvps.hollows import beyond_noise, dug, hidden, solid
    from mvps.hull import visual_hull
    from mvps.mesh import piece_count
    from mvps.occupancy import CONTINUED, Occupancy
    from mvps.plan import once

    noise, pixel = samples_noise(capture), surface_pixel(capture, found.surface)

    def unexplained(of: Refined) -> Float:
        return beyond_noise(of.unexplained, noise)

    def worth_digging(of: Refined) -> bool:
        return hidden(of.surface, unexplained(of)) > (HIDDEN if of is found else LEFT) * pixel

    def better(after: Refined, before: Refined, share: float = 1.0) -> bool:
        return bool(np.nanmean(unexplained(after)) < share * np.nanmean(unexplained(before)))

    best, rounds, count = found, list[dict[str, float]](), piece_count(found.surface)
    for depth in DEPTHS:
        for _ in range(MOST_TURNS):
            if not worth_digging(best):
                return best, rounds
            trial, taken = best, []
            for _ in range(MOST_TURNS):
                before, surface = trial, visual_hull(dug(trial.surface, unexplained(trial), grid, depth, walls=True), count)
                trial = stage_two("hollows", capture, surface, before, once(of_turn), settings, progress)
                taken += trial.rounds
                if not (better(trial, before) and worth_digging(trial)):
                    break
            field = Occupancy(capture, solid(trial.surface, grid), CONTINUED, settings.seed, chosen_device(settings.device), count)
            surface = stage_one(field, trial.maps, CONTINUED, progress)
            trial = stage_two("coarse refinement", capture, surface, trial, of_turn, settings, progress)
            if not better(trial, best, WORTHWHILE):
                break
            best, rounds = trial, rounds + taken + trial.rounds
    return best, rounds


def pitted(
    capture: Capture, grid: SignedDistanceGrid, found: Refined, settings: Settings, of_turn: RefineSettings, progress: Progress
) -> tuple[Refined, list[dict[str, float]]]:
    """Stage II with pits dug that are too small to show in the whole, and the rounds that this took: Stage I would fill them again in part.
    One each time, and another where it is on the way to halving the misfit. As it was found where there are none, or where the model
    explains no more in them."""
    from mvps.camera import surface_pixel
    from mvps.hollows import beyond_noise, dug, mean_depth, misfit, pits
    from mvps.hull import visual_hull
    from mvps.mesh import piece_count
    from mvps.plan import COARSE, once

    noise, pixel = samples_noise(capture), surface_pixel(capture, found.surface)
    best, rounds, plan = found, list[dict[str, float]](), once(of_turn)
    left = beyond_noise(best.unexplained, noise)
    # A single vertex that does not fit is as wide as edges are.
    least = grid.spacing * max(one.edge for one in of_turn.rounds) / COARSE.edge
    for _ in range(MOST_TURNS):
        depth = pits(best.surface, left, least)
        if mean_depth(best.surface, left, depth) <= PITS * pixel:
            break
        # Ground that was dug is a cell away from the balls at most.
        balls = best.surface.vertices[depth > 0], depth[depth > 0] + grid.spacing
        before = misfit(best.surface, left, *balls)
        trial, taken, surface = best, list[dict[str, float]](), visual_hull(dug(best.surface, left, grid), piece_count(best.surface))
        for worth_another in (np.sqrt(HALVED), HALVED):
            trial = stage_two("pits", capture, surface, trial, plan, settings, progress, trial.carried if taken else None)
            after, surface, taken = beyond_noise(trial.unexplained, noise), trial.surface, taken + trial.rounds
            share = misfit(surface, after, *balls) / before
            if share <= HALVED or share > worth_another:
                break
        if share > HALVED:
            break
        best, left, rounds = trial, after, rounds + taken
    return best, rounds
