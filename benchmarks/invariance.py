"""What must not matter: precision, cores, seed, units. Captures again with one of them changed, and by how much the figures differ.

    python benchmarks/invariance.py CAPTURES [NAME ...] [--preset standard]

double     all that is computed in single precision is computed in double, from the same random draws, but for the ray tracer and OpenCV's
           pictures of distances, which have single precision alone
one core   the process may use one core
seed N     of all random draws
units x 10 translations of the cameras and the true mesh ten times as large

Same bytes: of mesh.ply, lights.json and material.npz, against the run as it is. Results: invariance.md and invariance.json beside this
file, where captures of earlier runs stay.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from accuracy import evaluated, machine

HERE = Path(__file__).resolve().parent
CAPTURES = ("bunny", "armadillo", "spot", "buddha")
COMPARED = ("mesh.ply", "lights.json", "material.npz")

COLUMNS = (
    ("lights deg", "light_error_deg", 1, 3),
    ("intensity %", "intensity_error", 100, 3),
    ("normal map deg", "map_normal_error_deg", 1, 3),
    ("mesh normal deg", "mesh_normal_error_deg", 1, 3),
    ("Chamfer px", "chamfer_px", 1, 4),
)

VARIANTS = ("as it is", "double", "one core", "seed 1", "seed 2", "seed 3", "seed 4", "units x 10")

DOUBLE = """
import sys
import numpy, torch
import embreex.rtcore_scene, cv2, scipy.ndimage, igl, nlopt
from skimage.measure import _marching_cubes_lewiner as cubes, _marching_cubes_lewiner_cy as compiled
single, drawn = numpy.float32, torch.float32
class Kept:
    def __getattr__(self, name):
        return single if name == "float32" else getattr(numpy, name)
cubes.np = compiled.np = Kept()
# OpenCV interpolates between doubles to a 32nd of a pixel.
def remap(image, x, y, interpolation, dst=None, borderMode=cv2.BORDER_CONSTANT):
    mode = {cv2.BORDER_CONSTANT: "grid-constant", cv2.BORDER_REPLICATE: "nearest"}[borderMode]
    at = lambda channel: scipy.ndimage.map_coordinates(channel, (y, x), order=1, mode=mode)
    if image.ndim == 2:
        return at(image.astype(float))
    return numpy.stack([at(channel) for channel in numpy.moveaxis(image.astype(float), 2, 0)], -1)
cv2.remap = remap
numpy.float32 = numpy.float64
torch.float32 = torch.float64
torch.Tensor.float = torch.Tensor.double
torch.set_default_dtype(torch.float64)
def same(draw):
    return lambda *size, **named: draw(*size, **named, dtype=drawn).double()
torch.rand, torch.randn = same(torch.rand), same(torch.randn)
import mvps.visibility
mvps.visibility.np = Kept()
from mvps.reconstruct import main
from mvps.command import run
raise SystemExit(run(main, sys.argv[1:]))
"""
"""The command with the names of single precision standing for double precision, once the libraries that need single are loaded."""


def ten_times(capture: Path, target: Path) -> Path:
    """A copy of the capture in units a tenth as long."""
    import trimesh
    from scipy.io import loadmat, savemat

    shutil.copytree(capture, target)
    values = {key: value for key, value in loadmat(capture / "Calib_Results.mat").items() if not key.startswith("__")}
    savemat(target / "Calib_Results.mat", {key: 10 * v if key.startswith("Tc_") else v for key, v in values.items()})
    mesh = trimesh.load(capture / "mesh_Gt.ply", process=False)
    mesh.apply_scale(10.0)
    mesh.export(target / "mesh_Gt.ply")
    return target


def row(capture: Path, variant: str, preset: str, folder: Path) -> dict[str, Any]:
    """The figures of a capture under a variant; its result stays in the folder until the end."""
    out, options = folder / variant.replace(" ", "-"), ["--preset", preset, "--quiet"]
    program = ["-c", DOUBLE] if variant == "double" else ["-m", "mvps.reconstruct"]
    if variant == "units x 10":
        capture = ten_times(capture, folder / "capture")
    if variant.startswith("seed"):
        options += ["--seed", variant[5:]]
    cores = {min(os.sched_getaffinity(0))} if variant == "one core" else os.sched_getaffinity(0)
    command = [sys.executable, *program, str(capture), "--out", str(out), *options]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, preexec_fn=lambda: os.sched_setaffinity(0, cores))
    if variant == "double":
        # A result holds normals in single precision.
        for path in (out / "normals").glob("*.npy"):
            np.save(path, np.load(path).astype(np.float32))
    metrics = evaluated(out, capture)
    first = folder / VARIANTS[0].replace(" ", "-")
    same = all((out / name).read_bytes() == (first / name).read_bytes() for name in COMPARED)
    return {"variant": variant, **metrics["truth"], "status": metrics["status"]["name"], "same_bytes": same}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown; in brackets the difference to the first row, per cent of it."""
    lines = ["| | " + " | ".join(title for title, *_ in COLUMNS) + " | status | same bytes |", "|" + "---|" * (len(COLUMNS) + 3)]
    for one in rows:
        cells = []
        for _, key, factor, digits in COLUMNS:
            change = "" if one is rows[0] else f" ({100 * (one[key] / rows[0][key] - 1):+.1f})"
            cells.append(f"{factor * one[key]:.{digits}f}{change}")
        lines.append(f"| {one['variant']} | " + " | ".join(cells) + f" | {one['status']} | {'yes' if one['same_bytes'] else 'no'} |")
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path)
    parser.add_argument("names", nargs="*", help=" ".join(CAPTURES))
    parser.add_argument("--preset", default="standard")
    given = parser.parse_args()
    stem = HERE / "invariance"
    found = json.loads(stem.with_suffix(".json").read_text(encoding="utf-8")) if stem.with_suffix(".json").exists() else {}
    for name in given.names or CAPTURES:
        with tempfile.TemporaryDirectory() as folder:
            found[name] = [row(given.captures / name, variant, given.preset, Path(folder)) for variant in VARIANTS]
        stem.with_suffix(".json").write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    parts = [f"`python benchmarks/invariance.py CAPTURES --preset {given.preset}` on {machine('cpu')}; changes in per cent."]
    parts += [f"## {name}\n\n{table(found[name])}" for name in CAPTURES if name in found]
    stem.with_suffix(".md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    print("\n\n".join(parts))


if __name__ == "__main__":
    main()
