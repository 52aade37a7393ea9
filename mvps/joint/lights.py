"""The lights' block, solved together with the vertices it depends on.

Alternating between lights and vertices creeps: a view's lights can grow only as fast as its vertices' albedo shrinks. So the vertices
are eliminated. With unknowns m (all lights) and x_j (vertex j: normal, albedo, weights) the Gauss-Newton system

    [ H_mm   H_mx ] [dm]     [g_m]                     S  = H_mm - sum_j H_mj (H_jj + P_j)^-1 H_jm
    [ H_xm  H_xx+P] [dx] = - [g_x]      reduces to     S dm = -(g_m - sum_j H_mj (H_jj + P_j)^-1 g_j)

(Schur complement, as in bundle adjustment: Triggs et al. 2000), P_j the ties of steps.py. The vertices come in patches that keep their
mean slope (patches.py), which adds two multipliers each: with A_j, c, E there and F = sum_j A_j H_jj^-1 H_jm, f = sum_j A_j H_jj^-1 g_j

    S <- S + F^T E^-1 F,        right-hand side <- right-hand side - F^T E^-1 (f - c)

Weights at their bound whose gradient keeps them there are no unknowns. A few thousand vertices say all there is to say about the lights,
three unknowns each.

Where photographs under one rig are not as bright as its lamps make them (strengths.py), the logarithms of their strengths e are unknowns
too, one for each view or one for each photograph: m is e times the rig's, and so are its derivatives; by log e the derivative is the image.

float64 holds the reduced system: S is the small difference of two large matrices along the family.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mvps.cores import on_cores
from mvps.joint.blocks import (
    WORKERS,
    DirectionalLights,
    Vertices,
    batches,
    evaluate,
    law_derivatives,
    light_jacobian,
    robust,
    tangents,
    vertex_derivatives,
)
from mvps.joint.elimination import Blocks, eliminated
from mvps.joint.observe import ViewSamples
from mvps.joint.patches import Patches
from mvps.joint.shadowed import TIMES, bounce_in_shadow
from mvps.joint.steps import LARGEST_TURN, Anchor
from mvps.joint.strengths import Strengths, Told, of_photographs
from mvps.scene import Law
from mvps.shading import returned
from solvers.least_squares import damped_solution

OF_LAW = 3
"""Unknowns of the law: grazing, bounce and gleam."""

OfLaw = tuple[bool, bool, bool]
"""Which of these are free."""

LARGEST_GRAZING = 0.9
"""Of the diffuse term's relative change at 90 degrees: none absorbs all there, none doubles."""


def on_some(views: list[ViewSamples], vertices: Vertices, chosen: Tensor) -> tuple[list[ViewSamples], Vertices]:
    """Samples and state of the chosen vertices only, which are numbered anew."""
    place = torch.full((len(vertices.normal),), -1, dtype=torch.long, device=chosen.device)
    place[chosen] = torch.arange(len(chosen), device=chosen.device)
    few = []
    for s in views:
        rows = torch.nonzero(place[s.vertex] >= 0)[:, 0]
        few.append(replace(s.of_pairs(rows), vertex=place[s.vertex[rows]]))
    return few, Vertices(vertices.normal[chosen], vertices.reflectance[chosen], vertices.scale[chosen])


def subset(views: list[ViewSamples], vertices: Vertices, anchor: Anchor, chosen: Tensor) -> tuple[list[ViewSamples], Vertices, Anchor]:
    """The same problem on the chosen vertices only."""
    few, state = on_some(views, vertices, chosen)
    tie = Anchor(anchor.normal[chosen], anchor.sigma, anchor.reflectance[chosen], anchor.reflectance_sigma[chosen])
    return few, state, tie


@dataclass(frozen=True)
class _Layout:
    """Which lights are whose: of each view the number of its rig, one for all or one for each; of each rig the number of its lights, none
    where they are known; how many strengths of each view are unknown: none, one, or one for each photograph. The unknowns are the rigs' m,
    x of all lights, then y, then z, the strengths, view by view, and those of the law."""

    rig: list[int]
    lights: list[int]
    strengths: int

    def start(self, rig: int) -> int:
        """Place of a rig's first unknown, or, after the last rig, of the first strength."""
        return 3 * sum(self.lights[:rig])

    def by_strength(self, values: Tensor) -> Tensor:
        """Values (..., lights) of a view's photographs, by its unknown strengths."""
        return values.sum(-1, keepdim=True) if self.strengths == 1 else values


