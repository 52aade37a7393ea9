"""A result's mesh finer than the one on whose vertices photometry was solved.

A vertex's reflectance costs a least-squares problem under all lights of all views that see it; the pixels' normals are there already. So
edges along which the surface turns by more than pixels err are split in the middle, and faces follow the pixels' normals once more
(vertices.py). Reflectance is interpolated, albedo' = P albedo with rows of 1 or of 1/2 and 1/2 in P (V', V). Positions are known of the
coarse vertices alone, since the middle of an edge lies beside the surface; there the normals count for every vertex (vertices.py), so that
the same weight against them takes

    sigma' = sigma sqrt(V / V')
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mvps.joint.agreement import Agreement
from mvps.joint.fused import NORMAL_SIGMA, face_targets
from mvps.joint.vertices import Moved, fuse
from mvps.mesh import edges, lengths, normalise, split_edges, unbiased, vertex_normals
from mvps.scene import Capture, Float, Int, Material, NormalMap, Surface

OPPOSITE = 1e-3
"""Length of the mean of two unit normals below which it says nothing."""


class Detailed(NamedTuple):
    """surface: the finer one; share (V', V): what its vertices take from those of the coarser one."""

    surface: Surface
    share: sp.csr_matrix


def detailed(capture: Capture, coarse: Moved, maps: tuple[NormalMap, ...], seen: list[Int], turn: float = NORMAL_SIGMA) -> Detailed:
    """The surface with its turning edges split and its faces turned to the maps' normals.

    seen: per view the coarse vertices that it sees; turn: of the surface along an edge, radians, from which it is split.
    """
    given, place, sigma = coarse
    normal, pairs = vertex_normals(given), edges(given)
    turning = lengths(np.subtract(*normal[pairs.T])) > turn
    surface, pairs = split_edges(given, turning), pairs[turning]
    share = sp.identity(len(place), format="csr")
    share = sp.vstack([share, (share[pairs[:, 0]] + share[pairs[:, 1]]) / 2], format="csr")
    views = np.zeros((len(place), len(seen)), bool)
    for i, index in enumerate(seen):
        views[index, i] = True
    outward = vertex_normals(surface)
    offset, spread = np.zeros(len(outward)), np.full(len(outward), np.inf)
    offset[: len(place)] = np.einsum("vc,vc->v", place - given.vertices, outward[: len(place)])
    # What no view sees has been closed over since masks spoke.
    spread[: len(place)] = np.where(views.any(1), sigma * np.sqrt(len(place) / len(outward)), np.inf)
    visible: list[Int] = [np.flatnonzero(of_view) for of_view in np.concatenate([views, views[pairs].all(1)]).T]
    target = face_targets(capture, surface, maps, visible, outward)
    return Detailed(unbiased(fuse(surface, target.normal, Agreement(offset, spread), target.sigma)[0]), share)


def directions(mean: Float, surface: Surface) -> Float:
    """Unit normals (V, 3) from means of unit normals (V, 3); where these were opposite there is no mean, and the surface's own stay."""
    told = lengths(mean) > OPPOSITE
    return np.where(told[:, None], normalise(mean), vertex_normals(surface))


def interpolated(material: Material, of: Detailed) -> Material:
    """The material on the finer surface's vertices."""
    share = of.share

    def at(values: NDArray[Any]) -> NDArray[Any]:
        mixed: NDArray[Any] = share @ values.reshape(len(values), math.prod(values.shape[1:]))
        return mixed.reshape(share.shape[0], *values.shape[1:]).astype(values.dtype)

    residual = material.residual
    return replace(
        material,
        normal=directions(at(material.normal), of.surface),
        albedo=at(material.albedo),
        specular_weight=at(material.specular_weight),
        confidence=at(material.confidence),
        residual=residual and replace(residual, share=at(residual.share), code=at(residual.code)),
    )
