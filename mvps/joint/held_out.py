"""Lights of photographs that were kept back, for a finished reconstruction: normals and reflectance stand still.

Start: least squares of Lambert's part, I = a n . m, then Gauss-Newton on the whole image model (blocks.py) with shadows traced anew, twice,
the second time with the lights' colours taken out of the photographs.
Views of one rig share their lights; the rig's lights carry over to a view that was kept back without any fit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mvps.camera import rig_frame
from mvps.gleam import coarse_senders
from mvps.joint.blocks import DirectionalLights, Vertices, evaluate, light_jacobian, robust
from mvps.joint.colours import ratios_of_known
from mvps.joint.lighting import LIGHT_VERTICES, drawn
from mvps.joint.observe import ViewSamples, observe, with_gathered
from mvps.joint.reflectance import Observed
from mvps.scene import Camera, Capture, Float, Law, Lights, Material, Surface

STEPS, TIMES = 6, 2
"""Of Gauss and Newton; and how often they are done, under colours and shadows of the lights that were found before."""


def carried_over(lights: Lights, first: Camera, camera: Camera) -> tuple[Float, Float]:
    """Direction and intensity (lights, 3) of a rig's lights in a view with `camera`, from its first view."""
    return np.asarray(lights.direction[0]) @ rig_frame(lights, first).T @ rig_frame(lights, camera), np.asarray(lights.intensity[0])


def _tint(material: Material) -> Float:
    """Colour (V, 3) of the lobes; white where there are none."""
    weight = material.specular_weight
    if weight.ndim == 2:
        return np.ones_like(material.albedo)
    total = weight.sum(1)
    mean = total.mean(1, keepdims=True)
    return np.where(mean > 0, total / np.where(mean > 0, mean, 1), 1.0)


def _vertices(material: Material, device: torch.device) -> Vertices:
    weight = material.specular_weight.mean(2) if material.specular_weight.ndim == 3 else material.specular_weight
    reflectance = np.column_stack([material.albedo.mean(1), weight])
    normal, values = (torch.tensor(a, dtype=torch.float32, device=device) for a in (material.normal, reflectance))
    # Residuals of about a tenth of the reflectance are outliers until the lights are known.
    return Vertices(normal, values, 0.1 * values.sum(1).clamp_min(1e-6))


def _lambertian(views: list[ViewSamples], vertices: Vertices, rotations: list[torch.Tensor], one_rig: bool) -> list[torch.Tensor]:
    """Per view m (lights, 3) in the frame of its rotation."""
    sums = []
    for samples, rotation in zip(views, rotations, strict=True):
        n = vertices.normal[samples.vertex] @ rotation.T * vertices.reflectance[samples.vertex, :1]
        # A view may see no vertex, and quantiles of nothing are errors.
        bright = samples.image.quantile(0.9, dim=0) if len(samples.image) else 0.0
        weight = samples.weight[:, None] * samples.data * (samples.image > 0.2 * bright)
        sums.append((torch.einsum("pl,pi,pj->lij", weight, n, n), torch.einsum("pl,pl,pi->li", weight, samples.image, n)))
    if one_rig:
        sums = [(torch.stack([H for H, _ in sums]).sum(0), torch.stack([g for _, g in sums]).sum(0))] * len(sums)
    eye = torch.eye(3, device=vertices.normal.device)
    damping = [(1e-6 * H.diagonal(dim1=1, dim2=2).mean()).clamp_min(1e-12) for H, _ in sums]
    solved = [torch.linalg.solve(H + d * eye, g[..., None])[..., 0] for (H, g), d in zip(sums, damping, strict=True)]
    # A photograph that was left out says nothing of its light: at the camera, or anywhere.
    toward = torch.tensor([0.0, 0.0, -1.0], device=eye.device)
    return [torch.where(m.norm(dim=1, keepdim=True) > 0, m, toward) for m in solved]


