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

float64 holds the reduced system: S is the small difference of two large matrices along the family.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mvps.joint.blocks import DirectionalLights, Vertices, evaluate, light_jacobian, robust, tangents, vertex_derivatives
from mvps.joint.observe import ViewSamples
from mvps.joint.patches import Patches
from mvps.joint.steps import LARGEST_TURN, Anchor
from mvps.scene import Law
from mvps.shading import returned

VERTICES_PER_BLOCK = 256

OF_LAW = 2
"""Unknowns of the law: grazing and bounce."""

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
    """Where the lights of each view stand among the unknowns: one place for all views of a rig, else one after the other; total 0
    where the lights are known."""

    start: list[int]
    total: int


def _layout(lights: list[DirectionalLights], one_rig: bool, free: bool) -> _Layout:
    if not free:
        return _Layout([0] * len(lights), 0)
    sizes = [len(of_view.intensity) for of_view in lights]
    if one_rig:
        return _Layout([0] * len(sizes), 3 * sizes[0])
    starts = [3 * sum(sizes[:i]) for i in range(len(sizes))]
    return _Layout(starts, 3 * sum(sizes))


def _coupled(
    views: list[ViewSamples],
    vertices: Vertices,
    lights: list[DirectionalLights],
    law: Law,
    rotations: list[Tensor],
    layout: _Layout,
) -> tuple[Tensor, ...]:
    """H_mm, g_m, H_jj, g_j, H_jm, each sample divided by its vertex's residual variance, and the weight of a vertex's samples (V,).

    The last two of m are the law's grazing and bounce.
    """
    n, p, like = len(vertices.normal), 2 + vertices.reflectance.shape[1], vertices.normal
    unknowns = layout.total + OF_LAW
    lights_hessian = like.new_zeros(unknowns, unknowns, dtype=torch.float64)
    lights_gradient = like.new_zeros(unknowns, dtype=torch.float64)
    hessian, gradient = like.new_zeros(n, p, p), like.new_zeros(n, p)
    cross, samples_of = like.new_zeros(n, p, unknowns), like.new_zeros(n)
    frame = tangents(vertices.normal)
    for samples, of_view, rotation, start in zip(views, lights, rotations, layout.start, strict=True):
        width = 3 * len(of_view.intensity) if layout.total else 0
        of_lights = slice(start, start + width)
        for part in samples.chunks():
            index, towards = samples.vertex[part], samples.towards[part]
            normal = vertices.normal[index]
            shaded = evaluate(normal, vertices.reflectance[index], towards, of_view, law, samples.gathered_of(part))
            residual = shaded.predicted - samples.image[part]
            scale = vertices.scale[index]
            weight = samples.weight[part, None] * samples.data[part] * robust(residual, scale) / scale[:, None] ** 2
            of_vertex = torch.stack(vertex_derivatives(shaded, (frame[0][index], frame[1][index]), towards, of_view), 1)
            of_law = torch.stack([shaded.grazing, shaded.indirect], -1)
            weighted = of_vertex * weight[:, None]
            hessian.index_add_(0, index, weighted @ of_vertex.transpose(1, 2))
            gradient.index_add_(0, index, (weighted @ residual[..., None])[..., 0])
            samples_of.index_add_(0, index, (weight * scale[:, None] ** 2).sum(1))
            cross[:, :, layout.total :].index_add_(0, index, weighted @ of_law)
            if width:
                of_light = light_jacobian(shaded, normal, towards, of_view, law, rotation)
                coupling = (weighted[..., None] * of_light[:, None]).reshape(len(index), p, width)
                cross[:, :, of_lights].index_add_(0, index, coupling)
                heavy = of_light * weight[..., None]
                lights_hessian[of_lights, of_lights] += torch.block_diag(*torch.einsum("pli,plj->lij", heavy, of_light).double())
                lights_gradient[of_lights] += torch.einsum("pli,pl->li", heavy, residual).reshape(-1).double()
                shared = torch.einsum("pli,plk->lik", heavy, of_law).reshape(width, OF_LAW).double()
                lights_hessian[of_lights, layout.total :] += shared
                lights_hessian[layout.total :, of_lights] += shared.T
            lights_hessian[layout.total :, layout.total :] += torch.einsum("pl,pli,plj->ij", weight, of_law, of_law).double()
            lights_gradient[layout.total :] += torch.einsum("pl,pli,pl->i", weight, of_law, residual).double()
    return lights_hessian, lights_gradient, hessian, gradient, cross, samples_of


