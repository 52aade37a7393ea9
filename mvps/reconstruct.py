"""The pipeline, photographs in, textured mesh out, and its command line.

capture -> visual hull -> lights -> photometric stereo of every view -> Stage I: occupancy field -> Stage II: everything together
        -> lights of held-out photographs, normal maps -> textures, report, result folder
"""

from __future__ import annotations

import gc
import sys
from argparse import ArgumentTypeError
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

from mvps.command import DEVICES, lights_argument, number_list, parse, parser, positive, run, whole
from mvps.finding import Finding
from mvps.inputs import shown
from mvps.memory import keep_below
from mvps.outcome import all_lights, lights_in, lights_of, normal_pictures, told, versions
from mvps.progress import Progress, peak_memory_mb
from mvps.scene import Capture, CaptureError, Law, Lights, NormalMap, Reconstruction

if TYPE_CHECKING:
    from mvps.checkpoint import Checkpoints
    from mvps.coarse import Step
    from mvps.joint.refine import Refined
    from mvps.plan import Parts

PRESETS = ("draft", "standard", "fine")

Numbers = Sequence[int]
LightNumbers = Numbers | Mapping[str, Numbers]

TEXELS_PER_PIXEL = {"draft": 1, "standard": 2, "fine": 2}
"""Texels along one pixel's footprint. With two, interpolating twice (photograph, texture) loses little of what pixels hold; one takes half
the time."""

FEWER_LIGHTS = 2
"""How many times fewer lights of a view tell its pixels' albedo than tell their six unknowns (mvps/joint/thinned.py), in `draft`, and in
`standard` where photographs abound."""


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
        if len(set(wanted)) < len(wanted):
            given = ",".join(map(str, wanted))
            raise CaptureError(f"--hold-out-{what}: wanted each number once, given {given}; remove the repeated one")
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


def drafted(used: Capture, settings: Settings, lights: Lights | None, parts: Parts, progress: Progress, step: Step) -> Refined:
    """Stage II on the hull alone."""
    from mvps.coarse import begin
    from mvps.passes import stage_two
    from mvps.plan import first_pass

    begun, plan = begin(used, used, settings, lights, parts, progress), parts.of(first_pass(lights is None, True))
    refined: Refined = step("joint refinement", lambda: stage_two("joint refinement", used, begun.surface, begun, plan, settings, progress))
    return refined


def reconstruct(
    capture: Capture,
    settings: Settings,
    lights: Lights | None,
    progress: Progress,
    parts: Parts | None = None,
    checkpoints: Checkpoints | None = None,
    findings: Sequence[Finding] = (),
) -> Reconstruction:
    """The whole way, values in, values out. lights: calibrated ones of all photographs, or None to solve them. parts: all if None.
    checkpoints: of long stages, kept and gone on from; none if None. findings: of the capture's checks, for the account."""
    from mvps.coarse import coarse, eased
    from mvps.cores import blas_as_asked
    from mvps.device import chosen_device
    from mvps.joint.pixels import few_lights
    from mvps.material import POOR_FIT
    from mvps.own_units import in_own_units, in_world_units, own_units
    from mvps.passes import stage_two
    from mvps.plan import Parts, last_pass
    from mvps.pyramid import halvings
    from mvps.thin import with_thin_parts, without_thin_parts

    blas_as_asked()
    parts = parts or Parts()
    used, held = parted(capture, settings.hold_out_views, settings.hold_out_lights)
    if len(used.views) == 1:
        from mvps.oneview import reconstruct_view

        return reconstruct_view(capture, used, held, settings, lights, parts, progress, findings)
    own = own_units(used)
    given = lights and lights_in(lights, capture, used)
    capture, used = in_own_units(capture, own), in_own_units(used, own)
    held = held and in_own_units(held, own)
    rest = without_thin_parts(used, progress)

    def step(name: str, make: Callable[[], Any]) -> Any:
        return make() if checkpoints is None else checkpoints.step(name, make, progress)

    rounds: list[dict[str, float]] = []
    if settings.preset == "draft":
        refined = drafted(rest, settings, given, parts, progress, step)
    else:
        start, rounds = coarse(rest, settings, given, parts, progress, step)
        # Where the model fits badly, ever finer meshes follow biased normals, and lights would follow the mesh: they stay with Stage I's.
        fits, less = start.rounds[-1]["residual"] <= POOR_FIT, eased(settings.preset, rest, start.rounds)
        far = few_lights(rest) or halvings(rest) > 0
        start = replace(start, maps=()) if halvings(rest) else start
        plan, name = parts.of(last_pass(settings.preset, given is None, far, rounds, less)), "joint refinement"
        plan = replace(plan, free_lights=plan.free_lights and fits)
        refined = step(name, lambda: stage_two(name, rest, start.surface, start, plan, settings, progress, start.carried))
        if given is None and not fits and start.status != "converged":
            # Lights that stay where they still turned have not settled.
            refined = replace(refined, status=start.status, text=start.text)
    refined, lacking = with_thin_parts(refined, rest, used)
    with progress.stage("lights and normals of all views"):
        device = chosen_device(settings.device)
        complete = all_lights(capture, used, held, refined.lights, refined.surface, refined.material, device, lights)
        pictures = normal_pictures(capture, used, refined)
    result = told(capture, used, asdict(settings), refined, complete, pictures, rounds + refined.rounds, progress, [*findings, *lacking])
    return in_world_units(result, own)


