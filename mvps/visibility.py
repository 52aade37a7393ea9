"""What sees what: first hits, cast shadows and visible vertices on a triangle mesh, by Embree.

A ray that leaves the mesh starts an `offset` h away from it along the surface normal: a triangle mesh stands for a smooth surface only up
to its own resolution, so nearer occluders are an artefact of the facets (shadow acne), not of the shape. Under a light at an elevation b
over the surface a shadow so begins h / tan b too late.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from mvps.camera import inside_image, pixel_centres, project, rays, view_directions
from mvps.cores import on_cores
from mvps.mesh import edges, mean_edge_length, vertex_normals
from mvps.once import computed_once, once_for
from mvps.scene import Bool, Camera, Float, Int, Surface, View

RAYS_PER_CALL = 1 << 18

OFFSET_EDGES = 0.2
"""Height at which rays leave the mesh, over the mean of its edges e. Facets stand off a sphere of radius R by e^2 / 8 R, which is less down
to R = 0.6 e. From a whole edge's height shadows would begin two edges late under a light at 27 degrees (docs/findings/shadows.md)."""


class Hits(NamedTuple):
    """First hits of n rays: face (n,) or -1; barycentric (n, 3) of the face's corners; distance (n,) along the ray, inf for a miss."""

    face: Int
    barycentric: Float
    distance: Float


class RayCaster:
    """A mesh that can be asked many times. Vertices are centred and scaled for Embree's single precision."""

    def __init__(self, surface: Surface) -> None:
        vertices = surface.vertices
        self._centre = (vertices.min(0) + vertices.max(0)) / 2
        self._scale = float(np.abs(vertices - self._centre).max()) or 1.0
        self._scene = EmbreeScene(robust=True)
        self._mesh = TriangleMesh(self._scene, self.local(vertices), surface.faces.astype(np.int32))
        # The first query builds the tree; later queries may then come from several threads.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), query="OCCLUDED")
        self.surface = surface

    @computed_once
    def vertex_normals(self) -> Float:
        """(V, 3) vertex normals of the mesh, computed when first asked for."""
        return vertex_normals(self.surface)

    @computed_once
    def offset(self) -> float:
        """Rays that leave the mesh start this far away."""
        return OFFSET_EDGES * mean_edge_length(self.surface)

    @computed_once
    def around(self) -> sp.csr_matrix:
        """(V, V) 1 where an edge joins two vertices, and for a vertex and itself."""
        n, pairs = len(self.surface.vertices), edges(self.surface)
        rows, columns = np.concatenate([pairs, pairs[:, ::-1], np.arange(n)[:, None].repeat(2, axis=1)]).T
        return sp.csr_matrix((np.ones(len(rows), np.float32), (rows, columns)), (n, n))

    def local(self, points: Float) -> NDArray[np.float32]:
        """(n, 3) points in the frame that Embree sees."""
        return np.ascontiguousarray((points - self._centre) / self._scale, dtype=np.float32)

    def first_hits(self, origins: Float, directions: Float) -> Hits:
        """First hits of rays from origins (n, 3) along unit directions (n, 3)."""
        chunks = _in_chunks(
            lambda s: self._scene.run(self.local(origins[s]), directions[s].astype(np.float32), query="INTERSECT", output=1),
            len(origins),
        )
        joined = {k: np.concatenate([c[k] for c in chunks]) if chunks else np.zeros(0) for k in ("primID", "u", "v", "tfar")}
        face = joined["primID"].astype(np.int64)
        u, v = joined["u"].astype(np.float64), joined["v"].astype(np.float64)
        miss = face < 0
        barycentric = np.stack([1 - u - v, u, v], -1)
        barycentric[miss] = 0
        return Hits(face, barycentric, np.where(miss, np.inf, joined["tfar"].astype(np.float64) * self._scale))

    def occluded(self, origins: Float, directions: Float) -> Bool:
        """(n,) True where a ray from origins (n, 3) along unit directions (n, 3) meets the mesh."""
        chunks = _in_chunks(lambda s: self.blocked(self.local(origins[s]), directions[s].astype(np.float32)), len(origins))
        return np.concatenate(chunks) if chunks else np.zeros(0, bool)

    def blocked(self, origins: NDArray[np.float32], directions: NDArray[np.float32]) -> Bool:
        """`occluded` of few rays, from `local` origins."""
        found: Bool = self._scene.run(origins, directions, query="OCCLUDED") >= 0
        return found


@lru_cache(maxsize=1)
def ray_caster(surface: Surface) -> RayCaster:
    """The caster of a surface; the one asked for last is kept, because one stage after the other asks for the same."""
    return RayCaster(surface)


def _in_chunks(query: Any, rays_total: int) -> list[Any]:
    """`query` of consecutive slices of the rays, on all cores (Embree releases the interpreter's lock)."""
    slices = [slice(i, i + RAYS_PER_CALL) for i in range(0, rays_total, RAYS_PER_CALL)]
    if len(slices) < 2:
        return [query(s) for s in slices]
    return on_cores(query, slices)


def camera_hits(caster: RayCaster, camera: Camera, pixels: Int) -> Hits:
    """First hits of the rays through the centres of pixels (n, 2), given as row and column."""
    return caster.first_hits(*rays(camera, pixel_centres(pixels)))


