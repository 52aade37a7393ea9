"""Lights of one view of metals and the like, for which Lambert's law says nothing, by an object of two materials.

A patch of material m that faces along n, of albedo rho, sends under a light l of intensity e (shading.py)

    I_l = rho e_l f_ml(n),     f_ml(n) = (n . l)+ (w_m0 + gain sum_k w_mk exp(s_k (h . n - 1))),     w >= 0

Of a pixel's values, over their intensities, patches with normal n leave the part r(n) of exemplars.py, of the material that explains more,
and the pixel all in all

    L = -2 / m log sum_n r'(n)^(-m / 2),     r'(n) = r(n) (1 + |n - o|^2 / OUTLINE^2)^2 near the outline, r(n) elsewhere

for m values, all n of a grid, and o the normal that the outline tells. The mean of L falls, by gradients, over lights, intensities and
weights together. All that a metal's patches have in common is what tells its lights: exemplars that are of any material each say next to
nothing of them (docs/findings/one_view.md). A second material is for what is only in part of metal; it costs others nothing.

What is hardly told are turns of all lights and normals together: about the direction to the camera they change no r. Lights move each on
its own from where the silhouette has them, a little a step, and such a turn would need them all; given a step of its own it ends farther
off. Draws of pixels differ by it, and their mean is nearer than each.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from mvps.camera import pixel_centres, rays
from mvps.cores import on_cores
from mvps.correlation import sphere
from mvps.exemplars import Weights, enough, left_by_materials, patches
from mvps.material import SHARPNESS
from mvps.mesh import normalise
from mvps.pixel_samples import grey_under, lamp_colours
from mvps.scene import Float, Int, View
from solvers.adam import Adam

NORMALS = 1000
"""Directions on the whole sphere, 6.4 degrees apart."""

PIXELS, AT_OUTLINE = 400, 100
"""Drawn from all, and from those near the outline."""

DRAWS = 4
"""Of pixels: two for each of two cores."""

OUTLINE = 0.2
"""Radians by which normals near the outline are off, if they are what it tells."""

AS_ROUGH = 0.15
"""Radians along a tangent by which the silhouette's lights are off: 12 degrees in the mean (docs/findings/one_view.md)."""

BODY = 20.0
"""Weight of the second material's body at first, over its lobes' and all of the first's: the two must differ to become different."""

ALONE, TOGETHER = 40, 300
"""Steps of the weights under the lights so far, and of everything: 600 leave as little."""

LIGHT_RATE, WEIGHT_RATE, ALONE_RATE = 0.01, 0.05, 0.1
"""Of Adam, radians and logarithms a step; the first two fall to a tenth."""


class _Asked(NamedTuple):
    """Of some pixels: values (p, lights), usable (p, lights), and the logarithm of r' / r (p, n); normals (n, 3) of patches; towards (1, 3)
    the camera."""

    image: Tensor
    usable: Tensor
    told: Tensor
    normal: Tensor
    towards: Tensor


def lights_by_materials(view: View, lights: Float, rough: Float, outline: Int, device: torch.device, seed: int) -> tuple[Float, float]:
    """(lights, 3) intensity times direction, camera frame, from rough ones (lights, 3), and the variance of a direction along a tangent,
    radians^2: mean of DRAWS, and how they scatter.

    rough (pixels, 3): normals of the silhouette, camera frame, which pixels near the outline (n,) have but for OUTLINE. Where no pixel has
    values enough, lights stay.
    """
    if not enough(view).any():
        return lights, AS_ROUGH**2
    draws = np.random.SeedSequence(seed).spawn(DRAWS)
    found = np.stack(on_cores(lambda draw: _lights(view, lights, rough, outline, device, np.random.default_rng(draw)), draws))
    strength = np.linalg.norm(found, axis=2, keepdims=True)
    direction = found / strength
    mean = normalise(direction.mean(0))
    scatter = ((direction - mean) ** 2).sum((0, 2)).mean() / (DRAWS - 1)
    return mean * np.exp(np.log(strength).mean(0)), float(scatter / 2)


