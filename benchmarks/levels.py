"""Models with fewer faces, beside the full one: what Mitsuba shows of them, how far off they are, how large their files.

    python benchmarks/levels.py RESULT CAPTURE

for a result of mvps.reconstruct --faces N,N and the capture it was made from. Writes levels.md beside this file; needs pip install
mvps[mitsuba].
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from glb import Array, Model, read_glb
from mitsuba_check import photographs, pictured, psnr
from mitsuba_scene import mesh, render, sensor

from mvps.command import run
from mvps.compare.tables import as_markdown
from mvps.export import read_reconstruction
from mvps.load import read_capture, read_truth
from mvps.measures import surface_errors
from mvps.scene import Capture, CaptureError, Reconstruction, Surface

HERE = Path(__file__).resolve().parent
HEAD = ("model", "faces", "MB", "inside, dB", "with outlines, dB", "without normal map, dB", "photographs, dB")
TAIL = ("Chamfer from full, px", "Chamfer from truth, px")
NOTE = """Direct light, peak 1. `inside`: Mitsuba's pictures against those of the full model, inside the outlines of both; `with outlines`:
in either's; `without normal map`: inside, the map left out; `photographs`: against those held out, inside the mask."""


class Picture(NamedTuple):
    """Radiance (height, width, 3) and coverage (height, width)."""

    radiance: Array
    coverage: Array


def shown(result: Reconstruction, model: Model, chosen: Capture) -> list[Picture]:
    """Photograph by photograph."""
    made, pictures = mesh(model), []
    for view in chosen.views:
        camera, at = sensor(view.camera), result.views.index(view.name)
        for number in view.lights:
            row = result.light_names[at].index(number)
            direction, intensity = result.lights.direction[at][row], result.lights.intensity[at][row]
            pictures.append(Picture(*render(made, camera, direction, np.pi * model.extras["albedo_scale"] * intensity)))
    return pictures


def gap(pictures: list[Picture], of_full: list[Picture], outlines: bool = False) -> float:
    """Mean PSNR, dB, inside the outlines of both or, with outlines, of either."""
    values = []
    for a, b in zip(pictures, of_full, strict=True):
        where: Any = (a.coverage + b.coverage > 0) if outlines else (np.minimum(a.coverage, b.coverage) > 0.999)
        values.append(psnr(a.radiance, b.radiance, where))
    return float(np.mean(values))


def lines(folder: Path, capture: Path) -> list[list[str]]:
    """The table: the full model, then the others by their numbers of faces."""
    result, files = read_reconstruction(folder), sorted(folder.glob("model*.glb"), key=lambda file: -len(read_glb(file).faces))
    if not files:
        raise CaptureError(
            f"{folder}: wanted a result with a model.glb, given one without; give the folder that mvps.reconstruct --out wrote"
        )
    whole = read_capture(capture, lights=[1])
    chosen, truth = photographs(result, capture), read_truth(capture).surface
    photographed = [(pictured(view, k), view.mask) for view in chosen.views for k in range(len(view.lights))]
    of_full, rows = shown(result, read_glb(files[0]), chosen), []
    for file in files:
        model = read_glb(file)
        flat = model._replace(bump=np.full_like(model.bump, (0.5, 0.5, 1)))
        pictures, bare = shown(result, model, chosen), shown(result, flat, chosen)
        surface = Surface(model.position, model.faces)
        against = [np.mean([psnr(a.radiance, b, mask) for a, (b, mask) in zip(pictures, photographed, strict=True)])]
        same = file == files[0]
        gaps = ["-" if same else f"{gap(pictures, of_full):.1f}", "-" if same else f"{gap(pictures, of_full, True):.1f}"]
        far = ["-" if same else f"{surface_errors(surface, result.surface, whole)['chamfer_px']:.3f}"]
        far += ["-" if truth is None else f"{surface_errors(surface, truth, whole)['chamfer_px']:.3f}"]
        size = f"{file.stat().st_size / 1e6:.2f}"
        rows.append([file.name, str(len(model.faces)), size, *gaps, f"{gap(bare, of_full):.1f}", f"{against[0]:.1f}", *far])
    return rows


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("capture", type=Path)
    given = parser.parse_args(argv)
    table = as_markdown([[*HEAD, *TAIL], *lines(given.result, given.capture)])
    text = f"`python benchmarks/levels.py RESULT CAPTURE`, {given.result.name}: levels of detail.\n\n{table}\n\n{NOTE}\n"
    (HERE / "levels.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    sys.exit(run(main))