@once_for
def view_hits(caster: RayCaster, view: View) -> Hits:
    """`camera_hits` of a view's pixels."""
    return camera_hits(caster, view.camera, view.pixels)


def interpolate(surface: Surface, hits: Hits, values: Float) -> Float:
    """Values (V, ...) on the vertices, interpolated at hits (n, ...); a miss gives zeros."""
    return interpolate_all(surface, hits, values)[0]


def interpolate_all(surface: Surface, hits: Hits, *values: Float) -> list[Float]:
    """`interpolate` of several values, which share the weights."""
    # In 32 bits: of longer indices scipy asks whether these would do.
    corners = np.take(surface.faces, np.maximum(hits.face, 0), axis=0).astype(np.int32)
    ends = np.arange(0, corners.size + 1, 3, dtype=np.int32)
    weights = sp.csr_matrix((hits.barycentric.ravel(), corners.ravel(), ends), (len(corners), len(surface.vertices)))
    return [(weights @ of.reshape(len(of), -1)).reshape(len(corners), *of.shape[1:]) for of in values]


@once_for
def visible_vertices(caster: RayCaster, camera: Camera, margin: int = 0) -> Bool:
    """(V,) True where a vertex lies on the image, faces the camera and nothing hides it, nor a vertex that faces the camera within `margin`
    edges of it."""
    vertices, normal = caster.surface.vertices, caster.vertex_normals
    image, depth = project(camera, vertices)
    towards = view_directions(camera, vertices)
    candidates = (depth > 0) & (np.einsum("ni,ni->n", normal, towards) > 0)
    candidates &= inside_image(camera, image)
    chosen = np.flatnonzero(candidates)
    hidden = caster.occluded(vertices[chosen] + caster.offset * normal[chosen], towards[chosen])
    visible, behind = np.zeros((2, len(vertices)), bool)
    visible[chosen[~hidden]] = True
    behind[chosen[hidden]] = True
    for _ in range(margin):
        behind = caster.around @ behind.astype(np.float32) > 0
    return visible & ~behind


def cast_shadow(caster: RayCaster, vertices: Int, lights: Float) -> Bool:
    """(n, lights) True where another part of the mesh hides a light from a vertex.

    vertices (n,) indices; lights (lights, 3) unit, world, towards the light. Only lights above the horizon are traced: below it the
    shadow is attached, not cast.
    """
    return shadows(caster, caster.surface.vertices[vertices], caster.vertex_normals[vertices], lights)


def distances_to_shade(caster: RayCaster, vertices: Int, lights: Float) -> Float:
    """(n, lights) from vertices (n,), indices, towards lights (lights, 3) to the part of the mesh that hides them; inf where nothing does,
    and for lights below the horizon."""
    # Whether anything hides a light takes less to find than what is first, and few are hidden.
    hidden = cast_shadow(caster, vertices, lights)
    row, light = np.nonzero(hidden)
    at = vertices[row]
    distance = np.full(hidden.shape, np.inf)
    distance[row, light] = caster.first_hits(
        caster.surface.vertices[at] + caster.offset * caster.vertex_normals[at], lights[light]
    ).distance
    return distance


class Shade(NamedTuple):
    """Of n vertices and some lights, (n, lights) each: beside, whether a vertex or one near it is in cast shadow; deep, whether it is
    itself, and none near it is lit."""

    beside: Bool
    deep: Bool


def shade_of(caster: RayCaster, vertices: Int, lights: Float, margin: int) -> Shade:
    """Cast shadows of vertices (n,), indices, with what is within `margin` edges of them, one at least."""
    around = caster.around[vertices]
    for _ in range(margin - 1):
        around = around @ caster.around
    close = np.zeros(around.shape[1], bool)
    close[around.indices] = True
    near = np.flatnonzero(close)
    around, shadow = around[:, near], cast_shadow(caster, near, lights)
    own, facing = np.searchsorted(near, vertices), caster.vertex_normals[near] @ lights.T > 0
    beside, deep = np.zeros((2, len(vertices), len(lights)), bool)
    step = max(1, RAYS_PER_CALL // max(1, len(near)))
    for start in range(0, len(lights), step):
        part = slice(start, start + step)
        dark = shadow[:, part]
        beside[:, part] = around @ dark.astype(np.float32) > 0
        deep[:, part] = dark[own] & ~(around @ (facing[:, part] & ~dark).astype(np.float32) > 0)
    return Shade(beside, deep)


def shadows(caster: RayCaster, points: Float, normal: Float, lights: Float) -> Bool:
    """The same for points of the mesh (n, 3) with its unit normals there (n, 3); nothing hides a light from a point whose normal is 0."""
    shadow = np.zeros((len(points), len(lights)), bool)
    origins, directions = caster.local(points + caster.offset * normal), lights.astype(np.float32)
    # A ray takes some forty bytes on its way and one in the answer.
    step = max(1, RAYS_PER_CALL // max(1, len(lights)))
    for start in range(0, len(points), step):
        part = slice(start, start + step)
        above = np.flatnonzero(normal[part] @ lights.T > 0)
        if len(above):
            point, light = np.divmod(above, len(lights))
            hidden = caster.blocked(np.take(origins[part], point, axis=0), np.take(directions, light, axis=0))
            shadow[part].reshape(-1)[above] = hidden
    return shadow
