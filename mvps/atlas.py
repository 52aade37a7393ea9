"""Charts of a surface in the plane (a texture atlas), and which texel lies where on the surface.

Charts are orthographic projections. Faces are labelled with one of the axes below, by the largest n . axis of their
smoothed normal; connected faces of one label make a chart; a chart smaller than a few texels joins a neighbour whose axis
its faces still face. Where a projection covers itself, the layers behind the first become charts of their own, so that no
texel has two owners. The charts, turned to their narrowest bounding rectangle, are packed on shelves (next-fit,
decreasing height: Coffman et al. 1980).

Texture coordinates (u, v) have their origin at the top left; the texel of row r and column c has its centre at
((c + 0.5) / width, (r + 0.5) / height). With an axis d = t x b of a chart, u grows along t and v against b, so charts are
never mirrored: dP/du, -dP/dv and the outward normal are right-handed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from mvps.mesh import edge_numbers, face_areas, face_normals, normalise
from mvps.scene import Bool, Float, Int, Surface
from mvps.values import checked

AXES = normalise(
    np.array(
        [[s if i == k else 0 for i in range(3)] for k in range(3) for s in (1, -1)]
        + [[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)],
        np.float64,
    )
)
"""Directions of projection: the face centres and corners of a cube; no direction is more than 36 degrees from one."""
STEEPEST = 0.25
"""Smallest cosine between a face and its chart's axis: a texel then covers at most 4 times its own area of the surface."""
SMOOTHING_ROUNDS = 20
"""Averagings over neighbouring faces before labelling: wrinkles narrower than about 10 faces do not cut charts."""
SMALLEST_CHART = 64.0
"""Charts below this area, texels, join a neighbour where they can."""
PADDING = 4
"""Texels between charts: two mip levels until neighbours mix."""


@dataclass(frozen=True, eq=False)
class Atlas:
    """A surface cut into charts.

    uv (T, 2) in [0, 1]; vertex (T,) the surface's vertex of every one; faces (F, 3) of these, in the order of the
    surface's faces; bitangent (T, 3) unit, world frame, against which v grows in the chart's plane; chart (F,); height, width in texels.
    """

    uv: Float
    vertex: Int
    faces: Int
    bitangent: Float
    chart: Int
    height: int
    width: int


class Texels(NamedTuple):
    """The n texels whose centre a face covers: row, column (n,), face (n,), barycentric (n, 3) of the face's corners."""

    row: Int
    column: Int
    face: Int
    barycentric: Float


def build_atlas(surface: Surface, texel: float) -> Atlas:
    """An atlas with texels of side `texel`, world units (measured in the plane of projection)."""
    if not texel > 0:
        raise ValueError(f"texel: wanted a positive length in world units, given {texel}")
    pairs = _adjacency(surface.faces)
    axis = _labels(surface, pairs, texel)
    chart, axis = _without_overlaps(surface, pairs, axis, texel)
    return _packed(surface, chart, axis, texel)


def vertex_tangents(atlas: Atlas, normal: Float) -> Float:
    """(T, 3) unit tangents of the atlas' vertices: dP/du of the plane across the vertex normals (V, 3) of the surface.

    There v stays, so that dP/du is across the bitangent too. Readers that make their own tangents of the texture coordinates (Blender, all
    of an OBJ file) make the same, but for the difference between the faces' planes and the vertices'.
    """
    n = normal[atlas.vertex]
    tangent = np.cross(atlas.bitangent, n)
    # A normal along the bitangent leaves no direction; any perpendicular one is as good.
    lost = np.linalg.norm(tangent, axis=-1) < 1e-6
    tangent[lost] = _frame(n[lost])[0]
    return normalise(tangent)


def rasterise(uv: Float, faces: Int, height: int, width: int) -> Texels:
    """The texels under the faces (F, 3) of texture coordinates uv (T, 2); one face per texel, the last of several."""
    found = _covered(uv * (width, height), faces)
    inside = (found.row >= 0) & (found.row < height) & (found.column >= 0) & (found.column < width)
    found = _taken(found, inside)
    owner = np.full(height * width, -1, np.int64)
    flat = found.row * width + found.column
    np.maximum.at(owner, flat, np.arange(len(flat)))
    return _taken(found, owner[owner >= 0])


def _taken(texels: Texels, which: Int | Bool) -> Texels:
    return Texels(texels.row[which], texels.column[which], texels.face[which], texels.barycentric[which])


def padded(image: NDArray[Any], filled: Bool) -> NDArray[Any]:
    """The image (height, width, ...) with texels within PADDING of the filled ones set to the nearest of these, the rest to 0."""
    distance, (row, column) = distance_transform_edt(~filled, return_indices=True)
    grown: NDArray[Any] = image[row, column]
    grown[distance > PADDING] = 0
    return grown