def _lights(view: View, lights: Float, rough: Float, outline: Int, device: torch.device, draw: np.random.Generator) -> Float:
    """(lights, 3) by one draw of pixels."""
    asked, strength = _asked(view, lamp_colours(view), rough, outline, device, draw), np.linalg.norm(lights, axis=1)
    usual = np.exp(np.log(strength).mean())
    relative = np.log(strength / usual)
    start, level = (torch.from_numpy(a.astype(np.float32)).to(device) for a in (lights / strength[:, None], relative))
    weights, turns, stronger = _solved_weights(asked, start, level), torch.zeros_like(start), torch.zeros_like(level)

    def so_far() -> tuple[Tensor, Tensor]:
        return normalize(start + turns, dim=1), level + stronger - stronger.mean()

    rates = (LIGHT_RATE, LIGHT_RATE, WEIGHT_RATE)
    _descend([turns, stronger, weights], rates, TOGETHER, lambda: _loss(asked, *so_far(), weights))
    direction, intensity = so_far()
    found: Float = usual * (direction * intensity.exp()[:, None]).double().cpu().numpy()
    return found


def materials_under(view: View, direction: Float, intensity: Float, device: torch.device) -> Weights:
    """Weights (2, 1 + lobes) of the object's materials under lights direction, intensity (lights, 3); all one where no pixel has values
    enough."""
    if not enough(view).any():
        return np.ones((2, 1 + len(SHARPNESS)), np.float32)
    nowhere = np.zeros((len(view.pixels), 3))
    colour = intensity / intensity.mean(1, keepdims=True)
    asked = _asked(view, colour, nowhere, np.zeros(0, int), device, np.random.default_rng(0))
    light = direction @ view.camera.rotation.T
    relative = np.log(intensity.mean(1)) - np.log(intensity.mean(1)).mean()
    known, level = (torch.from_numpy(a.astype(np.float32)).to(device) for a in (light, relative))
    found: Weights = _solved_weights(asked, known, level).exp().cpu().numpy()
    return found


def _asked(view: View, colour: Float, rough: Float, outline: Int, device: torch.device, draw: np.random.Generator) -> _Asked:
    """Pixels to be asked under lights of colour (lights, 3), mean one, those near the outline (n,) last."""
    usable, known = view.usable(), enough(view)
    anywhere = draw.permutation(np.flatnonzero(known))[:PIXELS]
    rows = np.concatenate([anywhere, draw.permutation(outline[known[outline]])[:AT_OUTLINE]])
    towards = normalise(-rays(view.camera, pixel_centres(view.pixels[rows]))[1].mean(0)[None]) @ view.camera.rotation.T
    grid = sphere(NORMALS)
    grid = grid[grid @ towards[0] > 0]
    off = ((rough[rows, None] - grid) ** 2).sum(-1) / OUTLINE**2
    off[: len(anywhere)] = 0
    image = np.where(usable[rows], grey_under(view.samples[rows], colour), 0)
    arrays = (image, usable[rows], 2 * np.log1p(off), grid, towards)
    return _Asked(*(torch.from_numpy(a.astype(np.float32)).to(device) for a in arrays))


def _loss(asked: _Asked, direction: Tensor, level: Tensor, weights: Tensor) -> Tensor:
    """Mean of L for lights of direction (lights, 3), logarithm of intensity level (lights,) and of weights (2, 1 + lobes)."""
    image = normalize(asked.image * (-level).exp(), dim=1)
    left, *_ = left_by_materials(image, asked.usable, patches(asked.normal, asked.towards, direction), weights.exp())
    half = asked.usable.sum(1, keepdim=True) / 2
    return -(torch.logsumexp(-half * (left.log() + asked.told), 1) / half[:, 0]).mean()


def _solved_weights(asked: _Asked, direction: Tensor, level: Tensor) -> Tensor:
    """(2, 1 + lobes) logarithms of the weights under lights that stay."""
    weights = direction.new_zeros(2, 1 + len(SHARPNESS))
    weights[1, 0] = np.log(BODY)
    _descend([weights], (ALONE_RATE,), ALONE, lambda: _loss(asked, direction, level, weights), falls=False)
    return weights


def _descend(unknown: list[Tensor], rates: tuple[float, ...], steps: int, loss: Callable[[], Tensor], falls: bool = True) -> None:
    """Steps of Adam, in place."""
    torch.set_num_threads(1)
    for values in unknown:
        values.requires_grad_(True)
    adam = Adam(unknown, (0.9, 0.99), 1e-8)
    with ThreadPoolExecutor(1) as pool:
        for step in range(steps):
            slower = 1 - 0.9 * step / steps if falls else 1.0
            gradients = torch.autograd.grad(loss(), unknown)
            adam.step([[gradient.contiguous()] for gradient in gradients], [rate * slower for rate in rates], pool)
    for values in unknown:
        values.requires_grad_(False)
