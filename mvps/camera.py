"""Pixels <-> rays <-> points, for a pinhole camera.

    x_camera = R x_world + t,      (x, y, 1) ~ K x_camera,      depth = z of x_camera

The only place that knows where pixel centres are: the pixel of row r and column c has its centre at (c + 0.5, r + 0.5).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.mesh import normalise
from mvps.scene import Bool, Camera, Capture, Float, Int, Lights, Surface

DILIGENT_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])
"""Axes of DiLiGenT's lights and normals (x right, y up, z towards the camera) from OpenCV camera axes; its own inverse."""


def project(camera: Camera, points: Float) -> tuple[Float, Float]:
    """Image coordinates (..., 2) in pixels and depth (...,) of world points (..., 3)."""
    local = points @ camera.rotation.T
    # Column by column: numpy's loops are slow along an axis of two or three.
    for k in range(3):
        local[..., k] += camera.translation[k]
    homogeneous = local @ camera.K.T
    image = np.empty_like(homogeneous[..., :2])
    for k in range(2):
        np.divide(homogeneous[..., k], homogeneous[..., 2], out=image[..., k])
    return image, local[..., 2]


def rays(camera: Camera, image: Float) -> tuple[Float, Float]:
    """Origins (..., 3) (the camera's centre) and unit directions (..., 3) in the world, through image coordinates (..., 2)."""
    homogeneous = np.concatenate([image, np.ones_like(image[..., :1])], -1)
    direction = normalise(homogeneous @ np.linalg.inv(camera.K).T @ camera.rotation)
    return np.broadcast_to(camera.centre, direction.shape).copy(), direction


def pixel_centres(pixels: Int) -> Float:
    """Image coordinates (..., 2) of the centres of pixels given as (..., 2) row and column."""
    centres: Float = np.asarray(pixels)[..., ::-1] + 0.5
    return centres


def view_directions(camera: Camera, points: Float) -> Float:
    """Unit vectors (..., 3), world frame, from points towards the camera."""
    towards = np.empty_like(points, float)
    for k in range(3):
        np.subtract(camera.centre[k], points[..., k], out=towards[..., k])
    return normalise(towards)


def footprint(camera: Camera, points: Float) -> Float:
    """Side length (...,) in world units that one pixel covers at the depth of the points (..., 3)."""
    side: Float = project(camera, points)[1] / camera.focal_length
    return side


def pixel_footprint(cameras: list[Camera], point: Float) -> float:
    """Median side length of a pixel at a world point (3,) over several cameras: the natural unit of length of a capture."""
    return float(np.median([footprint(camera, point) for camera in cameras]))


def surface_pixel(capture: Capture, surface: Surface) -> float:
    """What a pixel covers at the surface, world units."""
    return pixel_footprint([view.camera for view in capture.views], surface.vertices.mean(0))


def rig_frame(lights: Lights, camera: Camera) -> Float:
    """(3, 3) rotation from the world to the frame in which a rig of lights stands still; the camera's where there is no rig."""
    return np.eye(3) if lights.fixed else camera.rotation


def inside_image(camera: Camera, image: Float) -> Bool:
    """(...,) True where image coordinates (..., 2) lie on the image."""
    x, y = image[..., 0], image[..., 1]
    inside: Bool = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    return inside


def bilinear(index: Int, image: Float) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Bilinear interpolation between foreground pixels.

    index (height, width) is View.pixel_index; image (n, 2) are image coordinates. Returns the positions (n, 4) of the
    four nearest pixels in the foreground list and their weights (n, 4), which sum to 1 over the foreground ones
    (background pixels get weight 0 and position 0) or to 0 where all four are background.
    """
    height, width = index.shape
    x, y = image[:, 0] - 0.5, image[:, 1] - 0.5
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = x - column, y - row
    positions = np.empty((len(image), 4), np.int32)
    weights = np.empty((len(image), 4), np.float32)
    corners: list[tuple[int, int, Any]] = [(0, 0, (1 - fy) * (1 - fx)), (0, 1, (1 - fy) * fx), (1, 0, fy * (1 - fx)), (1, 1, fy * fx)]
    # Two rows and columns of background around the image stand for all that lies beyond it.
    framed = np.pad(index, 2, constant_values=-1).ravel()
    first = (np.clip(row, -2, height) + 2) * (width + 4) + np.clip(column, -2, width) + 2
    for k, (dr, dc, weight) in enumerate(corners):
        position = np.take(framed, first + (dr * (width + 4) + dc))
        positions[:, k] = np.maximum(position, 0)
        weights[:, k] = np.where(position >= 0, weight, 0)
    total = weights[:, 0] + weights[:, 1] + weights[:, 2] + weights[:, 3]
    known = total > 1e-6
    for weight in weights.T:
        np.divide(weight, total, out=weight, where=known)
    weights[~known] = 0
    return positions, weights
