"""The image model: albedo and spherical Gaussians under directional light. Differentiable (torch), any device.

    radiance / intensity = visibility * (albedo D(n . l) D(n . v) + gain sum_k weight_k exp(sharpness_k (h . n - 1))) max(n . l, 0)
    h = (v + l) / |v + l|,   so that   h . n = (n . v + n . l) / sqrt(2 + 2 v . l)
    gain = 1 / (h . v)^2 = 4 / (2 + 2 v . l), STEEPEST at most
    D(x) = 1 + grazing (1 - x)^p

Distributions of microfacets (GGX: Walter et al. 2007, eq. 33, 1 at its peak) may take the Gaussians' place,

    (1 + sharpness (1 - (h . n)^2) / 4)^-2,   which is alpha^4 / (1 - (1 - alpha^2) (h . n)^2)^2 with alpha^2 = 4 / (4 + sharpness),

of the same peak and the same slope there, but with longer tails.

gain is what a distribution of microfacets gains where light and view part, masking included (Kelemen and Szirmay-Kalos 2001).

D is what keeps a diffuse body from being Lambert's: a glossy coat lets less light in and out at grazing angles, a rough body sends more
back. Product and power follow Schlick 1994 and Burley 2012; p is GRAZING_POWER.

(spherical-Gaussian lobes over the half vector: Yang et al. 2022, eq. 9; Wang et al. 2009). Only three matrix products per
view are needed, n . l, v . l and n . v; everything else is elementwise on (points, lights).
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvps.scene import Float, Law

GRAZING_POWER = 3
"""Of (1 - cosine) in the diffuse term's grazing factor. Measured falloffs of two materials ask for 3 and 4; Schlick's dielectrics have
5 (docs/findings/reflectance.md)."""

QUADRATURE = 64
"""Nodes of Gauss and Legendre: enough for sharpness up to 10^4."""

DARKEST = 0.01
"""Least share of what it receives that the median point of an object returns: black paint returns 3 to 5 %, velvet about 1."""

FAINTEST = -30.0
"""Least logarithm of a Gaussian lobe's value: 1e-13 of its peak no photograph shows, and the value's square is still a normal number in
float32. Below that processors take ten times as long over every product (docs/findings/cost.md)."""

PARALLEL = 1e-6
"""Floor of 2 + 2 v.l: view and light exactly opposite have no half vector (and such a point is never lit and seen)."""


STEEPEST = 4.0
"""Largest gain, with light and view 120 degrees apart: beyond, masking takes over. The light between a copper object's walls is predicted
alike with 4, 16 and 100 (docs/findings/reflectance.md)."""


def half_length(v_dot_l: Tensor) -> Tensor:
    """|v + l| for v . l."""
    return (2 * v_dot_l).add_(2).clamp_min(PARALLEL).sqrt_()


def gain(length: Tensor) -> Tensor:
    """Of lobes, for |v + l|."""
    return (4 / length.square()).clamp_max(STEEPEST)


def gain_of(length: NDArray[np.float32]) -> NDArray[np.float32]:
    """`gain` of an array."""
    values: NDArray[np.float32] = gain(torch.from_numpy(length)).numpy()
    return values


def half_dot_normal(n_dot_v: Tensor, n_dot_l: Tensor, v_dot_l: Tensor) -> Tensor:
    """h . n for n . v (points, 1), n . l (points, lights) and v . l (points, lights). Where view and light are opposite, rounding would
    take it out of [-1, 1]."""
    return ((n_dot_v + n_dot_l) / half_length(v_dot_l)).clamp(-1, 1)


def lobe(h_dot_n: Tensor, sharpness: float | Tensor, microfacet: bool) -> tuple[Tensor, Tensor | float]:
    """A lobe's value (...) for h . n (...), and the derivative of its logarithm by h . n."""
    if not microfacet:
        return (h_dot_n - 1).mul_(sharpness).clamp_min(FAINTEST).exp_(), sharpness
    spread = 1 + sharpness / 4 * (1 - h_dot_n**2)
    return spread**-2, sharpness * h_dot_n / spread