def _step(
    views: list[ViewSamples],
    vertices: Vertices,
    lights: list[DirectionalLights],
    law: Law,
    rotations: list[torch.Tensor],
    one_rig: bool,
) -> list[DirectionalLights]:
    sums = []
    for samples, of_view, rotation in zip(views, lights, rotations, strict=True):
        count = len(of_view.intensity)
        H, g = samples.image.new_zeros(count, 3, 3), samples.image.new_zeros(count, 3)
        for part in samples.chunks():
            index, towards = samples.vertex[part], samples.towards[part]
            shaded = evaluate(vertices.normal[index], vertices.reflectance[index], towards, of_view, law, samples.gathered_of(part))
            residual = shaded.predicted - samples.image[part]
            weight = samples.weight[part, None] * samples.data[part] * robust(residual, vertices.scale[index], shaded.unsure)
            J = light_jacobian(shaded, vertices.normal[index], towards, of_view, law, rotation)
            H += torch.einsum("pl,pil,pjl->lij", weight, J, J)
            g += torch.einsum("pl,pil,pl->li", weight, J, residual)
        sums.append((H, g))
    if one_rig:
        sums = [(torch.stack([H for H, _ in sums]).sum(0), torch.stack([g for _, g in sums]).sum(0))] * len(sums)
    stepped = []
    for (H, g), of_view, rotation in zip(sums, lights, rotations, strict=True):
        H = H + torch.diag_embed(1e-4 * H.diagonal(dim1=1, dim2=2) + 1e-12)
        m = (of_view.direction * of_view.intensity[:, None]) @ rotation.T - torch.linalg.solve(H, g[..., None])[..., 0]
        stepped.append(_from_product(m, rotation))
    return stepped


def _from_product(m: torch.Tensor, rotation: torch.Tensor) -> DirectionalLights:
    length = m.norm(dim=1).clamp_min(1e-12)
    return DirectionalLights(m / length[:, None] @ rotation, length)


def _as_lights(grey: list[DirectionalLights], ratios: list[Float], like: Lights) -> Lights:
    directions = [g.direction.double().cpu().numpy() for g in grey]
    unit = tuple(d / np.linalg.norm(d, axis=1, keepdims=True) for d in directions)
    intensity = tuple(g.intensity.double().cpu().numpy()[:, None] * r for g, r in zip(grey, ratios, strict=True))
    return replace(like, direction=unit, intensity=intensity)


def fit_lights(capture: Capture, surface: Surface, material: Material, one_rig: bool, device: torch.device, fixed: bool = False) -> Lights:
    """Lights of all photographs of `capture` for a known surface and material. one_rig: its views share them; fixed: in the world."""
    torch.set_num_threads(1)
    # With the light at the camera no visible vertex is in shadow.
    from_camera = [np.tile(-view.camera.rotation[2], (len(view.lights), 1)) for view in capture.views]
    white = [np.ones_like(d) for d in from_camera]
    start = Lights(tuple(from_camera), tuple(white), one_rig, fixed)
    rotations = [torch.tensor(rig_frame(start, view.camera), dtype=torch.float32, device=device) for view in capture.views]
    views = observe(capture, surface, start, device, shadows=material.law.shadows)
    vertices = _vertices(material, device)
    products = _lambertian(views, vertices, rotations, one_rig)
    grey = [_from_product(m, rotation) for m, rotation in zip(products, rotations, strict=True)]
    sent = coarse_senders(surface, material, grey=True)
    ratios, generator = white, np.random.default_rng(0)
    for _ in range(TIMES):
        lights = _as_lights(grey, ratios, start)
        views = observe(capture, surface, lights, device, shadows=material.law.shadows)
        if sent is not None:
            views = with_gathered(views, capture, surface, sent, lights)
        for _ in range(STEPS):
            grey = _step(views, vertices, grey, material.law, rotations, one_rig)
        some = drawn(views, LIGHT_VERTICES, generator)
        rows = [samples.of_vertices(some, len(vertices.normal)) for samples in views]
        of = Observed(capture, surface, rows, vertices, grey, material.law)
        # The channels' plain mean of an object in colours, under lights in colours, is not as bright as under white ones.
        ratios = ratios_of_known(of, material.albedo, _tint(material), one_rig)
    return _as_lights(grey, ratios, start)
