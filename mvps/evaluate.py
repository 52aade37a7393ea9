"""python -m mvps.evaluate RESULT --truth CAPTURE: a reconstruction against ground truth, as a table and as JSON."""

from __future__ import annotations

import json
from argparse import SUPPRESS, ArgumentTypeError
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from mvps.command import parse, parser, run
from mvps.folders import check_file, write_whole

if TYPE_CHECKING:
    from mvps.scene import Capture, Reconstruction, Truth


PROTOCOLS = {
    "ours": "first hits of all views' pixels, exact distances to triangles (mvps/measures/ours.py)",
    "supernormal": "SuperNormal (CVPR 2024): first hits of the masks' pixels, point to point",
    "mvscps": "MVSCPS (ICCV 2025): first hits of all pixels, point to point",
    "psnerf": "PS-NeRF (ECCV 2022): whole surfaces in units in which the truth is in [-1, 1]; images of held-out views",
    "mvpsnet": "MVPSNet (ICCV 2023): vertices 5 mm above the support, after ICP, sum of both mean L1 distances",
    "rnbneus": "RNb-NeuS (CVPR 2024): all vertices, to the nearest vertex",
}
"""Ways to measure, and whose they are; mvps/measures/protocols.py says each in full."""


ACCOUNTS = ("metrics.json", "settings.json", "lights.json", "cameras.json")
"""A result's own files of the kind that figures are written in."""


class Row(NamedTuple):
    """A line of the table: what it is, the keys of its three columns (all views, fitted views, held-out views), its format.

    needs: what was missing where the line has no figure, in words.
    """

    title: str
    keys: tuple[str, str, str]
    form: str
    needs: str = ""


def _single(title: str, key: str, form: str, needs: str = "") -> Row:
    return Row(title, (key, "", ""), form, needs)


def _grouped(title: str, prefix: str, name: str, form: str) -> Row:
    return Row(title, (f"{prefix}{name}", f"{prefix}fitted_{name}", f"{prefix}held_out_{name}"), form)


HELD_OUT = "needs views held out (mvps.reconstruct --hold-out-views)"

LPIPS = "needs --lpips-weights, and views held out"

ROWS: dict[str, tuple[Row, ...]] = {
    "ours": (
        _single("accuracy, mm", "accuracy_mm", "{:.3f}"),
        _single("completeness, mm", "completeness_mm", "{:.3f}"),
        _single("Chamfer distance, mm", "chamfer_mm", "{:.3f}"),
        _single("Chamfer distance, pixels", "chamfer_px", "{:.3f}"),
        _single("mean signed offset, pixels (negative: inside)", "offset_px", "{:+.3f}"),
        _single("median signed offset, pixels", "offset_median_px", "{:+.3f}"),
        _single("F-score at 0.5 mm", "f_score_0_5_mm", "{:.3f}"),
        _single("F-score at 1 mm", "f_score_1_mm", "{:.3f}"),
        _single("share of the mask that the mesh covers", "mesh_coverage", "{:.4f}"),
        _grouped("mesh normals, mean error, degrees", "mesh_", "normal_error_deg", "{:.2f}"),
        _grouped("mesh normals, median error, degrees", "mesh_", "normal_error_median_deg", "{:.2f}"),
        _grouped("normal maps, mean error, degrees", "map_", "normal_error_deg", "{:.2f}"),
        _grouped("normal maps, median error, degrees", "map_", "normal_error_median_deg", "{:.2f}"),
        _grouped("share of the truth that the normal maps cover", "map_", "normal_coverage", "{:.4f}"),
        _single("normals, stated against measured, largest factor", "confidence_factor", "{:.2f}"),
        _single("light directions, mean error, degrees", "light_error_deg", "{:.2f}"),
        _single("light directions, largest error, degrees", "light_error_max_deg", "{:.2f}"),
        _single("light intensities, mean relative error", "intensity_error", "{:.4f}"),
        Row("PSNR of held-out lights in fitted views, dB", ("", "held_out_lights_psnr_db", ""), "{:.2f}"),
        Row("PSNR of held-out views, dB", ("", "", "held_out_views_psnr_db"), "{:.2f}"),
    ),
    "supernormal": (
        _single("Chamfer distance, mm", "supernormal_chamfer_mm", "{:.3f}"),
        _single("F-score at 0.5 mm", "supernormal_f_score", "{:.3f}"),
    ),
    "mvscps": (
        _single("Chamfer distance, mm", "mvscps_chamfer_mm", "{:.3f}"),
        _single("F-score at 0.5 mm", "mvscps_f_score", "{:.3f}"),
    ),
    "psnerf": (
        _single("Chamfer distance, thousandths", "psnerf_chamfer", "{:.2f}"),
        _single("normal maps of held-out (or all) views, deg", "psnerf_normal_error_deg", "{:.2f}"),
        _single("mesh normals of the same views, deg", "psnerf_mesh_normal_error_deg", "{:.2f}"),
        _single("light directions, mean error, degrees", "psnerf_light_error_deg", "{:.2f}"),
        _single("light intensities, mean relative error", "psnerf_intensity_error", "{:.4f}"),
        _single("light-averaged images, PSNR, dB", "psnerf_average_psnr_db", "{:.2f}", HELD_OUT),
        _single("light-averaged images, SSIM", "psnerf_average_ssim", "{:.4f}", HELD_OUT),
        _single("light-averaged images, 100 LPIPS", "psnerf_average_lpips_x100", "{:.2f}", LPIPS),
        _single("images light by light, PSNR, dB", "psnerf_psnr_db", "{:.2f}", HELD_OUT),
        _single("images light by light, SSIM", "psnerf_ssim", "{:.4f}", HELD_OUT),
        _single("images light by light, 100 LPIPS", "psnerf_lpips_x100", "{:.2f}", LPIPS),
    ),
    "mvpsnet": (
        _single("Chamfer distance (sum), mm", "mvpsnet_chamfer_mm", "{:.3f}"),
        _single("the same, both meshes split alike", "mvpsnet_split_chamfer_mm", "{:.3f}"),
    ),
    "rnbneus": (
        _single("Chamfer distance, mm", "rnbneus_chamfer_mm", "{:.3f}"),
        _single("  where curvature is high", "rnbneus_high_curvature_chamfer_mm", "{:.3f}"),
        _single("  where few views see", "rnbneus_low_visibility_chamfer_mm", "{:.3f}"),
        _single("the same, both meshes split alike", "rnbneus_split_chamfer_mm", "{:.3f}"),
        _single("  where curvature is high", "rnbneus_split_high_curvature_chamfer_mm", "{:.3f}"),
        _single("  where few views see", "rnbneus_split_low_visibility_chamfer_mm", "{:.3f}"),
        _single("mesh normals, mean error, degrees", "rnbneus_normal_error_deg", "{:.2f}"),
    ),
}
"""The figures of each protocol, in the order of the table."""


