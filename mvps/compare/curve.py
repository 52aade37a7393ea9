"""Error against time, as a drawing: a point a run, both axes logarithmic, the budgets of our method joined."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from mvps.compare.running import Run
from mvps.compare.tables import COLUMNS, Column
from mvps.methods import BUDGETS

WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 720, 420, 64, 110, 16, 44
MEASURES = ("mesh_normal_error_deg", "chamfer_px")
"""Keys of the errors that are drawn."""

STYLE = (
    "<style>.curve text{font:12px sans-serif;fill:#222}.curve .axis{stroke:#222;fill:none}.curve .grid{stroke:#ddd}"
    ".curve .ours{stroke:#06c;fill:none;stroke-width:2}.curve .own{fill:#06c}.curve .other{fill:#c40}</style>"
)
"""Of the drawing alone, which stands in pages that have a style of their own."""


class Point(NamedTuple):
    """A run's seconds, error and name."""

    seconds: float
    error: float
    name: str


def points_of(runs: Sequence[Run], key: str) -> list[Point]:
    """Those of the runs that have this error."""
    return [Point(run.seconds, run.errors[key], run.method) for run in runs if run.errors.get(key, 0) > 0 and run.seconds > 0]


def ticks(low: float, high: float) -> list[float]:
    """Round numbers 1, 2, 5 x 10^k within two positive ones."""
    decades = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    return [m * 10.0**k for k in decades for m in (1, 2, 5) if low <= m * 10.0**k <= high]


def drawing(points: Sequence[Point], column: Column) -> str:
    """The points as a whole SVG file. ValueError where there is none."""
    if not points:
        raise ValueError("curve: wanted runs with an error against ground truth, given none")
    x, y = np.array([p.seconds for p in points]), np.array([p.error for p in points]) * column.factor
    (left, right), (low, high) = ((values.min() / 1.3, values.max() * 1.3) for values in (x, y))

    def across(seconds: float) -> float:
        return LEFT + float(np.log(seconds / left) / np.log(right / left)) * (WIDTH - LEFT - RIGHT)

    def up(error: float) -> float:
        return HEIGHT - BOTTOM - float(np.log(error / low) / np.log(high / low)) * (HEIGHT - TOP - BOTTOM)

    base, end = HEIGHT - BOTTOM, WIDTH - RIGHT
    grid = [f'<path class="grid" d="M{across(t):.1f} {TOP}V{base}"/>' for t in ticks(left, right)]
    grid += [f'<path class="grid" d="M{LEFT} {up(t):.1f}H{end}"/>' for t in ticks(low, high)]
    labels = [f'<text x="{across(t):.1f}" y="{base + 16}" text-anchor="middle">{t:g}</text>' for t in ticks(left, right)]
    labels += [f'<text x="{LEFT - 6}" y="{up(t) + 4:.1f}" text-anchor="end">{t:g}</text>' for t in ticks(low, high)]
    labels.append(f'<text x="{(LEFT + end) / 2:.0f}" y="{HEIGHT - 8}" text-anchor="middle">seconds</text>')
    labels.append(f'<text x="{LEFT}" y="{TOP - 4}">{escape(column.title)}</text>')
    own = sorted((across(p.seconds), up(e)) for p, e in zip(points, y, strict=True) if p.name in BUDGETS)
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in own)
    dots = [
        f'<circle class="{"own" if p.name in BUDGETS else "other"}" cx="{across(p.seconds):.1f}" cy="{up(e):.1f}" r="4"/>'
        f'<text x="{across(p.seconds) + 7:.1f}" y="{up(e) + 4:.1f}">{escape(p.name)}</text>'
        for p, e in zip(points, y, strict=True)
    ]
    label = f"{column.title} over seconds: " + ", ".join(f"{p.name} {p.seconds:.0f} s {e:.3g}" for p, e in zip(points, y, strict=True))
    picture = [f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#fff"/>', *grid, f'<path class="axis" d="M{LEFT} {TOP}V{base}H{end}"/>']
    picture += [f'<polyline class="ours" points="{line}"/>', *dots, *labels]
    head = f'<svg class="curve" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(label)}">'
    return f"{head}{STYLE}{''.join(picture)}</svg>\n"


def drawings(runs: Sequence[Run]) -> dict[str, str]:
    """A drawing by the key of its error, for every measure that a run has."""
    columns = {column.key: column for column in COLUMNS}
    found = {key: points_of(runs, key) for key in MEASURES}
    return {key: drawing(points, columns[key]) for key, points in found.items() if points}


def dominated(points: Sequence[Point], by: Sequence[str] = BUDGETS) -> dict[str, bool]:
    """Whether for each point one of ours is at least as fast and as accurate; ours are left out."""
    ours = [p for p in points if p.name in by]
    return {p.name: any(o.seconds <= p.seconds and o.error <= p.error for o in ours) for p in points if p.name not in by}
