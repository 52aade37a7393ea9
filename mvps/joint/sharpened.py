"""Normals without the blur of the pixels that they come from: of faces (fused.py), of vertices (shown.py).

Blur. A pixel's normal is a mean over its area, of variance 1/12 along either axis, and between pixels normals are interpolated linearly,
which adds 1/6. On a surface seen at an angle a the footprint is longer by 1 / cos a along one of two directions, so that with p the
footprint of a pixel and w the weights of the views a normal is a mean over the variance

    b = (1/12 + 1/6) sum w p^2 (1 + 1 / cos^2 a) / 2 / sum w

Edges come out round. With S the mean over what lies around, whose kernel has the variance v, n - S n is -v/2 times n's Laplacian, and

    n + SHARPENING part (b / v) (n - S n),        part = 1 - e / D^2, at least 0

gives back what blur took where normals next to each other differ by more, |n - S n|^2 / 2 = D^2 in the mean over some twenty of them, than
their errors' variance e along a tangent makes them (Wiener 1949).

Edges within a pixel take a second pass. In it what lies beside an edge must not turn beyond it: the way from n to a sharper n' is taken
as far as the farthest of the normals next to n lies along it (`within`; Osher and Rudin 1990).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from mvps.camera import footprint
from mvps.mesh import normalise
from mvps.scene import Camera, Float

PIXEL_BLUR = 1 / 12 + 1 / 6
"""Variance along an axis of a pixel and of linear interpolation between pixels, pixels^2."""

SHARPENING = 2.0
"""Over the first order of undoing a pixel's blur: views lie on each other with errors of some tenths of a pixel, which blurs what they say
together once more. Chosen among 1, 2 and 3 (docs/findings/edges.md)."""

MOST_GAIN = 8.0
"""Of the difference: what faces of a third of a pixel take. A face with hardly any area around would take any."""

LEAST_TURN = 1e-4
"""Between neighbours, radians: less is no bend that could be blunted."""

LEAST_COSINE = 0.5
"""Of the angle at which a place is seen, in its blur: beyond 60 degrees a view has little weight, and is the best one only where too
little is known to sharpen."""


def pixel_area(camera: Camera, points: Float, cosine: Float) -> Float:
    """(n,) mean square of the sides of what a pixel covers at points (n, 3) of a surface seen under angles with cosines (n,), length^2."""
    area: Float = footprint(camera, points) ** 2 * (1 + 1 / np.maximum(cosine, LEAST_COSINE) ** 2) / 2
    return area


def sharpened(
    normal: Float, place: Float, blur: Float, error: Float, around: Callable[[Float], Float], over_some: Callable[[Float], Float]
) -> Float:
    """Normals (n, 3), unit, without their blur (n,), at place (n, 3) about the middle of all: squares of places far from it would swallow
    what neighbours lie apart.

    error (n,): their variance along a tangent, NaN where not known; around: S, of values (n, k); over_some: means over some twenty of n
    values, NaN where none is known.
    """
    near = around(np.column_stack([normal, place, (place**2).sum(1)]))
    spread = (near[:, 6] - 2 * (near[:, 3:6] * place).sum(1) + (place**2).sum(1)) / 2
    away = normal - near[:, :3]
    apart = over_some((away**2).sum(1) / 2)
    part = np.nan_to_num(1 - error / np.maximum(apart, LEAST_TURN**2)).clip(0)
    gain = SHARPENING * part * blur / np.maximum(spread, np.finfo(float).tiny)
    return normalise(normal + gain.clip(max=MOST_GAIN)[:, None] * away)


def within(normal: Float, sharper: Float, beside: sp.csr_matrix) -> Float:
    """Normals (n, 3), unit, turned to sharper ones (n, 3), no farther along the way than the farthest of those next to them. beside (n, n):
    not 0 for those next to each other, and for each itself."""
    way = sharper - normal
    own, along = np.repeat(np.arange(len(normal)), np.diff(beside.indptr)), np.zeros(beside.nnz)
    # One coordinate at a time: pairs are many.
    for k in range(3):
        along += normal[beside.indices, k] * way[own, k]
    farthest = np.maximum.reduceat(along, beside.indptr[:-1]) - (normal * way).sum(1)
    share = np.clip(farthest / np.maximum((way**2).sum(1), np.finfo(float).tiny), 0, 1)
    return normalise(normal + share[:, None] * way)