def table(errors: Mapping[str, float], protocols: Sequence[str] = ("ours",)) -> str:
    """The figures as text, a block per protocol under its name and source; "-", or what is needed, where there is no figure."""
    return "\n\n".join(_block(errors, protocol) for protocol in protocols)


def _block(errors: Mapping[str, float], protocol: str) -> str:
    lines = [f"{protocol}: {PROTOCOLS[protocol]}"]
    if protocol == "ours":
        lines.append(f"{'':46}{'all':>10}{'fitted':>10}{'held out':>10}")
    for row in ROWS[protocol]:
        if row.needs and not any(key in errors for key in row.keys):
            lines.append(f"{row.title:46}  {row.needs}")
            continue
        cells = [("" if not key else row.form.format(errors[key]) if key in errors else "-") for key in row.keys]
        lines.append(f"{row.title:46}" + "".join(f"{cell:>10}" for cell in cells).rstrip())
    return "\n".join(lines)


def read_views(path: Path, reconstruction: Reconstruction, truth: Truth) -> Capture:
    """All views of the capture with the photographs that were held out, and one more each where none was: the rest is not needed."""
    from mvps.measures import held_out_photographs
    from mvps.same_object import capture_of
    from mvps.scene import CaptureError

    if not set(truth.views) & set(reconstruction.views):
        raise CaptureError(
            f"{path}: wanted the capture of the result's views {', '.join(reconstruction.views)}, given one with"
            f" {', '.join(truth.views)}; give the capture that was reconstructed as --truth"
        )
    numbers: dict[str, list[int]] = {view: [] for view in truth.views}
    for view, number in held_out_photographs(reconstruction):
        if view in numbers:
            numbers[view].append(number)
    first = {view: used[0] for view, used in zip(reconstruction.views, reconstruction.light_names, strict=True) if used}
    lights = {view: kept or [first.get(view, 1)] for view, kept in numbers.items()}
    # Views of the calibration that are not there were not reconstructed from either.
    return capture_of(reconstruction, path, [int(view[5:]) for view in truth.views], lights)


def write_json(path: Path, value: object) -> None:
    """The value as JSON, at its place whole or not at all."""
    write_whole(path, json.dumps(value, indent=1, sort_keys=True, allow_nan=False) + "\n")


def evaluate_result(result: Path, truth: Path, protocols: Sequence[str] = ("ours",), lpips_weights: Path | None = None) -> dict[str, float]:
    """Figures of a result folder against its capture's ground truth. CaptureError where one cannot be read or has no truth.

    lpips_weights: torchvision's file of AlexNet; without it there is no LPIPS.
    """
    from mvps.export import read_reconstruction
    from mvps.load import read_truth
    from mvps.measures import figures_of, perceptual_distance, seen_from_outside
    from mvps.same_object import was_mended
    from mvps.scene import CaptureError

    perceptual = perceptual_distance(lpips_weights) if lpips_weights is not None else None
    reconstruction, true_values = read_reconstruction(result), read_truth(truth)
    if not has_truth(true_values):
        raise CaptureError(
            f"{truth}: wanted ground truth (mesh_Gt.ply, or Normal_gt.mat, light_directions.txt or light_intensities.txt in the views),"
            " given none; give a capture that has some"
        )
    capture = read_views(truth, reconstruction, true_values)
    if was_mended(reconstruction):
        true_values = read_truth(truth, {view.name: view.camera for view in capture.views})
    if true_values.surface is not None:
        true_values = replace(true_values, surface=seen_from_outside(true_values.surface, capture))
    errors: dict[str, float] = {}
    for protocol in protocols:
        errors |= figures_of(protocol, reconstruction, capture, true_values, support_height(capture, true_values), perceptual)
    return errors


