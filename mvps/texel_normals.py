"""Normals of texels: what the pixels' normals tell beyond the vertices'.

A texel has the normal v that its vertices give, solved from all samples around, and the mean f of the normals of the pixels that show it,
one photometric stereo a view, which has finer detail and more noise. With weights w of n = (sum w)^2 / sum w^2 views, effectively, and R
= |sum w n| / sum w, the views scatter with the variance (1 - R) n / (n - 1) of either tangential component (Mardia and Jupp 2000), so
that f errs by s^2 = (1 - R) / (n - 1). That v and f differ by d^2 = |f - v|^2 / 2 comes of that, of v's error and of detail that v lacks:

    normal = v + (1 - s^2 / d^2) (f - v),        the part between 0 and 1

the best linear mean of two that err on their own (Wiener 1949). s^2 and d^2 are means over the vertices around: of a handful of views a
variance is known to a factor of two at best.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mvps.mesh import edges, lengths, neighbour_sums, normalise
from mvps.scene import Bool, Float, Int, Surface

LEAST_VIEWS = 1.5
"""Effective number of views from which they scatter."""


class Places(NamedTuple):
    """Of n points on a surface: its faces (n,), and barycentric coordinates (n, 3) in these."""

    face: Int
    barycentric: Float


class Shown(NamedTuple):
    """Of n points: sum of the views' normals times weights (n, 3), of the weights (n,), of their squares (n,)."""

    total: Float
    weight: Float
    square: Float


def texel_normals(surface: Surface, places: Places, own: Float, shown: Shown) -> Float:
    """(n, 3) unit normals of points whose vertices give them `own` (n, 3), unit."""
    length = lengths(shown.total)
    count = shown.weight**2 / np.maximum(shown.square, 1e-300)
    told = (count >= LEAST_VIEWS) & (length > 0)
    mean = np.where(told[:, None], shown.total / np.where(told, length, 1)[:, None], own)
    noise = (1 - length / np.where(told, shown.weight, 1)).clip(0) / np.maximum(count - 1, LEAST_VIEWS - 1)
    apart = ((mean - own) ** 2).sum(1) / 2
    noise, apart = around(surface, places, np.stack([noise, apart], 1), told).T
    part = (1 - noise / np.maximum(apart, 1e-12)).clip(0, 1) * told
    return normalise(own + part[:, None] * (mean - own))


def around(surface: Surface, places: Places, values: Float, known: Bool | Float) -> Float:
    """(n, k) values (n, k) of the points that are known, or weights of theirs (n,), in the mean over the vertices around; 0 where none
    are."""
    corners, count = np.take(surface.faces, places.face, axis=0), len(surface.vertices)
    weight = places.barycentric * known[:, None]
    sums = [np.bincount(corners.ravel(), (weight * of[:, None]).ravel(), count) for of in (*values.T, np.ones(len(values)))]
    own: Float = np.stack(sums, 1)
    near = own + neighbour_sums(own, edges(surface))
    mean = near[:, :-1] / np.maximum(near[:, -1:], 1e-300)
    found: Float = np.einsum("nk,nkc->nc", places.barycentric, np.take(mean, corners, axis=0))
    return found
