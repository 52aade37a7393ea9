"""A tiny whole capture on disk, another value in every sample, for tests of the loaders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.io

HEIGHT, WIDTH, VIEWS, LIGHTS = 12, 16, 2, 3
K = np.array([[50.0, 0, 8], [0, 50, 6], [0, 0, 1]])


def rotation(view: int) -> np.ndarray:
    return cv2.Rodrigues(np.array([0.1, 0.4 * view, 0.0]))[0]


def translation(view: int) -> np.ndarray:
    return np.array([[0.1], [0.2], [5.0 + view]])


def calibration(views: int = VIEWS) -> dict[str, np.ndarray]:
    """Calib_Results.mat of a tiny capture."""
    values = {"KK": K}
    for i in range(1, views + 1):
        values |= {f"Rc_{i}": rotation(i), f"Tc_{i}": translation(i)}
    return values


def photograph(view: int, light: int, dtype: Any = np.uint16) -> np.ndarray:
    """(height, width, 3) RGB, another value in every sample."""
    full = np.iinfo(dtype).max
    values = np.random.default_rng(100 * view + light).integers(0, full, (HEIGHT, WIDTH, 3))
    return values.astype(dtype)


def mask() -> np.ndarray:
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    image[2:9, 3:12] = 255
    image[5, 5] = 127
    return image


def write_rgb(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def tiny_capture(root: Path) -> Path:
    """A tiny whole capture: two views, three lights, 16 bits, without ground truth."""
    root.mkdir()
    scipy.io.savemat(root / "Calib_Results.mat", calibration())
    (root / "scene.json").write_text('{"pixel_center": 0.5}')
    for view in range(1, VIEWS + 1):
        folder = root / f"view_{view:02d}"
        folder.mkdir()
        write_rgb(folder / "mask.png", mask())
        for light in range(1, LIGHTS + 1):
            write_rgb(folder / f"{light:03d}.png", photograph(view, light))
    return root