def _reduced_step(parts: tuple[Tensor, ...], vertices: Vertices, anchor: Anchor, patches: Patches, solved: tuple[bool, bool]) -> Tensor:
    """dm of the Schur complement. solved: grazing, bounce."""
    H, g, hessian, gradient, cross, samples_of = parts
    away, strength = vertices.normal - anchor.normal, samples_of / anchor.sigma**2
    for k, tangent in enumerate(tangents(vertices.normal)):
        hessian[:, k, k] += strength
        gradient[:, k] += strength * (away * tangent).sum(1)
    held = torch.zeros_like(gradient)
    held[:, 2:] = ((vertices.reflectance <= 0) & (gradient[:, 2:] >= 0)).to(held.dtype)
    free = 1 - held
    hessian = hessian * free[:, :, None] * free[:, None, :] + torch.diag_embed(held)
    hessian = hessian + torch.diag_embed(1e-6 * torch.diagonal(hessian, dim1=1, dim2=2) + 1e-12)
    moved, A = patches.moved(vertices.normal)
    E, F, f = (H.new_zeros(patches.count, 2, *shape) for shape in ((2,), (len(g),), ()))
    for start in range(0, len(hessian), VERTICES_PER_BLOCK):
        part = slice(start, start + VERTICES_PER_BLOCK)
        L = torch.linalg.cholesky(hessian[part].double())
        coupled = (cross[part] * free[part][..., None]).double()
        half = torch.linalg.solve_triangular(L, coupled, upper=False)
        right = torch.linalg.solve_triangular(L, (gradient[part] * free[part]).double()[..., None], upper=False)
        # L^-1 of the normals' columns: products of two such halves have the inverse of the whole block between them.
        normals = torch.linalg.solve_triangular(
            L, torch.eye(L.shape[1], 2, dtype=L.dtype, device=L.device).expand(len(L), -1, -1), upper=False
        )
        normals = normals @ A[part].transpose(1, 2)
        E.index_add_(0, patches.of[part], normals.transpose(1, 2) @ normals)
        F.index_add_(0, patches.of[part], normals.transpose(1, 2) @ half)
        f.index_add_(0, patches.of[part], (normals.transpose(1, 2) @ right)[..., 0])
        half, right = half.reshape(-1, len(g)), right.reshape(-1)
        H -= half.T @ half
        g -= half.T @ right
    of_patches = torch.linalg.solve(E, torch.cat([F, (f - patches.summed(moved))[..., None]], 2))
    H += torch.einsum("kim,kin->mn", F, of_patches[..., :-1])
    g += torch.einsum("kim,ki->m", F, of_patches[..., -1])
    # The common scale of all lights is free (albedo takes it up): damping keeps it still.
    diagonal = torch.diagonal(H).clamp_min(0)
    H += torch.diag(1e-4 * diagonal + 1e-9 * diagonal.max() + torch.finfo(H.dtype).tiny ** 0.5)
    wanted = torch.cat([torch.full((len(g) - OF_LAW,), True), torch.tensor(solved)]).nonzero()[:, 0].to(g.device)
    step = torch.zeros_like(g)
    if len(wanted):
        step[wanted] = -torch.linalg.solve(H[wanted][:, wanted], g[wanted])
    return step


def light_step(
    views: list[ViewSamples],
    vertices: Vertices,
    lights: list[DirectionalLights],
    law: Law,
    anchor: Anchor,
    patches: Patches,
    rotations: list[Tensor],
    one_rig: bool,
    free: tuple[bool, bool, bool] = (True, True, True),
) -> tuple[list[DirectionalLights], Law]:
    """One Gauss-Newton step of what is free of lights, grazing and bounce, with the vertices eliminated.

    rotations: camera_from_world of the views, float32.
    """
    layout = _layout(lights, one_rig, free[0])
    parts = _coupled(views, vertices, lights, law, rotations, layout)
    step = _reduced_step(parts, vertices, anchor, patches, free[1:])
    reflected = float((vertices.reflectance @ vertices.reflectance.new_tensor(returned(law.sharpness))).median())
    law = _stepped_law(law, step[layout.total :], reflected)
    if not layout.total:
        return lights, law
    stepped = []
    for of_view, rotation, start in zip(lights, rotations, layout.start, strict=True):
        m = (of_view.direction * of_view.intensity[:, None]).double() @ rotation.double().T
        d = step[start : start + m.numel()].reshape(-1, 3)
        length = m.norm(dim=1, keepdim=True)
        d = d * (LARGEST_TURN * length / d.norm(dim=1, keepdim=True).clamp_min(1e-300)).clamp_max(1)
        m = m + d
        intensity = m.norm(dim=1)
        stepped.append(DirectionalLights((m / intensity[:, None] @ rotation.double()).float(), intensity.float()))
    return stepped, law


def _stepped_law(law: Law, step: Tensor, reflected: float) -> Law:
    """The law after a step, within LARGEST_GRAZING and so that the median point, lobes and all, returns no more than it receives."""
    grazing, bounce = (float(value) for value in torch.tensor([law.grazing, law.bounce], dtype=step.dtype) + step.cpu())
    return replace(
        law, grazing=min(max(grazing, -LARGEST_GRAZING), LARGEST_GRAZING), bounce=min(max(bounce, 0.0), 1 / max(reflected, 1e-300))
    )


def with_mean_one(lights: list[DirectionalLights], vertices: Vertices) -> tuple[list[DirectionalLights], Vertices]:
    """The same images with the lights' mean intensity one."""
    mean = float(torch.cat([of_view.intensity for of_view in lights]).mean())
    scaled = [DirectionalLights(of_view.direction, of_view.intensity / mean) for of_view in lights]
    return scaled, replace(vertices, reflectance=vertices.reflectance * mean)
