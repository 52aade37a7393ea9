"""Small captures by chance, damaged by chance, through the command line: every run ends with a result or with one sentence.

    python benchmarks/fuzz_runs.py [--runs 100] [--first 0]

Made objects of 12 to 40 pixels in one to four views under one to twelve lights; masks cut to rims, to halves and to dots, with holes,
grown; photographs black, clipped, of noise, all the same, a thousand times too dim, mostly without light. Prints what ended otherwise than
with exit code 0 or 2, or with a traceback or a warning, with its seed; exit code 1 if anything did.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[Any]
Damage = Callable[[Image, np.random.Generator], Image]

SQUARE = np.ones((3, 3), np.uint8)


def sometimes(value: int) -> Damage:
    """Photographs of one value, three of five."""
    return lambda image, rng: np.full_like(image, value) if rng.random() < 0.6 else image


MASKS: dict[str, Damage] = {
    "rim": lambda mask, rng: mask - cv2.erode(mask, SQUARE, iterations=int(rng.integers(1, 4))),
    "holes": lambda mask, rng: np.where(rng.random(mask.shape) < 0.1, 0, mask).astype(mask.dtype),
    "half": lambda mask, _: np.where(np.arange(mask.shape[1]) < mask.shape[1] // 2, 0, mask).astype(mask.dtype),
    "dots": lambda mask, rng: np.where(rng.random(mask.shape) < 0.5, 0, mask).astype(mask.dtype),
    "grown": lambda mask, _: np.asarray(cv2.dilate(mask, SQUARE, iterations=2)),
}
PHOTOGRAPHS: dict[str, Damage] = {
    "black": sometimes(0),
    "clipped": sometimes(65535),
    "noise": lambda image, rng: rng.integers(0, 60000, image.shape).astype(image.dtype),
    "dim": lambda image, rng: (image * rng.choice([1e-3, 1e-2, 1e-1])).astype(image.dtype),
    "unlit": lambda image, rng: np.where(rng.random(image.shape[:2])[..., None] < 0.7, 0, image).astype(image.dtype),
}
SOUND = 0.3
"""Of the views, left as they are."""


def damaged(path: Path, damage: Damage, rng: np.random.Generator) -> None:
    """Does it to an image file."""
    cv2.imwrite(str(path), damage(np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)), rng))


def damage_view(view: Path, rng: np.random.Generator) -> str:
    """One kind of damage to a view's mask or photographs; which."""
    photographs = sorted(path for path in view.glob("*.png") if path.stem.isdigit())
    kind = str(rng.choice(["same", *MASKS, *PHOTOGRAPHS])) if rng.random() > SOUND else "sound"
    if kind in MASKS:
        damaged(view / "mask.png", MASKS[kind], rng)
    for path in photographs:
        if kind in PHOTOGRAPHS:
            damaged(path, PHOTOGRAPHS[kind], rng)
        elif kind == "same":
            path.write_bytes(photographs[0].read_bytes())
    return kind


def run(seed: int, folder: Path) -> str:
    """What went wrong with a capture by chance, empty where nothing did."""
    rng = np.random.default_rng(seed)
    views, lights, size = (int(rng.choice(of)) for of in ((1, 1, 2, 3, 4), (1, 2, 3, 4, 5, 8, 12), (12, 16, 24, 32, 40)))
    capture, preset = folder / "capture", str(rng.choice(["draft", "standard"]))
    made = ["--views", str(views), "--lights", str(lights), "--size", str(size), "--seed", str(seed)]
    subprocess.run([sys.executable, "-m", "mvps.synthetic", "--out", str(capture), "--quiet", *made], check=True)
    kinds = [damage_view(view, rng) for view in sorted(capture.glob("view_*"))]
    command = ["-m", "mvps.reconstruct", str(capture), "--out", str(folder / "result"), "--preset", preset, "--quiet"]
    ended = subprocess.run([sys.executable, *command], capture_output=True, text=True, check=False)
    if ended.returncode in (0, 2) and "Traceback" not in ended.stderr and "Warning" not in ended.stderr:
        return ""
    said = (ended.stderr.strip().splitlines() or [""])[-1]
    return f"seed {seed} ({', '.join(kinds)}; {lights} lights, {size} pixels, {preset}): exit code {ended.returncode}, {said}"


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    given = parser.parse_args()
    wrong = 0
    for seed in range(given.first, given.first + given.runs):
        with tempfile.TemporaryDirectory() as folder:
            fault = run(seed, Path(folder))
        if fault:
            wrong += 1
            print(fault, flush=True)
    print(f"{given.runs} captures, {wrong} ended otherwise than with a result or a sentence")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
