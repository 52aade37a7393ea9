"""Photometric stereo of one view: lights, normals, and how far off the stated errors are.

    python benchmarks/one_view.py CAPTURES [CASE ...] [--preset standard]

CAPTURES holds ball and bear, photographed, and bunny, armadillo, spot and buddha, of which single views are taken; made objects are made.
Mesh normals are left out: of single views of several, the truth has more than the view shows. Writes one_view.json and one_view.md beside
this file, where cases of earlier runs stay.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from accuracy import evaluated, machine, table

HERE = Path(__file__).resolve().parent

CASES: dict[str, tuple[str, list[str]]] = {
    **{f"made, seed {seed}": ("made", ["--seed", str(seed)]) for seed in range(5)},
    "ball": ("ball", []),
    "bear": ("bear", []),
    **{f"bunny, view {view}": ("bunny", ["--views", str(view)]) for view in (1, 7, 13)},
    **{f"armadillo, view {view}": ("armadillo", ["--views", str(view)]) for view in (1, 7)},
    **{f"spot, view {view}": ("spot", ["--views", str(view)]) for view in (1, 8)},
    **{f"buddha, view {view}": ("buddha", ["--views", str(view)]) for view in (1, 7)},
    **{f"{name}, given lights": (name, ["--calibrated-lights"]) for name in ("ball", "bear")},
    **{f"buddha, view {view}, given lights": ("buddha", ["--views", str(view), "--calibrated-lights"]) for view in (1, 7)},
}
"""Name: capture, and options of mvps.reconstruct, or for made ones of mvps.synthetic."""

COLUMNS = (
    ("light deg", "light_error_deg", 1, 2),
    ("intensity %", "intensity_error", 100, 2),
    ("normal map deg", "map_normal_error_deg", 1, 2),
    ("stated error, factor", "confidence_factor", 1, 2),
    ("s", "seconds", 1, 0),
)


def measure(name: str, captures: Path, preset: str, folder: Path) -> dict[str, Any]:
    """One row."""
    of, options = CASES[name]
    capture, result = captures / of, folder / "result"
    if of == "made":
        capture, made = folder / name.replace(", ", "-").replace(" ", "-"), options
        subprocess.run([sys.executable, "-m", "mvps.synthetic", "--out", str(capture), "--quiet", "--views", "1", *made], check=True)
        options = []
    start = time.perf_counter()
    command = ["-m", "mvps.reconstruct", str(capture), "--out", str(result), "--preset", preset, "--quiet", *options]
    subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
    seconds = time.perf_counter() - start
    metrics = evaluated(result, capture)
    figures = {key: metrics["truth"][key] for _, key, *_ in COLUMNS if key in metrics["truth"]}
    return {**figures, "case": name, "seconds": seconds, "status": metrics["status"]["name"]}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path)
    parser.add_argument("cases", nargs="*", help="; ".join(CASES))
    parser.add_argument("--preset", default="standard")
    given = parser.parse_args()
    kept = HERE / "one_view.json"
    rows = {r["case"]: r for r in json.loads(kept.read_text(encoding="utf-8"))} if kept.exists() else {}
    for name in given.cases or CASES:
        with tempfile.TemporaryDirectory() as folder:
            rows[name] = measure(name, given.captures, given.preset, Path(folder))
        print(table([rows[name]], COLUMNS).splitlines()[-1], flush=True)
        kept.write_text(json.dumps([rows[n] for n in CASES if n in rows], indent=1) + "\n", encoding="utf-8")
    words = f"`python benchmarks/one_view.py CAPTURES --preset {given.preset}` on {machine('cpu')}; single runs."
    made = table([rows[n] for n in CASES if n in rows], COLUMNS)
    (HERE / "one_view.md").write_text(f"{words}\n\n{made}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
