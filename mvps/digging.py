"""Hollows that Stage I and photographs left, dug (hollows.py): wide ones first, pit into pit, then single pits.

Whether they stay is for the photographs to say: of the pixels of all views together the model must then explain more (misfit in
hollows.py).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from mvps.noise import samples_noise
from mvps.passes import stage_one, stage_two
from mvps.progress import Progress
from mvps.scene import Capture, Float

if TYPE_CHECKING:
    from mvps.joint.refine import Refined, RefineSettings
    from mvps.reconstruct import Settings
    from mvps.scene import SignedDistanceGrid

WORTHWHILE = 0.9
"""Of the misfit, what is left at most where hollows that were dug stay. Two that are no farther apart are alike: another round brings as
much (docs/findings/hollows.md)."""

DEPTHS = (1.0, 0.5)
"""Of pits, over the width of the patch: half as deep where as deep as wide is not better."""

HIDDEN = 0.2
"""Mean depth, pixels, of the hollows that may be hidden where nothing fits (hollows.py) from which they are dug for. Seven captures without
hollows that Stage I leaves are at 0.02 to 0.1, a vessel and a bowl at 1.2 and 1.4 (docs/findings/hollows.md)."""

LEFT = 0.1
"""The same after a dig: no more than objects without any have."""

PITS = 0.01
"""Mean depth, pixels, of pits from which they are dug: runs with other seeds differ by up to as much (docs/findings/hollows.md)."""

MOST_TURNS = 6
"""As long as it helps, each of them."""

Rounds = list[dict[str, float]]


def while_it_helps(found: Refined, dig: Callable[[Refined], Refined | None], left: Callable[[Refined], float]) -> tuple[Refined, Rounds]:
    """Pits dug one into the other as long as the misfit falls, and the rounds that this took. dig: one more, None where there is none to
    dig; left: the misfit. After one that leaves about as much another is dug: it may be on its way to the ground."""
    best, least, rounds = found, left(found), Rounds()
    trial, taken = best, Rounds()
    for _ in range(MOST_TURNS):
        before, deeper = trial, dig(trial)
        if deeper is None:
            break
        trial, now, taken = deeper, left(deeper), taken + deeper.rounds
        if now < least:
            best, least, rounds, taken = trial, now, rounds + taken, Rounds()
        elif before is not best or WORTHWHILE * now > least:
            break
    return best, rounds


def hollowed(
    capture: Capture, grid: SignedDistanceGrid, found: Refined, settings: Settings, of_turn: RefineSettings, progress: Progress
) -> tuple[Refined, Rounds]:
    """Stage II with hollows dug that neither Stage I nor photographs reach (hollows.py), and the rounds that this took; as it was found
    where there are none, or where the model explains no more of the photographs with them.

    Pits are dug one into the other while that helps, each after a single round: what still moves is dug anew. Then Stage I goes on from
    their bottoms, whose normals it now has, unless it fills them again.
    """
    from mvps.camera import surface_pixel
    from mvps.device import chosen_device
    from mvps.hollows import beyond_noise, dug, hidden, solid
    from mvps.hull import visual_hull
    from mvps.mesh import piece_count
    from mvps.occupancy import CONTINUED, Occupancy
    from mvps.plan import once

    noise, pixel, count = samples_noise(capture), surface_pixel(capture, found.surface), piece_count(found.surface)

    def unexplained(of: Refined) -> Float:
        return beyond_noise(of.unexplained, noise)

    left = _judge(capture, found, noise)

    def deeper(of: Refined, share: float) -> Refined | None:
        if hidden(of.surface, unexplained(of)) <= (HIDDEN if of is found else LEFT) * pixel:
            return None
        surface = visual_hull(dug(of.surface, unexplained(of), grid, share, walls=True), count)
        return stage_two("hollows", capture, surface, of, once(of_turn), settings, progress)

    def smoothed(of: Refined) -> Refined:
        field = Occupancy(capture, solid(of.surface, grid), CONTINUED, settings.seed, chosen_device(settings.device), count)
        surface = stage_one(field, of.maps, CONTINUED, progress)
        return stage_two("coarse refinement", capture, surface, of, of_turn, settings, progress)

    best, rounds = found, Rounds()
    for depth in DEPTHS:
        for _ in range(MOST_TURNS):
            first = deeper(best, depth)
            if first is None:
                return best, rounds
            pit, more = while_it_helps(first, partial(deeper, share=depth), left)
            ground = smoothed(pit)
            # Of two that leave about as much the one that photographs have smoothed.
            trial = ground if WORTHWHILE * left(ground) <= left(pit) else pit
            if left(trial) > WORTHWHILE * left(best):
                break
            best, rounds = trial, rounds + first.rounds + more + (ground.rounds if trial is ground else [])
    return best, rounds


def _judge(capture: Capture, found: Refined, noise: float) -> Callable[[Refined], float]:
    """What a solution leaves (`misfit`): all, 1, where it covers less of the masks than the one found, by as much as a part of the object
    covers alone. A pit through a thin wall takes this away, and what is left of the surface may fit.
    """
    from mvps.hollows import beyond_noise, misfit
    from mvps.hull import ALONE, covered

    least = covered(found.surface, capture) - ALONE * sum(len(view.pixels) for view in capture.views)

    def left(of: Refined) -> float:
        return misfit(capture, of.surface, beyond_noise(of.unexplained, noise)) if covered(of.surface, capture) >= least else 1.0

    return left


def pitted(
    capture: Capture, grid: SignedDistanceGrid, found: Refined, settings: Settings, of_turn: RefineSettings, progress: Progress
) -> tuple[Refined, Rounds]:
    """Stage II with pits dug that are too narrow to be `hollowed`, and the rounds that this took: Stage I would fill them again in part. As
    it was found where there are none, or where the model explains no more of the photographs with them."""
    from mvps.camera import surface_pixel
    from mvps.hollows import beyond_noise, dug, mean_depth, pits
    from mvps.hull import visual_hull
    from mvps.mesh import piece_count
    from mvps.plan import COARSE, once

    noise, pixel, plan = samples_noise(capture), surface_pixel(capture, found.surface), once(of_turn)
    # A single vertex that does not fit is as wide as edges are.
    least = grid.spacing * max(one.edge for one in of_turn.rounds) / COARSE.edge

    left = _judge(capture, found, noise)

    def deeper(of: Refined) -> Refined | None:
        unexplained = beyond_noise(of.unexplained, noise)
        if mean_depth(of.surface, unexplained, pits(of.surface, unexplained, least)) <= PITS * pixel:
            return None
        surface = visual_hull(dug(of.surface, unexplained, grid), piece_count(of.surface))
        return stage_two("pits", capture, surface, of, plan, settings, progress)

    best, rounds = while_it_helps(found, deeper, left)
    return (best, rounds) if left(best) <= WORTHWHILE * left(found) else (found, [])
