"""How far off a vertex's normal may be: the error that is stated with it.

Four things are wrong with a normal. Noise is independent from sample to sample. What the model does not know (other lobes,
inter-reflection, a position that is off) is shared by the samples of one view, or by those under one light. With H the vertex's normal
equations, s its residuals' scale and g_c the part of the gradient that comes from view or light c, the errors of the unknowns have the
covariance

    H^-1 (sum_views g_c g_c^T + sum_lights g_c g_c^T) H^-1,   at least   s^2 H^-1

(sandwich estimator for clustered samples, Liang and Zeger 1986; clusters of two kinds, Cameron et al. 2011, who take what noise alone does,
which both sums hold, off once: here it stays). Lights nearest to the same of twelve directions, an icosahedron's corners, count as one: a
turntable's rig is elsewhere in every view. Then, no surface has the
normals n of all vertices: fused positions keep only what is integrable of them, and of an error without any pattern half is. So how far n
is from the normal m of the surface is one more sign of error. Last, a surface goes on between its vertices. The mean M over neighbours
takes apart what normals show at the length of an edge, D = |n - M n|^2 / 2, and at twice that, C = |M n - M^4 n|^2 / 2, both beyond what
noise alone does. Below the edges there is as much less again, by D / C: by 1, which is most, where all scales are as rough, by 1/9 where
the surface is smooth. Of each tangential component

    sigma^2 = 1 / (1 / sigma_samples^2 + 1 / tie^2) + |n - m|^2 / 2 + D min(D / C, 1)

where the tie to the mesh stands in where samples say little. A vertex has few clusters, so its figures are averaged with its neighbours'.
No constant is fitted to true normals; that noise stays in both sums, and the last term's form, were chosen with true normals in view
(docs/findings/normals.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mvps.cores import on_cores
from mvps.joint.blocks import WORKERS, DirectionalLights, Vertices, batches, evaluate, robust, tangents, vertex_derivatives
from mvps.joint.observe import ViewSamples
from mvps.joint.reflectance import Observed
from mvps.joint.steps import confidence_of
from mvps.mesh import edges, normalise, vertex_normals
from mvps.scene import Float, Law
from solvers.least_squares import columns_of_inverse

ROUNDS = 2
"""Of averaging with neighbours, over some twenty vertices: a variance from a handful of clusters is known to a factor of two at best."""


def icosahedron() -> Float:
    """(12, 3) unit vectors to its corners."""
    golden = (1 + 5**0.5) / 2
    corners = np.array([np.roll((0.0, s, t), k) for s in (1, -1) for t in (golden, -golden) for k in range(3)])
    return normalise(corners)


class Stated(NamedTuple):
    """confidence (V,) in the vertices' normals as those of the surface (scene.py), 0 without samples; noise (V,) what noise of the samples
    alone makes of their variance along a tangent, radians^2, NaN without samples."""

    confidence: Float
    noise: Float


def stated_errors(of: Observed, tie: float, finer: bool = False) -> Stated:
    """How well the vertices' normals are known. tie: radians. finer: the result's mesh has what photographs show below these edges
    (detail.py), so that nothing is added for it."""
    hands = min(WORKERS, len(of.views))
    parts = on_cores(lambda k: _sums(of.views[k::hands], of.vertices, of.lights[k::hands], of.law), range(hands))
    hessian, meat, of_kinds, squares, count = (sum(of_hands[1:], of_hands[0]) for of_hands in zip(*parts, strict=True))
    scale = squares / count.clamp_min(torch.finfo(squares.dtype).tiny)
    meat = meat + of_kinds.transpose(1, 2) @ of_kinds
    bread = columns_of_inverse(hessian, 2)
    noise = scale * (bread[:, 0, 0] + bread[:, 1, 1]) / 2
    variance = torch.maximum((bread * (meat @ bread)).sum((1, 2)) / 2, noise)
    seen = (count > 0) & (variance > 0)
    # A camera sees no two normals that are further apart than a radian or so.
    variance = torch.where(seen, variance.clamp(1e-12, 1.0), 0.0)
    away = of.vertices.normal - torch.tensor(vertex_normals(of.surface)).to(of.vertices.normal)
    noise = torch.where(seen, noise, 0.0)
    ends = torch.from_numpy(edges(of.surface)).to(seen.device)
    terms = torch.stack([variance, away.square().sum(1) / 2, *_bands(of.vertices.normal, seen, noise, ends)], 1)
    variance, apart, edge, coarse = averaged(terms, seen, ends).unbind(1)
    edge = edge.clamp_min(0)
    detail = 0.0 if finer else edge * (edge / coarse.clamp_min(1e-12)).clamp_max(1)
    sigma = (1 / (1 / variance + 1 / tie**2) + apart + detail).sqrt()
    confidence, noise = torch.where(seen, confidence_of(sigma), 0.0), torch.where(seen, noise, torch.nan)
    return Stated(confidence.double().cpu().numpy(), noise.double().cpu().numpy())


def _bands(normal: Tensor, seen: Tensor, noise: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
    """(V,) each D and C without what noise with this variance (V,) along a tangent adds to them in the mean; ends (E, 2) of the edges."""
    near = [normal]
    for _ in range(4):
        total, count = _summed(near[-1], seen, ends)
        alone = (count == 0)[:, None]
        near.append(torch.where(alone, near[-1], total / count.clamp_min(1)[:, None]))
    share = 1 / count.clamp_min(1)
    at_edges, at_twice = ((a - b).square().sum(1) / 2 for a, b in ((near[0], near[1]), (near[1], near[4])))
    return at_edges - (1 + share) * noise, at_twice - share * noise


def _sums(views: list[ViewSamples], vertices: Vertices, lights: list[DirectionalLights], law: Law) -> tuple[Tensor, ...]:
    """H (V, p, p), sum over views of g g^T (V, p, p), g under each kind of light (V, 12, p), weighted squares and weights (V,)."""
    like, n, p = vertices.normal, len(vertices.normal), 2 + vertices.reflectance.shape[1]
    corners = torch.from_numpy(icosahedron()).to(like)
    hessian, meat, of_kinds = like.new_zeros(n, p, p), like.new_zeros(n, p, p), like.new_zeros(n, len(corners), p)
    squares, count = like.new_zeros(n), like.new_zeros(n)
    first, second = tangents(vertices.normal)
    for batch in batches(views, lights):
        index, towards = batch.vertex, batch.towards
        kind = torch.nn.functional.one_hot((batch.lights.direction @ corners.T).argmax(-1), len(corners)).to(like)
        shaded = evaluate(vertices.normal[index], vertices.reflectance[index], towards, batch.lights, law, batch.gathered)
        residual = shaded.predicted - batch.image
        weight = batch.weight * robust(residual, vertices.scale[index], shaded.unsure)
        rows = torch.stack(vertex_derivatives(shaded, (first[index], second[index]), towards, batch.lights), -2)
        by_kind = ((rows * (weight * residual)[..., None, :]) @ kind[:, None]).mT
        by_view = by_kind.sum(-2)
        batch.added(hessian, (rows * weight[..., None, :]) @ rows.mT)
        batch.added(meat, by_view[..., :, None] * by_view[..., None, :])
        batch.added(of_kinds, by_kind)
        batch.added(squares, (weight * residual**2).sum(-1))
        batch.added(count, weight.sum(-1))
    return hessian, meat, of_kinds, squares, count


def averaged(values: Tensor, known: Tensor, ends: Tensor) -> Tensor:
    """(V, k) values, where known, averaged with their neighbours'."""
    for _ in range(ROUNDS):
        total, count = _summed(values, known, ends)
        values = (total + values * known[:, None]) / (count + known.to(count))[:, None].clamp_min(1)
    return values


def _summed(values: Tensor, known: Tensor, ends: Tensor) -> tuple[Tensor, Tensor]:
    """(V, k) sums of the values (V, k) of a vertex's known neighbours, and (V,) how many these are."""
    own = torch.cat([values, torch.ones_like(values[:, :1])], 1) * known[:, None]
    around = torch.zeros_like(own)
    for here, there in ((0, 1), (1, 0)):
        around.index_add_(0, ends[:, here], own[ends[:, there]])
    return around[:, :-1], around[:, -1]
