"""An open mesh of a view's pixels from their depth.

Every foreground pixel is a quad of two triangles. Its corner belongs to all pixels around that hold together there, and lies in the mean
of where their tangents (their own depth and slopes) put it; pixels across a step do not hold together, so the mesh is cut there, and on
every pixel's ray there is surface.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from mvps.camera import rays
from mvps.relief.integrate import Depth, slopes
from mvps.scene import Camera, Float, Int, Surface

CUT = 0.1
"""Share below which a pixel does not hold a neighbour; where neither holds the other the mesh is cut. On smooth ground the share is 1/2."""

STEEPEST = 3.0
"""Largest slope, depth in pixels per pixel, by which a corner leaves its pixel's depth: 72 degrees. Normals say no more near the rim."""

CORNERS = ((0, 0), (0, 1), (1, 1), (1, 0))
"""Row and column of a pixel's corners from its upper left one, clockwise in the image."""


def held_together(depth: Depth) -> list[tuple[Int, Int]]:
    """Pixels (n,) and their right neighbours (n,), and the same with those below, that are not across a step."""
    pairs = []
    for side in (0, 2):
        a = np.flatnonzero(depth.neighbour[:, side] >= 0)
        b = depth.neighbour[a, side]
        held = np.maximum(depth.weight[a, side], depth.weight[b, side + 1]) > CUT
        pairs.append((a[held], b[held]))
    return pairs


def _corner_vertices(count: int, depth: Depth) -> tuple[int, Int]:
    """How many vertices, and of each pixel's four corners (pixels, 4) which."""
    (left, right), (upper, lower) = held_together(depth)
    # Corners clockwise from the upper left: a right neighbour shares 1 with its 0 and 2 with its 3, a lower one 3 with 0 and 2 with 1.
    shared = [(4 * left + 1, 4 * right), (4 * left + 2, 4 * right + 3), (4 * upper + 3, 4 * lower), (4 * upper + 2, 4 * lower + 1)]
    a, b = (np.concatenate(ends) for ends in zip(*shared, strict=True))
    number, label = connected_components(sp.coo_matrix((np.ones(len(a)), (a, b)), shape=(4 * count, 4 * count)), directed=False)
    return int(number), label.reshape(count, 4)


def pixel_surface(camera: Camera, pixels: Int, normal: Float, depth: Depth, distance: float) -> Surface:
    """The mesh of pixels (n, 2) with normals (n, 3), camera frame; world units, its median depth being `distance`."""
    facing, across = slopes(camera, pixels, normal)
    slope = np.clip(-across / facing[:, None], -STEEPEST / camera.focal_length, STEEPEST / camera.focal_length)
    number, of = _corner_vertices(len(pixels), depth)
    corner = np.array(CORNERS)
    # Slopes are per pixel along x (columns) and y (rows).
    at_corner = depth.log_depth[:, None] + slope @ (corner[:, ::-1].T - 0.5)
    total, members = np.bincount(of.ravel(), at_corner.ravel(), number), np.bincount(of.ravel(), minlength=number)
    log_depth = total / members
    place = np.zeros((number, 2))
    place[of.ravel()] = (pixels[:, None] + corner).reshape(-1, 2)[:, ::-1]
    log_depth = np.log(distance) + log_depth - np.median(depth.log_depth)
    origin, direction = rays(camera, place)
    forward = direction @ camera.rotation[2]
    vertices = origin + direction * (np.exp(log_depth) / forward)[:, None]
    # Counter-clockwise seen from the camera, y down: upper left, lower left, lower right, upper right.
    faces = np.concatenate([of[:, [0, 3, 2]], of[:, [0, 2, 1]]])
    return Surface(vertices, faces)
