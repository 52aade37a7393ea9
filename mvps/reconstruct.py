"""The pipeline, photographs in, textured mesh out, and its command line.

capture -> visual hull -> lights -> photometric stereo of every view -> Stage I: occupancy field -> Stage II: everything together
        -> lights of held-out photographs, normal maps -> textures, report, result folder
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any, NamedTuple

from mvps.command import lights_argument, number_list, parse, parser, positive, run
from mvps.finding import Finding
from mvps.inputs import shown
from mvps.memory import keep_below
from mvps.outcome import all_lights, normal_pictures, told, versions
from mvps.progress import Progress, peak_memory_mb
from mvps.scene import Capture, CaptureError, Law, Lights, NormalMap, Reconstruction

if TYPE_CHECKING:
    from mvps.checkpoint import Checkpoints
    from mvps.joint.refine import Refined, RefineSettings
    from mvps.occupancy import Occupancy, OccupancySettings
    from mvps.plan import Parts
    from mvps.scene import SignedDistanceGrid, Surface

PRESETS = ("draft", "standard", "fine")

Numbers = Sequence[int]
LightNumbers = Numbers | Mapping[str, Numbers]

Step = Callable[[str, Callable[[], Any]], Any]
"""Makes what a long stage makes, under its name; or takes it from where it was kept."""

TEXELS_PER_PIXEL = {"draft": 1, "standard": 2, "fine": 2}
"""Texels along one pixel's footprint. With two, interpolating twice (photograph, texture) loses little of what pixels hold; one takes half
the time."""

GOOD_HULL = 0.2
"""Mean shift, pixels, that views ask of the hull, below which Stage I is left out: of what comes out of Stage I they ask 0.13 to 0.31 (five
captures, docs/method.md), so it would do no better."""

MOVING_DEG = 1.0
"""Mean turn of the lights in a round from which on the field has seen other lights than there are: wrong by a degree, they bend normals by
as much. Where the model fits, lights of eight captures turned by 0.06 to 0.9 deg, and by 3.8 where four views leave the hull four pixels
off (docs/method.md)."""

MOST_TURNS = 6
"""Of Stage I and a round of Stage II. One is enough where the model fits; where it fits badly each takes another part off the errors, as
long as the residual falls."""


@dataclass(frozen=True)
class Settings:
    """Everything needed to run a reconstruction again.

    views, lights: numbers to use, counted from 1, empty for all; hold_out_views, hold_out_lights: numbers kept back for evaluation;
    faces: of the smaller models beside the full one.
    """

    capture: str
    preset: str = "standard"
    views: Numbers = ()
    lights: LightNumbers = ()
    hold_out_views: Numbers = ()
    hold_out_lights: Numbers = ()
    calibrated_lights: bool = False
    device: str = "auto"
    seed: int = 0
    faces: Numbers = ()


def parted(capture: Capture, hold_out_views: Numbers, hold_out_lights: Numbers) -> tuple[Capture, Capture | None]:
    """What is reconstructed from, and the same views with the lights that were kept back plus the views that were, all their lights
    (None where nothing is).

    CaptureError where the capture has no such view or light, and where nothing would be left to reconstruct from.
    """
    views = {int(view.name[5:]) for view in capture.views}
    lights = {number for view in capture.views for number in view.lights}
    for what, wanted, there in (("views", hold_out_views, views), ("lights", hold_out_lights, lights)):
        unknown = sorted(set(wanted) - there)
        if unknown:
            raise CaptureError(f"--hold-out-{what}: wanted some of {', '.join(map(str, sorted(there)))}, given {unknown[0]}")
    keep: dict[str, list[int]] = {}
    back: dict[str, list[int]] = {}
    for view in capture.views:
        held = int(view.name[5:]) in hold_out_views
        keep[view.name] = [] if held else [n for n in view.lights if n not in hold_out_lights]
        back[view.name] = list(view.lights) if held else [n for n in view.lights if n in hold_out_lights]
    if not any(keep.values()):
        raise CaptureError(f"{capture.name}: wanted photographs left after holding some out, given none; hold out fewer views or lights")
    used = capture.select({name: numbers for name, numbers in keep.items() if numbers})
    rest = {name: numbers for name, numbers in back.items() if numbers}
    return used, capture.select(rest) if rest else None


def rough_shape(capture: Capture, progress: Progress) -> tuple[SignedDistanceGrid, Surface]:
    """The visual hull as a grid and as a surface."""
    from mvps.hull import default_cells, signed_distance, visual_hull

    with progress.stage("visual hull") as stage:
        grid = signed_distance(capture, default_cells(capture))
        surface = visual_hull(grid)
        stage.status(f"{len(surface.vertices)} vertices, cells of {grid.spacing:.3g} units")
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


def stage_one(field: Occupancy, maps: tuple[NormalMap, ...], plan: OccupancySettings, progress: Progress, words: str = "") -> Surface:
    """The occupancy field under the progress bar; words: its status."""
    with progress.stage("occupancy field", total=plan.steps) as stage:
        stage.status(words)
        return field.trained(maps, plan, lambda _, loss: stage.advance(1, loss=loss))


def shaped(
    capture: Capture, grid: SignedDistanceGrid, rough: Refined, settings: Settings, of_turn: RefineSettings, progress: Progress
) -> tuple[Refined, list[dict[str, float]]]:
    """Stage I and a coarse round of Stage II on its surface in turn; what Stage II last made, and all its rounds.

    The field digs hollows by normals, the round goes on by photographs, and in a deeper hollow normals and lights are better: the field
    is trained again from these while the model fits badly or lights turn, as long as the residual falls. A hull that is good enough stays.
    """
    from mvps.device import chosen_device
    from mvps.joint.pixels import few_lights
    from mvps.material import POOR_FIT
    from mvps.occupancy import CONTINUED, Occupancy, OccupancySettings

    rounds, shift = list(rough.rounds), rough.rounds[0]["vertex_change_px"]
    words = f"views moved the hull by {shift:.2f} px"
    # Of fewer lights a view's normals say nothing of their own, and nothing asks the hull to move.
    if shift < GOOD_HULL and not few_lights(capture):
        with progress.stage("occupancy field") as stage:
            stage.status(f"skipped: {words}, less than {GOOD_HULL} px")
        return rough, rounds
    plan, refined, carried = OccupancySettings(), rough, None
    field = Occupancy(capture, grid, plan, settings.seed, chosen_device(settings.device))
    surface = stage_one(field, rough.maps, plan, progress, words)
    for turn in range(MOST_TURNS):
        if turn:
            surface = stage_one(field, refined.maps, CONTINUED, progress)
        refined = stage_two("coarse refinement", capture, surface, refined, of_turn, settings, progress, carried)
        residuals = [one["residual"] for one in rounds + refined.rounds if "residual" in one]
        rounds, carried = rounds + refined.rounds, refined.carried
        fits = residuals[-1] <= POOR_FIT and refined.rounds[-1]["light_change_deg"] <= MOVING_DEG
        if fits or residuals[-1] >= residuals[-2]:
            break
    return refined, rounds


def stage_two(
    name: str,
    capture: Capture,
    surface: Surface,
    of: Begun | Refined,
    plan: RefineSettings,
    settings: Settings,
    progress: Progress,
    carried: tuple[Surface, Any] | None = None,
) -> Refined:
    """Rounds of Stage II under the progress bar, from a surface and the lights, normal maps and image model `of` what came before."""
    from mvps.device import chosen_device
    from mvps.joint.refine import refine

    with progress.stage(name, total=len(plan.rounds)) as stage:

        def on_round(_: int, changes: dict[str, float]) -> None:
            stage.advance(1, **{k: v for k, v in changes.items() if k in ("residual", "light_change_deg", "vertex_change_px")})

        device = chosen_device(settings.device)
        refined = refine(capture, surface, of.lights, of.maps, of.law, plan, settings.seed, device, on_round, carried)
        stage.status(refined.status)
    return refined


class Begun(NamedTuple):
    """What Stage II starts with: the hull, as a grid too, lights, and the views' photometric stereo under them."""

    grid: SignedDistanceGrid
    surface: Surface
    lights: Lights
    maps: tuple[NormalMap, ...]
    law: Law


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