def _layout(lights: list[DirectionalLights], one_rig: bool, free: bool, strengths: int) -> _Layout:
    sizes = [len(of_view.intensity) for of_view in lights] if free else []
    of_one = _Layout([0] * len(lights), sizes[:1], strengths if free else 0)
    return of_one if one_rig else _Layout(list(range(len(lights))), sizes, 0)


@dataclass(frozen=True)
class _OfStrengths:
    """Products of the derivatives by the strengths of a view's n photographs: with those by vertices (V, p, n), or (V, p, 1) of a strength
    that all have, with those by lights (3, n), and with themselves, those by the law, and the residual (OF_LAW + 2, n)."""

    vertices: Tensor
    lights: Tensor
    rest: Tensor

    @classmethod
    def none(cls, like: Tensor, vertices: tuple[int, int, int], lights: int) -> _OfStrengths:
        """Of no samples."""
        return cls(like.new_zeros(vertices), *(like.new_zeros(rows, lights, dtype=torch.float64) for rows in (3, OF_LAW + 2)))

    def add(self, index: Tensor, weighted: Tensor, heavy: Tensor, weight: Tensor, image: Tensor) -> None:
        """Adds the samples of n vertices (n,), in place: weighted (n, p + OF_LAW + 1, lights) and heavy (n, 3, lights) derivatives by
        vertices, law and lights with their weight (n, lights), and the image (n, lights)."""
        along = weighted * image[:, None]
        p = self.vertices.shape[1]
        self.vertices.index_add_(0, index, along[:, :p] if self.vertices.shape[2] > 1 else along[:, :p].sum(-1, keepdim=True))
        self.lights.add_((heavy * image[:, None]).sum(0))
        self.rest[0] += (weight * image**2).sum(0)
        self.rest[1:].add_(along[:, p:].sum(0))


@dataclass(frozen=True)
class _Sums:
    """Products of derivatives with each other, each sample divided by its vertex's residual variance.

    vertices (V, p + 4, p + 4): by the vertex's p unknowns, the law's three and the residual; count (V,) weight of a vertex's samples;
    of each rig cross (V, p, 3, lights): by vertex and light; lights (lights, 3, 7): by light with by light, the law's three, the residual;
    strengths: by number of the view, where strengths are unknown.
    """

    vertices: Tensor
    count: Tensor
    cross: dict[int, Tensor]
    lights: dict[int, Tensor]
    strengths: dict[int, _OfStrengths]

    def add(self, other: _Sums) -> None:
        """Adds sums over other views, in place."""
        self.strengths.update(other.strengths)
        self.vertices.add_(other.vertices)
        self.count.add_(other.count)
        for mine, others in ((self.cross, other.cross), (self.lights, other.lights)):
            for rig, values in others.items():
                mine[rig] = mine[rig].add_(values) if rig in mine else values


