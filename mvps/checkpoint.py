"""What stages came to, kept in the result's folder, so that an interrupted run can go on.

A value is one NPZ file: its arrays, and a JSON text that says how they make up tuples, lists, mappings, tensors and frozen values. Reading
executes nothing. A file appears whole. Each says of which run it is, as run.json beside them does: only the same run goes on from them.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

import mvps
import solvers
from mvps.folders import replaced, write_whole
from mvps.inputs import DAMAGED, JSON_LIMIT, check_npz, read_file
from mvps.progress import Progress
from mvps.scene import Capture, CaptureError, Lights

T = TypeVar("T")

RUN = "run.json"


def packed(value: Any, arrays: dict[str, Any]) -> Any:
    """The value as JSON, with its arrays and tensors put into `arrays` by the names that stand in their place."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return packed(value.item(), arrays)
    if isinstance(value, np.ndarray | torch.Tensor):
        name = f"array_{len(arrays)}"
        arrays[name] = value.cpu().numpy() if isinstance(value, torch.Tensor) else value
        return {"kind": "tensor" if isinstance(value, torch.Tensor) else "array", "name": name}
    if isinstance(value, tuple | list):
        return {"kind": type(value).__name__, "of": [packed(part, arrays) for part in value]}
    if isinstance(value, Mapping):
        return {"kind": "dict", "of": {key: packed(part, arrays) for key, part in value.items()}}
    if is_dataclass(value):
        return {"kind": type(value).__name__, "of": {f.name: packed(getattr(value, f.name), arrays) for f in fields(value)}}
    raise TypeError(f"checkpoint: no way to keep a {type(value).__name__}")


def unpacked(text: Any, arrays: Mapping[str, Any], kinds: Mapping[str, Callable[..., Any]], device: torch.device) -> Any:
    """What `packed` made `text` and `arrays` of; kinds: the frozen values that may occur, by name."""
    if not isinstance(text, dict):
        return text
    kind = text["kind"]
    if kind == "array":
        return arrays[text["name"]]
    if kind == "tensor":
        return torch.from_numpy(arrays[text["name"]]).to(device)
    if kind in ("tuple", "list"):
        parts = [unpacked(part, arrays, kinds, device) for part in text["of"]]
        return tuple(parts) if kind == "tuple" else parts
    named = {key: unpacked(part, arrays, kinds, device) for key, part in text["of"].items()}
    return named if kind == "dict" else kinds[kind](**named)


def program() -> str:
    """Hash of the program's own source: what another version kept may be of other kinds, or of other sizes."""
    digest = hashlib.blake2b(digest_size=16)
    for package in (mvps, solvers):
        folder = Path(package.__path__[0])
        for path in sorted(folder.rglob("*.py")):
            digest.update(str(path.relative_to(folder)).encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def fingerprint(capture: Capture, lights: Lights | None) -> str:
    """Hash of all that a reconstruction reads of a capture, with its calibrated lights if they are used."""
    digest = hashlib.blake2b(digest_size=16)
    of_lights = () if lights is None else (*lights.direction, *lights.intensity)
    for values in of_lights:
        digest.update(values.tobytes())
    for view in capture.views:
        digest.update(repr((view.name, view.lights, view.scale, view.saturation)).encode())
        camera = view.camera
        for array in (view.mask, camera.K, camera.rotation, camera.translation):
            digest.update(array.tobytes())
        digest.update(np.ascontiguousarray(view.samples).data)
    return digest.hexdigest()


class Checkpoints:
    """Those of one run in a folder."""

    def __init__(
        self, folder: Path, run: Mapping[str, Any], kinds: Iterable[Callable[..., Any]], device: torch.device, resume: bool
    ) -> None:
        """run: plain JSON values by which the run is known. Without `resume` what is there goes; with it, CaptureError where it is another
        run's."""
        self._folder, self._device, self._kinds = folder, device, {kind.__name__: kind for kind in kinds}
        self._run = json.dumps(run, sort_keys=True, indent=1)
        if not folder.exists():
            return
        if not resume or not (folder / RUN).exists():
            shutil.rmtree(folder)
        elif read_file(folder / RUN, JSON_LIMIT) != self._run.encode():
            raise CaptureError(
                f"{folder}: wanted the checkpoints of a run with these options, this capture and this program, given those of another;"
                f" see {RUN} there, or start anew without --resume"
            )

    def step(self, name: str, make: Callable[[], T], progress: Progress) -> T:
        """What `make` returns: read where it was kept, else made and kept, with the stages that it added to the progress."""
        path = self._folder / f"{name.replace(' ', '-')}.npz"
        if path.exists():
            run, value, stages = self._read(path)
            # Another one may be under way in the same folder.
            if run == self._run:
                progress.stages.extend(stages)
                return value  # type: ignore[no-any-return]
        before = len(progress.stages)
        value = make()
        self._write(path, (self._run, value, progress.stages[before:]))
        return value

    def _read(self, path: Path) -> Any:
        try:
            check_npz(path)
            with np.load(path, allow_pickle=False) as arrays:
                text = json.loads(bytes(arrays["text"]))
                return unpacked(text, {name: arrays[name] for name in arrays.files}, self._kinds, self._device)
        except DAMAGED as error:
            raise CaptureError(f"{path}: wanted a whole checkpoint, given a damaged one ({error}); start anew without --resume") from error

    def _write(self, path: Path, value: Any) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        write_whole(self._folder / RUN, self._run)
        arrays: dict[str, Any] = {}
        text = np.frombuffer(json.dumps(packed(value, arrays)).encode(), np.uint8)
        replaced(path, lambda file: np.savez(file, text=text, **arrays))
