"""How far off the normals that a result is shaded with may be: the error that is stated with them.

What samples say. Noise is independent from sample to sample. What the model does not know (other lobes, inter-reflection, a position that
is off) is shared by the samples of one view, or by those under one light. With H a vertex's normal equations, s its residuals' scale and
g_c the part of the gradient that comes from view or light c, the errors of the unknowns have the covariance

    C = H^-1 (sum_views g_c g_c^T + sum_lights g_c g_c^T) H^-1,   at least   N = s^2 H^-1

(sandwich estimator for clustered samples, Liang and Zeger 1986; clusters of two kinds, Cameron et al. 2011). Lights nearest to the same of
twelve directions, an icosahedron's corners, count as one: a turntable's rig is elsewhere in every view. The photographs' own noise has the
share q of N, its variance (noise.py) over the residuals'. C has it too, though no samples share it, and of a vertex's normal only as much
is in what is shaded as that normal is, p (shown.py): surfaces are means over many faces. Of each tangential component

    v = max(C - q N, (1 - q) N) + p^2 q N

What the surface says. No surface has the normals n of all vertices: fused positions keep only what is integrable of them. So how far n,
without pixels' blur, is from the normal m of the surface is one more sign of error, a = |n - m|^2 / 2. Together, with means < > over
neighbours, because few clusters tell a variance badly, and of precisions, because a vertex whose samples say little has its normal from
those beside it,

    sigma^2 = 1 / (<1 / v> + 1 / t^2) + <a>

Where samples say nothing n is the surface's, and a says nothing either. There t stands in: the tie T of n to the surface, but no more than
DEVIATIONS of the median sigma that comes out with it.

The surface of a single view is the integral of these normals and no mean over others: there p = 1, variances are averaged, and t = T.

No constant is fitted to true normals; the form was chosen with true normals in view (docs/findings/normals.md).
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
from mvps.joint.state import relative_residuals
from mvps.joint.steps import confidence_of
from mvps.mesh import averaged, edges, normalise, vertex_normals
from mvps.scene import Float, Law, Surface
from solvers.least_squares import columns_of_inverse

DEVIATIONS = 3.0
"""Standard deviations beyond which an error is none of the same kind."""

LEAST_VARIANCE, MOST_VARIANCE = 1e-12, 1.0
"""Of a normal, radians^2: a camera sees no two normals that are further apart than a radian or so."""


class Scatter(NamedTuple):
    """What samples alone say of the vertices' normals, variances along a tangent (V,), radians^2, NaN without samples: shared, of what
    samples share or photographs' noise does not explain; noise, of all that scatters; photographs, of the part of it that is theirs."""

    shared: Float
    noise: Float
    photographs: Float


def icosahedron() -> Float:
    """(12, 3) unit vectors to its corners."""
    golden = (1 + 5**0.5) / 2
    corners = np.array([np.roll((0.0, s, t), k) for s in (1, -1) for t in (golden, -golden) for k in range(3)])
    return normalise(corners)


def scatter(of: Observed, noise: float) -> Scatter:
    """What the samples say. noise: their standard deviation as a share of the signal (noise.py)."""
    hands = min(WORKERS, len(of.views))
    parts = on_cores(lambda k: _sums(of.views[k::hands], of.vertices, of.lights[k::hands], of.law), range(hands))
    hessian, meat, of_kinds, squares, count = (sum(of_hands[1:], of_hands[0]) for of_hands in zip(*parts, strict=True))
    scale = squares / count.clamp_min(torch.finfo(squares.dtype).tiny)
    meat = meat + of_kinds.transpose(1, 2) @ of_kinds
    bread = columns_of_inverse(hessian, 2)
    alone = scale * (bread[:, 0, 0] + bread[:, 1, 1]) / 2
    clustered = (bread * (meat @ bread)).sum((1, 2)) / 2
    relative = relative_residuals(of.views, of.vertices).clamp_min(torch.finfo(squares.dtype).tiny)
    share = (noise / relative).square().clamp_max(1)
    known = (count > 0) & (torch.maximum(clustered, alone) > 0)
    values = torch.maximum(clustered - share * alone, (1 - share) * alone), alone, share * alone
    return Scatter(*(torch.where(known, v, torch.nan).double().cpu().numpy() for v in values))


def stated_errors(told: Scatter, normal: Float, surface: Surface, share: float, tie: float, one_view: bool = False) -> Float:
    """(V,) confidence (scene.py) in the normals that a result is shaded with, 0 without samples.

    normal (V, 3), unit, without pixels' blur: the vertices' own, of which `share` is in what is shaded; tie: T, radians. one_view: the
    surface is one view's.
    """
    seen, ends = np.isfinite(told.noise), edges(surface)
    if not seen.any():
        return np.zeros(len(seen))
    share, power, most = (1.0, 1, np.inf) if one_view else (share, -1, DEVIATIONS)
    variance = np.where(seen, told.shared + share**2 * told.photographs, MOST_VARIANCE).clip(LEAST_VARIANCE, MOST_VARIANCE)
    apart = ((normal - vertex_normals(surface)) ** 2).sum(1) / 2
    mean, around = averaged(np.column_stack([variance**power, apart]), seen, ends).T
    precision = mean.clip(LEAST_VARIANCE) ** -power

    def error(otherwise: float) -> Float:
        return np.where(seen, np.sqrt(1 / (precision + 1 / otherwise**2) + around), np.inf)

    otherwise = min(tie, most * float(np.median(error(tie)[seen])))
    return confidence_of(torch.from_numpy(error(otherwise))).numpy()


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
