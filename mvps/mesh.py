"""Discrete geometry on a triangle mesh (V, F): normals, areas, angles, edges, nearest points, remeshing, decimation, cleaning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from mvps.once import once_for
from mvps.scene import Bool, Float, Int, Surface

KNIFE_EDGE = 90.0
"""Degrees that a surface turns by across an edge that remeshing keeps: where two sides of a thin part meet, relaxing would draw vertices
off their edge, and the nearest point of the surface is then on a side. What is smooth turns by less over an edge's length."""

AVERAGED = 2
"""Times that values are averaged with neighbours', over some twenty vertices: a variance from a handful of clusters is known to a factor of
two at best."""


def face_cross(surface: Surface) -> Float:
    """(F, 3) cross product of two edges of every face: outward normal times twice the area."""
    a, b, c = corners(surface)
    return cross(b - a, c - a)


def corners(surface: Surface) -> list[Float]:
    """The faces' first, second and third corners, (F, 3) each."""
    # Several times faster than numpy's indexing by rows.
    return [np.take(surface.vertices, surface.faces[:, k], axis=0) for k in range(3)]


def cross(a: Float, b: Float) -> Float:
    """Cross products (n, 3) of vectors a and b (n, 3); several times faster than numpy's."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


def normalise(vectors: Float, floor: float = 1e-300) -> Float:
    """Vectors (..., 3) divided by their length; a zero vector stays zero."""
    length = np.maximum(lengths(vectors), floor)
    unit: Float = np.empty_like(vectors, np.result_type(vectors, length))
    # Numpy's loops are slow along an axis of three.
    for k in range(vectors.shape[-1]):
        np.divide(vectors[..., k], length, out=unit[..., k])
    return unit


def dot(a: Float, b: Float) -> Float:
    """(...,) products of vectors a and b (..., 3); several times faster than a sum along an axis of three."""
    product: Float = a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
    return product


def lengths(vectors: Float) -> Float:
    """(...,) lengths of vectors (..., 3); several times faster than numpy's norm, which reduces three numbers at a time."""
    length: Float = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))
    return length


def angles_deg(a: Float, b: Float) -> Float:
    """Angles (...,) in degrees between unit vectors a and b (..., 3): 2 atan2(|a - b|, |a + b|) (Kahan), exact for small ones too."""
    chord, sum_ = lengths(a - b), lengths(a + b)
    angle: Float = np.degrees(2 * np.arctan2(chord, sum_))
    return angle


def centres(surface: Surface) -> Float:
    """(F, 3) of the faces."""
    a, b, c = corners(surface)
    centre: Float = (a + b + c) / 3
    return centre


@once_for
def face_normals(surface: Surface) -> Float:
    """(F, 3) unit outward normals; zero for a degenerate face."""
    return normalise(face_cross(surface))


@once_for
def face_areas(surface: Surface) -> Float:
    """(F,) areas."""
    areas: Float = lengths(face_cross(surface)) / 2
    return areas


@once_for
def vertex_areas(surface: Surface) -> Float:
    """(V,) a third of the faces at each vertex: they sum to the surface's area."""
    areas = np.zeros(len(surface.vertices))
    np.add.at(areas, surface.faces, face_areas(surface)[:, None] / 3)
    return areas


@once_for
def vertex_normals(surface: Surface) -> Float:
    """(V, 3) unit outward normals: face normals weighted by the angle at the vertex (Thuermer and Wuethrich 1998). Read-only, made once
    for a surface, like others here."""
    ends = corners(surface)
    sides = [ends[(k + 1) % 3] - ends[k] for k in range(3)]
    outward = cross(sides[0], sides[1])
    doubled = lengths(outward)
    normals = normalise(outward)
    total = np.zeros_like(surface.vertices)
    for k in range(3):
        # Sides leave corner k along sides[k] and -sides[k - 1]; twice the area is the sine's part.
        angle = np.arctan2(doubled, -np.einsum("fi,fi->f", sides[k], sides[k - 1]))
        for axis in range(3):
            total[:, axis] += np.bincount(surface.faces[:, k], angle * normals[:, axis], len(total))
    total[lengths(total) < 1e-12] = (0, 0, 1)
    return normalise(total)


