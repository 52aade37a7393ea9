"""Error and time against the number of views, of lights, both, the strength of highlights and the size of images; a table each.

    python benchmarks/sweeps.py CAPTURES [SWEEP ...] --out DIR

Views and lights are spread evenly over those of `bunny`; strength and size are those of captures that mvps.synthetic makes. With time
t = c x^p the exponent p is fitted to the logarithms. Time is of the processor, all cores together, which says less of what else the
machine does. DIR keeps the runs: what is there is not run again. Results: benchmarks/sweeps.md, sweeps.json.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from mvps.compare.running import Run, run_all
from mvps.progress import Progress

HERE = Path(__file__).resolve().parent
CAPTURE, VIEWS, LIGHTS = "bunny", 20, 32

SWEEPS: dict[str, tuple[str, list[tuple[float, ...]]]] = {
    "views": ("views", [(5,), (10,), (15,), (20,)]),
    "lights": ("lights", [(1,), (2,), (4,), (8,), (16,), (32,)]),
    "grid": ("views x lights", [(v, k) for v in (5, 10, 15) for k in (2, 4, 8, 16)]),
    "strength": ("strength of highlights", [(0.0,), (0.5,), (1.0,), (2.0,)]),
    "size": ("image size, pixels", [(96,), (160,), (256,), (400,)]),
}
"""Name: what is varied, and its values."""

COLUMNS = (
    ("lights deg", "light_error_deg", 1, 2),
    ("intensity %", "intensity_error", 100, 2),
    ("normal map deg", "map_normal_error_deg", 1, 2),
    ("mesh normal deg", "mesh_normal_error_deg", 1, 2),
    ("Chamfer px", "chamfer_px", 1, 3),
)


def spread(count: int, most: int) -> str:
    """`count` numbers from 1 to `most`, evenly spread round a circle: "1,5,9"."""
    return ",".join(str(1 + k * most // count) for k in range(count))


def options_of(sweep: str, value: tuple[float, ...]) -> list[str]:
    """Options of mvps.methods for a value of a sweep of views or lights."""
    views, lights = {"views": (value[0], LIGHTS), "lights": (VIEWS, value[0]), "grid": value}[sweep]
    return [f"--views={spread(int(views), VIEWS)}", f"--lights={spread(int(lights), LIGHTS)}"]


def made(option: str, value: float, folder: Path) -> Path:
    """The made capture with an option of mvps.synthetic at this value."""
    capture = folder / f"{option}-{value:g}-capture"
    if not capture.exists():
        command = ["-m", "mvps.synthetic", "--out", str(capture), f"--{option}", f"{value:g}", "--views", "12", "--lights", "16", "--quiet"]
        subprocess.run([sys.executable, *command], check=True)
    return capture


def measured(sweep: str, captures: Path, folder: Path) -> list[Run]:
    """A run a value of the sweep."""
    runs = []
    for value in SWEEPS[sweep][1]:
        out = folder / f"{sweep}-{'-'.join(f'{v:g}' for v in value)}"
        if sweep in ("strength", "size"):
            capture, options = made(sweep, value[0], folder), []
        else:
            capture, options = captures / CAPTURE, options_of(sweep, value)
        runs.append(run_all(capture, ["ours"], options, out, Progress())["ours"])
    return runs


def exponent(values: Sequence[float], seconds: Sequence[float]) -> float:
    """p of t = c x^p, by least squares of the logarithms."""
    return float(np.polyfit(np.log(values), np.log(seconds), 1)[0])


def table(sweep: str, runs: Sequence[dict[str, object]]) -> str:
    """Markdown."""
    title, values = SWEEPS[sweep]
    lines = [f"| {title} | " + " | ".join(t for t, *_ in COLUMNS) + " | processor s | status |", "|" + "---|" * (len(COLUMNS) + 3)]
    for value, run in zip(values, runs, strict=True):
        errors = run["errors"]
        assert isinstance(errors, dict)
        cells = [f"{factor * errors[key]:.{digits}f}" if key in errors else "-" for _, key, factor, digits in COLUMNS]
        lines.append(
            f"| {' x '.join(f'{v:g}' for v in value)} | " + " | ".join(cells) + f" | {run['processor_seconds']:.0f} | {run['status']} |"
        )
    if len(values[0]) == 1 and min(values)[0] > 0:
        p = exponent([v[0] for v in values], [float(str(run["processor_seconds"])) for run in runs])
        lines.append(f"\nTime grows with the power {p:.2f} of it.")
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path)
    parser.add_argument("sweeps", nargs="*", help=" ".join(SWEEPS))
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    stem = HERE / "sweeps"
    found = json.loads(stem.with_suffix(".json").read_text(encoding="utf-8")) if stem.with_suffix(".json").exists() else {}
    for sweep in given.sweeps or SWEEPS:
        found[sweep] = [asdict(run) for run in measured(sweep, given.captures, given.out)]
        stem.with_suffix(".json").write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    text = "\n\n".join(table(sweep, found[sweep]) for sweep in SWEEPS if sweep in found)
    stem.with_suffix(".md").write_text(f"`python benchmarks/sweeps.py CAPTURES --out DIR`, preset standard.\n\n{text}\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
