"""The photometric blocks of the joint problem: vertices (normal and reflectance) and lights.

For a vertex with normal n, grey albedo a and lobe weights w_k, seen along v under light m = e l (e intensity, l unit):

    c = |v + l| = sqrt(2 + 2 v.l),   h.n = (n.v + n.l) / c,   E_k = 4 / c^2 exp(s_k (h.n - 1)),   q = e max(n.l, 0)
    I = q R + e (a b G_0 + y (a G_1 + sum_k w_k G_2+k)),     R = a D_l D_v + sum_k w_k E_k,     B = sum_k s_k w_k E_k

with D_x = 1 + g (1 - n.x)^p (shading.py) and G the light that other surfaces send (bounce.py, and where lobes take part gleam.py)

    dI/dn = e [n.l > 0] R l + q a (D_l' D_v l + D_l D_v' v) + q B (l + v) / c
    dI/da = q D_l D_v + e (b G_0 + y G_1),   dI/dw_k = q E_k + y e G_2+k
    dI/dm = [n.l > 0] R n + max(n.l, 0) (1 - l l^T) (a D_l' D_v n + B (n / c - (h.n) v / c^2) - 2 sum_k w_k E_k v / c^2) + I_G / e l
            (the half vector moves with l; the last term in the bracket only below the gain's bound, shading.STEEPEST)
    dI/dg = q a ((1 - n.l)^p D_v + (1 - n.v)^p D_l),   dI/db = a e G_0,   dI/dy = e (a G_1 + sum_k w_k G_2+k)

Objective 1/2 sum w rho(I - image), rho Cauchy's with a scale s per vertex, the standard deviation of its weighted residuals. What lobes
send, u = e y (a G_1 + sum_k w_k G_2+k), hangs on shapes that are not yet right, their normals above all: it adds u^2 to a sample's
variance s^2 (LOBES_ERROR), so that samples of light that comes straight from the lamps say what normals are.
Every block is Gauss-Newton: normal equations are accumulated over batches of pairs, never a Jacobian as a whole, and add up over views.
Batches are single-threaded and views are dealt to threads: torch's own threads would meet at a barrier after every one of some thirty
small operations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from mvps.cores import on_cores
from mvps.joint.observe import ViewSamples
from mvps.scene import Law
from mvps.shading import GRAZING_POWER, STEEPEST, gain, half_length, lobe
from solvers.low_rank import CAUCHY_95

WORKERS = 2
"""Parts that the views are dealt into: fixed, because the order of a sum is part of its value. Two is what a laptop's cores keep busy."""

LOBES_ERROR = 1.0
"""Of light that lobes send, over that light: a wall whose normal is off by a lobe's width sends all of it elsewhere
(docs/findings/reflectance.md)."""


@dataclass
class Vertices:
    """What is known about the vertices: normal (V, 3); reflectance (V, 1 + lobes) grey albedo and weights; scale (V,) of residuals.

    As of the last step, None before the first: sigma (V,) standard deviation of the normal in radians, infinite without samples; said
    (V, 1 + lobes) how much the samples say of each reflectance, the diagonal of the normal equations.
    """

    normal: Tensor
    reflectance: Tensor
    scale: Tensor
    sigma: Tensor | None = None
    said: Tensor | None = None


@dataclass(frozen=True)
class NormalEquations:
    """Sums over samples: hessian (n, p, p), gradient (n, p), squares (n,) weighted squared residuals, count (n,) weights."""

    hessian: Tensor
    gradient: Tensor
    squares: Tensor
    count: Tensor