def _sums(
    views: list[ViewSamples],
    vertices: Vertices,
    lights: list[DirectionalLights],
    law: Law,
    rotations: list[Tensor],
    rigs: list[int],
    strengths: dict[int, Tensor],
    unknown: int,
) -> _Sums:
    """Over some views with their lights, rotations and rigs, -1 where the lights are known; strengths: by number in the capture where they
    are unknown, in the order of the views, and how many of each view are."""
    n, p, like = len(vertices.normal), 2 + vertices.reflectance.shape[1], vertices.normal
    size = {rig: len(of_view.intensity) for rig, of_view in zip(rigs, lights, strict=True) if rig >= 0}
    sums = _Sums(
        like.new_zeros(n, p + OF_LAW + 1, p + OF_LAW + 1),
        like.new_zeros(n),
        {rig: like.new_zeros(n, p, 3, count) for rig, count in size.items()},
        {rig: like.new_zeros(count, 3, 3 + OF_LAW + 1, dtype=torch.float64) for rig, count in size.items()},
        {
            number: _OfStrengths.none(like, (n, p, unknown), len(of_view.intensity))
            for number, of_view in zip(strengths, lights, strict=False)
        },
    )
    numbers = list(strengths)
    first, second = tangents(vertices.normal)
    for batch in batches(views, lights):
        index, towards = batch.vertex, batch.towards
        normal, reflectance, scale = (values[index] for values in (vertices.normal, vertices.reflectance, vertices.scale))
        shaded = evaluate(normal, reflectance, towards, batch.lights, law, batch.gathered)
        residual = shaded.predicted - batch.image
        weight = batch.weight * robust(residual, scale, shaded.unsure)
        batch.added(sums.count, weight.sum(-1))
        of_vertex = vertex_derivatives(shaded, (first[index], second[index]), towards, batch.lights)
        rows = torch.stack([*of_vertex, *law_derivatives(shaded, reflectance, batch.lights, law), residual], -2)
        weighted = rows * (weight / scale[..., None] ** 2)[..., None, :]
        batch.added(sums.vertices, weighted @ rows.mT)
        if not size:
            continue
        of_light = light_jacobian(shaded, normal, towards, batch.lights, law, torch.stack([rotations[i] for i in batch.views]))
        if strengths:
            of_light = of_light * torch.stack([strengths[numbers[i]] for i in batch.views])[:, None, None]
        for k, view in enumerate(batch.views):
            rig = rigs[view]
            sums.cross[rig].index_add_(0, index[k], weighted[k, :, :p, None] * of_light[k, :, None])
            # What goes with the light's own derivative carries the weight.
            heavy = (weight[k] / scale[k, :, None] ** 2)[:, None] * of_light[k]
            sums.lights[rig] += torch.einsum("pil,pjl->lij", of_light[k], torch.cat([heavy, weighted[k, :, p:]], 1))
            if strengths:
                own_weight = weight[k] / scale[k, :, None] ** 2
                sums.strengths[numbers[view]].add(index[k], weighted[k], heavy, own_weight, shaded.predicted[k])
    return sums


def _coupled(
    views: list[ViewSamples],
    vertices: Vertices,
    lights: list[DirectionalLights],
    law: Law,
    rotations: list[Tensor],
    layout: _Layout,
    strengths: Sequence[Tensor] | None,
) -> _Sums:
    """The sums over all views, dealt to the cores as `vertex_equations` deals them."""
    hands = min(WORKERS, len(views))
    rigs = layout.rig if layout.lights else [-1] * len(views)

    def dealt(k: int) -> _Sums:
        of_views = {} if strengths is None else {i: strengths[i] for i in range(k, len(views), hands)}
        return _sums(views[k::hands], vertices, lights[k::hands], law, rotations[k::hands], rigs[k::hands], of_views, layout.strengths)

    total, *others = on_cores(dealt, range(hands))
    for other in others:
        total.add(other)
    return total


def _lights_equations(sums: _Sums, layout: _Layout) -> tuple[Tensor, Tensor]:
    """H_mm and g_m; the last OF_LAW of m are the law's."""
    of_law = sums.vertices[:, -OF_LAW - 1 :, -OF_LAW - 1 :].double().sum(0)
    first = layout.start(len(layout.lights))
    unknowns = first + layout.strengths * len(sums.strengths) + OF_LAW
    H, g = of_law.new_zeros(unknowns, unknowns), of_law.new_zeros(unknowns)
    law = slice(unknowns - OF_LAW, unknowns)
    H[law, law], g[law] = of_law[:-1, :-1], of_law[:-1, -1]
    for rig, count in enumerate(layout.lights):
        products, start = sums.lights[rig].permute(1, 2, 0), layout.start(rig)
        own = slice(start, start + 3 * count)
        torch.diagonal(H[own, own].view(3, count, 3, count), dim1=1, dim2=3).copy_(products[:, :3])
        H[own, law] = products[:, 3:-1].transpose(1, 2).reshape(-1, OF_LAW)
        H[law, own] = H[own, law].T
        g[own] = products[:, -1].reshape(-1)
    for view, of_strengths in sums.strengths.items():
        own = slice(layout.start(layout.rig[view]), layout.start(layout.rig[view] + 1))
        at = slice(first + view * layout.strengths, first + (view + 1) * layout.strengths)
        H[own, at] = layout.by_strength(torch.diag_embed(of_strengths.lights).flatten(0, 1))
        H[at, own] = H[own, at].T
        H[law, at] = layout.by_strength(of_strengths.rest[1:-1])
        H[at, law] = H[law, at].T
        H[at, at] = torch.diag(layout.by_strength(of_strengths.rest[0]))
        g[at] = layout.by_strength(of_strengths.rest[-1])
    return H, g


