"""A result's mesh finer than the one on whose vertices photometry was solved.

A vertex's reflectance costs a least-squares problem under all lights of all views that see it; the pixels' normals are there already. So
edges along which the surface turns by more than pixels err are split in the middle, and faces follow the pixels' normals once more
(vertices.py). What is smoother than normals is interpolated, with rows of 1 or of 1/2 and 1/2 in P (V', V):

    t' = P t,  sigma' = P sigma      agreed positions; neighbours share their error, so that two know no better than one
    albedo' = P albedo, ...          reflectance
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mvps.joint.agreement import Agreement
from mvps.joint.fused import face_targets
from mvps.joint.vertices import Moved, fuse
from mvps.mesh import edges, lengths, normalise, split_edges, unbiased, vertex_normals
from mvps.scene import Capture, Int, Material, NormalMap, Surface


class Detailed(NamedTuple):
    """surface: the finer one; share (V', V): what its vertices take from those of the coarser one."""

    surface: Surface
    share: sp.csr_matrix


def detailed(capture: Capture, coarse: Moved, maps: tuple[NormalMap, ...], seen: list[Int], error: float) -> Detailed:
    """The surface with its turning edges split and its faces turned to the maps' normals.

    seen: per view the coarse vertices that it sees; error: of the maps' normals, radians.
    """
    given, place, sigma = coarse
    normal, pairs = vertex_normals(given), edges(given)
    turning = lengths(np.subtract(*normal[pairs.T])) > error
    surface, pairs = split_edges(given, turning), pairs[turning]
    share = sp.identity(len(sigma), format="csr")
    share = sp.vstack([share, (share[pairs[:, 0]] + share[pairs[:, 1]]) / 2], format="csr")
    place, sigma = (np.concatenate([values, values[pairs].mean(1)]) for values in (place, sigma))
    visible: list[Int] = []
    for index in seen:
        before = np.isin(np.arange(len(normal)), index)
        visible.append(np.flatnonzero(np.concatenate([before, before[pairs].all(1)])))
    outward = vertex_normals(surface)
    target = face_targets(capture, surface, maps, visible, outward)
    offset = np.einsum("vc,vc->v", place - surface.vertices, outward)
    return Detailed(unbiased(fuse(surface, target, Agreement(offset, sigma), error)[0]), share)


def interpolated(material: Material, share: sp.csr_matrix) -> Material:
    """The material on vertices that take `share` (V', V) of its own."""

    def at(values: NDArray[Any]) -> NDArray[Any]:
        mixed: NDArray[Any] = share @ values.reshape(len(values), math.prod(values.shape[1:]))
        return mixed.reshape(share.shape[0], *values.shape[1:]).astype(values.dtype)

    residual = material.residual
    return replace(
        material,
        normal=normalise(at(material.normal)),
        albedo=at(material.albedo),
        specular_weight=at(material.specular_weight),
        confidence=at(material.confidence),
        residual=residual and replace(residual, share=at(residual.share), code=at(residual.code)),
    )
