"""Environment maps: .hdr (Radiance RGBE) and .exr files of all directions."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mvps.load.images import PIXEL_LIMIT, complaint, read_bytes

WANTED = "an environment map, .hdr or .exr"
RADIANCE, OPENEXR = b"#?", b"\x76\x2f\x31\x01"
"""First bytes of the two formats."""


def read_environment(path: str | Path) -> NDArray[np.float32]:
    """(height, width, 3) linear radiance, equirectangular, first row straight up. CaptureError where the file is none, or has values that
    are negative or not finite."""
    path = Path(path)
    start = read_bytes(path, WANTED, "give another --envmap", 4)
    if not start.startswith(RADIANCE) and start != OPENEXR:
        raise complaint(path, WANTED, f"a file that starts with {start!r}", "convert it")
    with _libraries_silent():
        image = _openexr(path) if start == OPENEXR else _radiance(path)
    if image.ndim != 3 or image.shape[2] < 3 or image.shape[0] < 2 or image.shape[1] < 2:
        raise complaint(path, f"{WANTED}, in colour", f"an array of shape {image.shape}", "export it again")
    image = np.ascontiguousarray(image[..., :3], np.float32)
    if not np.isfinite(image).all() or (image < 0).any():
        raise complaint(path, f"{WANTED}, of finite values of 0 and more", "others", "export it again")
    return image


@contextmanager
def _libraries_silent() -> Iterator[None]:
    """What OpenCV and OpenEXR print about a damaged file goes nowhere: on standard error from C, and OpenEXR by Python's print. A sentence
    of ours says it."""
    if sys.stderr is None:
        # The process was started without, and there is nothing to keep.
        yield
        return
    kept = os.dup(2)
    with open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), 2)
    try:
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _radiance(path: Path) -> NDArray[np.float32]:
    head = read_bytes(path, WANTED, "give another --envmap", 4096)
    size = [int(word) for line in head.split(b"\n") if line[:2] in (b"-Y", b"+Y") for word in line.split()[1::2] if word.isdigit()]
    if len(size) != 2 or not 0 < size[0] * size[1] <= PIXEL_LIMIT:
        raise complaint(path, f"{WANTED}, of 1 to {PIXEL_LIMIT // 1_000_000} megapixels", f"a size of {size}", "scale it down")
    try:
        image = cv2.imdecode(np.frombuffer(read_bytes(path, WANTED, "give another --envmap"), np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.ndim != 3:
        raise complaint(path, WANTED, "a damaged one", "copy or export it again")
    rgb: NDArray[np.float32] = image[..., ::-1].astype(np.float32)
    return rgb


def _openexr(path: Path) -> NDArray[np.float32]:
    import OpenEXR

    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            low, high = file.header()["dataWindow"]
        if not 0 < (high - low + 1).prod(dtype=np.int64) <= PIXEL_LIMIT or (high < low).any():
            raise complaint(path, f"{WANTED}, of 1 to {PIXEL_LIMIT // 1_000_000} megapixels", f"a window {low} to {high}", "scale it down")
        with OpenEXR.File(str(path)) as file:
            channels = file.channels()
            found, names = next((channels[name].pixels for name in ("RGB", "RGBA") if name in channels), None), ", ".join(channels)
    except (RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
        raise complaint(path, WANTED, f"a damaged one ({error})", "copy or export it again") from error
    if found is None:
        raise complaint(path, f"{WANTED}, with channels R, G and B", f"only {names}", "export it again")
    pixels: NDArray[np.float32] = np.asarray(found, np.float32)
    return pixels
