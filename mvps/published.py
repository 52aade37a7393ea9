"""Figures that papers of the field have printed, each with the protocol by which it was measured.

published.csv, a line per figure: data (DiLiGenT-MV, and PS-NeRF's Synth-PS and Synth-Env), object (in capitals; `average` over all
objects of the data, `one` for a single run), method, protocol, metric, unit, value, source (paper and table), note. A figure of
protocol p and metric m is the one that `mvps.evaluate` calls p_m; protocols are its own (mvps/measures/protocols.py), and two more:

other   measured by a protocol that `mvps.evaluate` does not have: of the same kind, but no figure to stand beside another
time    seconds of a reconstruction, on the machine that the note names
"""

from __future__ import annotations

import csv
from collections.abc import Collection
from dataclasses import dataclass, fields
from functools import cache
from importlib.resources import files

DILIGENT_MV = "DiLiGenT-MV"

DILIGENT_OBJECTS = ("BEAR", "BUDDHA", "COW", "POT2", "READING")

DILIGENT_VIEWS, DILIGENT_LIGHTS = 20, 96

AVERAGE = "average"
"""Object of a figure that is the mean over all objects of its data."""

ONE_RUN = "one"
"""Object of a figure of a single run, whatever the object."""

OTHERWISE = ("other", "time")
"""Protocols of figures that `mvps.evaluate` does not measure."""


@dataclass(frozen=True)
class Figure:
    """A printed figure; its source and note say where it stands and under what conditions it was measured."""

    data: str
    object: str
    method: str
    protocol: str
    metric: str
    unit: str
    value: float
    source: str
    note: str

    @property
    def key(self) -> str:
        """The name of the same measure in `mvps.evaluate`."""
        return f"{self.protocol}_{self.metric}"


@cache
def figures() -> tuple[Figure, ...]:
    """All figures, in the order of the file."""
    text = files("mvps").joinpath("published.csv").read_text(encoding="utf-8")
    texts = [field.name for field in fields(Figure) if field.name != "value"]
    return tuple(Figure(value=float(row["value"]), **{name: row[name] for name in texts}) for row in csv.DictReader(text.splitlines()))


def published(data: str, objects: Collection[str] | None, protocol: str, metric: str, source: str = "") -> list[Figure]:
    """The figures of these objects (None: all, averages too), in the order of the file; an empty list where nobody printed any.

    One method may have several for an object, from tables under different conditions (numbers of views, of lights): `source` keeps
    those whose source contains it, such as "MVPS methods" (20 views) or "neural rendering methods" (15 views, 5 others to test).
    """
    found = [f for f in figures() if (f.data, f.protocol, f.metric) == (data, protocol, metric) and source in f.source]
    return [f for f in found if objects is None or f.object in objects]


def diligent_object(name: str, views: int, lights: int) -> str | None:
    """Which of DiLiGenT-MV's five objects a capture is, or None: by its folder's name and its numbers of views and of lights per view.

    Other captures are called bear or buddha too, so the name alone says nothing: bearPNG and Bear both count, with 20 views of 96 lights.
    """
    found = name.upper().removesuffix("PNG")
    return found if found in DILIGENT_OBJECTS and (views, lights) == (DILIGENT_VIEWS, DILIGENT_LIGHTS) else None
