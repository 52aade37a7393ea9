"""Normal maps and their errors side by side: a column a method, the truth first."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from mvps.export import normal_picture
from mvps.mesh import angles_deg
from mvps.scene import Float

WORST_DEG = 30.0
"""Error that is shown white."""

LABEL_HEIGHT = 24


def error_picture(normals: Float, truth: Float) -> NDArray[np.uint8]:
    """(h, w, 3) error of normals against true ones, both (h, w, 3): dark to light, 0 to WORST_DEG; black where one is unknown."""
    known = np.asarray(np.isfinite(normals).all(-1) & np.isfinite(truth).all(-1))
    level = np.zeros(known.shape, np.uint8)
    level[known] = np.clip(np.rint(angles_deg(normals[known], truth[known]) / WORST_DEG * 254) + 1, 1, 255)
    coloured = cv2.applyColorMap(level, cv2.COLORMAP_INFERNO)[..., ::-1]
    return np.where(known[..., None], coloured, 0).astype(np.uint8)


def side_by_side(truth: Float, found: Mapping[str, Float]) -> NDArray[np.uint8]:
    """(height, width, 3) picture: above the normals (h, w, 3) of the truth and of each method, below their errors."""
    columns = [_labelled("truth", normal_picture(truth), np.zeros((*truth.shape[:2], 3), np.uint8))]
    columns += [_labelled(name, normal_picture(normals), error_picture(normals, truth)) for name, normals in found.items()]
    return np.concatenate(columns, axis=1)


def cropped(truth: Float) -> tuple[slice, slice]:
    """The box around what is known of normals (h, w, 3)."""
    known = np.asarray(np.isfinite(truth).all(-1))
    if not known.any():
        return slice(None), slice(None)
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _labelled(name: str, above: NDArray[np.uint8], below: NDArray[np.uint8]) -> NDArray[np.uint8]:
    label = np.full((LABEL_HEIGHT, above.shape[1], 3), 255, np.uint8)
    cv2.putText(label, name, (4, LABEL_HEIGHT - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([label, above, below], axis=0)