def drafted(used: Capture, settings: Settings, lights: Lights | None, parts: Parts, progress: Progress, step: Step) -> Refined:
    """Stage II on the hull alone."""
    from mvps.plan import first_pass

    begun, plan = begin(used, used, settings, lights, parts, progress), parts.of(first_pass(lights is None, True))
    refined: Refined = step("joint refinement", lambda: stage_two("joint refinement", used, begun.surface, begun, plan, settings, progress))
    return refined


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
    turns = parts.of(carving_pass(lights is None))
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


def reconstruct(
    capture: Capture,
    settings: Settings,
    lights: Lights | None,
    progress: Progress,
    parts: Parts | None = None,
    checkpoints: Checkpoints | None = None,
    findings: Sequence[Finding] = (),
) -> Reconstruction:
    """The whole way, values in, values out. lights: calibrated ones of all photographs used, or None to solve them. parts: all if None.
    checkpoints: of long stages, kept and gone on from; none if None. findings: of the capture's checks, for the account."""
    from mvps.device import chosen_device
    from mvps.joint.pixels import few_lights
    from mvps.material import POOR_FIT
    from mvps.plan import Parts, last_pass
    from mvps.pyramid import halvings

    parts = parts or Parts()
    used, held = parted(capture, settings.hold_out_views, settings.hold_out_lights)
    if len(used.views) == 1:
        from mvps.oneview import reconstruct_view

        return reconstruct_view(capture, used, held, settings, lights, parts, progress, findings)

    def step(name: str, make: Callable[[], Any]) -> Any:
        return make() if checkpoints is None else checkpoints.step(name, make, progress)

    rounds: list[dict[str, float]] = []
    if settings.preset == "draft":
        refined = drafted(used, settings, lights, parts, progress, step)
    else:
        start, rounds = coarse(used, settings, lights, parts, progress, step)
        # Where the model fits badly, ever finer meshes follow biased normals, and lights would follow the mesh: they stay with Stage I's.
        free = lights is None and start.rounds[-1]["residual"] <= POOR_FIT
        far = few_lights(used) or halvings(used) > 0
        start = replace(start, maps=()) if halvings(used) else start
        plan, name = parts.of(last_pass(settings.preset, free, far)), "joint refinement"
        refined = step(name, lambda: stage_two(name, used, start.surface, start, plan, settings, progress, start.carried))
    with progress.stage("lights and normals of all views"):
        complete = all_lights(capture, used, held, refined.lights, refined.surface, refined.material, chosen_device(settings.device))
        pictures = normal_pictures(capture, used, refined)
    return told(capture, used, asdict(settings), refined, complete, pictures, rounds + refined.rounds, progress, findings)


