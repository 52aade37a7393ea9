"""Hollows deeper than anything else reaches, found by what the image model cannot explain and dug out of the solid.

Pixels over a deep hollow show, at each place of the surface that bridges it, something else in every view. Nothing fits there, so normals
say nothing and no neighbouring place fits better: the surface stays. But where it is wrong is known, by the share u of a vertex's samples
that the model leaves unexplained, beyond their noise. With U the vertices above MISFIT and

    L(v) = distance from v in U to the nearest vertex that fits, 0 elsewhere

a hollow under a patch of U is likely to be about as deep as the patch is wide. So balls of radius min(L, half of the solid's thickness
inwards) around U are cut out of it, a pit that ends at the patch's edge and never meets another side. A wall that is thin beside the pit
would be eaten by halves all the same, pit by pit: where its other side fits, wide pits leave as much of it as the grid can hold. Of what is
then seen the model explains more if the hollow is there: the caller sees to that, and digs again (space carving, Kutulakos and Seitz 2000,
by patches and with a way back). The mean of L over what is seen,

    hidden_px = mean of L, pixels,

says how far off the surface is likely to be for this alone. Whether pits belong there is told by

    misfit = mean of min(u, 1)^2 over the pixels of all views

(few samples, or dark ones, have u without bounds). Over vertices it would grow as soon as a pit shows more of a hollow's inside. The
rougher a pit, the more of it lies beside what hides it, where no sample tells u: there it is as at the nearest vertex that has one, for
what is left out would fit.
"""

from __future__ import annotations

import igl
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from mvps.camera import view_directions
from mvps.cores import neighbours
from mvps.mesh import vertex_areas, vertex_normals
from mvps.scene import Bool, Capture, Float, Int, SignedDistanceGrid, Surface
from mvps.visibility import ray_caster, visible_vertices

MISFIT = 0.2
"""Share of its signal that a vertex leaves unexplained from which it lies on no surface, or on one that the model does not know: twice what
makes a model a bad one for a whole object. From 0.1 on digging goes into what merely fits badly, from 0.3 on it comes to rest early
(docs/findings/hollows.md)."""

EXACT_CELLS = 3
"""From the surface; farther off distances count cells."""

WALL_CELLS = 2.0
"""Of a wall whose one side fits, what wide pits leave: a grid holds a plate of two cells wherever its nodes lie."""

BEHIND = 0.5
"""Cosine of the angle between a vertex's normal and the way to it, above which a point lies behind the vertex and not beside it."""


def beyond_noise(residual: Float, noise: float) -> Float:
    """What residuals, shares of the signal, are without noise, a share as well."""
    beyond: Float = np.sqrt(np.maximum(residual**2 - noise**2, 0))
    return beyond


def clearance(surface: Surface, unexplained: Float) -> Float:
    """L (V,), world units, of a surface whose vertices leave the shares `unexplained` (V,), NaN where none sees them; 0 everywhere where
    none fits, which says nothing of the shape."""
    misfits, fits = unexplained > MISFIT, unexplained <= MISFIT
    found = np.zeros(len(unexplained))
    if misfits.any() and fits.any():
        found[misfits] = neighbours(cKDTree(surface.vertices[fits]), surface.vertices[misfits])[0]
    return found


def hidden(surface: Surface, unexplained: Float) -> float:
    """Mean of L over the surface that is seen, world units."""
    return mean_depth(surface, unexplained, clearance(surface, unexplained))


def mean_depth(surface: Surface, unexplained: Float, depth: Float) -> float:
    """Mean of depths (V,) over the surface that is seen, in their unit; unexplained (V,): NaN where no view sees a vertex."""
    area = np.where(np.isfinite(unexplained), vertex_areas(surface), 0)
    return float((depth * area).sum() / max(area.sum(), np.finfo(float).tiny))


def pits(surface: Surface, unexplained: Float, spacing: float) -> Float:
    """L (V,) where a grid of this spacing can hold a ball of it, 0 elsewhere."""
    depth = clearance(surface, unexplained)
    return np.where(depth >= spacing, depth, 0)