@once_for
def edges(surface: Surface) -> Int:
    """(E, 2) undirected edges, the smaller index first, each once."""
    n = len(surface.vertices)
    # Sorting is several times faster than the hashes of numpy's `unique`.
    number = np.sort(edge_numbers(surface.faces, n), axis=None)
    number = number[np.diff(number, prepend=-1) > 0]
    return np.stack([number // n, number % n], 1)


def neighbour_sums(values: Float, ends: Int) -> Float:
    """(V, k) sums of the values (V, k) at the other ends (E, 2) of a vertex's edges."""
    sums = np.zeros(values.shape)
    for here, there in (ends.T, ends.T[::-1]):
        for k, column in enumerate(values.T):
            sums[:, k] += np.bincount(here, column[there], len(values))
    return sums


def averaged(values: Float, known: Bool, ends: Int) -> Float:
    """(V, k) values, where known (V,), averaged with what is known at the other ends (E, 2) of a vertex's edges, AVERAGED times; 0 where
    nothing is."""
    for _ in range(AVERAGED):
        own = np.column_stack([values, np.ones(len(values))]) * known[:, None]
        total = own + neighbour_sums(own, ends)
        values = total[:, :-1] / np.maximum(total[:, -1:], 1)
    return values


def edge_numbers(faces: Int, n: int) -> Int:
    """(F, 3) for the edges 0-1, 1-2, 2-0 of faces over n vertices, i n + j with i < j: numpy sorts numbers many times faster than rows."""
    other = faces[:, [1, 2, 0]]
    return np.minimum(faces, other) * n + np.maximum(faces, other)


@once_for
def mean_edge_length(surface: Surface) -> float:
    """Mean length of the faces' sides: of the edges, those at a border counting half."""
    a, b, c = corners(surface)
    return float(np.stack([lengths(a - b), lengths(b - c), lengths(c - a)], 1).mean())


def without_unused_vertices(surface: Surface) -> Surface:
    """The same faces over only the vertices that they use."""
    used, inverse = np.unique(surface.faces, return_inverse=True)
    return Surface(surface.vertices[used], inverse.reshape(-1, 3))


def labelled_pieces(surface: Surface) -> tuple[Int, Int]:
    """Of each face the number of its connected component, and these numbers from the largest area to the smallest."""
    n, pairs = len(surface.vertices), edges(surface)
    graph = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1][surface.faces[:, 0]]
    area = np.bincount(label, face_areas(surface))
    # Single vertices are components without faces.
    return label, np.argsort(-area, kind="stable")[: len(np.unique(label))]


def piece_count(surface: Surface) -> int:
    """How many connected components the faces make."""
    return len(labelled_pieces(surface)[1])


def pieces_of(surface: Surface) -> list[Surface]:
    """The connected components, from the largest area to the smallest."""
    label, order = labelled_pieces(surface)
    return [without_unused_vertices(Surface(surface.vertices, surface.faces[label == k])) for k in order]


def largest_pieces(surface: Surface, count: int = 1) -> Surface:
    """The `count` connected components with the largest areas."""
    label, order = labelled_pieces(surface)
    return chosen_pieces(surface, label, order[:count])


def chosen_pieces(surface: Surface, label: Int, numbers: Sequence[int] | Int) -> Surface:
    """The connected components of these numbers; label (F,): of each face its component's (`labelled_pieces`)."""
    return without_unused_vertices(Surface(surface.vertices, surface.faces[np.isin(label, numbers)]))


def split_edges(surface: Surface, marked: Bool) -> Surface:
    """The surface with the marked ones of `edges(surface)` split in the middle; faces become two, three or four."""
    pairs, n = edges(surface), len(surface.vertices)
    middle = np.full(len(pairs), -1)
    middle[marked] = n + np.arange(int(marked.sum()))
    vertices = np.concatenate([surface.vertices, surface.vertices[pairs[marked]].mean(1)])
    middles = middle[np.searchsorted(pairs[:, 0] * n + pairs[:, 1], edge_numbers(surface.faces, n))]
    count = (middles >= 0).sum(1)
    faces = [surface.faces[count == 0]]
    for k in range(3):
        # The face turned so that its first edge is the k-th: a b c with middles p on ab, q on bc.
        turned, on = np.roll(surface.faces, -k, axis=1), np.roll(middles, -k, axis=1)
        one = (count == 1) & (on[:, 0] >= 0)
        (a, b, c), p = turned[one].T, on[one, 0]
        faces += [np.stack(f, 1) for f in ((a, p, c), (p, b, c))]
        two = (count == 2) & (on[:, 0] >= 0) & (on[:, 1] >= 0)
        (a, b, c), (p, q) = turned[two].T, on[two, :2].T
        faces += [np.stack(f, 1) for f in ((p, b, q), (a, p, c), (p, q, c))]
    (a, b, c), (p, q, r) = surface.faces[count == 3].T, middles[count == 3].T
    faces += [np.stack(f, 1) for f in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
    return Surface(vertices, np.concatenate(faces))


def unbiased(surface: Surface) -> Surface:
    """The surface with its vertices lifted so that its flat faces lie on the smooth surface in the mean, and not its vertices.

    Of a function f a triangle with right corners is short by the mean  sum over its edges e of  e . f'' e / 24; along an edge from x_i
    to x_j the normals say  e . f'' e = (n_i - n_j) . (x_i - x_j). A vertex rises by the mean over its faces: edge^2 / (8 r) on a ball.
    """
    normal, area, faces = vertex_normals(surface), face_areas(surface), surface.faces
    turned, side = (a[faces] - a[np.roll(faces, -1, axis=1)] for a in (normal, surface.vertices))
    gap = np.einsum("fkc,fkc->f", turned, side) / 24
    rise, total = (sum(np.bincount(faces[:, k], values, len(normal)) for k in range(3)) for values in (area * gap, area))
    return Surface(surface.vertices + (rise / np.maximum(total, np.finfo(float).tiny))[:, None] * normal, faces)


def isotropic_remesh(surface: Surface, edge_length: float, iterations: int = 2) -> Surface:
    """The surface with edges of about `edge_length` (split, collapse, flip, relax: Botsch and Kobbelt 2004). Edges across which
    the surface turns by KNIFE_EDGE stay edges, and vertices on them stay there. Of what falls apart as many pieces stay as there were."""
    import igl
    from gpytoolbox import remesh_botsch

    vertices: Any
    # gpytoolbox finds the same edges of a closed mesh, in as much time as a third of the remeshing takes.
    sharp = igl.sharp_edges(np.array(surface.vertices), np.array(surface.faces, dtype=np.int64), np.radians(KNIFE_EDGE))
    vertices, faces = remesh_botsch(
        np.array(surface.vertices),
        np.array(surface.faces, dtype=np.int32),
        i=iterations,
        h=edge_length,
        project=True,
        feature_edges=np.unique(np.sort(sharp, axis=1), axis=0),
    )
    return largest_pieces(Surface(vertices, faces), piece_count(surface))


LEAST_FACES = 4
"""Of a closed mesh: a tetrahedron's."""


def decimated(surface: Surface, faces: int) -> Surface | None:
    """The surface with about `faces` faces, by collapsing edges (quadrics: Garland and Heckbert 1997); as it is where it has no more.

    None where an edge has more than two faces, which collapsing cannot do with.
    """
    import igl

    if faces >= len(surface.faces):
        return surface
    vertices, fewer, *_ = igl.qslim(np.asfortranarray(surface.vertices), np.asfortranarray(surface.faces, np.int32), faces)
    return Surface(vertices, fewer) if len(fewer) else None


class Nearest(NamedTuple):
    """Nearest points of a surface: distance (n,), point (n, 3), face (n,), barycentric (n, 3) of the face's corners."""

    distance: Float
    point: Float
    face: Int
    barycentric: Float


def nearest(surface: Surface, points: Float) -> Nearest:
    """Of the surface to points (n, 3)."""
    import igl

    vertices, faces = np.array(surface.vertices), np.array(surface.faces)
    squared, face, point = igl.point_mesh_squared_distance(np.ascontiguousarray(points), vertices, faces)
    corners = vertices[faces[face]]
    barycentric = np.nan_to_num(igl.barycentric_coordinates(point, *(np.ascontiguousarray(corners[:, k]) for k in range(3))))
    return Nearest(np.sqrt(squared), point, face, np.clip(barycentric, 0, 1))
