"""PJ16's mesh refinement: a displacement along the mesh's normals that makes the surface follow the photometric normals.

A vertex goes from x_i to y_i = x_i + d_i n_i. Within face f, whose photometric normal is m_f, the refined surface is at right angles to m_f
where grad(m_f . y) = 0, in both directions of the parameter domain: linear in d. With hat functions phi_i on the faces,

    minimise over d   sum_f A_f c_f |sum_i (m_f . y_i) grad phi_i|^2 / (a sigma_n^2)  +  sum_i rho(h(y_i) / sigma_h)
                      + sum_i w_i (d_i - r_i)^2

c_f in [0, 1] how far the normal is to be trusted, a the mean area of a vertex, h the signed distance to the coarse mesh, linear in d too,
r_i the displacement at which the mesh's outline lies on the masks' (mvps/silhouette.py), w_i the weight of that: one sparse symmetric
system. The next displacement starts from its minimum, with normals, slopes and robust weights anew. Vertices are shared by the charts, so
their borders are like the rest.

The coarse mesh is a visual hull, which lies nowhere inside the object: rho is square outwards, and inwards that of Geman and McClure
(1985), which lets go of a vertex in a hollow.

A slope is the tangent of the angle between m_f and the mesh's normal, whose error grows with 1 / cos^2: c_f has a factor cos^2, and none
follows a normal that points to the other side. No vertex moves by more than an edge at once: as far as slopes stay linear.
"""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp
from scipy.ndimage import map_coordinates

from mvps.joint.agreement import Agreement
from mvps.joint.vertices import with_masks
from mvps.mesh import face_areas, face_normals, mean_edge_length, vertex_normals
from mvps.scene import Capture, Float, SignedDistanceGrid, Surface
from mvps.silhouette import mask_distances
from solvers.linear import CholeskyLike

NORMAL_SIGMA = 0.03
"""Standard deviation of a photometric normal, radians: what Lambert's law leaves on objects that are not quite Lambertian."""

COARSE_SIGMA = 0.5
"""Standard deviation of the coarse mesh where it touches the object, pixels: it passes anywhere through the pixels of the outlines.
Half or four times as much changes nothing."""

OFF_THE_MASK = 3.0
"""Scale of outliers among the masks' pulls, pixels: outlines of the mesh that are no outlines of the object."""

LEAST_TRUST = 1e-3
"""Trust in a face that no photograph tells of: it keeps its shape, and all others overrule it."""

REST = 1e-4
"""Weight, relative to that of the coarse mesh, by which a vertex of which nothing is known stays where it is."""

SHARPEST = 1e-3
"""Bounds of half the cotangents, this and its inverse: a sliver of a face has no say, and none is negative."""


def displaced(surface: Surface, target: Float, trust: Float, capture: Capture, coarse: SignedDistanceGrid, pixel: float) -> Surface:
    """The surface after a displacement by which its faces come to follow target (F, 3), unit, as far as trust (F,) goes.

    coarse: signed distance to the coarse mesh; pixel: what a pixel covers, world units.
    """
    along, count = vertex_normals(surface), len(surface.vertices)
    facing = np.einsum("fc,fc->f", target, face_normals(surface)).clip(0)
    system, right = _slopes(surface, along, target, np.maximum(trust * facing**2, LEAST_TRUST))
    sigma, edge = COARSE_SIGMA * pixel, mean_edge_length(surface)
    beyond, ahead, behind = (_distance(coarse, surface.vertices + step * along) for step in (0, edge, -edge))
    rate = (ahead - behind) / (2 * edge)
    held = 1 / (1 + (np.minimum(beyond, 0) / sigma) ** 2) ** 2 / sigma**2
    nothing = Agreement(np.zeros(count), np.full(count, np.inf))
    rim = with_masks(nothing, capture, surface, mask_distances(capture), 0.0)
    pull = np.where(np.isfinite(rim.sigma), rim.sigma, np.inf) ** -2 / (1 + (rim.offset / (OFF_THE_MASK * pixel)) ** 2)
    right += pull * rim.offset - held * rate * beyond
    d = CholeskyLike(system + sp.diags(held * rate**2 + pull + REST / sigma**2)).solve(right[:, None])[:, 0]
    return Surface(surface.vertices + d.clip(-edge, edge)[:, None] * along, surface.faces)


def _slopes(surface: Surface, along: Float, target: Float, trust: Float) -> tuple[sp.csr_matrix, Float]:
    """Matrix (V, V) and right side (V,) of the normal equations of the faces' slopes in d."""
    faces, count = surface.faces, len(surface.vertices)
    # With the cotangent of the opposite angle, an edge i-j adds half of it times (s_i - s_j)^2 for s = height + slope d.
    half = igl.cotmatrix_entries(np.array(surface.vertices), np.array(faces))
    # A face without area has angles that are no numbers.
    half = np.where(np.isfinite(half), half, SHARPEST).clip(SHARPEST, 1 / SHARPEST)
    scale = count / (NORMAL_SIGMA**2 * face_areas(surface).sum())
    weight = half * (scale * trust)[:, None]
    slope = np.einsum("fc,fkc->fk", target, along[faces])
    height = np.einsum("fc,fkc->fk", target, surface.vertices[faces] - surface.vertices[faces[:, :1]])
    rows, columns, values, right = [], [], [], np.zeros(count)
    for k in range(3):
        i, j, w = (k + 1) % 3, (k + 2) % 3, weight[:, k]
        for p, q, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            rows.append(faces[:, p])
            columns.append(faces[:, q])
            values.append(sign * w * slope[:, p] * slope[:, q])
        pulled = w * (height[:, i] - height[:, j])
        right += np.bincount(faces[:, j], pulled * slope[:, j], count) - np.bincount(faces[:, i], pulled * slope[:, i], count)
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sp.csr_matrix(entries, (count, count)), right


def _distance(grid: SignedDistanceGrid, points: Float) -> Float:
    """(n,) signed distance of points (n, 3), interpolated between the grid's nodes."""
    distance: Float = map_coordinates(grid.values, ((points - grid.origin) / grid.spacing).T, np.float64, order=1, mode="nearest")
    return distance
