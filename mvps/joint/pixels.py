"""Normals of single views at the pixels themselves, under the reflectance that all views agreed on.

Every pixel takes the place of a vertex (blocks.py) with the samples of its own view alone: no interpolation blurs it and no error of the
geometry misplaces it. Its few samples cannot tell all unknowns, so normal and reflectance are tied to the vertices' values at its
first hit.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mvps.camera import view_directions
from mvps.cores import on_cores
from mvps.gleam import Senders, terms
from mvps.joint.blocks import DirectionalLights, Vertices
from mvps.joint.observe import SHADOW_MARGIN, ViewSamples, channel_ratio, grey_radiance
from mvps.joint.steps import Anchor, confidence, vertex_step
from mvps.joint.thinned import kept
from mvps.mesh import normalise
from mvps.pixel_samples import light_shares
from mvps.rendering import points_under, shadow_at
from mvps.scene import Bool, Capture, Float, Int, Lights, Material, NormalMap, Surface, View
from mvps.visibility import RayCaster, ray_caster

NORMAL_TIE = 0.3
"""Standard deviation, radians, of a pixel's normal from the interpolated one: it only speaks where samples do not, for the agreement of
views must find the mesh's errors and not what the mesh says of itself."""

ALBEDO_TIE, WEIGHT_TIE = 0.3, 0.05
"""Standard deviation of a pixel's albedo over the vertices' albedo, and of a lobe's weight over albedo plus weight. Albedo has edges that a
mesh blurs; one view's lights hardly tell a lobe from a turned normal, so lobes keep close to what all views say."""

QUICK_STEPS = 2
"""Under enough lights (thinned.py), before one under all."""

OWN_LIGHTS = 4
"""Lights of a view from which its pixels say something of their own: albedo and two angles of a normal are three unknowns."""


def few_lights(capture: Capture) -> bool:
    """Whether a view has fewer lights than tell normals of its own."""
    return min(len(view.lights) for view in capture.views) < OWN_LIGHTS


def _samples(view: View, position: Float, shadow: Bool, intensity: Float, rows: Int, device: torch.device) -> ViewSamples:
    """Of some of the view's pixels, rows (n,), which show position (n, 3)."""
    image, usable = grey_radiance(view, intensity)
    image, data = image[rows], usable[rows] & ~shadow
    towards = view_directions(view.camera, position).astype(np.float32)
    towards_, image_, data_ = (torch.from_numpy(a).to(device) for a in (towards, image, data))
    n = len(rows)
    return ViewSamples(torch.arange(n, device=device), towards_, torch.ones(n, device=device), image_, data_)


def _beside(view: View, rows: Int, shadow: Bool) -> Bool:
    """(n, lights) True where one of the view's pixels, rows (n,), or one within SHADOW_MARGIN of it is in shadow (n, lights)."""
    x, y = np.indices((2 * SHADOW_MARGIN + 1,) * 2) - SHADOW_MARGIN
    disk = (x**2 + y**2 < (SHADOW_MARGIN + 0.5) ** 2).astype(np.uint8)
    beside, place = np.zeros_like(shadow), tuple(view.pixels[rows].T)
    image = np.zeros(view.mask.shape, np.uint8)
    for k, of_light in enumerate(shadow.T):
        image[place] = of_light
        beside[:, k] = cv2.dilate(image, disk)[place]
    return beside


def _chroma(view: View, intensity: Float, rows: Int) -> NDArray[np.float32]:
    """(n, 3) share of the channels in a pixel's radiance under white light, mean 1."""
    ratio, samples = channel_ratio(intensity), view.samples[rows]
    per_channel = (view.shown[:, None] * light_shares(ratio) / ratio).astype(np.float32)
    white = np.column_stack([np.einsum("pl,l->p", samples[..., c].astype(np.float32), per_channel[:, c]) for c in range(3)])
    chroma: NDArray[np.float32] = white / np.maximum(white.mean(1, keepdims=True), 1e-12)
    return chroma


