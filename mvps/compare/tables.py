"""Runs as tables: one by our own measures, one for every protocol of a paper with what papers printed; text, Markdown, CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mvps.compare.running import Run
from mvps.evaluate import PROTOCOLS, ROWS, write_json
from mvps.folders import write_whole
from mvps.published import AVERAGE, DILIGENT_MV, ONE_RUN, OTHERWISE, figures, published


class Column(NamedTuple):
    """Title, key of the errors, factor, decimal digits."""

    title: str
    key: str
    factor: float
    digits: int


COLUMNS = (
    Column("lights deg", "light_error_deg", 1, 2),
    Column("intensities %", "intensity_error", 100, 2),
    Column("normal map deg", "map_normal_error_deg", 1, 2),
    Column("mesh normal deg", "mesh_normal_error_deg", 1, 2),
    Column("Chamfer px", "chamfer_px", 1, 3),
    Column("Chamfer mm", "chamfer_mm", 1, 3),
    Column("F@0.5 mm", "f_score_0_5_mm", 1, 3),
    Column("held-out view normals deg", "mesh_held_out_normal_error_deg", 1, 2),
    Column("held-out views PSNR dB", "held_out_views_psnr_db", 1, 1),
)
"""Errors of mvps.measures (first hits of the capture's cameras; millimetres are the capture's units)."""


def rows(runs: Sequence[Run]) -> list[list[str]]:
    """Title row and one row a run; columns that no run has are left out."""
    kept = [column for column in COLUMNS if any(column.key in run.errors for run in runs)]
    lines = [["method", *(column.title for column in kept), "s", "processor s", "peak MB", "status"]]
    for run in runs:
        figures = [f"{c.factor * run.errors[c.key]:.{c.digits}f}" if c.key in run.errors else "-" for c in kept]
        cost = ["-"] * 3 if run.failed else [f"{x:.0f}" for x in (run.seconds, run.processor_seconds, run.peak_memory_mb)]
        lines.append([run.method, *figures, *cost, f"did not run: {run.failed}" if run.failed else run.status])
    return lines


def protocol_rows(protocol: str, runs: Sequence[Run], printed: str) -> list[list[str]]:
    """The same by one protocol of a paper: the runs, then what papers printed of DiLiGenT-MV's object `printed`, or "average"."""
    keys = {row.keys[0]: row for row in ROWS[protocol] if row.keys[0]}
    of_papers: dict[tuple[str, str], dict[str, float]] = {}
    for key in keys:
        for figure in published(DILIGENT_MV, {printed}, protocol, key.removeprefix(f"{protocol}_")):
            of_papers.setdefault((figure.method, f"{figure.source}, {figure.object}"), {})[key] = figure.value
    kept = [key for key in keys if any(key in run.errors for run in runs) or any(key in values for values in of_papers.values())]
    lines = [["method", *(keys[key].title.strip() for key in kept), "source"]]
    found = [(run.method, "this comparison", run.errors) for run in runs]
    for method, source, errors in [*found, *((method, source, values) for (method, source), values in of_papers.items())]:
        lines.append([method, *(keys[key].form.format(errors[key]) if key in errors else "-" for key in kept), source])
    return lines


def otherwise_rows(printed: str) -> list[list[str]]:
    """What papers printed of DiLiGenT-MV's object `printed`, or "average", that no protocol of `mvps.evaluate` measures: by protocols of
    their own, and times. A row each, for no two are to be compared."""
    lines = [["method", "what", "value", "unit", "source", "note"]]
    for one in figures():
        if one.data == DILIGENT_MV and one.protocol in OTHERWISE and one.object in (printed, AVERAGE, ONE_RUN):
            lines.append([one.method, one.metric, f"{one.value:g}", one.unit, f"{one.source}, {one.object}", one.note])
    return lines


def as_text(lines: list[list[str]]) -> str:
    """Columns of equal width."""
    width = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    return "\n".join(
        "  ".join(cell.ljust(w) if k in (0, len(width) - 1) else cell.rjust(w) for k, (cell, w) in enumerate(zip(line, width, strict=True)))
        for line in lines
    )


def as_markdown(lines: list[list[str]]) -> str:
    """A Markdown table."""
    head, *body = lines
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ["---"] * len(head), *body))


def as_csv(lines: list[list[str]]) -> str:
    """Comma-separated values."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


def heading(protocol: str) -> str:
    """The protocol with what it measures."""
    return f"{protocol}: {PROTOCOLS.get(protocol, 'what papers printed of DiLiGenT-MV, measured by none of these protocols')}"


def write_tables(tables: Mapping[str, list[list[str]]], out: Path) -> str:
    """Tables by protocol as table.md, table.json and a CSV each (table.csv by our own measures, table_PROTOCOL.csv) in `out`; as text."""
    for name, lines in tables.items():
        write_whole(out / ("table.csv" if name == "ours" else f"table_{name}.csv"), as_csv(lines))
    records = {name: [dict(zip(lines[0], line, strict=True)) for line in lines[1:]] for name, lines in tables.items()}
    write_json(out / "table.json", records)
    page = "\n\n".join(f"## {heading(name)}\n\n{as_markdown(lines)}" for name, lines in tables.items())
    write_whole(out / "table.md", page + "\n")
    return "\n\n".join(f"{heading(name)}\n{as_text(lines)}" for name, lines in tables.items())
