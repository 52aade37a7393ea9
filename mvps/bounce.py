"""Light that surfaces send each other: diffuse inter-reflection, gathered with rays.

A point x with diffuse reflectance r = b a (albedo a in units of the photographs, b the object's bounce, scene.py) returns

    r(x) * mean over cosine-distributed directions w of the radiance that arrives along w
    = a(x) b e G(x),      G = S (L_1 + b a G),      L_1 = a max(n.l, 0) * shadow     per unit intensity e

S averages over the first hits of a fixed set of directions (Embree). The series is summed bounce by bounce (Neumann). Light that comes by
way of another surface varies slowly, so G is computed at few vertices, one for each patch, and interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mvps.cores import neighbours
from mvps.mesh import face_normals, mean_edge_length, vertex_normals
from mvps.once import once_for
from mvps.scene import Bool, Float, Int, Surface
from mvps.visibility import RayCaster, cast_shadow, ray_caster

RAYS = 128
"""Rays of a patch: the mean over an occluded tenth of the hemisphere is then known to about 25 %, over the patches that a point
interpolates to 12 %, of an effect of some per cent."""

LIFT_EDGES = 0.01
"""Height at which these rays start, over the mean of the mesh's edges. What a point has beside it is mostly lit where it is itself, so that
from a fifth of an edge's height on a hollow's lit side lacked 2.5 % and its dark side had 5 % too much (docs/findings/shadows.md)."""

BOUNCES = 3
"""What is left after three is below r^4 of the occluded part: 0.1 % for a white bowl, nothing elsewhere."""

PATCH_EDGES, SHELTERED_EDGES = 3.0, 1.5
"""Size of a patch over the mesh's edges: some eight vertices in the open, and two where light from other parts counts: normals in a chalk
ball's hollows are then 1.3 deg off, at the truth, in place of 1.6, and beside rims 3.5 in place of 5.5 (docs/findings/reflectance.md)."""

SHELTERED = 0.05
"""Of the hemisphere that is another part, weighted by cosines, from which on its light counts: six of RAYS, which tell it to a half. What
arrives is less than a twentieth of what shines on the open then."""

PATCHES_AT_ONCE = 4096
"""Whose rays are traced together: half a million."""

NEIGHBOURS = 4
"""Patches that a point interpolates."""


@dataclass(frozen=True, eq=False)
class Gather:
    """The mesh's ray caster; n patches with a vertex each: its index and normal (n, 3); S (n, n); the tree of their places;
    spread (n,) variance of its vertices' normals about its own, along a tangent.

    Of the rays that meet another part: row (rays,) patch that they start from, in order, start (n + 1,) where a patch's begin; column
    (rays,) patch that they meet; along (rays, 3) unit. sending: patches that are met, the only ones whose own light is asked for; shadow:
    of lights that were asked for, by their direction, which of these are in cast shadow, in bits: a round asks again and again.
    """

    caster: RayCaster
    vertex: Int
    normal: Float
    S: sp.csr_matrix
    tree: cKDTree
    spread: Float
    row: Int
    start: Int
    column: Int
    along: NDArray[np.float32]
    sending: Int
    shadow: dict[bytes, NDArray[np.uint8]] = field(default_factory=dict)


def gather(surface: Surface, size: float, sheltered: float) -> Gather:
    """Patches of about `size`, or of `sheltered` where SHELTERED of what arrives comes from other parts, and S between them. A patch is the
    vertices in a cube whose normals lie in one octant, so that thin parts keep two sides."""
    caster, normals = ray_caster(surface), vertex_normals(surface)
    vertex, patch = _cut(surface, normals, np.full(len(normals), size))
    rows, faces, along = _met(caster, vertex)
    if sheltered < size:
        met = np.bincount(rows, minlength=len(vertex)) / RAYS
        smaller, patch = _cut(surface, normals, np.where(met[patch] < SHELTERED, size, sheltered))
        rows, faces, along = _met_again(caster, smaller, vertex, (rows, faces, along))
        vertex = smaller
    normal, columns = normals[vertex], patch[surface.faces[faces, 0]]
    S = sp.csr_matrix((np.full(len(rows), 1 / RAYS, np.float32), (rows, columns)), (len(vertex), len(vertex)))
    spread = np.bincount(patch, ((normals - normal[patch]) ** 2).sum(1) / 2) / np.bincount(patch)
    start = np.searchsorted(rows, np.arange(len(vertex) + 1))
    tree, sending = cKDTree(surface.vertices[vertex]), np.unique(columns)
    return Gather(caster, vertex, normal, S, tree, spread, rows, start, columns, along, sending)