def _covered(points: Float, faces: Int) -> Texels:
    """All pairs of a texel centre and a face that covers it; points (T, 2) in texels. Candidates are the bounding boxes."""
    corners = points[faces]
    low = np.ceil(corners.min(1) - 0.5).astype(np.int64)
    size = np.maximum(np.floor(corners.max(1) - 0.5).astype(np.int64) - low + 1, 0)
    count = size[:, 0] * size[:, 1]
    face = np.repeat(np.arange(len(faces)), count)
    local = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    column = low[face, 0] + local % size[face, 0]
    row = low[face, 1] + local // size[face, 0]
    a, b, c = (corners[:, k] for k in range(3))
    u, v = b - a, c - a
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    area = np.where(area == 0, np.inf, area)
    offset = np.stack([column + 0.5, row + 0.5], -1) - a[face]
    second = (offset[:, 0] * v[face, 1] - offset[:, 1] * v[face, 0]) / area[face]
    third = (u[face, 0] * offset[:, 1] - u[face, 1] * offset[:, 0]) / area[face]
    barycentric = np.stack([1 - second - third, second, third], -1)
    # The rounding of a centre on an edge must not leave a hole between two faces.
    inside = (barycentric >= -1e-9).all(-1) & np.isfinite(area[face])
    return Texels(row[inside], column[inside], face[inside], barycentric[inside].clip(0, 1))


def _adjacency(faces: Int) -> Int:
    """(pairs, 2) faces that share an edge; an edge of more than two faces joins consecutive ones."""
    number = edge_numbers(faces, int(faces.max(initial=0)) + 1).ravel()
    order = np.argsort(number, kind="stable")
    same = np.diff(number[order]) == 0
    return np.stack([order[:-1][same] // 3, order[1:][same] // 3], -1)


def _components(pairs: Int, label: Int) -> Int:
    """(F,) numbers of the connected sets of faces of one label."""
    pairs = pairs[label[pairs[:, 0]] == label[pairs[:, 1]]]
    graph = sp.coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(label),) * 2)
    component: Int = connected_components(graph, directed=False)[1].astype(np.int64)
    return component


def _labels(surface: Surface, pairs: Int, texel: float) -> Int:
    """(F,) positions in AXES, from smoothed normals, small patches joined to neighbours; pairs (n, 2) of adjacent faces."""
    normals, areas = face_normals(surface), face_areas(surface)
    n = len(normals)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    mean = sp.csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(n, n)) + sp.eye(n, format="csr")
    smooth = normals
    for _ in range(SMOOTHING_ROUNDS):
        smooth = normalise(mean @ smooth)
    facing = normals @ AXES.T
    label: Int = np.where(facing > STEEPEST, smooth @ AXES.T, facing - 2).argmax(1)
    component = _components(pairs, label)
    while True:
        joined = _join_small(label, component, pairs, areas / texel**2, facing)
        after = _components(pairs, joined)
        if after.max() >= component.max():
            return label
        label, component = joined, after


def _join_small(label: Int, component: Int, pairs: Int, areas: Float, facing: Float) -> Int:
    """Labels with every small component (F,) of them that can given the label of the larger neighbour with which it shares most edges."""
    size = np.bincount(component, areas)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    ends = ends[component[ends[:, 0]] != component[ends[:, 1]]]
    ends = ends[size[component[ends[:, 0]]] < np.minimum(SMALLEST_CHART, size[component[ends[:, 1]]])]
    if not len(ends):
        return label
    border = sp.coo_matrix((np.ones(len(ends)), (component[ends[:, 0]], label[ends[:, 1]])), shape=(len(size), len(AXES))).toarray()
    worst = np.full((len(size), len(AXES)), np.inf)
    small = np.flatnonzero(border.sum(1)[component] > 0)
    np.minimum.at(worst, component[small], facing[small])
    border[worst < STEEPEST] = 0
    best = border.argmax(1)
    change = border.max(1)[component] > 0
    return np.where(change, best[component], label)


def _frame(axis: Float) -> tuple[Float, Float]:
    """Unit t, b (..., 3) with t x b = axis (..., 3) (Duff et al. 2017)."""
    x, y, z = axis[..., 0], axis[..., 1], axis[..., 2]
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    xy = x * y * a
    return np.stack([1 + sign * x * x * a, sign * xy, -sign * x], -1), np.stack([xy, sign + y * y * a, -y], -1)


def _plane(surface: Surface, axis: Int, texel: float) -> Float:
    """(F, 3, 2) corners of the faces in the plane of their axis, texels, u along t and v against b."""
    tangent, bitangent = _frame(AXES[axis])
    corners = surface.vertices[surface.faces] / texel
    return np.stack([np.einsum("fkc,fc->fk", corners, tangent), -np.einsum("fkc,fc->fk", corners, bitangent)], -1)


