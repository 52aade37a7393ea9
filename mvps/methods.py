"""python -m mvps.methods CAPTURE --method NAME --out RESULT: one method of those that mvps.compare sets side by side.

Ours in its presets; ours with a part left out (ablations: mvps.plan.Parts); what came before a part (hull, Stage I); published methods
written from their papers (mvps.baselines). Every one takes the same capture and writes the same kind of result folder.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mvps.command import device_name, lights_argument, number_list, parse, parser, run, whole
from mvps.finding import Finding
from mvps.inputs import shown
from mvps.progress import Progress
from mvps.reconstruct import Settings, parted
from mvps.scene import Capture, Lights, Reconstruction

if TYPE_CHECKING:
    from mvps.plan import Parts

Run = Callable[[Capture, Settings, Lights | None, Progress, Sequence[Finding]], Reconstruction]
"""From a capture, held-out photographs included, settings, calibrated lights of all of it, if they were asked for, and what was found in
it, of which our own account tells more."""


@dataclass(frozen=True)
class Method:
    """A method: what it is, in words; how it runs; whether it wants the capture's calibrated lights."""

    words: str
    run: Run
    calibrated: bool = False


def _ours(preset: str, parts: Callable[[], Parts] | None = None) -> Run:
    """Ours with these parts, all if None; a function makes them, for their module takes a second to import."""

    def run_(
        capture: Capture, settings: Settings, lights: Lights | None, progress: Progress, findings: Sequence[Finding]
    ) -> Reconstruction:
        from mvps.reconstruct import reconstruct

        return reconstruct(capture, replace(settings, preset=preset), lights, progress, parts() if parts else None, findings=findings)

    return run_


def _lambert() -> Parts:
    from mvps.material import Model
    from mvps.plan import Parts

    return Parts(model=Model())


def _no_neural() -> Parts:
    from mvps.material import LARGEST
    from mvps.plan import Parts

    return Parts(model=replace(LARGEST, neural=False))


def _with(**parts: float) -> Callable[[], Parts]:
    def made() -> Parts:
        from mvps.plan import Parts

        return Parts(**parts)  # type: ignore[arg-type]

    return made


def _ablation(parts: Callable[[], Parts]) -> Run:
    return _ours("standard", parts)


def _hull(capture: Capture, settings: Settings, lights: Lights | None, progress: Progress, findings: Sequence[Finding]) -> Reconstruction:
    from mvps.stages import hull

    return hull(capture, settings, lights, progress)


def _stage1(capture: Capture, settings: Settings, lights: Lights | None, progress: Progress, findings: Sequence[Finding]) -> Reconstruction:
    from mvps.stages import stage1

    return stage1(capture, settings, lights, progress)


def _radiance(density: bool, with_normals: bool) -> Run:
    def run_(
        capture: Capture, settings: Settings, lights: Lights | None, progress: Progress, findings: Sequence[Finding]
    ) -> Reconstruction:
        from mvps.stages import radiance

        return radiance(capture, settings, lights, progress, density, with_normals)

    return run_


def _pj16(capture: Capture, settings: Settings, lights: Lights | None, progress: Progress, findings: Sequence[Finding]) -> Reconstruction:
    from mvps.baselines.pj16 import pj16

    used, _ = parted(capture, settings.hold_out_views, settings.hold_out_lights)
    return _whole(pj16(used, settings.seed, progress), capture, settings)


def _lz20(capture: Capture, settings: Settings, lights: Lights | None, progress: Progress, findings: Sequence[Finding]) -> Reconstruction:
    from mvps.baselines.lz20 import lz20
    from mvps.outcome import lights_in

    assert lights is not None
    used, _ = parted(capture, settings.hold_out_views, settings.hold_out_lights)
    return _whole(lz20(used, lights_in(lights, capture, used), progress), capture, settings, lights)


def _whole(made: Reconstruction, capture: Capture, settings: Settings, given: Lights | None = None) -> Reconstruction:
    """The result for all views and lights, made of those that are not held out: lights of the others as ours have them, those `given` or
    not, the mesh's normals in the other views."""
    import numpy as np

    from mvps.device import chosen_device
    from mvps.measures import mesh_normals
    from mvps.outcome import all_lights, versions
    from mvps.visibility import ray_caster

    used, held = parted(capture, settings.hold_out_views, settings.hold_out_lights)
    device = chosen_device(settings.device)
    lights = all_lights(capture, used, held, made.lights, made.surface, made.material, device, given)
    maps, caster = dict(zip(made.views, made.normal_maps, strict=True)), ray_caster(made.surface)
    names = tuple(view.name for view in capture.views)
    pictures = tuple(maps[v.name] if v.name in maps else mesh_normals(caster, v).astype(np.float32) for v in capture.views)
    numbers = tuple(view.lights for view in capture.views)
    account = {**asdict(settings), "versions": versions()}
    return Reconstruction(made.surface, made.material, lights, names, numbers, pictures, made.metrics, account)