def write(reconstruction: Reconstruction, capture: Capture, settings: Settings, out: Path, progress: Progress) -> None:
    """Textures, report and the result folder."""
    from mvps.export import write_reconstruction
    from mvps.joint.thinned import thinned
    from mvps.mesh import decimated
    from mvps.report import report_html
    from mvps.texture import bake

    used, _ = parted(capture, settings.hold_out_views, settings.hold_out_lights)
    with progress.stage("textures") as stage:
        # A texel is seen by several views: their kept lights together determine its albedo several times over.
        part, lights = thinned(used, lights_of(reconstruction, used))
        density = TEXELS_PER_PIXEL[settings.preset]
        surface = reconstruction.surface
        shells = {faces: shell for faces in settings.faces if (shell := decimated(surface, faces)) is not None}
        textures, *levels = bake(surface, reconstruction.material, lights, part, density, tuple(shells.values()))
        if len(shells) < len(settings.faces):
            stage.status("no models of fewer faces: the mesh has an edge of more than two")
    metrics = {**reconstruction.metrics, "stages": progress.stages}
    finished = replace(reconstruction, metrics=metrics)
    with progress.stage("report and files"):
        write_reconstruction(finished, out, textures, report_html(finished, capture), dict(zip(shells, levels, strict=True)))


def checkpoints_of(out: Path, capture: Capture, settings: Settings, lights: Lights | None, resume: bool) -> Checkpoints:
    """Those of this run in its result's place."""
    from mvps.checkpoint import Checkpoints, fingerprint, program
    from mvps.device import chosen_device
    from mvps.folders import CHECKPOINT
    from mvps.joint.blocks import Vertices
    from mvps.joint.refine import Refined
    from mvps.material import Trial
    from mvps.scene import Law, Material, Residual, Surface

    run = {"settings": asdict(settings), "versions": versions(), "program": program(), "capture": fingerprint(capture, lights)}
    kinds = (Refined, Surface, Material, Residual, Lights, NormalMap, Law, Trial, Vertices)
    return Checkpoints(out / CHECKPOINT, run, kinds, chosen_device(settings.device), resume)