def tangents(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (n, 3) that complete unit normals (n, 3) to a frame (Duff et al. 2017)."""
    x, y, z = normal.unbind(-1)
    sign = torch.where(z >= 0, 1.0, -1.0).to(normal.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    second = torch.stack([b, sign + y * y * a, -y], -1)
    return first, second


@dataclass(frozen=True)
class DirectionalLights:
    """Lights of one view: direction (lights, 3) unit, world; intensity (lights,) mean of the channels."""

    direction: Tensor
    intensity: Tensor

    def of(self, rows: slice | Tensor) -> DirectionalLights:
        """Only some of them."""
        return DirectionalLights(self.direction[rows], self.intensity[rows])


@dataclass(frozen=True, eq=False)
class Batch:
    """Samples of k views with equally many lights that are handled at once: n pairs of each, fewer filled up with pairs of no weight.

    views: their numbers; vertex (k, n); towards (k, n, 3); weight (k, n, lights) of the samples, 0 where they are no data; image
    (k, n, lights); gathered (k, n, lights, terms) or None; lights: direction (k, lights, 3), intensity (k, 1, lights).
    """

    views: list[int]
    vertex: Tensor
    towards: Tensor
    weight: Tensor
    image: Tensor
    gathered: Tensor | None
    lights: DirectionalLights

    def added(self, sums: Tensor, values: Tensor) -> None:
        """Adds values (k, n, ...) of the pairs to sums (V, ...) of their vertices, in place."""
        sums.index_add_(0, self.vertex.flatten(), values.flatten(0, 1))


def _together(views: list[ViewSamples]) -> Iterator[list[tuple[int, slice]]]:
    """Which views, and which of their pairs, make a batch: part of a view, or all pairs of consecutive small ones."""
    group: list[tuple[int, slice]] = []
    longest = 0
    for i, samples in enumerate(views):
        pairs = len(samples.vertex)
        if pairs > samples.pairs_at_once:
            yield from ([(i, part)] for part in samples.chunks())
            continue
        longest = max(longest, pairs)
        alike = all(views[j].image.shape[1] == samples.image.shape[1] for j, _ in group)
        if group and not (alike and (len(group) + 1) * longest <= samples.pairs_at_once):
            yield group
            group, longest = [], pairs
        if pairs:
            group.append((i, slice(None)))
    if group:
        yield group


def batches(views: list[ViewSamples], lights: list[DirectionalLights]) -> Iterator[Batch]:
    """All samples of the views, in a fixed order. Small views go together: alone each takes some thirty
    operations, whose start then takes longer than they do."""
    for group in _together(views):
        some = [views[i] for i, _ in group]

        def filled(values: list[Tensor], group: list[tuple[int, slice]] = group) -> Tensor:
            parts = [of_view[part] for of_view, (_, part) in zip(values, group, strict=True)]
            return parts[0][None] if len(parts) == 1 else pad_sequence(parts, batch_first=True)

        gathered = [s.gathered for s in some if s.gathered is not None]
        direction, intensity = (torch.stack([getattr(lights[i], name) for i, _ in group]) for name in ("direction", "intensity"))
        yield Batch(
            [i for i, _ in group],
            filled([s.vertex for s in some]),
            filled([s.towards for s in some]),
            filled([s.weight for s in some])[..., None] * filled([s.data for s in some]),
            filled([s.image for s in some]),
            filled(gathered) if gathered else None,
            DirectionalLights(direction, intensity[:, None]),
        )


@dataclass(frozen=True)
class Shaded:
    """The image model on a batch of pairs, (..., n, lights) each: lit 1 above the horizon; n . l clamped at 0; h . n; c; basis dI/da and
    dI/dw_k; reflectance R, its lobes' part; slope B; of_light a D_l' D_v, of_view a D_l D_v'; missing (1 - n.l)^p and (1 - n.v)^p
    (..., n, 1); indirect a e G_0 and gleamed dI/dy; rest, all that other surfaces send; unsure, its standard deviation, None
    where lobes send nothing; predicted I."""

    lit: Tensor
    n_dot_l: Tensor
    half: Tensor
    c: Tensor
    basis: list[Tensor]
    reflectance: Tensor
    specular: Tensor
    slope: Tensor
    of_light: Tensor
    of_view: Tensor
    missing: tuple[Tensor, Tensor]
    indirect: Tensor
    gleamed: Tensor
    rest: Tensor
    unsure: Tensor | None
    predicted: Tensor


def evaluate(
    normal: Tensor, reflectance: Tensor, towards: Tensor, lights: DirectionalLights, law: Law, gathered: Tensor | None = None
) -> Shaded:
    """The image model for normal, towards (..., n, 3) and reflectance (..., n, 1 + lobes) under all lights of a view, or of several that
    stand first (Batch). gathered (..., n, lights, 1 or 2 + lobes): G."""
    light, intensity = lights.direction, lights.intensity
    n_dot_l = (normal @ light.mT).clamp_min_(0)
    n_dot_v = (normal * towards).sum(-1, keepdim=True)
    c = half_length(towards @ light.mT)
    # Below the horizon h . n is of no account, there is no light; but it must not grow with a light opposite to the view.
    half = (n_dot_v + n_dot_l).div_(c).clamp_(-1, 1)
    q, albedo = n_dot_l * intensity, reflectance[..., :1]
    (of_l, slope_l), (of_v, slope_v) = _grazing(n_dot_l), _grazing(n_dot_v.clamp_min(0))
    # Factors of a point alone are multiplied before those of its samples.
    D_l, D_v, slant = (law.grazing * of_l).add_(1), 1 + law.grazing * of_v, albedo * law.grazing
    D = D_l * D_v
    specular, slope, basis = torch.zeros_like(q), torch.zeros_like(q), [q * D]
    gained = gain(c)
    for k, s in enumerate(law.sharpness):
        value, steepness = lobe(half, s, law.microfacet)
        value = value * gained
        weighted = value * reflectance[..., k + 1, None]
        specular += weighted
        slope += weighted.mul_(steepness)
        basis.append(q * value)
    indirect = gleamed = rest = torch.zeros_like(q)
    unsure = None
    if gathered is not None:
        received = (intensity[..., None] * gathered).unbind(-1)
        indirect = albedo * received[0]
        rest = law.bounce * indirect
        basis[0] += law.bounce * received[0]
        if len(received) > 1:
            gleamed = sum((reflectance[..., k, None] * g for k, g in enumerate(received[1:])), torch.zeros_like(q))
            by_lobes = law.gleam * gleamed
            rest, unsure = rest + by_lobes, LOBES_ERROR * by_lobes
            basis = [own + law.gleam * g for own, g in zip(basis, received[1:], strict=True)]
    total = (albedo * D).add_(specular)
    predicted = (q * total).add_(rest)
    of_light, of_view = slant * D_v * slope_l, slant * slope_v * D_l
    return Shaded(
        n_dot_l.sign(),
        n_dot_l,
        half,
        c,
        basis,
        total,
        specular,
        slope,
        of_light,
        of_view,
        (of_l, of_v),
        indirect,
        gleamed,
        rest,
        unsure,
        predicted,
    )


def _grazing(cosine: Tensor) -> tuple[Tensor, Tensor]:
    """(1 - cosine)^p and its derivative."""
    missing = 1 - cosine
    lower = missing ** (GRAZING_POWER - 1)
    return lower * missing, -GRAZING_POWER * lower


def vertex_derivatives(shaded: Shaded, frame: tuple[Tensor, Tensor], towards: Tensor, lights: DirectionalLights) -> list[Tensor]:
    """3 + lobes derivatives (..., n, lights) of the samples by two tangential steps of the normal, the albedo and the weights."""
    # In place: arrays of a batch fill the processor's cache, and new ones push out what is still needed.
    q = shaded.n_dot_l * lights.intensity
    along_half = (q * shaded.slope).div_(shaded.c)
    along_light = (shaded.lit * lights.intensity).mul_(shaded.reflectance).add_(along_half).add_(q * shaded.of_light)
    along_view = (q * shaded.of_view).add_(along_half)
    columns = [(t @ lights.direction.mT).mul_(along_light).add_(along_view * (t * towards).sum(-1, keepdim=True)) for t in frame]
    return columns + shaded.basis


def light_jacobian(shaded: Shaded, normal: Tensor, towards: Tensor, lights: DirectionalLights, law: Law, rotation: Tensor) -> Tensor:
    """(..., n, 3, lights) derivatives of the samples by m = intensity * direction in the camera's frame (rotation: camera_from_world)."""
    along_normal = shaded.n_dot_l * (shaded.slope / shaded.c + shaded.of_light)
    # dI/dm = alpha n + beta v + gamma l
    alpha = shaded.lit * shaded.reflectance + along_normal
    growing = shaded.specular * (4 / shaded.c**2 < STEEPEST)
    beta = -shaded.n_dot_l * (shaded.slope * shaded.half + 2 * growing) / shaded.c**2
    v_dot_l = shaded.c**2 / 2 - 1
    gamma = shaded.rest / lights.intensity - (along_normal * shaded.n_dot_l + beta * v_dot_l)
    n, v, light = (a @ rotation.mT for a in (normal, towards, lights.direction))
    return alpha[..., None, :] * n[..., None] + beta[..., None, :] * v[..., None] + gamma[..., None, :] * light.mT[..., None, :, :]


def law_derivatives(shaded: Shaded, reflectance: Tensor, lights: DirectionalLights, law: Law) -> list[Tensor]:
    """Derivatives (..., n, lights) of the samples by the law's grazing, bounce and gleam; reflectance (..., n, 1 + lobes)."""
    of_l, of_v = shaded.missing
    changed = of_l * (1 + law.grazing * of_v) + (1 + law.grazing * of_l) * of_v
    return [reflectance[..., :1] * lights.intensity * shaded.n_dot_l * changed, shaded.indirect, shaded.gleamed]


def robust(residual: Tensor, scale: Tensor, unsure: Tensor | None) -> Tensor:
    """Cauchy's weight of residuals (..., n, lights) with scale (..., n), to whose square unsure (..., n, lights) adds its own."""
    excess = (residual / (CAUCHY_95 * scale[..., None])).square_().add_(1)
    if unsure is not None:
        excess += (unsure / scale[..., None]).square_()
    return excess.reciprocal_()


def _vertex_equations(views: list[ViewSamples], vertices: Vertices, lights: list[DirectionalLights], law: Law) -> NormalEquations:
    n, p = len(vertices.normal), 2 + vertices.reflectance.shape[1]
    # One product of (jacobian, residual) with itself holds hessian, gradient and squares.
    sums, count = vertices.normal.new_zeros(n, p + 1, p + 1), vertices.normal.new_zeros(n)
    first, second = tangents(vertices.normal)
    for batch in batches(views, lights):
        index, towards = batch.vertex, batch.towards
        shaded = evaluate(vertices.normal[index], vertices.reflectance[index], towards, batch.lights, law, batch.gathered)
        residual = shaded.predicted - batch.image
        weight = robust(residual, vertices.scale[index], shaded.unsure).mul_(batch.weight)
        rows = torch.stack([*vertex_derivatives(shaded, (first[index], second[index]), towards, batch.lights), residual], -2)
        batch.added(sums, (rows * weight[..., None, :]) @ rows.mT)
        batch.added(count, weight.sum(-1))
    return NormalEquations(sums[:, :p, :p].contiguous(), sums[:, :p, p].contiguous(), sums[:, p, p].contiguous(), count)


def vertex_equations(views: list[ViewSamples], vertices: Vertices, lights: list[DirectionalLights], law: Law) -> NormalEquations:
    """Normal equations of every vertex at the current state, unknowns as in `vertex_derivatives`.

    The views are dealt out to the cores in a fixed order and their sums added in that order, so that the result does not
    depend on which core was faster.
    """
    hands = min(WORKERS, len(views))
    parts = on_cores(lambda k: _vertex_equations(views[k::hands], vertices, lights[k::hands], law), range(hands))
    total = parts[0]
    for part in parts[1:]:
        total = NormalEquations(
            total.hessian + part.hessian, total.gradient + part.gradient, total.squares + part.squares, total.count + part.count
        )
    return total
