"""python -m mvps.evaluate RESULT --truth CAPTURE: a reconstruction against ground truth, as a table and as JSON."""

from __future__ import annotations

import json
import os
from argparse import SUPPRESS
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from mvps.command import parse, parser, run

if TYPE_CHECKING:
    from mvps.scene import Capture, Reconstruction, Truth


class Row(NamedTuple):
    """A line of the table: what it is, the keys of its three columns (all views, fitted views, held-out views), its format."""

    title: str
    keys: tuple[str, str, str]
    form: str


def _grouped(title: str, prefix: str, name: str, form: str) -> Row:
    return Row(title, (f"{prefix}{name}", f"{prefix}fitted_{name}", f"{prefix}held_out_{name}"), form)


ROWS = (
    Row("accuracy, mm", ("accuracy_mm", "", ""), "{:.3f}"),
    Row("completeness, mm", ("completeness_mm", "", ""), "{:.3f}"),
    Row("Chamfer distance, mm", ("chamfer_mm", "", ""), "{:.3f}"),
    Row("Chamfer distance, pixels", ("chamfer_px", "", ""), "{:.3f}"),
    Row("mean signed offset, pixels (negative: inside)", ("offset_px", "", ""), "{:+.3f}"),
    Row("median signed offset, pixels", ("offset_median_px", "", ""), "{:+.3f}"),
    Row("F-score at 0.5 mm", ("f_score_0_5_mm", "", ""), "{:.3f}"),
    Row("F-score at 1 mm", ("f_score_1_mm", "", ""), "{:.3f}"),
    Row("share of the mask that the mesh covers", ("mesh_coverage", "", ""), "{:.4f}"),
    _grouped("mesh normals, mean error, degrees", "mesh_", "normal_error_deg", "{:.2f}"),
    _grouped("mesh normals, median error, degrees", "mesh_", "normal_error_median_deg", "{:.2f}"),
    _grouped("normal maps, mean error, degrees", "map_", "normal_error_deg", "{:.2f}"),
    _grouped("normal maps, median error, degrees", "map_", "normal_error_median_deg", "{:.2f}"),
    _grouped("share of the truth that the normal maps cover", "map_", "normal_coverage", "{:.4f}"),
    Row("normals, stated against measured, largest factor", ("confidence_factor", "", ""), "{:.2f}"),
    Row("light directions, mean error, degrees", ("light_error_deg", "", ""), "{:.2f}"),
    Row("light directions, largest error, degrees", ("light_error_max_deg", "", ""), "{:.2f}"),
    Row("light intensities, mean relative error", ("intensity_error", "", ""), "{:.4f}"),
    Row("PSNR of held-out lights in fitted views, dB", ("", "held_out_lights_psnr_db", ""), "{:.2f}"),
    Row("PSNR of held-out views, dB", ("", "", "held_out_views_psnr_db"), "{:.2f}"),
)
"""The measures of mvps.measures, in the order of the table."""


def table(errors: Mapping[str, float]) -> str:
    """The measures as text; "-" where there is no figure."""
    lines = [f"{'':46}{'all':>10}{'fitted':>10}{'held out':>10}"]
    for row in ROWS:
        cells = [("" if not key else row.form.format(errors[key]) if key in errors else "-") for key in row.keys]
        lines.append(f"{row.title:46}" + "".join(f"{cell:>10}" for cell in cells).rstrip())
    return "\n".join(lines)


def read_views(path: Path, reconstruction: Reconstruction, truth: Truth) -> Capture:
    """All views of the capture with the photographs that were held out, and one more each where none was: the rest is not needed."""
    from mvps.load import read_capture
    from mvps.measures import held_out_photographs
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
    return read_capture(path, lights={view: kept or [first.get(view, 1)] for view, kept in numbers.items()})


def write_json(path: Path, value: object) -> None:
    """The value as JSON, at its place whole or not at all."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_text(json.dumps(value, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def evaluate_result(result: Path, truth: Path) -> dict[str, float]:
    """Measures of a result folder against its capture's ground truth. CaptureError where one cannot be read or has no truth."""
    from mvps.export import read_reconstruction
    from mvps.load import read_truth
    from mvps.measures import evaluate
    from mvps.scene import CaptureError

    reconstruction, true_values = read_reconstruction(result), read_truth(truth)
    if true_values.surface is None and not true_values.normals and not true_values.direction:
        raise CaptureError(
            f"{truth}: wanted ground truth (mesh_Gt.ply, or Normal_gt.mat or light_directions.txt in the views), given none;"
            " give a capture that has some"
        )
    return evaluate(reconstruction, read_views(truth, reconstruction, true_values), true_values)


def renew_report(result: Path, truth: Path) -> None:
    """The result's report.html made again, now with the figures against ground truth."""
    from mvps.export import read_reconstruction
    from mvps.load import read_capture
    from mvps.report import write_report

    write_report(read_reconstruction(result), read_capture(truth), result / "report.html")


def main(argv: Sequence[str]) -> None:
    """The command line."""
    made = parser(
        "mvps.evaluate",
        "Compare a reconstruction with ground truth: surface (mm and pixels), normals (degrees), lights (degrees, relative\n"
        "intensity), held-out photographs (PSNR, dB). Figures in mm are in the capture's own unit of length. The figures are\n"
        "added to RESULT/metrics.json as 'truth', and to RESULT/report.html.",
    )
    made.add_argument("result", type=Path, metavar="RESULT", help="folder that mvps.reconstruct wrote")
    made.add_argument("--truth", type=Path, required=True, default=SUPPRESS, metavar="CAPTURE", help="the capture, with its ground truth")
    made.add_argument("--json", type=Path, default=SUPPRESS, metavar="FILE", help="write the figures to this file too")
    options = parse(made, argv)
    errors = evaluate_result(options.result, options.truth)
    metrics_file = options.result / "metrics.json"
    metrics = json.loads(metrics_file.read_text(encoding="utf-8"))
    write_json(metrics_file, metrics | {"truth": errors})
    renew_report(options.result, options.truth)
    if "json" in options:
        write_json(options.json, errors)
    print(table(errors))


if __name__ == "__main__":
    raise SystemExit(run(main))
