"""Which of several lights make views say the same of the same places.

Lambert's law without shadow for vertex j of a rough surface in view i, under the view's lights s_il in the camera's frame:

    I_ijl = b_ij . s_il,    b_ij = a_j R_i n_j        albedo a_j and normal n_j (world) are the vertex's, R_i the view's rotation

Under candidates for s_i robust least squares give b_ij, and c_i R_i^T b_ij is the same in all views where these are right, with one scale
c_i a view, 1 of a rig. Lights that are off by a matrix A of the factorisation's ambiguity give R_i^T A R_i a_j n_j, which is not. So what
is asked is how far views are apart,

    median over j, i of  |c_i R_i^T b_ij - m_j| / |m_j| sqrt(k_j / (k_j - 1)),     m_j the mean over the k_j > 1 views of the vertex

It needs no normals of the rough surface, which in hollows are off by tens of degrees, and its positions only as exactly as albedo and
normals change along it. (Several views that fix the bas-relief ambiguity: Belhumeur, Kriegman and Yuille 1999.)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mvps.mesh import lengths
from mvps.scene import Camera, Float, Int
from mvps.sharing import VertexSamples
from solvers.low_rank import robust_weights, solve_rows

SWEEPS = 4

LEAST_KNOWN = 4
"""Samples of a vertex in a view that tell its three unknowns."""

CLEARLY_NEARER = 0.9
"""Part of how far views are apart under first lights, up to which others are believed in their place: of 0.95 to 1.05 either may be nearer
to the truth, by a degree or two (docs/findings/lights.md). Of one view's lights it is that view's part of it."""

BODY = 0.1
"""Of the photographs, that factors leave up to which they are believed until others are CLEARLY_NEARER. Where they leave more, much is not
diffuse, or in shadow, and nothing speaks for either but what views say: the nearer are believed. Matte objects leave 0.02 to 0.05, metals
0.13 and more, noise of some percent as much; of glossy ones between them either rule chooses as well (docs/findings/lights.md)."""

ROUNDS = 3


def said(of: VertexSamples, lights: Float, camera: Camera, noise: float) -> Float:
    """(n, 3) albedo times normal, world frame, of a view's vertices under lights (lights, 3), intensities times directions in the camera's
    frame; NaN where too few samples tell. noise: of a sample."""
    weight = of.known.astype(np.float64)
    for _ in range(SWEEPS):
        pseudo = solve_rows(of.image, weight, lights)
        weight = robust_weights(of.image - pseudo @ lights.T, of.known, noise)
    in_world: Float = pseudo @ camera.rotation
    return np.where(of.known.sum(1, keepdims=True) >= LEAST_KNOWN, in_world, np.nan)


def apart(of: Sequence[VertexSamples], by_view: Sequence[Float], one_rig: bool) -> float:
    """How far views are apart (module docstring) in what they say (n, 3) each of their vertices; infinite where no vertex is in two."""
    numbers, values = np.concatenate([view.vertex for view in of]), np.concatenate(by_view)
    known = np.isfinite(values).all(1)
    views = np.bincount(numbers[known], minlength=int(numbers.max(initial=0)) + 1)
    told = known & (views[numbers] > 1)
    if not told.any():
        return np.inf
    of_view = np.repeat(np.arange(len(of)), [len(view.vertex) for view in of])[told]
    vertex, values = numbers[told], values[told]
    mean = _mean(vertex, values, views)
    for _ in range(0 if one_rig else ROUNDS):
        ratio = _lengths(mean[vertex]) / _lengths(values)
        scale = np.array([np.median(ratio[of_view == i]) if (of_view == i).any() else 1.0 for i in range(len(of))])
        values = values * scale[of_view, None]
        mean = _mean(vertex, values, views)
    k = views[vertex]
    return float(np.median(_lengths(values - mean[vertex]) * np.sqrt(k / (k - 1)) / _lengths(mean[vertex])))


def _mean(vertex: Int, values: Float, views: Int) -> Float:
    """(V, 3) means of values (n, 3) over the views of each vertex."""
    total = np.stack([np.bincount(vertex, axis, len(views)) for axis in values.T], 1)
    mean: Float = total / np.maximum(views, 1)[:, None]
    return mean


def _lengths(vectors: Float) -> Float:
    """(n,) of vectors (n, 3), never zero."""
    length: Float = np.maximum(lengths(vectors), np.finfo(float).tiny)
    return length


def nearest(of: Sequence[VertexSamples], candidates: Sequence[Sequence[Float]], one_rig: bool) -> int:
    """Under which of several lights views are nearest to each other, by what is said (n, 3) under each; the last where nothing tells."""
    distance = [apart(of, by_view, one_rig) for by_view in candidates]
    return max(i for i, d in enumerate(distance) if d == min(distance))


def nearer(
    of: Sequence[VertexSamples], first: Sequence[Float], other: Sequence[Float], one_rig: bool, clearly: float = CLEARLY_NEARER
) -> list[bool]:
    """Of which views what is said under the other lights is believed, in place of the first: where views are nearer to each other, at most
    `clearly` times as far apart. Of a rig all or none; else one view after the other changes, from none and from all of them on."""
    count = len(of)

    def distance(chosen: Sequence[bool]) -> float:
        return apart(of, [b if is_other else a for a, b, is_other in zip(first, other, chosen, strict=True)], one_rig)

    none, every = [False] * count, [True] * count
    if one_rig:
        return every if distance(every) < clearly * distance(none) else none
    found, least = none, np.inf
    for chosen in (none, every):
        now, before = distance(chosen), np.inf
        for _ in range(ROUNDS):
            if not now < before:
                break
            before = now
            for i in range(count):
                changed = [is_other ^ (k == i) for k, is_other in enumerate(chosen)]
                then = distance(changed)
                if then < now * (1 - (1 - clearly) / count):
                    chosen, now = changed, then
        if now < clearly * least:
            found, least = chosen, now
    return found