def lobes(h_dot_n: Tensor, law: Law, spread: Tensor | None = None) -> Tensor:
    """(..., lobes) values of the law's lobes for h . n (...).

    spread (lights,): variance of the directions that a light stands for, radians^2 (illumination.py). Half vectors turn half as far, so a
    lobe is s / (1 + s spread / 4) sharp, and of as much less height that it returns the same (as in Toksvig 2005).
    """
    if spread is None:
        values = [lobe(h_dot_n, s, law.microfacet)[0] for s in law.sharpness]
    else:
        duller = [1 / (1 + s * spread / 4) for s in law.sharpness]
        values = [lobe(h_dot_n, s * d, law.microfacet)[0] * d for s, d in zip(law.sharpness, duller, strict=True)]
    return torch.stack(values, -1) if values else h_dot_n.new_zeros(*h_dot_n.shape, 0)


def lobes_of(h_dot_n: Float, law: Law) -> NDArray[np.float64]:
    """`lobes` of an array."""
    values: NDArray[np.float64] = lobes(torch.from_numpy(h_dot_n), law).numpy()
    return values


def lobe_of(h_dot_n: NDArray[np.float32], sharpness: NDArray[np.float32], microfacet: bool) -> NDArray[np.float32]:
    """`lobe` of arrays, with a sharpness for each value."""
    values: NDArray[np.float32] = lobe(torch.from_numpy(h_dot_n), torch.from_numpy(sharpness), microfacet)[0].numpy()
    return values


@functools.cache
def returned(sharpness: tuple[float, ...], microfacet: bool) -> NDArray[np.float64]:
    """(1 + lobes,) what a point returns of light from everywhere, over that of a white diffuse one, by its albedo and weights, seen from
    above: 1 for the albedo, and for a lobe, with u = h.n,

        1/pi int gain lobe(h.n) n.l dl = 8 int gain lobe(u) (2 u^2 - 1) u du from sqrt(1/2) to 1,     gain = 1 / u^2
    """
    u, weight = np.polynomial.legendre.leggauss(QUADRATURE)
    low = np.sqrt(0.5)
    u = low + (1 - low) * (u + 1) / 2
    gained = gain(torch.from_numpy(2 * u)).numpy()
    values = (lobe(torch.from_numpy(u), s, microfacet)[0].numpy() for s in sharpness)
    return np.array([1.0, *(4 * (1 - low) * float(weight @ (gained * value * (2 * u**2 - 1) * u)) for value in values)])


def most_albedo(reflectance: Tensor, law: Law) -> float:
    """What no albedo of an object exceeds whose points have reflectance (n, 1 + lobes), albedo and weights: no surface returns more than
    all, and the median point DARKEST of it at least. Infinite where nothing is reflected."""
    of_all = reflectance.double() @ torch.from_numpy(returned(law.sharpness, law.microfacet)).to(reflectance.device)
    usual = float(of_all.median()) if len(of_all) else 0.0
    return usual / DARKEST if usual else np.inf


def against(vectors: Tensor, light: Tensor) -> Tensor:
    """(points, lights) dot products of vectors (points, 3) with lights (lights, 3), or with each point's own (points, lights, 3)."""
    return vectors @ light.T if light.ndim == 2 else (light @ vectors[..., None])[..., 0]


def shade(
    normal: Tensor, view: Tensor, light: Tensor, albedo: Tensor, specular_weight: Tensor, law: Law, spread: Tensor | None = None
) -> Tensor:
    """Radiance over intensity (points, lights, 3), attached shadow included, cast shadow not.

    normal, view (points, 3) unit; light (lights, 3) unit, or (points, lights, 3) where every point has its own; albedo (points, 3);
    specular_weight (points, lobes) or (points, lobes, 3). All in one frame. spread (lights,): of lights that stand for many (`lobes`).
    """
    n_dot_l = against(normal, light)
    n_dot_v = (normal * view).sum(-1, keepdim=True)
    v_dot_l = against(view, light)
    h_dot_n = half_dot_normal(n_dot_v, n_dot_l, v_dot_l)
    D_l, D_v = (1 + law.grazing * (1 - x.clamp_min(0)) ** GRAZING_POWER for x in (n_dot_l, n_dot_v))
    weight = specular_weight if specular_weight.ndim == 3 else specular_weight[..., None].expand(-1, -1, 3)
    specular = gain(half_length(v_dot_l))[..., None] * (lobes(h_dot_n, law, spread) @ weight)
    return (albedo[:, None] * (D_l * D_v)[..., None] + specular) * n_dot_l.clamp_min(0)[..., None]