def _check_json(path: Path, result: Path) -> None:
    """CaptureError unless figures can be written at this place and take none of the result's own files away."""
    from mvps.scene import CaptureError

    check_file(path)
    if path.resolve() in [(result / name).resolve() for name in ACCOUNTS]:
        raise CaptureError(f"{path}: wanted a file for the figures alone, given one of the result's own; give another place")


def has_truth(truth: Truth) -> bool:
    """Whether there is anything to measure against."""
    return truth.surface is not None or any((truth.normals, truth.direction, truth.intensity))


def support_height(capture: Capture, truth: Truth) -> float | None:
    """z of what the object stands on: 0 for DiLiGenT-MV's objects, None where that is not known."""
    from mvps.published import diligent_object

    lights = {len(direction) for direction in truth.direction.values()}
    known = len(lights) == 1 and diligent_object(capture.name, len(truth.views), lights.pop())
    return 0.0 if known else None


def protocol_list(text: str) -> tuple[str, ...]:
    """Protocols separated by commas, or "all"."""
    names = tuple(PROTOCOLS) if text == "all" else tuple(dict.fromkeys(text.split(",")))
    unknown = [name for name in names if name not in PROTOCOLS]
    if unknown:
        raise ArgumentTypeError(f"wanted all, or names among {', '.join(PROTOCOLS)}, given {unknown[0]!r}")
    return names


def protocol_of(figure: str) -> str:
    """The protocol that a figure is of, by its name."""
    named = figure.partition("_")[0]
    return named if named in PROTOCOLS else "ours"


def reported(result: Path, truth: Path) -> tuple[Reconstruction, Capture]:
    """What the result's report is made of. CaptureError where it cannot be read."""
    from mvps.export import read_reconstruction
    from mvps.same_object import capture_of, photographs_in

    reconstruction = read_reconstruction(result)
    return reconstruction, capture_of(reconstruction, truth, *photographs_in(reconstruction, truth))


def main(argv: Sequence[str]) -> None:
    """The command line."""
    made = parser(
        "mvps.evaluate",
        "Compare a reconstruction with ground truth: surface (mm and pixels), normals (degrees), lights (degrees, relative\n"
        "intensity), held-out photographs (PSNR, dB). Figures in mm are in the capture's own unit of length. The figures are\n"
        "added to RESULT/metrics.json as 'truth', and to RESULT/report.html. Papers measure differently: --protocols measures as\n"
        "they do, for figures to stand beside theirs.",
    )
    made.add_argument("result", type=Path, metavar="RESULT", help="folder that mvps.reconstruct wrote")
    made.add_argument("--truth", type=Path, required=True, default=SUPPRESS, metavar="CAPTURE", help="the capture, with its ground truth")
    made.add_argument("--json", type=Path, default=SUPPRESS, metavar="FILE", help="write the figures to this file too")
    made.add_argument(
        "--protocols",
        type=protocol_list,
        default="ours",
        metavar="NAMES",
        help=f"how to measure: all, or some of {', '.join(PROTOCOLS)}, separated by commas",
    )
    made.add_argument(
        "--lpips-weights",
        type=Path,
        default=SUPPRESS,
        metavar="FILE",
        help="torchvision's weights of AlexNet (alexnet-owt-7be5be79.pth), for the LPIPS of psnerf; needs pip install mvps[lpips]",
    )
    options = parse(made, argv)
    if "lpips_weights" in options and "psnerf" not in options.protocols:
        made.error(f"--lpips-weights: wanted psnerf among --protocols, given {','.join(options.protocols)}")
    if "json" in options:
        _check_json(options.json, options.result)
    errors = evaluate_result(options.result, options.truth, options.protocols, vars(options).get("lpips_weights"))
    from mvps.report import write_report

    reconstruction, capture = reported(options.result, options.truth)
    # What other protocols found stays; what these found before, perhaps with more of the truth, does not.
    others = {k: v for k, v in (reconstruction.metrics.get("truth") or {}).items() if protocol_of(k) not in options.protocols}
    metrics = reconstruction.metrics | {"truth": others | errors}
    write_json(options.result / "metrics.json", metrics)
    write_report(replace(reconstruction, metrics=metrics), capture, options.result / "report.html")
    if "json" in options:
        write_json(options.json, errors)
    print(table(errors, options.protocols))


if __name__ == "__main__":
    raise SystemExit(run(main))
