"""Shape, lights and normals for the last rounds to start from.

masks -> visual hull -> lights by factorisation -> photometric stereo of every view -> a refinement on the hull
      -> Stage I and a coarse round of Stage II in turn, while that helps -> hollows that both left, dug (digging.py)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from mvps.passes import Begun, stage_one, stage_two
from mvps.progress import Progress
from mvps.scene import Capture, Lights

if TYPE_CHECKING:
    from mvps.joint.refine import Refined, RefineSettings
    from mvps.plan import Parts
    from mvps.reconstruct import Settings
    from mvps.scene import SignedDistanceGrid, Surface

Step = Callable[[str, Callable[[], Any]], Any]
"""Makes what a long stage makes, under its name; or takes it from where it was kept."""

GOOD_HULL = 0.2
"""Mean shift, pixels, that views ask of the hull, below which Stage I is left out: of what comes out of Stage I they ask 0.13 to 0.31 (five
captures, docs/findings/stage_one.md), so it would do no better."""

FINER = 0.75
"""Edges of later turns' rounds over those of the first, where the model fits badly: normals on long ones are means over folds. Gold comes
nearer with edges of 1.5 pixels in place of 2, and no nearer with 1.2: chosen on buddha, a bolt's surface is nearer too, its lights farther
off (docs/findings/stage_one.md)."""

FINER_FROM = 2
"""Turns before these: one that fits badly may do so because its lights are still on their way, and edges of two pixels are better then
(statue of copper; docs/findings/stage_one.md)."""

SIGNS = 0.5**0.5
"""Of what a model leaves that fits badly, beyond noise, what one may leave all over whose misfits still are signs of hollows: half of the
variance. A cut stone of aluminium left 0.10 and was farther off when it was dug; fourteen others that were dug left up to 0.05
(docs/findings/hollows.md)."""

MOST_TURNS = 6
"""Of Stage I and a round of Stage II. One is enough where the model fits; where it fits badly each takes another part off the errors, as
long as the residual falls."""


def rough_shape(capture: Capture, progress: Progress) -> tuple[SignedDistanceGrid, Surface]:
    """The visual hull as a grid and as a surface."""
    from mvps.camera import surface_pixel
    from mvps.hull import hull_grid, hull_of_masks

    with progress.stage("visual hull") as stage:
        grid = hull_grid(capture)
        surface = hull_of_masks(capture, grid)
        pixel = surface_pixel(capture, surface)
        stage.status(f"{len(surface.vertices)} vertices, cells of {grid.spacing / pixel:.2g} pixels")
    return grid, surface


def first_lights(capture: Capture, surface: Surface, given: Lights | None, seed: int, progress: Progress, may_share: bool = True) -> Lights:
    """The given lights, or those of the uncalibrated factorisation; may_share: of one rig, if that fits."""
    from mvps.calibrate import uncalibrated_lights

    with progress.stage("lights") as stage:
        if given is not None:
            stage.status("given with the capture")
            return given
        calibration = uncalibrated_lights(capture, surface, seed, may_share)
        stage.status(calibration.words())
        return calibration.lights


def shaped(
    capture: Capture, grid: SignedDistanceGrid, rough: Refined, settings: Settings, of_turn: RefineSettings, progress: Progress
) -> tuple[Refined, list[dict[str, float]]]:
    """Stage I and a coarse round of Stage II on its surface in turn, then hollows; what Stage II last made, and all its rounds. A hull that
    is good enough stays, but for hollows; an object that the model fits badly all over gives no sign of them."""
    from mvps.digging import hollowed, pitted
    from mvps.joint.pixels import few_lights

    rounds, shift = list(rough.rounds), rough.rounds[0]["vertex_change_px"]
    words = f"views moved the hull by {shift:.2f} px"
    # Of fewer lights a view's normals say nothing of their own, and nothing asks the hull to move.
    if shift < GOOD_HULL and not few_lights(capture):
        with progress.stage("occupancy field") as stage:
            stage.status(f"skipped: {words}, less than {GOOD_HULL} px")
        found = rough
    else:
        found, more = in_turn(capture, grid, rough, settings, of_turn, progress, words)
        rounds += more
    if not (all(one.fusions for one in of_turn.rounds) and tells_of_hollows(capture, found)):
        return found, rounds
    for dig in (hollowed, pitted):
        found, more = dig(capture, grid, found, settings, of_turn, progress)
        rounds += more
    return found, rounds


def tells_of_hollows(capture: Capture, found: Refined) -> bool:
    """Whether the model fits so well that where it does not a hollow is likely."""
    import numpy as np

    from mvps.hollows import beyond_noise
    from mvps.material import POOR_FIT
    from mvps.noise import samples_noise

    if not outnumbers_unknowns(capture, found.surface):
        return False
    left = float(np.nanmedian(beyond_noise(found.unexplained, samples_noise(capture))))
    return found.rounds[-1]["residual"] <= POOR_FIT and left <= SIGNS * POOR_FIT


def outnumbers_unknowns(capture: Capture, surface: Surface) -> bool:
    """Whether half of what is seen is in more photographs than a vertex has unknowns: no more than that fit nearly any normal and albedo,
    and what they leave compares no surfaces."""
    from mvps.joint.pixels import few_lights
    from mvps.verdict import UNKNOWNS, photographs, seen_by

    return not few_lights(capture) or photographs(capture, surface, seen_by(capture, surface)) > UNKNOWNS


def in_turn(
    capture: Capture,
    grid: SignedDistanceGrid,
    rough: Refined,
    settings: Settings,
    of_turn: RefineSettings,
    progress: Progress,
    words: str,
) -> tuple[Refined, list[dict[str, float]]]:
    """Stage I and a coarse round in turn; what the last round made, and all rounds. words: Stage I's status.

    The field digs hollows by normals, the round goes on by photographs, and in a deeper hollow normals and lights are better: the field
    is trained again from these while the model fits badly, then with rounds on finer meshes, or lights turn, as long as the residual falls.
    """
    from mvps.device import chosen_device
    from mvps.joint.refine import MOVING_DEG
    from mvps.material import POOR_FIT
    from mvps.mesh import piece_count
    from mvps.occupancy import CONTINUED, EASED, Occupancy, OccupancySettings

    plan, refined, carried = EASED if of_turn.eased else OccupancySettings(), rough, None
    rounds: list[dict[str, float]] = []
    residual = rough.rounds[-1]["residual"]
    field = Occupancy(capture, grid, plan, settings.seed, chosen_device(settings.device), piece_count(rough.surface))
    surface = stage_one(field, rough.maps, plan, progress, words)
    for turn in range(MOST_TURNS):
        if turn:
            surface = stage_one(field, refined.maps, CONTINUED, progress)
        if turn == FINER_FROM and residual > POOR_FIT:
            of_turn = replace(of_turn, rounds=tuple(replace(one, edge=FINER * one.edge) for one in of_turn.rounds))
        refined = stage_two("coarse refinement", capture, surface, refined, of_turn, settings, progress, carried)
        before, turned = residual, max(one["light_change_deg"] for one in refined.rounds)
        rounds, carried, residual = rounds + refined.rounds, refined.carried, refined.rounds[-1]["residual"]
        if (residual <= POOR_FIT and turned <= MOVING_DEG) or residual >= before:
            break
    return refined, rounds


def begin(capture: Capture, masks: Capture, settings: Settings, lights: Lights | None, parts: Parts, progress: Progress) -> Begun:
    """What photographs and masks say before anything is solved together. masks: the same views, perhaps larger: thin parts are in no other
    way known to the hull."""
    from mvps.device import chosen_device
    from mvps.joint.thinned import thinned
    from mvps.photometric import normal_maps

    grid, surface = rough_shape(masks, progress)
    start = first_lights(capture, surface, lights, settings.seed, progress, parts.one_rig)
    with progress.stage("photometric stereo"):
        maps = normal_maps(*thinned(capture, start), chosen_device(settings.device))
    return Begun(grid, surface, start, maps, parts.law())


def eased(preset: str, capture: Capture, rounds: list[dict[str, float]]) -> bool:
    """Whether less of each does (docs/findings/stage_one.md): photographs abound and the model fits after these rounds. `fine` takes
    its time for the little that is to be had."""
    from mvps.joint.thinned import abundant
    from mvps.material import POOR_FIT

    return preset != "fine" and abundant(capture) and rounds[-1]["residual"] <= POOR_FIT


def coarse(
    used: Capture, settings: Settings, lights: Lights | None, parts: Parts, progress: Progress, step: Step
) -> tuple[Refined, list[dict[str, float]]]:
    """Shape, lights and normals for the last rounds to start from, and the rounds that they took, moves in pixels of `used`. Of large
    photographs at half their size, or less; what is found there is pulled to what each larger level but the last shows."""
    from mvps.plan import carving_pass, first_pass

    sizes = half_sizes(used, progress)
    level = sizes.pop()
    begun, plan = begin(level, used, settings, lights, parts, progress), parts.of(first_pass(lights is None, False))
    rough = step("first refinement", lambda: stage_two("first refinement", level, begun.surface, begun, plan, settings, progress))
    turns = parts.of(carving_pass(lights is None, eased(settings.preset, level, rough.rounds)))
    found: Refined
    found, rounds = step("shape", lambda: shaped(level, begun.grid, rough, settings, turns, progress))
    rounds = in_pixels(rounds, 2 ** len(sizes))
    while len(sizes) > 1:
        level, before = sizes.pop(), replace(found, maps=())
        name = f"refinement at {level.views[0].camera.width} x {level.views[0].camera.height}"
        found = step(name, partial(stage_two, name, level, before.surface, before, turns, settings, progress, before.carried))
        rounds = rounds + in_pixels(found.rounds, 2 ** len(sizes))
    return found, rounds


def half_sizes(capture: Capture, progress: Progress) -> list[Capture]:
    """`levels` of the capture, under the progress bar where there is more than one."""
    from mvps.pyramid import halvings, levels

    if not halvings(capture):
        return [capture]
    with progress.stage("half size") as stage:
        sizes = levels(capture)
        least = sizes[-1].views[0].camera
        stage.status(f"the shape is looked for at {least.width} x {least.height} pixels")
    return sizes


def in_pixels(rounds: list[dict[str, float]], factor: int) -> list[dict[str, float]]:
    """Rounds on a level whose pixels are `factor` of the photographs' wide, with moves in the photographs'."""
    return [{key: value * factor if key.endswith("_px") else value for key, value in one.items()} for one in rounds]
