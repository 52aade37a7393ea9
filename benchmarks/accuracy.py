"""Figures per capture: reconstruct through the command line, evaluate, and keep a table.

    python benchmarks/accuracy.py CAPTURES [CASE ...] [--preset standard] [--repeats 3] [--device cuda]

CASES are below, all of them if none is named. CAPTURES is the folder that holds the captures; `large` is made for the purpose
where it is not there, and thrown away. Writes accuracy-PRESET.json and accuracy-PRESET.md beside this file (accuracy-PRESET-cuda on
CUDA) as each case is done, where cases of earlier runs stay: errors against ground truth (which the reconstruction never reads),
seconds of the whole command, and its largest resident set, with the machine named.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from model_normals import model_normal_errors

HERE = Path(__file__).resolve().parent

CASES: dict[str, tuple[str, list[str]]] = {
    "bunny": ("bunny", []),
    "armadillo": ("armadillo", []),
    "spot": ("spot", []),
    "buddha": ("buddha", []),
    "bunny-5-views": ("bunny", ["--views", "1,5,9,13,17"]),
    "bunny-4-lights": ("bunny", ["--lights", "1,11,21,32"]),
    "bunny-1-light-a-view": ("bunny", ["--lights", "ONE_LIGHT"]),
    "bunny-held-out-views": ("bunny", ["--hold-out-views", "4,8,12,16,20"]),
    "buddha-held-out-views": ("buddha", ["--hold-out-views", "4,8,12,16,20"]),
    "large": ("large", []),
}
"""Name: capture and options of mvps.reconstruct. ONE_LIGHT stands for a file that gives view k light 1 + 7 k mod 32."""

MADE = {"large": ["--views", "20", "--lights", "96", "--size", "400"]}
"""Captures that `mvps.synthetic` makes, with their options."""

COLUMNS = (
    ("light deg", "light_error_deg", 1, 2),
    ("intensity %", "intensity_error", 100, 2),
    ("normal map deg", "map_normal_error_deg", 1, 2),
    ("mesh normal deg", "mesh_normal_error_deg", 1, 2),
    ("model.glb normal deg", "model_normal_error_deg", 1, 2),
    ("without its map", "model_normal_error_without_map_deg", 1, 2),
    ("Chamfer px", "chamfer_px", 1, 3),
    ("Chamfer mm", "chamfer_mm", 1, 3),
    ("signed offset px", "offset_px", 1, 3),
    ("median offset px", "offset_median_px", 1, 3),
    ("F@0.5 mm", "f_score_0_5_mm", 1, 3),
    ("stated error, factor", "confidence_factor", 1, 2),
    ("held-out PSNR dB", "held_out_views_psnr_db", 1, 1),
    ("s", "seconds", 1, 0),
    ("runs", "repeats", 1, 0),
    ("peak MB", "peak_memory_mb", 1, 0),
)


def machine(device: str) -> str:
    """Processor, cores and Python's version; on CUDA the GPU and torch's version too."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), "")
    found = f"{model or platform.processor()}, {len(os.sched_getaffinity(0))} cores, Python {platform.python_version()}"
    if device == "cpu":
        return found
    import torch

    return f"{torch.cuda.get_device_name()}, {found}, torch {torch.__version__}"


def evaluated(result: Path, truth: Path) -> dict[str, Any]:
    """What metrics.json says of a result that was compared with the truth of a capture."""
    command = ["-m", "mvps.evaluate", str(result), "--truth", str(truth)]
    subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)
    metrics: dict[str, Any] = json.loads((result / "metrics.json").read_text(encoding="utf-8"))
    return metrics


def measure(name: str, captures: Path, preset: str, device: str, folder: Path, repeats: int) -> dict[str, Any]:
    """One row: the figures of one case; seconds are the median of `repeats` runs."""
    capture, options = captures / CASES[name][0], CASES[name][1]
    if capture.name in MADE and not capture.exists():
        capture = folder / f"{capture.name}-capture"
        subprocess.run([sys.executable, "-m", "mvps.synthetic", "--out", str(capture), "--quiet", *MADE[CASES[name][0]]], check=True)
    one_light = folder / "one-light.json"
    one_light.write_text(json.dumps({f"view_{k:02d}": [1 + 7 * k % 32] for k in range(1, 21)}), encoding="utf-8")
    options = [str(one_light) if option == "ONE_LIGHT" else option for option in options]
    result = folder / name
    seconds, peaks = [], []
    for _ in range(repeats):
        start = time.perf_counter()
        command = ["-m", "mvps.reconstruct", str(capture), "--out", str(result), "--preset", preset, "--device", device, "--quiet"]
        peaks.append(peak_mb([sys.executable, *command, *options]))
        seconds.append(time.perf_counter() - start)
    metrics = evaluated(result, capture)
    stages = metrics["stages"]
    return {
        "case": name,
        **metrics["truth"],
        **model_normal_errors(result / "model.glb", capture),
        "seconds": statistics.median(seconds),
        "repeats": repeats,
        "peak_memory_mb": max(peaks),
        "status": metrics["status"]["name"],
        "stages": seconds_of(stages),
        "components": {c["name"]: [c["kept"], c["gain"], c["noise"], c["seconds"]] for c in metrics["model"]["components"]},
    }