def write(reconstruction: Reconstruction, capture: Capture, settings: Settings, out: Path, progress: Progress) -> None:
    """Textures, report and the result folder."""
    from mvps.export import write_reconstruction
    from mvps.joint.thinned import abundant, thinned
    from mvps.mesh import decimated
    from mvps.pbr import fit_error
    from mvps.report import report_html
    from mvps.texture import bake

    used, _ = parted(capture, settings.hold_out_views, settings.hold_out_lights)
    with progress.stage("textures") as stage:
        # A texel is seen by several views: their kept lights together determine its albedo several times over.
        fewer_lights = settings.preset == "draft" or (settings.preset == "standard" and abundant(used))
        lights = lights_of(reconstruction.lights, reconstruction.views, reconstruction.light_names, used)
        part, lights = thinned(used, lights, FEWER_LIGHTS if fewer_lights else 1)
        density = TEXELS_PER_PIXEL[settings.preset]
        surface = reconstruction.surface
        fewer = [faces for faces in settings.faces if faces < len(surface.faces)]
        shells = {faces: shell for faces in fewer if (shell := decimated(surface, faces)) is not None}
        maps = [reconstruction.own_normals[reconstruction.views.index(view.name)] for view in part.views]
        textures, *levels = bake(surface, reconstruction.material, lights, part, density, tuple(shells.values()), maps)
        off = fit_error(reconstruction.material.specular_weight, reconstruction.material.law)
        said = [f"glTF's highlights are {100 * off:.0f} % off ours" if off else "no highlights"]
        if len(fewer) < len(settings.faces):
            more = ", ".join(str(faces) for faces in settings.faces if faces not in fewer)
            said.append(f"no models of {more} faces: the mesh has {len(surface.faces)}")
        if any(faces not in shells for faces in fewer):
            said.append("no models of fewer faces: the mesh has an edge of more than two")
        stage.status("; ".join(said))
    metrics = {**reconstruction.metrics, "stages": progress.stages}
    finished = replace(reconstruction, metrics=metrics)
    with progress.stage("report and files"):
        smaller, cameras = dict(zip(shells, levels, strict=True)), {view.name: view.camera for view in capture.views}
        write_reconstruction(finished, out, textures, report_html(finished, capture), smaller, cameras)


def checkpoints_of(out: Path, capture: Capture, settings: Settings, lights: Lights | None, resume: bool) -> Checkpoints:
    """Those of this run in its result's place."""
    from mvps.checkpoint import Checkpoints, fingerprint, program
    from mvps.device import chosen_device
    from mvps.folders import CHECKPOINT
    from mvps.joint.blocks import Vertices
    from mvps.joint.refine import Refined
    from mvps.material import Trial
    from mvps.scene import Material, Residual, Surface

    # From wherever and by whatever path it is given, a capture is known by what it holds.
    options = {name: value for name, value in asdict(settings).items() if name != "capture"}
    run = {"settings": options, "versions": versions(), "program": program(), "capture": fingerprint(capture, lights)}
    kinds = (Refined, Surface, Material, Residual, Lights, NormalMap, Law, Trial, Vertices)
    return Checkpoints(out / CHECKPOINT, run, kinds, chosen_device(settings.device), resume)


def load_libraries() -> None:
    """What the stages are made of: 2 s on one core, while photographs are decoded outside the interpreter's lock."""
    # Of libraries nothing ever is garbage, for which all of their half a million objects would be looked through again and again.
    gc.disable()
    try:
        for name in ("mvps.joint.refine", "mvps.report", "mvps.sound", "mvps.texture", "gpytoolbox", "gpytoolbox_bindings"):
            import_module(name)
    finally:
        gc.freeze()
        gc.enable()


def face_counts(text: str) -> tuple[int, ...]:
    """Numbers of faces, each once: "20000,5000" -> (20000, 5000)."""
    from mvps.mesh import LEAST_FACES

    counts = tuple(dict.fromkeys(number_list(text)))
    if min(counts) < LEAST_FACES:
        raise ArgumentTypeError(f"wanted {LEAST_FACES} faces or more, as many as a closed mesh has at least, given {min(counts)}")
    return counts


FACES_HELP = "write models of about so many faces too (model_N.glb, model_N.obj, mesh_N.ply), their detail in the normal map"


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
    made.add_argument("--device", choices=DEVICES, default="auto", help="where torch computes")
    made.add_argument("--max-memory", type=positive, metavar="GB", help="keep the resident set below, or end with what it takes")
    made.add_argument("--seed", type=whole, default=0, help="of all random draws")
    made.add_argument("--faces", type=face_counts, default=(), metavar="N,N", help=FACES_HELP)
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

    # Says what is wrong with numbers before anything is looked at.
    parted(capture, settings.hold_out_views, settings.hold_out_lights)
    lights = read_calibrated_lights(given.capture, capture) if given.calibrated_lights else None
    capture, findings = sound(capture, progress, settings.hold_out_views, lights is None or lights.one_rig)
    # Once more, for they turn with cameras that were moved.
    lights = lights and read_calibrated_lights(given.capture, capture)
    kept = checkpoints_of(given.out, capture, settings, lights, given.resume)
    reconstruction = reconstruct(capture, settings, lights, progress, checkpoints=kept, findings=findings)
    write(reconstruction, capture, settings, given.out, progress)
    for one in reconstruction.metrics["findings"]:
        print(f"{one['where']}: {one['text']}")
    print(f"{given.out}: {reconstruction.metrics['status']['name']}. {reconstruction.metrics['status']['text']}")


if __name__ == "__main__":
    sys.exit(run(main))