def _cut(surface: Surface, normals: Float, size: Float) -> tuple[Int, Int]:
    """A vertex of each patch, and (V,) the patches of all vertices, in cubes of their sizes (V,)."""
    cube = np.floor((surface.vertices - surface.vertices.min(0)) / size[:, None]).astype(np.int64)
    small, octant = (size < size.max()).astype(np.int64), (normals > 0) @ (4, 2, 1)
    key = np.ravel_multi_index((*cube.T, octant, small), (*cube.max(0) + 1, 8, 2))
    _, vertex, patch = np.unique(key, return_index=True, return_inverse=True)
    return vertex, patch


def _met(caster: RayCaster, vertex: Int) -> tuple[Int, Int, NDArray[np.float32]]:
    """Of the rays of patches about vertices (n,) that meet another part: the patch that they start from, in order, the face that they meet,
    and their direction (rays, 3)."""
    normal, facing = caster.vertex_normals[vertex], face_normals(caster.surface)
    starts = caster.surface.vertices[vertex] + LIFT_EDGES * mean_edge_length(caster.surface) * normal

    def met(first: int) -> tuple[Int, Int, NDArray[np.float32]]:
        some = slice(first, first + PATCHES_AT_ONCE)
        directions = _around(normal[some], _cosine_directions(RAYS))
        hits = caster.first_hits(np.repeat(starts[some], RAYS, axis=0), directions)
        # A ray that meets the back of a face started below a facet.
        seen = np.flatnonzero(hits.face >= 0)
        seen = seen[(facing[hits.face[seen]] * directions[seen]).sum(1) < 0]
        return first + seen // RAYS, hits.face[seen], directions[seen].astype(np.float32)

    rows, faces, along = (np.concatenate(parts) for parts in zip(*map(met, range(0, max(len(vertex), 1), PATCHES_AT_ONCE)), strict=True))
    return rows, faces, along


def _met_again(
    caster: RayCaster, vertex: Int, before: Int, met: tuple[Int, Int, NDArray[np.float32]]
) -> tuple[Int, Int, NDArray[np.float32]]:
    """`_met` of vertices (n,), some of which are among others (m,) whose rays met what `met` says."""
    place = np.full(len(caster.surface.vertices), -1)
    place[vertex] = np.arange(len(vertex))
    kept = np.flatnonzero(place[before][met[0]] >= 0)
    known, new = [of[kept] for of in met], np.flatnonzero(~np.isin(vertex, before))
    known[0] = place[before][known[0]]
    started, *others = _met(caster, vertex[new])
    rows, faces, along = (np.concatenate(both) for both in zip(known, (new[started], *others), strict=True))
    order = np.argsort(rows, kind="stable")
    return rows[order], faces[order], along[order]


@dataclass(frozen=True, eq=False)
class Sources:
    """Patches that send light, and their albedo (n,) or (n, channels)."""

    of: Gather
    albedo: Float


def sources_on(of: Gather, surface: Surface, albedo: Float) -> Sources:
    """The sources of a surface whose vertices have `albedo` (V,) or (V, channels), on patches of it or of one that is about the same."""
    weight = on_vertices(of, surface).T.tocsr()
    total = np.asarray(weight.sum(1))[:, 0]
    near = total > 1e-6
    # A patch to which no vertex is near has no albedo of its own.
    mean = np.broadcast_to(np.median(albedo, axis=0), (len(total), *albedo.shape[1:])).copy()
    mean[near] = ((weight @ albedo)[near].T / total[near]).T
    return Sources(of, mean)


def _cosine_directions(count: int) -> Float:
    """(count, 3) directions with density cos / pi about z (Fibonacci's spiral on the disk, lifted: Malley's method)."""
    k = np.arange(count) + 0.5
    radius, turn = np.sqrt(k / count), np.pi * (1 + np.sqrt(5)) * k
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - radius**2)], 1)