def pixel_normals(
    view: View,
    caster: RayCaster,
    sent: Senders | None,
    material: Material,
    direction: Float,
    intensity: Float,
    quick: slice,
    device: torch.device,
    every_other: bool,
) -> NormalMap:
    """Normals, albedo and confidence of a view's pixels; confidence 0 where a pixel misses the mesh.

    sent: what other surfaces send, None without inter-reflection; direction, intensity (lights, 3);
    quick: lights of the first steps; every_other: only `view.every_other`; confidence 0 elsewhere.
    """
    chosen = view.every_other if every_other else np.arange(len(view.pixels))
    points = points_under(caster, material, view.camera, view.pixels[chosen])
    hit = np.flatnonzero(points.hit)
    rows, shadow = chosen[hit], shadow_at(caster, material.law, points, direction)[hit]
    samples = _samples(view, points.position[hit], _beside(view, rows, shadow), intensity, rows, device)
    if sent is not None:
        G = terms(sent, direction, view.camera.centre).at(points.position[hit], points.mesh_normal[hit])
        samples = replace(samples, gathered=torch.from_numpy(G).to(device))
    known = np.column_stack([points.albedo.mean(1), points.specular_weight])[hit]
    reflectance, normal, light, grey = (
        torch.tensor(a, dtype=torch.float32, device=device) for a in (known, points.normal[hit], direction, intensity.mean(1))
    )
    spread = torch.cat([ALBEDO_TIE * reflectance[:, :1], WEIGHT_TIE * (reflectance[:, :1] + reflectance[:, 1:])], 1)
    anchor = Anchor(normal, NORMAL_TIE, reflectance, spread.clamp_min(1e-6 * float(spread.max())))
    lights = [DirectionalLights(light, grey)]
    state = Vertices(normal, reflectance, reflectance.sum(1).median().expand(len(hit)))
    for _ in range(QUICK_STEPS):
        state = vertex_step([samples.of_lights(quick)], state, [lights[0].of(quick)], material.law, anchor, stated=False)
    state = vertex_step([samples], state, lights, material.law, anchor)
    towards = -view.camera.rotation[2].astype(np.float32)
    pixels = len(view.pixels)
    normals = np.tile(towards, (pixels, 1))
    albedo, certain = np.zeros((pixels, 3), np.float32), np.zeros(pixels, np.float32)
    normals[rows] = normalise(state.normal.double().cpu().numpy())
    albedo[rows] = state.reflectance[:, :1].cpu().numpy() * _chroma(view, intensity, rows)
    certain[rows] = confidence(state).cpu().numpy()
    if len(view.lights) < OWN_LIGHTS:
        # What is known comes from the vertex, which other views saw under other lights.
        certain[rows] = np.maximum(certain[rows], points.confidence[hit])
    return NormalMap(normals, albedo, certain)


def filled(view: View, maps: NormalMap, rough: Float) -> Float:
    """Normals (pixels, 3) of a view: the solved ones of its map, and between them rough ones (pixels, 3), those of the vertices, plus the
    mean of what the solved ones among a pixel's four neighbours differ from theirs: what vertices blur neighbours share."""
    solved = maps.confidence > 0
    difference = np.zeros((view.mask.shape[0] + 2, view.mask.shape[1] + 2, 4))
    difference[1:-1, 1:-1][view.mask] = np.column_stack([maps.normal - rough, np.ones(len(solved))]) * solved[:, None]
    around = difference[:-2, 1:-1] + difference[2:, 1:-1] + difference[1:-1, :-2] + difference[1:-1, 2:]
    total = around[view.mask]
    return np.where(solved[:, None], maps.normal, normalise(rough + total[:, :3] / np.maximum(total[:, 3:], 1)))


def all_pixel_normals(
    capture: Capture,
    surface: Surface,
    material: Material,
    lights: Lights,
    sent: Senders | None,
    device: torch.device,
    every_other: bool = False,
) -> tuple[NormalMap, ...]:
    """`pixel_normals` of every view, on all cores."""
    caster, quick = ray_caster(surface), kept([len(view.lights) for view in capture.views])

    def one(i: int) -> NormalMap:
        of_view = capture.views[i], caster, sent, material, lights.direction[i], lights.intensity[i]
        return pixel_normals(*of_view, quick[i], device, every_other)

    return tuple(on_cores(one, range(len(capture.views))))
