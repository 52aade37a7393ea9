"""Files changed at random bytes, and what reads them: a CaptureError or a value may come of it, nothing else."""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hostile_files import make_capture
from hypothesis import strategies as st

from mvps.checkpoint import Checkpoints
from mvps.compare.running import known_runs
from mvps.export import read_reconstruction, write_reconstruction
from mvps.load import read_calibrated_lights, read_capture, read_truth
from mvps.measures import held_out_photographs
from mvps.progress import Progress
from mvps.report import report_html
from mvps.scene import CaptureError, Law, Lights, Material, Reconstruction, Surface

LOUD = (
    *(b"\xff" * 4, b"\x7f\xff\xff\xff", b"\x00" * 8, b"\x00\x00\xf0\x7f", b"\x00\x00\x00\x80"),
    *(b"9" * 12, b"-1", b"nan", b"1e999", b'"', b"{", b"["),
)
"""What headers and numbers do not expect: largest and smallest, infinite, not a number, signs of another kind."""

Edit = tuple[str, float, bytes]

edits: st.SearchStrategy[list[Edit]] = st.lists(
    st.tuples(
        st.sampled_from(("over", "insert", "remove", "cut", "twice")),
        st.floats(0, 1, exclude_max=True),
        st.one_of(st.sampled_from(LOUD), st.binary(min_size=1, max_size=9)),
    ),
    min_size=1,
    max_size=4,
)


def changed(data: bytes, by: Sequence[Edit]) -> bytes:
    """The bytes after these edits, one after the other, each at its share of the length."""
    for kind, share, piece in by:
        at = int(share * len(data))
        data = {
            "over": data[:at] + piece + data[at + len(piece) :],
            "insert": data[:at] + piece + data[at:],
            "remove": data[:at] + data[at + len(piece) :],
            "cut": data[:at],
            "twice": data[:at] + data[at // 2 : at] + data[at:],
        }[kind]
    return data


def sealed(data: bytes) -> bytes:
    """A PNG whose checksums are right again, so that its decoder sees what was changed."""
    out, at = bytearray(data), 8
    while at + 12 <= len(out):
        stop = at + 12 + int.from_bytes(out[at : at + 4], "big")
        if stop > len(out):
            break
        out[stop - 4 : stop] = zlib.crc32(bytes(out[at + 4 : stop - 4])).to_bytes(4, "big")
        at = stop
    return bytes(out)


@dataclass(frozen=True)
class Target:
    """A folder of good files, and what reads it."""

    root: Path
    files: tuple[str, ...]
    read: Callable[[Path], Any]

    def tried(self, name: str, by: Sequence[Edit], seal: bool) -> str:
        """Reads the folder with one file changed by edits; "value" or the refusal's text."""
        return self.holding(name, changed((self.root / name).read_bytes(), by), seal)

    def holding(self, name: str, data: bytes, seal: bool) -> str:
        """Reads the folder with other data in a file; "value" or the refusal's text. The file is as it was afterwards."""
        path = self.root / name
        good = path.read_bytes()
        path.write_bytes(sealed(data) if seal and name.endswith(".png") else data)
        try:
            self.read(self.root)
        except CaptureError as error:
            return str(error)
        finally:
            path.write_bytes(good)
        return "value"


def read_whole_capture(root: Path) -> None:
    """All that is ever read of a capture."""
    capture = read_capture(root)
    read_calibrated_lights(root, capture)
    read_truth(root)


def capture_target(folder: Path) -> Target:
    """A tiny capture."""
    root = make_capture(folder / "capture")
    in_view = ("mask.png", "002.png", "filenames.txt", "light_directions.txt", "light_intensities.txt", "Normal_gt.mat")
    files = ("Calib_Results.mat", "scene.json", "mesh_Gt.ply", *(f"view_01/{name}" for name in in_view))
    return Target(root, files, read_whole_capture)


def tiny_result(capture: Path) -> Reconstruction:
    """A tetrahedron with a lobe, as a result of the tiny capture."""
    views = read_capture(capture).views
    surface = Surface(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
    normal = np.full((4, 3), 3**-0.5)
    material = Material(normal, np.full((4, 3), 0.5), np.full((4, 1), 0.1), np.array([20.0]), np.ones(4))
    lights = Lights(tuple(np.tile([0.0, 0, 1], (3, 1)) for _ in views), tuple(np.ones((3, 3)) for _ in views), True)
    maps = tuple(np.zeros((*view.mask.shape, 3), np.float32) for view in views)
    metrics: dict[str, Any] = {
        "stages": [{"name": "load", "seconds": 0.5, "peak_memory_mb": 100.0}],
        "rounds": [{"round": 1, "residual": 0.01}],
        "status": {"name": "converged", "text": "done"},
        "model": {"components": [{"name": "lobe", "kept": True, "gain": 0.1, "noise": 0.01, "seconds": 0.1, "why": "better"}]},
        "truth": {"chamfer_mm": 0.5},
    }
    numbers = tuple(view.lights for view in views)
    return Reconstruction(
        surface, material, lights, tuple(v.name for v in views), numbers, maps, metrics, {"hold_out_views": [1], "hold_out_lights": [2]}
    )


def result_target(folder: Path) -> Target:
    """A result of the tiny capture, its report written again as mvps.evaluate does."""
    source = make_capture(folder / "of-result")
    capture = read_capture(source)
    root = folder / "result"
    write_reconstruction(tiny_result(source), root)

    def read(result: Path) -> None:
        reconstruction = read_reconstruction(result)
        held_out_photographs(reconstruction)
        report_html(reconstruction, capture)

    return Target(root, ("mesh.ply", "material.npz", "lights.json", "metrics.json", "settings.json", "normals/view_01.npy"), read)


def checkpoint_target(folder: Path) -> Target:
    """A checkpoint, gone on from."""

    def step(root: Path) -> None:
        value = (Surface(np.eye(3), np.array([[0, 1, 2]])), [Law((8.0,), -0.1)], {"x": torch.zeros(3)})
        Checkpoints(root, {"run": 1}, (Surface, Law), torch.device("cpu"), True).step("a", lambda: value, Progress())

    step(folder / "checkpoint")
    return Target(folder / "checkpoint", ("a.npz", "run.json"), step)


def comparison_target(folder: Path) -> Target:
    """The record of a comparison."""
    root = folder / "comparison"
    root.mkdir()
    run = '"seconds": 1.5, "processor_seconds": 2.0, "peak_memory_mb": 99.5, "failed": "", "status": "converged", "errors": {"a": 0.5}'
    (root / "runs.json").write_text(f'{{"ours": {{"method": "ours", "options": [], "protocols": ["ours"], {run}}}}}')
    return Target(root, ("runs.json",), known_runs)


TARGETS = {"capture": capture_target, "result": result_target, "checkpoint": checkpoint_target, "comparison": comparison_target}


def cleared(folder: Path) -> Path:
    """The folder, empty."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder
