"""Steps of the vertices' block for fixed lights.

Priors are ties to a known state: of the normal to the mesh's normal, |t . (n - n_0)|^2 / sigma^2, and of the reflectance to a given one,
|(x - x_0) / sigma_x|^2. What the model cannot explain (inter-reflection, other lobes) is shared by all samples of a vertex, so together
they weigh as one: a tie counts as often as the vertex has samples, in units of its residual variance.

The same step serves pixels of one view in the place of vertices (pixels.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mvps.joint.blocks import DirectionalLights, NormalEquations, Vertices, tangents, vertex_equations
from mvps.joint.observe import ViewSamples
from mvps.joint.patches import Patches, held
from mvps.scene import RELIABLE, Law
from mvps.shading import most_albedo
from solvers.least_squares import bounded_step, columns_of_inverse

LARGEST_TURN = 0.3
"""Radians that a normal or light may turn in one step: the linearisation of n . l and of a lobe's flank ends there."""

CORRELATED = 6.0
"""Samples that share one error of the model: measured errors of normals are 2 to 3 times what independent samples would give."""

LEAST_SCALE = 0.1
"""Smallest scale of a vertex's residuals over the median one: a vertex with few samples may fit them exactly by chance."""


SCALE_FLOOR = 1e-10
"""The same in any case: of a photograph's full scale less than a step of 32 bits, and one over its square is still a float32."""

LEAST_NOISE = 1e-3
"""The same over the median albedo: no sensor is better than 10 bits. Where every vertex has too few samples, all fit exactly."""


@dataclass(frozen=True)
class Anchor:
    """What the vertices are tied to: normal (V, 3) and its standard deviation in radians; reflectance (V, 1 + lobes) and its
    standard deviation (V, 1 + lobes), infinite where free."""

    normal: Tensor
    sigma: float
    reflectance: Tensor
    reflectance_sigma: Tensor


def free_reflectance(normal: Tensor, sigma: float, unknowns: int) -> Anchor:
    """A tie of the normals alone."""
    nothing = normal.new_zeros(len(normal), unknowns)
    return Anchor(normal, sigma, nothing, nothing + torch.inf)


def with_population(vertices: Vertices, anchor: Anchor) -> Anchor:
    """The anchor with every lobe's weight tied to the object's: mean and standard deviation over the vertices, each by what its samples say
    of that lobe (empirical Bayes). A lobe that no light has excited at a vertex would otherwise be free, and blaze under another light."""
    assert vertices.said is not None
    said = vertices.said.double()
    share = said / said.sum(0).clamp_min(1e-300)
    mean = (share * vertices.reflectance).sum(0)
    sigma = (share * (vertices.reflectance - mean) ** 2).sum(0).sqrt()
    # An object without this lobe shows no spread either; rounding must not turn that into certainty.
    sigma = sigma.clamp_min(1e-3 * float(mean.sum()))
    # Where nothing reflects anything there is nothing to be tied to.
    sigma = torch.where(sigma > SCALE_FLOOR, sigma, torch.inf)
    sigma[0] = torch.inf
    like = vertices.reflectance
    return replace(anchor, reflectance=mean.to(like).expand_as(like), reflectance_sigma=sigma.to(like).expand_as(like))


def lambert_albedo(views: list[ViewSamples], normal: Tensor, lights: list[DirectionalLights]) -> Tensor:
    """(V,) least-squares albedo of Lambert's law for normals (V, 3); 0 without samples."""
    top, bottom = torch.zeros_like(normal[:, 0]), torch.zeros_like(normal[:, 0])
    for samples, of_view in zip(views, lights, strict=True):
        q = (normal[samples.vertex] @ of_view.direction.T).clamp_min(0) * of_view.intensity
        weight = samples.weight[:, None] * samples.data
        top.index_add_(0, samples.vertex, (weight * q * samples.image).sum(1))
        bottom.index_add_(0, samples.vertex, (weight * q * q).sum(1))
    return torch.where(bottom > 0, top / bottom.clamp_min(torch.finfo(top.dtype).tiny), 0.0)


def add_ties(equations: NormalEquations, vertices: Vertices, anchor: Anchor) -> None:
    """Adds the ties to the normal equations, in place."""
    unit = equations.count * vertices.scale**2
    away = vertices.normal - anchor.normal
    for k, tangent in enumerate(tangents(vertices.normal)):
        equations.hessian[:, k, k] += unit / anchor.sigma**2
        equations.gradient[:, k] += unit / anchor.sigma**2 * (away * tangent).sum(1)
    strength = unit[:, None] / anchor.reflectance_sigma**2
    torch.diagonal(equations.hessian, dim1=1, dim2=2)[:, 2:] += strength
    equations.gradient[:, 2:] += strength * (vertices.reflectance - anchor.reflectance)