def misfit(capture: Capture, surface: Surface, unexplained: Float) -> float:
    """The misfit of a surface, whose vertices leave the shares `unexplained` (V,), NaN where no sample tells; 1 where none does anywhere,
    which explains nothing."""
    caster, looks = ray_caster(surface), np.zeros(len(unexplained))
    for view in capture.views:
        facing = (caster.vertex_normals * view_directions(view.camera, surface.vertices)).sum(1)
        looks += visible_vertices(caster, view.camera) * facing.clip(0)
    told = np.isfinite(unexplained)
    if not (told.any() and looks.any()):
        return 1.0
    share = unexplained.copy()
    share[~told] = unexplained[told][neighbours(cKDTree(surface.vertices[told]), surface.vertices[~told])[1]]
    return float(np.average(share.clip(max=1) ** 2, weights=looks * vertex_areas(surface)))


def solid(surface: Surface, like: SignedDistanceGrid) -> SignedDistanceGrid:
    """Signed distance of a closed surface on the nodes of another grid, exact near it."""
    shape = like.values.shape
    nodes = like.origin + like.spacing * np.indices(shape).reshape(3, -1).T
    vertices, faces = np.ascontiguousarray(surface.vertices), np.ascontiguousarray(surface.faces)
    inside = (igl.fast_winding_number(vertices, faces, nodes) > 0.5).reshape(shape)
    # A boundary between two nodes is half a cell from either.
    distance = (np.where(inside, distance_transform_edt(inside), distance_transform_edt(~inside)) - 0.5) * like.spacing
    near = distance.ravel() <= EXACT_CELLS * like.spacing
    exact = distance.ravel()
    exact[near] = np.sqrt(np.maximum(igl.point_mesh_squared_distance(nodes[near], vertices, faces)[0], 0))
    return SignedDistanceGrid(np.where(inside, -1, 1) * exact.reshape(shape), like.origin, like.spacing)


def thickness(surface: Surface, vertex: Int) -> Float:
    """(n,) distance from vertices, numbers (n,), straight inwards to where the solid ends; inf where it does not."""
    caster, normal = ray_caster(surface), vertex_normals(surface)[vertex]
    hits = caster.first_hits(surface.vertices[vertex] - caster.offset * normal, -normal)
    return hits.distance + caster.offset


def in_walls(points: Float, surface: Surface, unexplained: Float, depth: float) -> Bool:
    """(n,) which of the points (n, 3) lie no deeper than `depth` behind a vertex that fits."""
    fits = unexplained <= MISFIT
    distance, nearest = neighbours(cKDTree(surface.vertices[fits]), points)
    outwards = surface.vertices[fits][nearest] - points
    along = (outwards * vertex_normals(surface)[fits][nearest]).sum(1)
    within: Bool = (distance < depth) & (along > BEHIND * distance)
    return within


def dug(surface: Surface, unexplained: Float, like: SignedDistanceGrid, share: float = 1.0, walls: bool = False) -> SignedDistanceGrid:
    """The solid without the balls, on the nodes of another grid. share: of L that balls have as their radius; walls: what lies within
    WALL_CELLS behind a vertex that fits stays."""
    depth = share * clearance(surface, unexplained)
    vertex = np.flatnonzero(depth >= like.spacing)
    radius = np.minimum(depth[vertex], thickness(surface, vertex) / 2)
    grid = solid(surface, like)
    values = grid.values.copy()
    for centre, r in zip(surface.vertices[vertex], radius, strict=True):
        low, high = (np.clip((centre + side * (r + grid.spacing) - grid.origin) / grid.spacing, 0, values.shape) for side in (-1, 1))
        low, high = np.floor(low).astype(int), np.ceil(high).astype(int) + 1
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        around = values[box]
        offset = grid.origin + grid.spacing * (low + np.indices(around.shape).reshape(3, -1).T) - centre
        np.maximum(around, (r - np.linalg.norm(offset, axis=1)).reshape(around.shape), out=around)
    if walls:
        cut = np.stack(np.nonzero(values > grid.values))
        nodes = grid.origin + grid.spacing * cut.T
        stays = tuple(cut[:, in_walls(nodes, surface, unexplained, WALL_CELLS * grid.spacing)])
        values[stays] = grid.values[stays]
    return SignedDistanceGrid(values, grid.origin, grid.spacing)
