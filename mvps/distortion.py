"""Distortion of a lens: from a photograph's pixels to a pinhole's, and back.

A pinhole shows a point of the camera's frame at x = (X / Z, Y / Z); through the lens it appears at

    x (1 + k1 r^2 + k2 r^4 + k5 r^6) + (2 k3 x y + k4 (r^2 + 2 x^2), k3 (r^2 + 2 y^2) + 2 k4 x y),      r = |x|

(Brown 1971, in the order of the Caltech toolbox).
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from mvps.scene import Camera, Float

Image = NDArray[np.float32]


def free_of_lens(camera: Camera, points: Float) -> Float:
    """Where a pinhole would have image coordinates (n, 2) of the photograph."""
    if not (any(camera.distortion) and len(points)):
        return points
    # OpenCV takes the photograph's own K for one without skew.
    own = points - (points[:, 1:] - camera.K[1, 2]) / camera.K[1, 1] * [camera.K[0, 1], 0]
    return np.asarray(cv2.undistortPoints(own[:, None], camera.K, np.array(camera.distortion), P=camera.K), np.float64)[:, 0]


def seen_at(camera: Camera) -> tuple[Image, Image]:
    """Column and row (height, width) of the photograph, 0 at the first pixel's centre, where each pixel of the pinhole's image is seen."""
    K = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    column, row = cv2.initUndistortRectifyMap(K, np.array(camera.distortion), np.eye(3), K, (camera.width, camera.height), cv2.CV_32FC1)
    return np.asarray(column + K[0, 1] / K[1, 1] * (row - K[1, 2]), np.float32), np.asarray(row)


def straightener(camera: Camera) -> Callable[[Image], Image]:
    """From a photograph (height, width[, channels]) to what a pinhole would have taken, by bilinear interpolation; 0 beyond its border."""
    column, row = seen_at(camera)
    return lambda image: np.asarray(cv2.remap(image, column, row, cv2.INTER_LINEAR))
