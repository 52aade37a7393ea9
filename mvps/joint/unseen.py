"""What no view sees: closed smoothly from the rim of what is seen, inside the masks.

With the seen vertices fixed, the others minimise

    sum over them and their neighbours of |y_i - mean of y_i's neighbours|^2  +  sum over u of tau |y_u - t_u|^2

a discrete thin plate (Botsch and Kobbelt 2004) that leaves the rim with the slope that it has there; pieces that no view sees stay. Nothing
of an object projects outside a mask, nor lies in front of what a view sees: a vertex u that does is drawn to t_u, where it comes back into
the mask that it is farthest out of, or a pixel behind the seen surface; a few passes find them all. The faces stay, so that a closed
surface stays closed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mvps.camera import footprint, project, view_directions
from mvps.cores import on_cores
from mvps.joint.vertices import MASK_SIGMA_PIXELS
from mvps.mesh import edges, labelled_pieces
from mvps.scene import Bool, Capture, Float, Int, Surface, View
from mvps.silhouette import sampled
from mvps.visibility import RayCaster
from solvers.linear import CholeskyLike

PULL = 0.05
"""tau: a vertex that is drawn bends the surface over tau^(-1/4) = 2 edges around it."""

PASSES = 4

LEAST_SLOPE = 0.5
"""Of the distance to a mask, 1 but where two parts of the boundary are equally near."""


def closed_over(surface: Surface, seen: list[Int], capture: Capture, distance: list[NDArray[np.float32]]) -> Surface:
    """The surface with the vertices that no view sees bent over from those that are seen. seen: per view the indices of the vertices that
    it sees; distance: per view the signed distance to its mask (height, width), pixels."""
    known = np.zeros(len(surface.vertices), bool)
    known[np.concatenate(seen)] = True
    # A piece of which nothing is seen has no rim to be bent from.
    label, _ = labelled_pieces(surface)
    held = known.copy()
    held[surface.faces[~np.isin(label, label[known[surface.faces].any(1)])]] = True
    free, fixed = np.flatnonzero(~held), np.flatnonzero(held)
    if not len(free) or not len(fixed):
        return surface
    mean = _mean_of_neighbours(surface)
    rows = (sp.identity(len(held), format="csr") - mean)[np.flatnonzero(~held | (mean @ ~held > 0))]
    part = rows[:, free]
    bending, right = (part.T @ part).tocsc(), -(part.T @ (rows[:, fixed] @ surface.vertices[fixed]))
    y = CholeskyLike(bending).solve(right)
    front = _fronts(surface, known, seen)
    pull, wanted = np.zeros(len(free)), y
    for _ in range(PASSES):
        out, inside = _back_inside(y, capture, distance)
        before, behind = _back_behind(RayCaster(_with(surface, free, y)), free, capture, front)
        wrong: Bool = out | before
        if not wrong.any():
            break
        target = np.where(out[:, None], inside, behind)
        pull, wanted = np.where(wrong, PULL, pull), np.where(wrong[:, None], target, wanted)
        y = CholeskyLike(bending + sp.diags(pull)).solve(right + pull[:, None] * wanted)
    return _with(surface, free, y)


def _with(surface: Surface, free: Int, y: Float) -> Surface:
    """The surface with vertices `free` (n,) at y (n, 3)."""
    vertices = surface.vertices.copy()
    vertices[free] = y
    return Surface(vertices, surface.faces)


class _Fronts(NamedTuple):
    """What views see: the ray caster of its n faces, None without any, and per view which of them (n,) it sees."""

    caster: RayCaster | None
    seen: list[Bool]


def _fronts(surface: Surface, known: Bool, seen: list[Int]) -> _Fronts:
    faces = surface.faces[known[surface.faces].all(1)]
    if not len(faces):
        return _Fronts(None, [])

    def of_view(vertices: Int) -> Bool:
        visible = np.zeros(len(known), bool)
        visible[vertices] = True
        all_corners: Bool = np.all(visible[faces], axis=1)
        return all_corners

    return _Fronts(RayCaster(Surface(surface.vertices, faces)), [of_view(vertices) for vertices in seen])


def _back_behind(caster: RayCaster, free: Int, capture: Capture, front: _Fronts) -> tuple[Bool, Float]:
    """Which vertices `free` (n,) of the caster's surface show a view their back in front of what it sees, and all of them (n, 3), those
    moved a pixel behind it where they are least in front."""
    points, normal = caster.surface.vertices[free], caster.vertex_normals[free]
    least, moved = np.full(len(points), np.inf), points.copy()
    ahead = front.caster
    if ahead is None:
        return np.zeros(len(points), bool), moved

    def in_front(view: View, faces: Bool) -> tuple[Int, Float, Float]:
        """Which points show the view their back, how far before a face (faces,) that it sees, and a pixel behind that."""
        away = -view_directions(view.camera, points)
        chosen = np.flatnonzero((normal * away).sum(1) > 0)
        chosen = chosen[~caster.occluded(points[chosen] - caster.offset * away[chosen], -away[chosen])]
        hits = ahead.first_hits(points[chosen], away[chosen])
        before = (hits.face >= 0) & faces[hits.face]
        chosen, depth = chosen[before], hits.distance[before]
        return chosen, depth, points[chosen] + (depth + footprint(view.camera, points[chosen]))[:, None] * away[chosen]

    for chosen, depth, behind in on_cores(in_front, capture.views, front.seen):
        nearer = depth < least[chosen]
        least[chosen[nearer]], moved[chosen[nearer]] = depth[nearer], behind[nearer]
    found: Bool = np.isfinite(least)
    return found, moved


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
