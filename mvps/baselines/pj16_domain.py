"""PJ16's parameter domain: a mesh flattened into charts, and the photographs of all views and lights warped into it.

A texel t of the atlas (mvps/atlas.py) is a point x_t of the mesh with the mesh's normal there. A view's photographs come to it by one
sparse matrix, the same for all its lights:

    M_tl = sum_p share_tp I_pl,      p the four pixels around the projection of x_t

A view sees a texel where the rays through these pixels first meet the mesh at the texel, not on another part of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mvps.atlas import Atlas, Texels, build_atlas, padded, rasterise
from mvps.camera import bilinear, footprint, inside_image, project, view_directions
from mvps.cores import on_cores
from mvps.mesh import lengths, normalise, vertex_normals
from mvps.pixel_samples import colour_ratios
from mvps.scene import Capture, Float, Int, Surface, View
from mvps.silhouette import sampled
from mvps.texture import away_from_border
from mvps.visibility import RayCaster, camera_hits, interpolate, ray_caster

STEEPEST_VIEW = 0.2
"""Smallest cosine between the mesh's normal and a view's direction: beyond, one pixel spreads over more than five texels."""

SEEN = 0.75
"""Share of the four pixels' weights that must lie on the texel's part of the mesh."""

BLOCK = 32
"""Side of the squares of the atlas in whose order texels stand: neighbours are seen by the same views."""


@dataclass(frozen=True, eq=False)
class Domain:
    """A mesh with its atlas. texels: the n texels that the faces cover; position, normal (n, 3) of the mesh there, world frame."""

    surface: Surface
    atlas: Atlas
    texels: Texels
    position: Float
    normal: Float

    def picture(self, values: Float) -> NDArray[np.float32]:
        """Values (n, channels) of the texels as a picture (height, width, channels), continued over the charts' borders."""
        image = np.zeros((self.atlas.height, self.atlas.width, values.shape[1]), np.float32)
        filled = np.zeros(image.shape[:2], bool)
        image[self.texels.row, self.texels.column] = values
        filled[self.texels.row, self.texels.column] = True
        return padded(image, filled)

    def sampled_at(self, picture: NDArray[np.float32], uv: Float) -> Float:
        """(m, channels) values of a picture at texture coordinates (m, 2)."""
        return sampled(picture, uv * (self.atlas.width, self.atlas.height)).astype(np.float64)


def flattened(surface: Surface, texel: float) -> Domain:
    """The domain of a surface, with texels of side `texel`, world units."""
    atlas = build_atlas(surface, texel)
    found = rasterise(atlas.uv, atlas.faces, atlas.height, atlas.width)
    order = np.lexsort((found.column // BLOCK, found.row // BLOCK))
    texels = Texels(found.row[order], found.column[order], found.face[order], found.barycentric[order])
    corners = surface.faces[texels.face]
    both = (surface.vertices, vertex_normals(surface))
    position, outward = (np.einsum("nk,nkc->nc", texels.barycentric, values[corners]) for values in both)
    return Domain(surface, atlas, texels, position, normalise(outward))


class Warped(NamedTuple):
    """A capture's photographs in a domain. Per view: matrix (texels, pixels), whose rows sum to 1 where the view sees the texel and are
    empty elsewhere; facing (texels,), the cosine between normal and view there; ratio (lights, 3), the lights' colours."""

    capture: Capture
    matrix: list[sp.csr_matrix]
    facing: list[NDArray[np.float32]]
    ratio: list[Float]

    def samples(self, view: int, texels: Int | slice) -> NDArray[np.float32]:
        """(n, lights, 3) radiance of a view at some texels, the lights' colours taken out; NaN where a pixel is clipped."""
        rows = self.matrix[view][texels]
        photographed = self.capture.views[view]
        used, local = np.unique(rows.indices, return_inverse=True)
        image = photographed.samples[used] * (photographed.scale / self.ratio[view]).astype(np.float32)
        image[~photographed.usable()[used]] = np.nan
        share = sp.csr_matrix((rows.data, local, rows.indptr), (rows.shape[0], len(used)))
        warped: NDArray[np.float32] = (share @ image.reshape(len(used), -1)).reshape(-1, *image.shape[1:])
        return warped


def warped(domain: Domain, capture: Capture) -> Warped:
    """The photographs of a capture in a domain."""
    caster = ray_caster(domain.surface)
    pairs = on_cores(lambda view: _warp(domain, caster, view), capture.views)
    return Warped(capture, [m for m, _ in pairs], [f for _, f in pairs], on_cores(colour_ratios, capture.views))


def _warp(domain: Domain, caster: RayCaster, view: View) -> tuple[sp.csr_matrix, NDArray[np.float32]]:
    hits = camera_hits(caster, view.camera, view.pixels)
    met = interpolate(caster.surface, hits, caster.surface.vertices)
    reliable = (hits.face >= 0) & away_from_border(view)
    cosine = np.einsum("ni,ni->n", domain.normal, view_directions(view.camera, domain.position))
    chosen = np.flatnonzero(cosine > STEEPEST_VIEW)
    image, depth = project(view.camera, domain.position[chosen])
    inside = (depth > 0) & inside_image(view.camera, image)
    chosen, image = chosen[inside], image[inside]
    where, share = bilinear(view.pixel_index, image)
    # The four pixels around the point hit the surface within a diagonal of it, stretched by the slope.
    reach = np.sqrt(2) * footprint(view.camera, domain.position[chosen]) / cosine[chosen]
    share = share * (reliable[where] & (lengths(met[where] - domain.position[chosen, None]) < reach[:, None]))
    total = share.sum(1)
    sees = total > SEEN
    chosen, where, share = chosen[sees], where[sees], share[sees] / total[sees, None]
    shape = (len(domain.position), len(view.pixels))
    matrix = sp.csr_matrix((share.ravel(), (np.repeat(chosen, 4), where.ravel())), shape, dtype=np.float32)
    # A clipped pixel without a share would still spoil the sum.
    matrix.eliminate_zeros()
    facing = np.zeros(len(domain.position), np.float32)
    facing[chosen] = cosine[chosen]
    return matrix, facing
