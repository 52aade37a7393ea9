"""The generalised bas-relief of one view's normals and lights, by what lobes and few albedos say of it.

Integrability leaves  b -> G^-T b,  s -> G s,  G = [[1, 0, 0], [0, 1, 0], [mu, nu, lambda]]  along the mean viewing ray free (Belhumeur
et al. 1999): Lambert's images are the same. Lobes are not, whose half vectors turn otherwise than normals (Drbohlav and Sara 2002;
Georghiades 2003), nor is the spread of the albedos (Alldrin et al. 2007). mu, nu and log lambda minimise minus the log likelihood of drawn
pixels p,

    n mean_p log(scale_p / level_p) + H(log albedo),        n = lights / CORRELATED

scale_p is what normal and reflectance, solved under these lights with lobes tied to the object's (steps.py), leave of the pixel's
samples, level_p their root mean square; H is the entropy of the albedos with their chroma, by a kernel of SHADE. Three unknowns without
derivatives: COBYLA.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mvps.camera import pixel_centres, rays
from mvps.joint.blocks import DirectionalLights, Vertices
from mvps.joint.observe import ViewSamples, channel_ratio, grey_radiance, interior
from mvps.joint.pixels import WEIGHT_TIE
from mvps.joint.steps import CORRELATED, Anchor, free_reflectance, vertex_step, with_population
from mvps.mesh import lengths, normalise
from mvps.pixel_samples import light_shares
from mvps.scene import Bool, Camera, Float, Int, Law, View
from solvers.bounded import minimise

PIXELS = 800
"""Drawn: their mean log scale is known to a hundredth, and their distances to one another fit the cache."""

SHADE = 0.05
"""Kernel of the albedos' entropy, of their logarithm and chroma: shades of one paint, and the error of an albedo."""

FREE_STEPS, TIED_STEPS = 2, 3
LEAN = 0.3
"""Tie of the normals, radians, to where G puts them."""

REACH, FIRST_STEP, LAST_STEP, MOST_TRIED = 1.0, 0.15, 0.01, 60
"""Of mu, nu and log lambda: slopes of 45 degrees, reliefs a factor of e apart; a hundredth is half a degree."""


def _frame(camera: Camera, pixels: Int) -> Float:
    """(3, 3) rows: axes in the world, the third along the mean viewing ray."""
    axis = normalise(rays(camera, pixel_centres(pixels))[1].mean(0))
    first = normalise(np.cross(camera.rotation[1], axis))
    return np.stack([first, np.cross(axis, first), axis])


def _matrix(x: Float) -> Float:
    return np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [x[0], x[1], np.exp(x[2])]])


def turned(G: Float, normal: Float, albedo: Float, direction: Float, intensity: Float) -> tuple[Float, Float, Float, Float]:
    """Normals (n, 3) and albedo (n,), lights' directions (lights, 3) and intensities (lights,) after G (3, 3), their mean intensity as it
    was."""
    n, s = normal @ np.linalg.inv(G), (direction * intensity[:, None]) @ G.T
    size, strength = lengths(n), lengths(s)
    scale = strength.mean() / intensity.mean()
    return n / size[:, None], albedo * size * scale, s / strength[:, None], strength / scale


def _entropy(albedo: Float, chroma: Float) -> float:
    values = np.column_stack([np.log(np.maximum(albedo, 1e-12)), chroma])
    square = (values**2).sum(1)
    apart = np.maximum(square[:, None] + square[None] - 2 * values @ values.T, 0)
    return float(-np.log(np.exp(-apart / (2 * SHADE**2)).mean(1)).mean())


class _Pixels:
    """The drawn pixels, and how badly normals, albedos and lights fit them."""

    def __init__(self, view: View, ratio: Float, rows: Int, law: Law, device: torch.device) -> None:
        image, usable = grey_radiance(view, ratio)
        towards = -rays(view.camera, pixel_centres(view.pixels[rows]))[1]
        count = len(rows)
        self.samples = ViewSamples(
            torch.arange(count, device=device),
            torch.tensor(towards, dtype=torch.float32, device=device),
            torch.ones(count, device=device),
            torch.from_numpy(image[rows]).to(device),
            torch.from_numpy(usable[rows]).to(device),
        )
        total = np.maximum((view.samples[rows] / ratio.astype(np.float32) * light_shares(ratio)).sum(1), 1.0)
        self.chroma = np.log(total / total.mean(1, keepdims=True))
        self.law, self.device = law, device
        self.level = self.samples.image.square().mean(1).sqrt().clamp_min(1e-12)

    def loss(self, normal: Float, albedo: Float, direction: Float, intensity: Float) -> float:
        """Minus the log likelihood of a pixel."""
        n, a, light, strength = (torch.tensor(x, dtype=torch.float32, device=self.device) for x in (normal, albedo, direction, intensity))
        lights, views = [DirectionalLights(light, strength)], [self.samples]
        reflectance = torch.zeros(len(n), 1 + len(self.law.sharpness), device=self.device)
        reflectance[:, 0] = a
        free = free_reflectance(n, LEAN, reflectance.shape[1])
        state = Vertices(n, reflectance, a.median().expand(len(n)))
        for _ in range(FREE_STEPS):
            state = vertex_step(views, state, lights, self.law, free)
        for _ in range(TIED_STEPS):
            state = vertex_step(views, state, lights, self.law, _tied(state, free))
        fit = float((state.scale / self.level).log().mean())
        albedo = state.reflectance[:, 0].double().cpu().numpy()
        return len(direction) / CORRELATED * fit + _entropy(albedo, self.chroma)


def _tied(state: Vertices, free: Anchor) -> Anchor:
    """Lobes tied to the object's, but never closer than what one view knows of a lobe: the spread of what is tied shrinks by itself."""
    anchor = with_population(state, free)
    least = WEIGHT_TIE * float((state.reflectance.mean(0)).sum())
    spread = anchor.reflectance_sigma.clone()
    spread[:, 1:] = spread[:, 1:].clamp_min(least)
    return replace(anchor, reflectance_sigma=spread)


def bas_relief(
    view: View,
    normal: Float,
    albedo: Float,
    lights: tuple[Float, Float],
    law: Law,
    generator: np.random.Generator,
    device: torch.device,
    among: Bool | None = None,
) -> Float:
    """(3, 3) G, world frame, for normals (pixels, 3), world, and grey albedo (pixels,) of the view's foreground, and its lights' directions
    and intensities (lights, 3); among (pixels,): those that have a say, all by default. No motion where none has."""
    frame, (direction, intensity) = _frame(view.camera, view.pixels), lights
    rows = np.sort(generator.permutation(np.flatnonzero((interior(view) > 0) & (albedo > 0)))[:PIXELS])
    rows = rows if among is None else rows[among[rows]]
    if not len(rows):
        return np.eye(3)
    pixels = _Pixels(view, channel_ratio(intensity), rows, law, device)

    def matrix(x: Float) -> Float:
        G: Float = frame.T @ _matrix(x) @ frame
        return G

    def loss(x: Float) -> float:
        return pixels.loss(*turned(matrix(x), normal[rows], albedo[rows], direction, intensity.mean(1)))

    far = np.full(3, REACH)
    return matrix(minimise(loss, np.zeros(3), -far, far, FIRST_STEP, LAST_STEP, MOST_TRIED)[0])
