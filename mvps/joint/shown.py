"""The normals that a result is shaded with.

A vertex's normal n comes from all lights at the vertex, the surface's normal m there from what the pixels around it show and views agree
on. They err about as much, m less, and not alike, so that their mean errs less than either:

    (n' + SURFACE_SHARE m) / (1 + SURFACE_SHARE),       normalised,

n' being n without the blur of the pixels that its samples were interpolated from (sharpened.py); m is a fusion of such normals already.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvps.camera import view_directions
from mvps.joint.reflectance import Observed
from mvps.joint.sharpened import PIXEL_BLUR, pixel_area, sharpened
from mvps.mesh import averaged, edges, neighbour_sums, normalise, vertex_normals
from mvps.scene import Float, Material, Surface

SURFACE_SHARE = 2.0
"""Of the surface's normal over the vertex's own: on seven results 3 was as good, on eighteen 1 was worse (docs/findings/edges.md)."""

OWN_SHARE = 1 / (1 + SURFACE_SHARE)
"""Of a vertex's own normal in what is shaded."""


def own_normals(normal: Float, noise: Float, of: Observed) -> Float:
    """The vertices' normals (V, 3), unit, without the blur of the pixels in which views see them; noise (V,): their variance along a
    tangent, radians^2, NaN where no view does, and where they stay."""
    surface, facing = of.surface, vertex_normals(of.surface)
    blur, total = np.zeros((2, len(normal)))
    for view, samples in zip(of.capture.views, of.views, strict=True):
        index, weight = samples.vertex.cpu().numpy(), samples.weight.double().cpu().numpy()
        points = surface.vertices[index]
        cosine = (facing[index] * view_directions(view.camera, points)).sum(1)
        blur += np.bincount(index, weight * pixel_area(view.camera, points, cosine), len(normal))
        total += np.bincount(index, weight, len(normal))
    ends = edges(surface)
    count, known = np.maximum(np.bincount(ends.ravel(), minlength=len(normal)), 1), np.isfinite(noise)

    def over_some(values: Float) -> Float:
        return averaged(np.where(known, values, 0)[:, None], known, ends)[:, 0]

    # A mean over neighbours has noise of its own.
    error = over_some(noise * (1 + 1 / count))
    blur = np.where(known, PIXEL_BLUR * blur / np.maximum(total, np.finfo(float).tiny), 0)
    place = surface.vertices - surface.vertices.mean(0)
    return sharpened(normal, place, blur, error, lambda values: neighbour_sums(values, ends) / count[:, None], over_some)


def shaded_as(material: Material, surface: Surface) -> Material:
    """The material with normals between its own and those of its surface."""
    return replace(material, normal=normalise(material.normal + SURFACE_SHARE * vertex_normals(surface)))