def _blocks(sums: _Sums, vertices: Vertices, anchor: Anchor) -> Blocks:
    hessian, gradient = (sums.vertices[:, : -OF_LAW - 1, columns].clone() for columns in (slice(-OF_LAW - 1), -1))
    away, strength = vertices.normal - anchor.normal, sums.count / anchor.sigma**2
    for k, tangent in enumerate(tangents(vertices.normal)):
        hessian[:, k, k] += strength
        gradient[:, k] += strength * (away * tangent).sum(1)
    held = torch.zeros_like(gradient)
    held[:, 2:] = ((vertices.reflectance <= 0) & (gradient[:, 2:] >= 0)).to(held.dtype)
    free = 1 - held
    hessian = hessian * free[:, :, None] * free[:, None, :] + torch.diag_embed(held)
    hessian = hessian + torch.diag_embed(1e-6 * torch.diagonal(hessian, dim1=1, dim2=2) + 1e-12)
    return Blocks(hessian, gradient * free, free)


def _reduced(sums: _Sums, layout: _Layout, vertices: Vertices, anchor: Anchor, patches: Patches, solved: OfLaw) -> tuple[Tensor, Tensor]:
    """S of the Schur complement and the gradient beside it. solved: grazing, bounce, gleam."""
    H, g = _lights_equations(sums, layout)
    moved, A = patches.moved(vertices.normal)
    by_strength = [sums.strengths[i].vertices for i in sorted(sums.strengths)]
    by_strength = [torch.cat(by_strength, 2)] if layout.strengths == 1 else by_strength
    by_law = sums.vertices[:, : -OF_LAW - 1, -OF_LAW - 1 : -1]
    derivatives = [*(sums.cross[rig].flatten(2) for rig in range(len(layout.lights))), *by_strength, by_law]
    reduced = eliminated(H, g, derivatives, _blocks(sums, vertices, anchor), A, patches)
    F = reduced.F.flatten(0, 1)
    of_patches = torch.linalg.solve(reduced.E, torch.cat([reduced.F, (reduced.f - patches.summed(moved))[..., None]], 2)).flatten(0, 1)
    H.addmm_(F.T, of_patches[:, :-1])
    g.addmv_(F.T, of_patches[:, -1])
    # The common scale of all lights is free (albedo takes it up): damping keeps it still.
    diagonal = torch.diagonal(H)
    positive = diagonal.clamp_min(0)
    diagonal += 1e-4 * positive + 1e-9 * positive.max() + torch.finfo(H.dtype).tiny ** 0.5
    # What is not solved for stays: its row and column become the identity's.
    still = torch.cat([torch.zeros(len(g) - OF_LAW, dtype=torch.bool), ~torch.tensor(solved)]).to(g.device)
    H[still], H[:, still], g[still] = 0, 0, 0
    diagonal[still] = 1
    return H, g


def told_by_shadows(
    views: list[ViewSamples], vertices: Vertices, lights: list[DirectionalLights], law: Law, free: OfLaw, noise: float, times: int = TIMES
) -> tuple[Law, OfLaw]:
    """The law with the bounce that shadows alone tell (shadowed.py, noise and times too), and what is left free of it; as they were
    where lobes take part, and where shadows are too few."""
    _, bounce, gleam = free
    most = _most_returned(law, vertices)
    told = bounce_in_shadow(views, vertices, lights, law, noise, times, most) if bounce and not gleam else None
    if told is None:
        return law, free
    return _bounded(law, law.grazing, told, law.gleam, vertices), (free[0], False, False)


