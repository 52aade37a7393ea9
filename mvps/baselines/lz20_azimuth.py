"""LZ20, first step: the azimuth of the normal at every pixel of a view, from isotropy.

An isotropic surface with normal n, seen along v, reflects alike under two lights that are each other's image in the plane of v and n
(Alldrin and Kriegman 2007). So the azimuth is that half-plane through v about which the pixel's observations are symmetric. With T a unit
vector at right angles to it and l' = l - 2 (l . T) T,

    D_k(T) = I(l_k) - I(l'_k),      T = argmin sum_k w_k log(1 + (D_k / s)^2).

No light stands at l'_k. There the observation is interpolated as the linear function of the direction that fits the pixel best (Lambert's
law, robust) plus a mean of the other lights' residuals e, weighted by a Gaussian kernel on the sphere as wide as lights are apart. For a
matt pixel e vanishes and the answer is Lambert's azimuth; a wide lobe is in e. Dark samples (cast or attached shadow) and clipped ones are
left out; highlights narrower than the lights are apart find no mirrored partner and are outvoted. s is Cauchy's scale from the spread of e.

Of the two half-planes of a symmetry plane the surface faces the one on which it is brighter.

The same T is the direction of the iso-depth contour through the point: points of constant distance to the camera move at right angles to v,
on the surface at right angles to n, hence along v x n, which the azimuth alone determines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvps.camera import pixel_centres, rays
from mvps.cores import on_cores
from mvps.mesh import cross, normalise
from mvps.scene import Bool, Camera, Capture, Float, Int, Lights
from solvers.least_squares import cauchy_weights, weighted_rows
from solvers.low_rank import CAUCHY_95

Array = NDArray[Any]

PLANES = 45
"""Planes of symmetry that are tried, over 180 degrees: 4 degrees apart, less than a quarter of the distance between lights."""

TILE = 0.02
"""Radians between pixels that share the kernel of mirrored lights; the linear part is each pixel's own."""

DARK = 0.1
"""Of the pixel's 80 % quantile: samples below are in shadow."""

UNPAIRED = 0.1
"""Weight of a sample near whose mirrored light no other stands, so that the linear part is all there is to compare it with."""

SWEEPS = 6
STEPS = 4
LEAST_SAMPLES = 4
"""Three lights fit the linear part exactly; what a fourth says shows how well."""


@dataclass(frozen=True, eq=False)
class Azimuths:
    """At a view's foreground pixels: along (pixels, 3) unit, world frame, the direction T of the iso-depth contour; sigma (pixels,) the
    standard deviation of T . n, infinite where the observations do not tell. The azimuth's direction is T x v.
    """

    along: NDArray[np.float32]
    sigma: NDArray[np.float32]


class Fit(NamedTuple):
    """Linear functions of the light's direction at n pixels: b (n, 3); residual, robust weight, lit (n, lights); Cauchy's scale (n, 1)."""

    b: Tensor
    residual: Tensor
    weight: Tensor
    lit: Tensor
    scale: Tensor


class Frame(NamedTuple):
    """Lights and b in the pixels' frames: along x and y each, (n, lights) and (n, 1)."""

    light: tuple[Tensor, Tensor]
    b: tuple[Tensor, Tensor]


def azimuths(capture: Capture, lights: Lights) -> tuple[Azimuths, ...]:
    """`azimuths_of` the pixels of every view, on all cores."""
    torch.set_num_threads(1)

    def of_view(i: int) -> Azimuths:
        view = capture.views[i]
        image = (view.radiance() / lights.intensity[i].astype(np.float32)).mean(-1)
        towards = -rays(view.camera, pixel_centres(view.pixels))[1]
        noise = float(view.scale / np.mean(lights.intensity[i]))
        return azimuths_of(image, view.usable(), lights.direction[i], towards, view.camera, noise)

    return tuple(on_cores(of_view, range(len(capture.views))))


def azimuths_of(image: Array, known: Bool, light: Float, towards: Float, camera: Camera, noise: float) -> Azimuths:
    """The azimuths at n pixels with radiance over intensity image (n, lights), where it is known (n, lights); light (lights, 3) and
    towards, to the camera, (n, 3): unit, world frame. noise: of a sample."""
    along = np.zeros((len(image), 3), np.float32)
    sigma = np.full(len(image), np.inf, np.float32)
    x, y = pixel_frames(camera, towards)
    for part in _tiles(camera, towards):
        lit = known[part] & (image[part] > DARK * np.quantile(image[part], 0.8, axis=1, keepdims=True))
        fit = linear_fit(torch.tensor(image[part], dtype=torch.float64), torch.tensor(lit), torch.tensor(light), noise)
        angle, spread = _symmetric(fit, light, x[part], y[part])
        c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
        T, b = c * y[part] - s * x[part], fit.b.numpy()
        # The brighter side: b . (T x v) > 0.
        T *= np.where(np.einsum("ni,ni->n", b, cross(T, towards[part])) < 0, -1, 1)[:, None]
        slant = np.sqrt(np.maximum(1 - np.einsum("ni,ni->n", normalise(b), towards[part]) ** 2, 0))
        along[part], sigma[part] = T, np.where(lit.sum(1) >= LEAST_SAMPLES, spread * slant, np.inf)
    return Azimuths(along, sigma)