def lights_of(reconstruction: Reconstruction, capture: Capture) -> Lights:
    """The reconstruction's lights for just the photographs of `capture`."""
    directions, intensities = [], []
    for view in capture.views:
        at = reconstruction.views.index(view.name)
        rows = [reconstruction.light_names[at].index(n) for n in view.lights]
        directions.append(reconstruction.lights.direction[at][rows])
        intensities.append(reconstruction.lights.intensity[at][rows])
    return Lights(tuple(directions), tuple(intensities), reconstruction.lights.one_rig)


def load_libraries() -> None:
    """What the stages are made of: 2 s on one core, while photographs are decoded outside the interpreter's lock."""
    for name in ("mvps.joint.refine", "mvps.report", "mvps.sound", "mvps.texture", "gpytoolbox", "gpytoolbox_bindings"):
        import_module(name)


FACES_HELP = "write models of about so many faces too (model_N.glb, model_N.obj), their detail in the normal map"


def main(argv: Sequence[str]) -> None:
    """The command line."""
    made = parser("mvps.reconstruct", __doc__ or "")
    made.add_argument("capture", type=Path, help="folder in the DiLiGenT-MV layout")
    made.add_argument("--out", type=Path, required=True, help="result folder; an earlier result there is replaced")
    made.add_argument("--preset", choices=PRESETS, default="standard", help="how much time to spend")
    made.add_argument("--views", type=number_list, default=(), help="numbers of the views to read, counted from 1; all if not given")
    made.add_argument("--lights", type=lights_argument, default=(), help="numbers of the lights, or a JSON file with a list per view")
    made.add_argument("--hold-out-views", type=number_list, default=(), help="views kept back for evaluation")
    made.add_argument("--hold-out-lights", type=number_list, default=(), help="lights kept back for evaluation")
    made.add_argument("--calibrated-lights", action="store_true", help="use the lights given with the capture instead of solving them")
    made.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where torch computes")
    made.add_argument("--max-memory", type=positive, metavar="GB", help="keep the resident set below, or end with what it takes")
    made.add_argument("--seed", type=int, default=0, help="of all random draws")
    made.add_argument("--faces", type=number_list, default=(), metavar="N,N", help=FACES_HELP)
    made.add_argument("--resume", action="store_true", help="go on where an interrupted run with the same options stopped")
    given = parse(made, argv)
    settings = Settings(
        shown(given.capture),
        given.preset,
        given.views,
        given.lights,
        given.hold_out_views,
        given.hold_out_lights,
        given.calibrated_lights,
        given.device,
        given.seed,
        given.faces,
    )
    from mvps.folders import CHECKPOINT, RESULT_MARKS, check_place
    from mvps.load import read_calibrated_lights, read_capture

    libraries = Thread(target=load_libraries)

    def before_decoding(sizes: list[tuple[int, int]]) -> None:
        libraries.start()
        if given.max_memory is not None:
            # What the program takes is known once its libraries are there.
            libraries.join()
            keep_below(given.max_memory, 1e6 * peak_memory_mb(), sizes, given.preset)

    check_place(given.out.resolve(), RESULT_MARKS, CHECKPOINT)
    progress = Progress()
    with progress.stage("load") as stage:
        capture = read_capture(given.capture, given.views or None, given.lights or None, before_decoding)
        stage.status(f"{len(capture.views)} views, {sum(len(view.lights) for view in capture.views)} photographs")
        if libraries.is_alive():
            # Not by an import: interrupted in one, it would leave the other thread waiting for ever.
            libraries.join()
    from mvps.sound import sound

    capture, findings = sound(capture, progress)
    used, _ = parted(capture, settings.hold_out_views, settings.hold_out_lights)
    lights = read_calibrated_lights(given.capture, used) if given.calibrated_lights else None
    kept = checkpoints_of(given.out, capture, settings, lights, given.resume)
    reconstruction = reconstruct(capture, settings, lights, progress, checkpoints=kept, findings=findings)
    write(reconstruction, capture, settings, given.out, progress)
    for one in findings:
        print(f"{one.where}: {one.text}")
    print(f"{given.out}: {reconstruction.metrics['status']['name']}. {reconstruction.metrics['status']['text']}")


if __name__ == "__main__":
    sys.exit(run(main))