def light_step(
    views: list[ViewSamples],
    vertices: Vertices,
    lights: list[DirectionalLights],
    law: Law,
    anchor: Anchor,
    patches: Patches,
    rotations: list[Tensor],
    one_rig: bool,
    free_lights: bool = True,
    free: OfLaw = (True, True, True),
    strengths: Strengths | None = None,
) -> tuple[list[DirectionalLights], Law]:
    """One Gauss-Newton step of what is free of lights, grazing, bounce and gleam, with the vertices eliminated.

    rotations: from the world to the frames in which the views' lights are unknown (rig_frame in camera.py), float32.
    strengths: how many times as bright as the rig's lights photographs are, which is unknown as well (strengths.py); all as bright if None.
    """
    layout = _layout(lights, one_rig, free_lights, 0 if strengths is None else strengths.unknown)
    of_views = strengths.of if strengths is not None and layout.strengths else None
    sums = _coupled(views, vertices, lights, law, rotations, layout, of_views)
    step = -damped_solution(*_reduced(sums, layout, vertices, anchor, patches, free))
    grazing, bounce, gleam = step[-OF_LAW:].tolist()
    law = _bounded(law, law.grazing + grazing, law.bounce + bounce, law.gleam + gleam, vertices)
    if not layout.lights:
        return lights, law
    stepped = []
    brighter = step[layout.start(len(layout.lights)) : -OF_LAW].reshape(-1, max(layout.strengths, 1)).clamp(-LARGEST_TURN, LARGEST_TURN)
    # What is common to all views is the lights' scale.
    factor = (brighter - brighter.mean(0)).exp()
    for i, (of_view, rotation, rig) in enumerate(zip(lights, rotations, layout.rig, strict=True)):
        m = (of_view.direction * of_view.intensity[:, None]).double() @ rotation.double().T
        d = step[layout.start(rig) :][: m.numel()].reshape(3, -1).T
        if of_views is not None:
            d = of_views[i].double()[:, None] * d
        length = m.norm(dim=1, keepdim=True)
        d = d * (LARGEST_TURN * length / d.norm(dim=1, keepdim=True).clamp_min(1e-300)).clamp_max(1)
        m = m + d
        if of_views is not None:
            m = m * factor[i][:, None]
        intensity = m.norm(dim=1)
        stepped.append(DirectionalLights((m / intensity[:, None] @ rotation.double()).float(), intensity.float()))
    return stepped, law


def told_of_strengths(
    views: list[ViewSamples],
    vertices: Vertices,
    lights: list[DirectionalLights],
    law: Law,
    anchor: Anchor,
    patches: Patches,
    rotations: list[Tensor],
    free: OfLaw,
    strengths: Strengths,
) -> Told:
    """What strengths of one rig's photographs would be, and explain; arguments as in `light_step`. Those of views are solved together with
    all else; those of photographs beside everything else, which leaves no less unexplained than together with it."""
    layout = _layout(lights, True, True, 1)
    sums = _coupled(views, vertices, lights, law, rotations, layout, strengths.of)
    S, g = _reduced(sums, layout, vertices, anchor, patches, free)
    first = layout.start(1)
    others = torch.ones(len(g), dtype=torch.bool, device=g.device)
    others[first : first + len(views)] = False
    unexplained = sums.vertices[:, -1, -1].double().sum()
    step = -damped_solution(S, g)
    without = g[others] @ damped_solution(S[others][:, others], g[others])
    information, gradient = (torch.stack([sums.strengths[i].rest[k] for i in range(len(views))]) for k in (0, -1))
    photographs = of_photographs(gradient, information)
    explained = torch.stack([without, -g @ step - without, photographs]) / unexplained
    return Told(step[~others].tolist(), *explained.tolist())


def _bounded(law: Law, grazing: float, bounce: float, gleam: float, vertices: Vertices) -> Law:
    """The law with these, within LARGEST_GRAZING and so that the median point, lobes and all, returns no more than it receives."""
    most = _most_returned(law, vertices)
    bounce, gleam = (min(max(value, 0.0), most) for value in (bounce, gleam))
    return replace(law, grazing=min(max(grazing, -LARGEST_GRAZING), LARGEST_GRAZING), bounce=bounce, gleam=gleam)


def _most_returned(law: Law, vertices: Vertices) -> float:
    """The strength at which the median point, of those that some view shows, returns as much light as it receives."""
    reflected = vertices.reflectance @ vertices.reflectance.new_tensor(returned(law.sharpness, law.microfacet))
    known = reflected[reflected > 0]
    return 1 / float(known.median()) if len(known) else float("inf")


def with_mean_one(lights: list[DirectionalLights], vertices: Vertices) -> tuple[list[DirectionalLights], Vertices]:
    """The same images with the lights' mean intensity one."""
    mean = float(torch.cat([of_view.intensity for of_view in lights]).mean())
    scaled = [DirectionalLights(of_view.direction, of_view.intensity / mean) for of_view in lights]
    return scaled, replace(vertices, reflectance=vertices.reflectance * mean)
