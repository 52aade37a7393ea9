"""What the program makes of hard captures, and whether its status is honest: a table of figures, statuses, refusals and crashes.

    python benchmarks/hard_cases.py [CASE ...] [--honesty 50] [--preset standard] [--keep DIR]

Cases are those of benchmarks/hard/cases.py, all of them if none is named. Each is reconstructed and evaluated through the command line,
against the truth, cameras and masks of the capture before it was damaged. --honesty N runs N cases by chance instead (with cases named,
these too). Results: benchmarks/hard_cases.json, where cases of earlier runs stay, written after every case; docs/hard_cases.md is made
from it. --keep DIR keeps DIR/CASE/given (the capture), DIR/CASE/good (its truth) and DIR/CASE/result.

status   as the program says; "refused": exit code 2, one sentence; "CRASH": any other exit code; "HANG": stopped after --limit seconds;
         "NO FIGURES": the result cannot be evaluated
bad      mesh normals more than 10 deg or Chamfer more than 1 px off, in the mean
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from accuracy import COLUMNS, HERE, machine, ran, table
from hard.cases import CASES, OF_THE_MADE_OBJECT, Sample, by_chance
from hard.scenes import BASE

from mvps.synthetic.files import write_capture

BAD_DEG, BAD_PX = 10.0, 1.0
FIGURES = [column for column in COLUMNS if column[0] in ("light deg", "normal map deg", "mesh normal deg", "Chamfer px")]
SHOWN = [*FIGURES, ("processor s", "processor_seconds", 1, 0), ("peak MB", "peak_memory_mb", 1, 0)]
RECORD, PAGE = HERE / "hard_cases.json", HERE.parent / "docs" / "hard_cases.md"

Row = dict[str, Any]


def photographed_outside(sample: Sample, given: Path) -> None:
    """Puts what cameras saw outside masks into the given capture's photographs: the part of the object that masks lack, for a wrong mask
    takes nothing away from photographs, and what stands behind it. Only where the view's place and size are still those of the
    unharmed one."""
    for before, after in zip(sample.good.views, sample.given.views, strict=False):
        lost = before.mask & ~after.mask if before.mask.shape == after.mask.shape else np.zeros(1, bool)
        if not (lost.any() or sample.behind) or before.name != after.name or before.lights != after.lights:
            continue
        for k, light in enumerate(after.lights):
            path = given / after.name / f"{light:03d}.png"
            image = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
            image[lost] = before.samples[before.pixel_index[lost], k, ::-1]
            if sample.behind:
                beside = ~before.mask & ~after.mask
                image[beside] = sample.behind(before, k, int(beside.sum()))[:, ::-1]
            cv2.imwrite(str(path), image)


def write(sample: Sample, folder: Path) -> None:
    """The captures of a case, in place of all that `folder` had."""
    shutil.rmtree(folder, ignore_errors=True)
    write_capture(sample.given, sample.truth, folder / "given")
    write_capture(sample.good, sample.truth, folder / "good")
    photographed_outside(sample, folder / "given")


def measured(folder: Path, preset: str, limit: float = 900.0) -> Row:
    """Figures, status, what the program said, seconds and peak memory of the case in `folder`, and its result there."""
    given, good, result = folder / "given", folder / "good", folder / "result"
    shutil.rmtree(result, ignore_errors=True)
    command = [sys.executable, "-m", "mvps.reconstruct", str(given), "--out", str(result), "--preset", preset, "--device", "cpu", "--quiet"]
    found = ran(command, limit)
    row: Row = {"seconds": found.seconds, "processor_seconds": found.processor_seconds}
    if found.code != 0:
        status = {None: "HANG", 2: "refused"}.get(found.code, "CRASH")
        return row | {"status": status, "said": last_line(found.said).replace(f"{given}/", "").replace(str(given), "capture")}
    figures = folder / "figures.json"
    judged = ran([sys.executable, "-m", "mvps.evaluate", str(result), "--truth", str(good), "--json", str(figures)], limit)
    if judged.code != 0:
        return row | {"status": "NO FIGURES", "said": last_line(judged.said)}
    metrics = json.loads((result / "metrics.json").read_text(encoding="utf-8"))
    status = metrics["status"]
    # The program's own figure: the system's, of a child, starts with the peak of this process.
    row["peak_memory_mb"] = max(stage["peak_memory_mb"] for stage in metrics["stages"])
    errors = json.loads(figures.read_text(encoding="utf-8"))
    kept = {key: errors[key] for _, key, _, _ in COLUMNS if key in errors}
    return row | kept | {"status": status["name"], "said": status["text"]}


def last_line(text: str) -> str:
    """The last line that says something."""
    return next((line for line in reversed(text.splitlines()) if line.strip()), "")


def bad(row: Row) -> bool | None:
    """Whether a result is bad; None where there is none."""
    if "chamfer_px" not in row:
        return None
    return bool(row["chamfer_px"] > BAD_PX or row.get("mesh_normal_error_deg", 0.0) > BAD_DEG)


def honesty(rows: Sequence[Row]) -> str:
    """How often a bad result was called converged and a good one was not, with both lists, as Markdown."""
    wrong = [row for row in rows if bad(row) is True]
    right = [row for row in rows if bad(row) is False]
    trusted = [row for row in wrong if row["status"] == "converged"]
    doubted = [row for row in right if row["status"] != "converged"]
    none = [row for row in rows if bad(row) is None]
    counts = ", ".join(f"{sum(row['status'] == s for row in none)} {s}" for s in sorted({row["status"] for row in none}))
    lines = [f"{len(rows)} cases: {len(right)} good, {len(wrong)} bad, {len(none)} without a result{f' ({counts})' if counts else ''}."]
    for title, part, of in (("bad but called converged", trusted, wrong), ("good but doubted", doubted, right)):
        lines += ["", f"**{title}: {len(part)} of {len(of)}**", ""] + [f"- {in_words(row)}" for row in part]
    return "\n".join(lines)


def where(rows: Sequence[Row]) -> str:
    """The machine of most rows, and others with theirs."""
    most, *others = (name for name, _ in Counter(row["machine"] for row in rows).most_common())
    named = (f"{other} ({', '.join(row['case'] for row in rows if row['machine'] == other)})" for other in others)
    return "; ".join([most, *named])


def in_words(row: Row) -> str:
    """A row of a list."""
    what = f" ({row['what']})" if "what" in row else ""
    return f"{row['case']}{what}: {row.get('mesh_normal_error_deg', 0):.1f} deg, {row['chamfer_px']:.2f} px, {row['status']}"


def page(record: dict[str, Any]) -> str:
    """docs/hard_cases.md."""
    rows, random = record["rows"], record["random"]
    command = "python benchmarks/hard_cases.py"
    parts = [
        "# Hard cases",
        f"`{command}`, preset {record['preset']}, on {where(rows)}; s of the processor, all cores together. The made object,"
        f" {BASE.views} views x {BASE.lights} lights x {BASE.size} x {BASE.size} pixels, with one thing changed (`benchmarks/hard/`)."
        " Errors are against the truth before the change, seen by the cameras and masks before it.",
    ]
    for group in dict.fromkeys(case.group for case in CASES.values()):
        of_group = [row for row in rows if CASES[row["case"]].group == group]
        if of_group:
            parts += [f"## {group.capitalize()}", table(of_group, SHOWN)]
    missing = [name for name in CASES if name not in {row["case"] for row in rows}]
    if missing:
        parts += ["## Not run", f"`{command} {' '.join(missing)}`"]
    said = [f"- {row['case']}, {row['status']}: {row['said']}" for row in rows if bad(row) is None]
    if said:
        parts += ["## Refusals and failures, in the program's words", "\n".join(said)]
    bounds = f"mesh normals are more than {BAD_DEG:g} deg or the surface (Chamfer) more than {BAD_PX:g} px off in the mean"
    parts += ["## Is the status honest?", f"A result is bad where {bounds}.", "### The cases above", honesty(rows)]
    if random:
        of = f"the made object, from case {OF_THE_MADE_OBJECT} on lumps by chance"
        text = f"`{command} --honesty {len(random)}`: {of}, under random settings with one or two random defects."
        parts += [f"### {len(random)} cases by chance", text, honesty(random)]
    return "\n\n".join(parts) + "\n"


def keep(record: dict[str, Any], preset: str) -> None:
    """The record as JSON and, of the preset that counts, as the page."""
    path = RECORD if preset == "standard" else RECORD.with_name(f"hard_cases-{preset}.json")
    path.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    if preset == "standard":
        PAGE.write_text(page(record), encoding="utf-8")


def run_one(name: str, sample: Sample | None, preset: str, limit: float, kept: Path | None) -> Row:
    """One case in a folder of its own; sample: None for the captures that `kept` has of it."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = (kept or Path(scratch)) / name
        if sample is not None:
            write(sample, folder)
        row = {"case": name, "machine": machine("cpu")} | measured(folder, preset, limit)
    print(
        f"{name}: {row['status']}, {row['processor_seconds']:.0f} s", *(f"{row[k]:.2f}" for _, k, _, _ in FIGURES if k in row), flush=True
    )
    return row


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", help=" ".join(CASES))
    parser.add_argument("--honesty", type=int, default=0, metavar="N", help="run N cases by chance")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--limit", type=float, default=900.0, metavar="S", help="seconds after which a command counts as hanging")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep captures and results")
    given = parser.parse_args()
    unknown = [name for name in given.cases if name not in CASES]
    if unknown:
        parser.error(f"wanted cases among {' '.join(CASES)}, given {' '.join(unknown)}")
    path = RECORD if given.preset == "standard" else RECORD.with_name(f"hard_cases-{given.preset}.json")
    record = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"rows": [], "random": []}
    record |= {"preset": given.preset}
    for name in given.cases or ([] if given.honesty else CASES):
        found = {row["case"]: row for row in record["rows"]} | {
            name: run_one(name, CASES[name].make(), given.preset, given.limit, given.keep)
        }
        record["rows"] = [found[name] for name in CASES if name in found]
        keep(record, given.preset)
    for number in range(given.honesty):
        sample, what = by_chance(number)
        name = f"chance-{number:02d}"
        found = {row["case"]: row for row in record["random"]} | {
            name: run_one(name, sample, given.preset, given.limit, given.keep) | {"what": what}
        }
        record["random"] = [found[name] for name in sorted(found)]
        keep(record, given.preset)


if __name__ == "__main__":
    main()
