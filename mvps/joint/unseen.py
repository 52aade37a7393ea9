"""What no view sees: closed smoothly from the rim of what is seen, inside the masks.

With the seen vertices fixed, the others minimise

    sum over them and their neighbours of |y_i - mean of y_i's neighbours|^2  +  sum over u of tau |y_u - t_u|^2

a discrete thin plate (Botsch and Kobbelt 2004) that leaves the rim with the slope that it has there. Nothing of an object projects outside
a mask: a vertex u that does is drawn to t_u, where it comes back into the mask that it is farthest out of; a few passes find them all.
The faces stay, so that a closed surface stays closed.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mvps.camera import project
from mvps.joint.vertices import MASK_SIGMA_PIXELS
from mvps.mesh import edges
from mvps.scene import Bool, Capture, Float, Surface
from mvps.silhouette import sampled
from solvers.linear import CholeskyLike

PULL = 0.05
"""tau: a vertex that is drawn bends the surface over tau^(-1/4) = 2 edges around it."""

PASSES = 4

LEAST_SLOPE = 0.5
"""Of the distance to a mask, 1 but where two parts of the boundary are equally near."""


def closed_over(surface: Surface, seen: Bool, capture: Capture, distance: list[NDArray[np.float32]]) -> Surface:
    """The surface with the vertices that are not `seen` (V,) bent over from those that are. distance: per view the signed distance to its
    mask (height, width), pixels."""
    free, fixed = np.flatnonzero(~seen), np.flatnonzero(seen)
    if not len(free) or not len(fixed):
        return surface
    mean = _mean_of_neighbours(surface)
    rows = (sp.identity(len(seen), format="csr") - mean)[np.flatnonzero(~seen | (mean @ ~seen > 0))]
    part = rows[:, free]
    bending, right = (part.T @ part).tocsc(), -(part.T @ (rows[:, fixed] @ surface.vertices[fixed]))
    y = CholeskyLike(bending).solve(right)
    pull, wanted = np.zeros(len(free)), y
    for _ in range(PASSES):
        out, inside = _back_inside(y, capture, distance)
        if not out.any():
            break
        pull, wanted = np.where(out, PULL, pull), np.where(out[:, None], inside, wanted)
        y = CholeskyLike(bending + sp.diags(pull)).solve(right + pull[:, None] * wanted)
    vertices = surface.vertices.copy()
    vertices[free] = y
    return Surface(vertices, surface.faces)


def _mean_of_neighbours(surface: Surface) -> sp.csr_matrix:
    """(V, V) matrix that takes values on the vertices to the means over their neighbours."""
    pairs, n = edges(surface), len(surface.vertices)
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    return sp.csr_matrix((1 / np.bincount(rows, minlength=n)[rows], (rows, columns)), (n, n))


def _back_inside(points: Float, capture: Capture, distance: list[NDArray[np.float32]]) -> tuple[Bool, Float]:
    """Which points (n, 3) are outside a mask by more than it is known to, and all points, those moved into the mask that they are farthest
    out of."""
    worst, moved = np.full(len(points), MASK_SIGMA_PIXELS), points.copy()
    for view, field in zip(capture.views, distance, strict=True):
        image, depth = project(view.camera, points)
        outside = sampled(field, image)
        chosen = np.flatnonzero(outside > worst)
        worst[chosen] = outside[chosen]
        image, depth = image[chosen], depth[chosen]
        slope = np.stack([sampled(field, image + step) - sampled(field, image - step) for step in np.eye(2)], 1) / 2
        inwards = -worst[chosen, None] * slope / np.maximum((slope**2).sum(1), LEAST_SLOPE**2)[:, None]
        moved[chosen] = points[chosen] + inwards * (depth / view.camera.focal_length)[:, None] @ view.camera.rotation[:2]
    return worst > MASK_SIGMA_PIXELS, moved