METHODS = {
    "ours": Method("all of the method, preset standard", _ours("standard")),
    "ours-draft": Method("preset draft: no Stage I, coarser mesh", _ours("draft")),
    "ours-fine": Method("preset fine: finer mesh", _ours("fine")),
    "pj16": Method("Park et al. 2017: uncalibrated photometric stereo in a mesh's parameter domain", _pj16),
    "lz20": Method("Li et al. 2020: isotropy, iso-depth contours, with the true lights", _lz20, calibrated=True),
    "hull": Method("the visual hull, lights of the factorisation", _hull),
    "stage1": Method("Stage I alone: normal-regularised occupancy field", _stage1),
    "nerf": Method("radiance field of density, on light-averaged photographs", _radiance(True, False)),
    "nerf+n": Method("the same with the loss on normals of photometric stereo", _radiance(True, True)),
    "unisurf": Method("radiance field of occupancy, on light-averaged photographs", _radiance(False, False)),
    "unisurf+n": Method("the same with the loss on normals of photometric stereo", _radiance(False, True)),
    "lambert": Method("ours with albedo alone: no lobes, no inter-reflection, no neural residual", _ablation(_lambert)),
    "microfacet": Method("ours with GGX lobes in place of spherical Gaussians", _ablation(_with(microfacet=True))),
    "fixed-light": Method("ours, the lights of the factorisation refined in colour alone", _ablation(_with(free_lights=False))),
    "no-visibility": Method("ours without cast shadows", _ablation(_with(shadows=False))),
    "per-view-lights": Method("ours with the lights of every view on their own", _ablation(_with(one_rig=False))),
    "no-vertex-step": Method("ours, but Stage II leaves the vertices where Stage I put them", _ablation(_with(moves=False))),
    "no-neural": Method("ours without a neural residual", _ablation(_no_neural)),
    "calibrated": Method("ours with the true lights", _ours("standard"), calibrated=True),
    "draft-2x": Method("preset draft with edges twice as long", _ours("draft", _with(edges=2.0))),
    "draft-0.7x": Method("preset draft with edges 0.7 times as long", _ours("draft", _with(edges=0.7))),
    "standard-1.4x": Method("preset standard with edges 1.4 times as long", _ours("standard", _with(edges=1.4))),
}
"""By the name that --method and --methods take."""

BUDGETS = ("draft-2x", "ours-draft", "draft-0.7x", "standard-1.4x", "ours", "ours-fine")
"""Ours as its budget grows, for the curve of error against time."""


def run_method(path: Path, name: str, settings: Settings, out: Path) -> None:
    """Read the capture, run the method and write its result folder. CaptureError where the method cannot run on it."""
    from mvps.export import write_reconstruction
    from mvps.folders import CHECKPOINT, RESULT_MARKS, check_place
    from mvps.load import read_calibrated_lights, read_capture
    from mvps.sound import sound

    check_place(out.resolve(), RESULT_MARKS, CHECKPOINT)
    method, progress = METHODS[name], Progress()
    with progress.stage("load"):
        capture = read_capture(path, settings.views or None, settings.lights or None)
    parted(capture, settings.hold_out_views, settings.hold_out_lights)
    lights = read_calibrated_lights(path, capture) if method.calibrated else None
    capture, findings = sound(capture, progress, settings.hold_out_views, lights is None or lights.one_rig)
    lights = lights and read_calibrated_lights(path, capture)
    made = method.run(capture, replace(settings, calibrated_lights=method.calibrated), lights, progress, findings)
    metrics = {"findings": [asdict(one) for one in findings], **made.metrics, "stages": progress.stages}
    finished = replace(made, metrics=metrics, settings={**made.settings, "method": name})
    write_reconstruction(finished, out, cameras={view.name: view.camera for view in capture.views})


OPTIONS: dict[str, tuple[Callable[[str], Any], Any, str]] = {
    "views": (number_list, (), "numbers of the views to read, counted from 1; all if not given"),
    "lights": (lights_argument, (), "numbers of the lights, or a JSON file with a list per view"),
    "hold-out-views": (number_list, (), "views kept back for evaluation"),
    "device": (device_name, "auto", "where torch computes: auto, cpu or cuda"),
    "seed": (whole, 0, "of all random draws"),
}
"""What every method takes: type, default, help by name."""


def listed_methods() -> str:
    """The methods, one a line."""
    return "\n".join(f"  {name:16} {method.words}" for name, method in METHODS.items())


def main(argv: Sequence[str]) -> None:
    """The command line."""
    made = parser("mvps.methods", f"Run one method on a capture and write its result folder, without textures.\n\n{listed_methods()}")
    made.add_argument("capture", type=Path, help="folder in the DiLiGenT-MV layout")
    made.add_argument("--method", choices=METHODS, required=True, metavar="NAME", help="one of the above")
    made.add_argument("--out", type=Path, required=True, help="result folder; an earlier result there is replaced")
    for name, (kind, default, words) in OPTIONS.items():
        made.add_argument(f"--{name}", type=kind, default=default, help=words)
    given = parse(made, argv)
    chosen = {name.replace("-", "_"): getattr(given, name.replace("-", "_")) for name in OPTIONS}
    run_method(given.capture, given.method, Settings(shown(given.capture), **chosen), given.out)


if __name__ == "__main__":
    raise SystemExit(run(main))
