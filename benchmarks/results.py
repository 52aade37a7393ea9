"""docs/results.md: every method on every capture, error against time, and the claims of PS-NeRF's paper one by one.

    python benchmarks/results.py CAPTURES --out DIR

DIR keeps the runs of mvps.compare: what is there is not run again. The sweeps are those of benchmarks/sweeps.json.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
from accuracy import machine

from mvps.compare.curve import MEASURES, dominated, points_of
from mvps.compare.pictures import cropped, side_by_side
from mvps.compare.running import Run, known_runs
from mvps.compare.tables import as_markdown, rows
from mvps.export import read_reconstruction
from mvps.load import read_truth
from mvps.methods import BUDGETS, METHODS

HERE = Path(__file__).resolve().parent
DOCS = HERE.parent / "docs"
CAPTURES = ("bunny", "armadillo", "spot", "buddha")
PUBLISHED = ("pj16", "lz20")
CLEARLY = 0.05
"""Relative difference between errors that is more than another seed makes of mesh normals, 4 % at most (benchmarks/invariance.md)."""
PICTURED = ("ours", "lz20", "pj16", "stage1", "unisurf+n", "hull")

Runs = Mapping[str, Run]


def compared(capture: Path, out: Path) -> dict[str, Run]:
    """All methods on a capture."""
    methods = ",".join(METHODS)
    subprocess.run([sys.executable, "-m", "mvps.compare", str(capture), "--methods", methods, "--curve", "--out", str(out)], check=True)
    return known_runs(out)


def picture(capture: Path, out: Path, target: Path) -> None:
    """Normals and errors of the methods in PICTURED, as a JPEG."""
    truth = read_truth(capture).normals
    found = {name: read_reconstruction(out / name) for name in PICTURED if (out / name).is_dir()}
    view = next(iter(truth))
    box = cropped(truth[view])
    maps = {name: result.normal_maps[result.views.index(view)][box] for name, result in found.items()}
    cv2.imwrite(str(target), side_by_side(truth[view][box], maps)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


def error(run: Run, key: str, digits: int = 2) -> str:
    """An error as text; "-" without one."""
    return f"{run.errors[key]:.{digits}f}" if key in run.errors else "-"


def against(runs: Mapping[str, Runs], better: str, worse: str, key: str) -> tuple[str, bool]:
    """The error of two methods on every capture that has both, as text, and whether the first is lower on all of them, by CLEARLY."""
    found = [(name, of.get(better), of.get(worse)) for name, of in runs.items()]
    pairs = [(name, a, b) for name, a, b in found if a and b and key in a.errors and key in b.errors]
    text = ", ".join(f"{name} {error(b, key)} against {error(a, key)}" for name, a, b in pairs)
    return text, bool(pairs) and all(a.errors[key] < (1 - CLEARLY) * b.errors[key] for _, a, b in pairs)


def along(sweep: Sequence[Mapping[str, Any]], values: Sequence[str], key: str) -> str:
    """A sweep's errors as text."""
    return ", ".join(f"{value}: {run['errors'][key]:.2f}" for value, run in zip(values, sweep, strict=True) if key in run["errors"])


def claims(runs: Mapping[str, Runs], sweeps: Mapping[str, Any]) -> list[list[str]]:
    """Claim, our figures, whether they bear it out; mesh normals' mean error in deg where nothing else is said."""
    normal, light = "mesh_normal_error_deg", "light_error_deg"
    pairs = (
        ("normal supervision helps (density)", "nerf+n", "nerf", normal),
        ("normal supervision helps (occupancy)", "unisurf+n", "unisurf", normal),
        ("joint optimisation improves normals", "ours", "stage1", normal),
        ("joint optimisation improves lights (deg)", "ours", "hull", light),
        ("fixed lights hurt", "ours", "fixed-light", normal),
        ("no visibility hurts", "ours", "no-visibility", normal),
        ("Gaussian lobes beat microfacets", "ours", "microfacet", normal),
    )
    lines = [["claim of the paper", "before against after, mean error", "holds"]]
    for words, better, worse, key in pairs:
        text, holds = against(runs, better, worse, key)
        lines.append([words, text, "yes" if holds else "not on all"])
    if "lights" in sweeps:
        errors = [run["errors"][normal] for run in sweeps["lights"]]
        text = along(sweeps["lights"], ("1", "2", "4", "8", "16", "32 lights"), normal)
        lines.append(["4 lights come close to all", text, f"{errors[2] / errors[-1]:.2f} times the error of all"])
    if "views" in sweeps:
        errors = [run["errors"][normal] for run in sweeps["views"]]
        text = along(sweeps["views"], ("5", "10", "15", "20 views"), normal)
        lines.append(["5 views suffice", text, f"{errors[0] / errors[-1]:.2f} times the error of 20"])
    if "strength" in sweeps:
        text = along(sweeps["strength"], ("0", "0.5", "1", "2 times the highlights"), normal)
        lines.append(["robust to specularity", text, "see the figures"])
    return lines