def pixel_frames(camera: Camera, towards: Float) -> tuple[Float, Float]:
    """Two unit vectors (n, 3) each at right angles to towards (n, 3) and to one another; the first lies along the camera's rows."""
    right = np.broadcast_to(camera.rotation[0], towards.shape)
    x = normalise(right - np.einsum("ni,ni->n", right, towards)[:, None] * towards)
    return x, cross(towards, x)


def _tiles(camera: Camera, towards: Float) -> list[Int]:
    """Groups of pixels whose lines of sight differ by no more than about TILE radians."""
    local = towards @ camera.rotation.T
    column, row = (np.floor(local[:, k] / local[:, 2] / TILE).astype(np.int64) for k in (0, 1))
    _, group = np.unique(np.stack([column, row], 1), axis=0, return_inverse=True)
    order = np.argsort(group.ravel(), kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group.ravel()[order])) + 1)


def linear_fit(image: Tensor, lit: Tensor, light: Tensor, noise: float) -> Fit:
    """Robust Lambert: image (n, lights) = b . light (lights, 3) over the samples that are lit (n, lights)."""
    weight = lit.to(image.dtype)
    for _ in range(SWEEPS):
        b = weighted_rows(image, weight, light, ridge=1e-6)
        residual = image - b @ light.T
        weight = cauchy_weights(residual, lit, noise)
    # The scale that made the weights: 1 / w = 1 + (r / s)^2.
    ratio = torch.where(lit, residual**2 * weight, 0).sum(1) / torch.where(lit, 1 - weight, 0).sum(1).clamp_min(1e-12)
    scale = ratio.sqrt()[:, None].clamp_min(CAUCHY_95 * noise)
    return Fit(b, residual.float(), weight.float(), lit.float(), scale.float())


def _symmetric(fit: Fit, light: Float, x: Float, y: Float) -> tuple[Array, Array]:
    """Angle (n,) of the plane of symmetry from x to y, and its standard deviation (n,)."""
    middle = normalise(x.mean(0)), normalise(y.mean(0))
    axes = [torch.tensor(axis) for axis in (x, y)]
    of_lights = [(axis @ torch.tensor(light).T).float() for axis in axes]
    of_b = [(fit.b * axis).sum(1, keepdim=True).float() for axis in axes]
    frame = Frame((of_lights[0], of_lights[1]), (of_b[0], of_b[1]))
    weighted = fit.weight * fit.residual
    costs = []
    best = torch.full_like(fit.scale, torch.inf)
    shares, rest = torch.zeros_like(weighted), torch.zeros_like(weighted)
    width = _spacing(light)
    for k in range(PLANES):
        c, s = float(np.cos(np.pi * k / PLANES)), float(np.sin(np.pi * k / PLANES))
        kernel = _mirrored_kernel(light, c * middle[1] - s * middle[0], width)
        mass = fit.weight @ kernel
        other = fit.residual - (weighted @ kernel) / mass.clamp_min(1e-6)
        share = fit.lit * mass.clamp(UNPAIRED, 1)
        across, beside = (c * of[1] - s * of[0] for of in frame)
        difference = (other + 2 * across * beside) / fit.scale
        cost = (share * torch.log1p(difference**2)).sum(1, keepdim=True) / share.sum(1, keepdim=True).clamp_min(1e-6)
        better = cost < best
        best, shares, rest = torch.where(better, cost, best), torch.where(better, share, shares), torch.where(better, other, rest)
        costs.append(cost)
    start = np.pi / PLANES * torch.cat(costs, 1).argmin(1, keepdim=True)
    return _refined(start, shares, rest, fit.scale, frame)


def _spacing(light: Float) -> float:
    """Median angle, radians, from a light to its nearest neighbour."""
    cosine = np.clip(light @ light.T, -1, 1)
    np.fill_diagonal(cosine, -1)
    return float(np.median(np.arccos(cosine.max(1))))


def _mirrored_kernel(light: Float, T: Float, width: float) -> Tensor:
    """(lights, lights) weight of light j for the mirrored light k in entry j, k."""
    mirrored = light - 2 * (light @ T)[:, None] * T
    return torch.tensor(np.exp((light @ mirrored.T - 1) / width**2), dtype=torch.float32)


def _refined(start: Tensor, share: Tensor, rest: Tensor, scale: Tensor, frame: Frame) -> tuple[Array, Array]:
    """Gauss and Newton's steps of the angle, the interpolated residuals left as they are, at most half the way to the next plane."""
    angle, reach = start, np.pi / PLANES / 2
    for _ in range(STEPS):
        c, s = angle.cos(), angle.sin()
        across, beside = (c * of[1] - s * of[0] for of in frame)
        along, slope = (c * of[0] + s * of[1] for of in frame)
        difference = (rest + 2 * across * beside) / scale
        # Both turn with the plane: d across = -along, d beside = -slope.
        turn = -2 * (along * beside + across * slope) / scale
        weight = share / (1 + difference**2)
        curvature = (weight * turn**2).sum(1, keepdim=True).clamp_min(1e-12)
        step = (weight * turn * difference).sum(1, keepdim=True) / curvature
        angle = torch.minimum(torch.maximum(angle - step, start - reach), start + reach)
    # Of Cauchy's cost with the scale of 95 % efficiency; every pair counts twice and has the noise of two.
    return angle[:, 0].double().numpy(), (1 / (CAUCHY_95 * curvature.sqrt()))[:, 0].numpy()