def _without_overlaps(surface: Surface, pairs: Int, axis: Int, texel: float) -> tuple[Int, Int]:
    """Charts (F,) and their axes (charts,): components of one axis, split until no texel centre lies under two faces of one. pairs (n, 2)
    of adjacent faces."""
    flat = _plane(surface, axis, texel).reshape(-1, 2)
    soup = np.arange(len(flat)).reshape(-1, 3)
    depth = (surface.vertices[surface.faces] * AXES[axis][:, None]).sum(-1)
    found = _covered(flat, soup)
    height = (depth[found.face] * found.barycentric).sum(1)
    layer = _layers(_components(pairs, axis), found, height, 1e-6 * texel)
    chart = _components(pairs, axis + len(AXES) * layer)
    return chart, axis[np.unique(chart, return_index=True)[1]]


def _layers(chart: Int, found: Texels, height: Float, edge: float) -> Int:
    """(F,) layer of every face: two faces of one chart (F,) over one texel centre have different ones, the highest layer 0.

    Faces that meet at an edge are at one height there, up to `edge`, and do not count. Layers are a greedy colouring from above.
    """
    order = np.lexsort((-height, found.column, found.row, chart[found.face]))
    face, top = found.face[order], height[order]
    key = np.stack([found.row[order], found.column[order], chart[face]])
    conflicts: dict[int, set[int]] = {}
    for apart in range(1, len(face)):
        same = (key[:, apart:] == key[:, :-apart]).all(0)
        if not same.any():
            break
        for i in np.flatnonzero(same & (top[:-apart] - top[apart:] > edge)):
            upper, lower = int(face[i]), int(face[i + apart])
            conflicts.setdefault(upper, set()).add(lower)
            conflicts.setdefault(lower, set()).add(upper)
    peak = np.full(len(chart), -np.inf)
    np.maximum.at(peak, found.face, height)
    layer = np.zeros(len(chart), np.int64)
    done: set[int] = set()
    for f in sorted(conflicts, key=lambda f: (-peak[f], f)):
        taken = {int(layer[g]) for g in conflicts[f] & done}
        layer[f] = next(k for k in range(len(taken) + 1) if k not in taken)
        done.add(f)
    return layer


def _narrowest(points: Float) -> float:
    """Angle that turns points (n, 2) into their bounding rectangle of the smallest area, the longer side along u."""
    try:
        hull = points[ConvexHull(points).vertices]
    except QhullError:
        hull = points
    sides = np.diff(hull, axis=0, append=hull[:1])
    angles = -np.arctan2(sides[:, 1], sides[:, 0])
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    width = np.ptp(cos * hull[:, 0] - sin * hull[:, 1], axis=1)
    height = np.ptp(sin * hull[:, 0] + cos * hull[:, 1], axis=1)
    best = int((width * height).argmin())
    return float(angles[best] + (np.pi / 2 if width[best] < height[best] else 0))


def _packed(surface: Surface, chart: Int, axis: Int, texel: float) -> Atlas:
    """The charts (F,) with axes (charts,) side by side in one atlas."""
    n = len(surface.vertices)
    key, inverse = np.unique(np.repeat(chart, 3) * n + surface.faces.ravel(), return_inverse=True)
    faces, vertex, of_chart = inverse.reshape(-1, 3), key % n, key // n
    tangent, bitangent = _frame(AXES[axis])
    start = np.searchsorted(of_chart, np.arange(len(axis) + 1))
    points = np.empty((len(key), 2))
    for k in range(len(axis)):
        part = slice(start[k], start[k + 1])
        local = surface.vertices[vertex[part]] @ np.stack([tangent[k], -bitangent[k]], -1) / texel
        angle = _narrowest(local)
        cos, sin = np.cos(angle), np.sin(angle)
        points[part] = local @ np.array([[cos, sin], [-sin, cos]])
        bitangent[k] = cos * bitangent[k] - sin * tangent[k]
    low = np.stack([np.minimum.reduceat(points[:, k], start[:-1]) for k in range(2)], -1)
    high = np.stack([np.maximum.reduceat(points[:, k], start[:-1]) for k in range(2)], -1)
    corner, height, width = _shelves(np.ceil(high - low).astype(np.int64) + PADDING)
    points += (corner - low + PADDING / 2)[of_chart]
    uv = checked("uv", points / (width, height), (None, 2))
    return Atlas(uv, vertex, faces, bitangent[of_chart], chart, height, width)


def _shelves(size: Int) -> tuple[Int, int, int]:
    """Corners (n, 2) for rectangles of size (n, 2) (u, v) that do not overlap, and the height and width that hold them."""
    width = max(int(np.ceil(np.sqrt(size.prod(1).sum()))), int(size[:, 0].max()))
    corner = np.zeros_like(size)
    x = y = shelf = 0
    for k in np.lexsort((-size[:, 0], -size[:, 1])):
        if x + size[k, 0] > width:
            x, y, shelf = 0, y + shelf, 0
        shelf = max(shelf, int(size[k, 1]))
        corner[k] = x, y
        x += int(size[k, 0])
    return corner, y + shelf, width