def won(best: Run) -> str:
    """Words for a published method that is the best."""
    return f"**a baseline wins, {best.method}:** " if best.method in PUBLISHED else ""


def verdict(runs: Runs) -> str:
    """Which method has the lowest errors and the highest F-score, and where a published one is faster than ours of the same accuracy."""
    lines = []
    score = "f_score_0_5_mm"
    highest = sorted((run for run in runs.values() if score in run.errors), key=lambda run: -run.errors[score])[:3]
    if highest:
        lines.append(f"{won(highest[0])}highest {score}: " + ", ".join(f"{run.method} {run.errors[score]:.3f}" for run in highest))
    for key in MEASURES:
        best = sorted((run for run in runs.values() if key in run.errors), key=lambda run: run.errors[key])[:3]
        lines.append(f"{won(best[0]) if best else ''}lowest {key}: " + ", ".join(f"{run.method} {run.errors[key]:.3f}" for run in best))
        for name, is_dominated in dominated(points_of([r for r in runs.values() if r.method in (*BUDGETS, *PUBLISHED)], key)).items():
            if not is_dominated:
                lines.append(f"{name} is faster than all of ours that are as accurate ({key})")
    return "\n".join(f"- {line}" for line in lines)


def page(runs: Mapping[str, Runs], sweeps: Mapping[str, Any], where: str) -> str:
    """The page as Markdown. where: the machine that its seconds are of."""
    command = "python benchmarks/results.py CAPTURES --out DIR"
    parts = ["# Results", f"`{command}` on {where}; errors as in `mvps.evaluate`. Methods: {words()}."]
    if sweeps:
        parts.append("The sweeps behind the last three claims are those of `benchmarks/sweeps.md`.")
    parts += ["## Claims of the paper", as_markdown(claims(runs, sweeps))]
    for name, of_capture in runs.items():
        chosen = [of_capture[method] for method in METHODS if method in of_capture]
        parts += [f"## {name}", as_markdown(rows(chosen)), verdict({run.method: run for run in chosen if not run.failed})]
        parts += [f"![{key} against time]({name}_{key}.svg)" for key in MEASURES]
        parts.append(f"Normals of the first view, below their errors, 0 to 30 degrees:\n\n![normals]({name}_normals.jpg)")
    return "\n\n".join(parts) + "\n"


def words() -> str:
    """What the methods are."""
    return "; ".join(f"`{name}` {method.words}" for name, method in METHODS.items())


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path)
    parser.add_argument("names", nargs="*", help=" ".join(CAPTURES))
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    given = parser.parse_args()
    names = given.names or CAPTURES
    runs = {name: compared(given.captures / name, given.out / name) for name in names}
    for name in names:
        picture(given.captures / name, given.out / name, DOCS / f"{name}_normals.jpg")
        for key in MEASURES:
            shutil.copyfile(given.out / name / f"curve_{key}.svg", DOCS / f"{name}_{key}.svg")
    found = HERE / "sweeps.json"
    sweeps = json.loads(found.read_text(encoding="utf-8")) if found.exists() else {}
    (DOCS / "results.md").write_text(page(runs, sweeps, machine("cpu")), encoding="utf-8")


if __name__ == "__main__":
    main()