def vertex_step(
    views: list[ViewSamples],
    vertices: Vertices,
    lights: list[DirectionalLights],
    law: Law,
    anchor: Anchor,
    stated: bool = True,
    patches: Patches | None = None,
) -> Vertices:
    """One Gauss-Newton step of every vertex for fixed lights; the scale of residuals is renewed. stated: and sigma, a fifth of the time;
    patches: keep their mean slope."""
    equations = vertex_equations(views, vertices, lights, law)
    scale = (equations.squares / equations.count.clamp_min(1e-6)).sqrt()
    vertices = replace(vertices, scale=scale.clamp_min(_least_scale(scale[equations.count > 0], vertices.reflectance[:, 0])))
    sigma, said = _sigma(equations, vertices) if stated else None, torch.diagonal(equations.hessian, dim1=1, dim2=2)[:, 2:].clone()
    add_ties(equations, vertices, anchor)
    lower = torch.cat([torch.full_like(vertices.normal[:, :2], -torch.inf), -vertices.reflectance], 1)
    step = bounded_step(equations.hessian, equations.gradient, lower)
    if patches is not None:
        step = held(step, equations.hessian, vertices, patches)
    turn = step[:, :2]
    turn = turn * (LARGEST_TURN / turn.norm(dim=1, keepdim=True).clamp_min(LARGEST_TURN))
    first, second = tangents(vertices.normal)
    normal = torch.nn.functional.normalize(vertices.normal + turn[:, :1] * first + turn[:, 1:] * second, dim=1)
    return Vertices(normal, (vertices.reflectance + step[:, 2:]).clamp_min(0), vertices.scale, sigma, said)


def possible(vertices: Vertices, law: Law) -> Vertices:
    """The vertices, after a step, with the median albedo where theirs is more than any surface's: light that the model does not know falls
    there, as on vertices that it takes to be all but dark. They would send as much to others."""
    assert vertices.said is not None
    albedo, told = vertices.reflectance[:, :1], vertices.said[:, 0] > 0
    beyond = albedo > most_albedo(vertices.reflectance[told], law)
    if not bool(beyond.any()):
        return vertices
    within = torch.where(beyond, albedo[told].median(), albedo)
    return replace(vertices, reflectance=torch.cat([within, vertices.reflectance[:, 1:]], 1))


def vertex_steps(
    views: list[ViewSamples], vertices: Vertices, lights: list[DirectionalLights], law: Law, anchor: Anchor, steps: int
) -> Vertices:
    """So many steps, to what is possible; sigma as of the last."""
    for k in range(steps):
        vertices = vertex_step(views, vertices, lights, law, anchor, stated=k == steps - 1)
    return possible(vertices, law)


def _least_scale(scale: Tensor, albedo: Tensor) -> float:
    """The smallest scale that is believed, for the scales of vertices with samples (n,) and albedo (V,)."""
    middle = float(scale.median()) if len(scale) else 0.0
    usual = float(albedo.median())
    if not usual and bool((albedo > 0).any()):
        # Most of the mesh is out of sight.
        usual = float(albedo[albedo > 0].median())
    return max(LEAST_SCALE * middle, LEAST_NOISE * usual, SCALE_FLOOR)


def _sigma(equations: NormalEquations, vertices: Vertices) -> Tensor:
    """(V,) standard deviation of the normals, radians, from the inverse of the normal equations without ties.

    Residuals are the model's error rather than noise, and samples under neighbouring lights share it: CORRELATED of them count as one.
    """
    inverse = columns_of_inverse(equations.hessian, 2)
    variance = (inverse[:, 0, 0] + inverse[:, 1, 1]) / 2 * vertices.scale**2 * CORRELATED
    return torch.where((equations.count > 0) & (variance > 0), variance.clamp_min(0).sqrt(), torch.inf)


def confidence(vertices: Vertices) -> Tensor:
    """(V,) confidence in the normals (scene.py); 0 without samples."""
    assert vertices.sigma is not None
    return confidence_of(vertices.sigma)


def confidence_of(sigma: Tensor) -> Tensor:
    """Confidence (scene.py) in normals with standard deviations in radians."""
    certain: Tensor = 1 / (1 + (sigma / RELIABLE) ** 2)
    return certain