class Ran(NamedTuple):
    """What came of a command: exit code (None where it was stopped), what it said on standard error, seconds, seconds of the processor
    (all cores together), largest resident set."""

    code: int | None
    said: str
    seconds: float
    processor_seconds: float
    peak_mb: float


def ran(command: list[str], limit: float | None = None) -> Ran:
    """Runs a command, stopped after `limit` seconds; the largest resident set is in 10^6 bytes (Linux counts it in units of 1024)."""
    with tempfile.TemporaryFile("w+") as said:
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said)
        timer = threading.Timer(limit or 0, process.kill)
        if limit is not None:
            timer.start()
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
        timer.cancel()
        said.seek(0)
        stopped = limit is not None and seconds >= limit
        code, processor = None if stopped else os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime
        return Ran(code, said.read(), seconds, processor, usage.ru_maxrss * 1024 / 1e6)


def peak_mb(command: list[str]) -> float:
    """Runs a command that must not fail; its largest resident set, 10^6 bytes."""
    found = ran(command)
    if found.code:
        raise SystemExit(f"{' '.join(command)}: exit code {found.code}. {found.said}")
    return found.peak_mb


def seconds_of(stages: list[dict[str, Any]]) -> dict[str, float]:
    """Seconds by name of the stage; some stages come again."""
    total: dict[str, float] = {}
    for stage in stages:
        total[stage["name"]] = round(total.get(stage["name"], 0.0) + stage["seconds"], 3)
    return total


def table(rows: list[dict[str, Any]], columns: Sequence[tuple[str, str, float, int]] = COLUMNS) -> str:
    """The rows as Markdown; columns: title, key, factor, decimal digits."""
    titles = ["case", *(title for title, *_ in columns), "status"]
    lines = ["| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
    for row in rows:
        figures = [f"{factor * row[key]:.{digits}f}" if key in row else "-" for _, key, factor, digits in columns]
        lines.append("| " + " | ".join([row["case"], *figures, row["status"]]) + " |")
    return "\n".join(lines)


def machines(rows: list[dict[str, Any]]) -> str:
    """Where rows were made, in words: all on one machine, or which on which."""
    cases: dict[str, list[str]] = {}
    for row in rows:
        cases.setdefault(row["machine"], []).append(row["case"])
    return "; ".join(f"{name} ({', '.join(some)})" if len(cases) > 1 else name for name, some in cases.items())


def kept(row: dict[str, Any], preset: str, device: str) -> str:
    """The row beside those of earlier runs, as JSON and as a table; its line of the table."""
    suffix, option = ("", "") if device == "cpu" else (f"-{device}", f" --device {device}")
    stem = HERE / f"accuracy-{preset}{suffix}"
    record, page = stem.with_suffix(".json"), stem.with_suffix(".md")
    before = json.loads(record.read_text(encoding="utf-8"))["rows"] if record.exists() else []
    found = {one["case"]: one for one in (*before, row)}
    rows = [found[name] for name in CASES if name in found]
    record.write_text(json.dumps({"preset": preset, "rows": rows}, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    command = f"python benchmarks/accuracy.py CAPTURES --preset {preset}{option}"
    page.write_text(f"`{command}` on {machines(rows)}; s is the median of the runs.\n\n{table(rows)}\n", encoding="utf-8")
    return table([row]).splitlines()[-1]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path)
    parser.add_argument("cases", nargs="*", help=" ".join(CASES))
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where torch computes")
    parser.add_argument("--repeats", type=int, default=1, help="runs of each case; the table says how many, and has their median time")
    given = parser.parse_args()
    for name in given.cases or CASES:
        with tempfile.TemporaryDirectory() as folder:
            row = measure(name, given.captures, given.preset, given.device, Path(folder), given.repeats)
        print(kept(row | {"machine": machine(given.device)}, given.preset, given.device), flush=True)


if __name__ == "__main__":
    main()