def _around(normal: Float, directions: Float) -> Float:
    """(n * count, 3) directions (count, 3) about each of the normals (n, 3)."""
    helper = np.where(np.abs(normal[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frame = np.stack([first, np.cross(normal, first), normal], 1)
    turned: Float = (directions @ frame).reshape(-1, 3)
    return turned


def lit_by(of: Gather, direction: Float) -> NDArray[np.float32]:
    """(n, lights) max(n.l, 0) * shadow of the patches that send, 0 of others."""
    lit = np.zeros((len(of.normal), len(direction)), np.float32)
    lit[of.sending] = np.maximum(of.normal @ direction.T, 0)[of.sending] * ~_shadows(of, direction)
    return lit


def _shadows(of: Gather, direction: Float) -> Bool:
    """(sending, lights) whether another part hides the lights from the patches that send."""
    lights = [one.tobytes() for one in direction]
    new = [k for k, light in enumerate(lights) if light not in of.shadow]
    if new:
        traced = np.packbits(cast_shadow(of.caster, of.vertex[of.sending], direction[new]), axis=0)
        of.shadow.update((lights[k], traced[:, column]) for column, k in enumerate(new))
    bits = np.empty((-(-len(of.sending) // 8), len(lights)), np.uint8)
    for column, light in enumerate(lights):
        bits[:, column] = of.shadow[light]
    return np.unpackbits(bits, axis=0, count=len(of.sending)).view(bool)


def series(S: sp.csr_matrix, direct: NDArray[np.float32], again: NDArray[np.float32], bounces: int) -> NDArray[np.float32]:
    """(n, lights) S (direct + again S (direct + ...)) after so many bounces, for direct (n, lights) and again (n, 1)."""
    G: NDArray[np.float32] = S @ direct
    for _ in range(bounces - 1):
        G = S @ (direct + again * G)
    return G


def lit_by_points(of: Gather, position: Float) -> tuple[Float, NDArray[np.float32]]:
    """Direction (n, points, 3), unit, from the patches to points of light, position (points, 3), and (n, points) max(n.l, 0) * shadow over
    the squared distance."""
    places = of.caster.surface.vertices[of.vertex]
    apart = position - places[:, None]
    distance = np.linalg.norm(apart, axis=-1)
    direction = apart / distance[..., None]
    facing = (of.normal[:, None] * direction).sum(-1)
    for k, towards in enumerate(direction.swapaxes(0, 1)):
        above = np.flatnonzero(facing[:, k] > 0)
        hits = of.caster.first_hits(places[above] + of.caster.offset * of.normal[above], towards[above])
        facing[above[hits.distance < distance[above, k]], k] = 0
    lit: NDArray[np.float32] = (np.maximum(facing, 0) / distance**2).astype(np.float32)
    return direction, lit


def gathered(sources: Sources, lit: NDArray[np.float32], bounce: float) -> NDArray[np.float32]:
    """G (n, lights) or (n, lights, channels) on the patches, lit (n, lights) as `lit_by` says."""

    def of_channel(albedo: Float) -> NDArray[np.float32]:
        direct = lit * albedo.astype(np.float32)[:, None]
        return series(sources.of.S, direct, (bounce * albedo[:, None]).astype(np.float32), BOUNCES)

    if sources.albedo.ndim == 1:
        return of_channel(sources.albedo)
    return np.stack([of_channel(channel) for channel in sources.albedo.T], -1)


def interpolation(of: Gather, points: Float, normal: Float) -> sp.csr_matrix:
    """(points, n) weights of the patches at points with normals (points, 3): inverse squared distance, facing the same way."""
    # A small mesh has fewer patches.
    near_by = min(NEIGHBOURS, len(of.normal))
    distance, index = (found.reshape(len(points), near_by) for found in neighbours(of.tree, points, near_by))
    near = 1e-3 * float(np.median(distance)) + 1e-300
    # Axis by axis: numpy's loops are slow along an axis of three.
    facing = sum(normal[:, k, None] * np.take(of.normal[:, k], index) for k in range(3))
    weight = np.maximum(facing, 0.05) / np.maximum(distance, near) ** 2
    weight /= weight.sum(1, keepdims=True)
    ends = np.arange(0, index.size + 1, near_by)
    return sp.csr_matrix((weight.astype(np.float32).ravel(), index.ravel(), ends), (len(points), len(of.normal))).sorted_indices()


@once_for
def on_vertices(of: Gather, surface: Surface) -> sp.csr_matrix:
    """The same at the vertices of a surface."""
    return interpolation(of, surface.vertices, vertex_normals(surface))
