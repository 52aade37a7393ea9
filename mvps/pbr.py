"""From albedo and spherical Gaussians to the metallic-roughness model of glTF 2.0 (its appendix B, KHR_materials_specular).

Ours, pi times the reflection factor up to the unknown exposure g:   albedo + sum_k w_k lobe_k(h.n) / (h.v)^2
glTF's, times pi:           base (1 - max F) + pi F D V,   F = F0 + (1 - F0) (1 - v.h)^5,   D GGX of alpha = roughness^2, V Smith's

alpha and F0 are those with which g F0 pi D V comes closest to the lobes, by least squares over the directions that a camera sees beside
its lights (`_directions`), cosine of incidence included. With M(alpha) = <lobes, pi D V> / |pi D V| that is the alpha of the largest
w . M(alpha), and g F0 = w . M / |pi D V|. Fresnel's rise is left out of the fit: lights within SPREAD of the camera lie far from it.

    base = albedo / (g (1 - max F0)),   because glTF takes what is reflected from what enters the body.

The exposure g is not observable. It is chosen so that base is at most 1, albedo / g + max F0 <= 1, but for the brightest thousandth of
the surface. Metallic is 0 everywhere: F0 carries the colour of a metal, by KHR_materials_specular.

Without masking a lobe and GGX of one peak and one integral over half vectors have  alpha^2 = 2 / s  and  F0 = 8 w / (s g)
(`specular_energy`): what edits of a material and the pictures' white level go by.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.scene import Float, Law, Material
from mvps.shading import lobes_of

BRIGHTEST = 99.9
"""Percentile of the reflectance that becomes 1: one vertex in a thousand may be an outlier and is clipped."""
SMOOTHEST, ALPHAS = 1e-2, 64
"""Smallest alpha: half of a sharper lobe (s over 20000) lies within half a degree, less than normals are known to; and how many are tried,
at equal ratios, from half the alpha of the sharpest lobe to twice that of the widest."""
SPREAD = np.radians(50)
"""Largest angle between light and view: photometric stereo's lights surround the camera."""
STEEPEST = np.radians(75)
"""Largest angle between normal and half vector: beyond it light or view are below the horizon, or nearly."""
ROWS_PER_CHUNK = 1 << 16


def specular_energy(specular_weight: Float, sharpness: Float) -> Float:
    """(n, 3) 8 sum_k w_k / s_k, which is g F0, from weights (n, lobes) or (n, lobes, 3) and sharpness (lobes,)."""
    weight = specular_weight if specular_weight.ndim == 3 else specular_weight[..., None].repeat(3, -1)
    energy: Float = 8 * np.einsum("nkc,k->nc", weight, 1 / sharpness)
    return energy


def glossy(specular_weight: Float, law: Law) -> tuple[Float, Float]:
    """(n,) roughness of glTF in [0, 1], 1 where there is no specular reflection, and (n, 3) g F0, from weights (n, lobes[, 3]) of a law."""
    weight = specular_weight if specular_weight.ndim == 3 else specular_weight[..., None]
    rough, reflected = np.ones(len(weight)), np.zeros((len(weight), 3))
    shining = np.flatnonzero(weight.any((1, 2)))
    if len(shining):
        alpha, alike, length = _alike(law)
    for start in range(0, len(shining), ROWS_PER_CHUNK):
        part = shining[start : start + ROWS_PER_CHUNK]
        of_part = weight[part].astype(np.float32)
        best = (of_part.mean(-1) @ alike).argmax(1)
        rough[part] = np.sqrt(alpha[best])
        reflected[part] = np.einsum("nkc,nk->nc", of_part, (alike / length).T[best])
    return rough, reflected


def fit_error(specular_weight: Float, law: Law) -> float:
    """Root mean square difference between lobes with weights (n, lobes[, 3]) of a law and glTF's, over the lobes' own root mean square,
    over all n and the directions of the fit; 0 without lobes."""
    weight = specular_weight if specular_weight.ndim == 3 else specular_weight[..., None].repeat(3, -1)
    if not weight.any():
        return 0.0
    alpha, alike, length = _alike(law)
    rough, reflected = glossy(weight, law)
    chosen = np.abs(alpha - rough[:, None] ** 2).argmin(1)
    # |L w - F g|^2 with the columns L of our lobes and glTF's g: their products among each other are known.
    ours = np.einsum("nkc,km,nmc->", weight, _among(law), weight)
    both = np.einsum("nkc,nk,nc->", weight, (alike * length).T[chosen], reflected)
    theirs = np.einsum("nc,n->", reflected**2, length[chosen] ** 2)
    return float(np.sqrt(max(ours - 2 * both + theirs, 0.0) / ours))


@lru_cache(maxsize=8)
def _among(law: Law) -> Float:
    """(lobes, lobes) products of the lobes over the directions of the fit."""
    ours = _lobes(law, *_directions())
    products: Float = ours.T @ ours
    return products


def _lobes(law: Law, n_dot_l: Float, _: Float, h_dot_n: Float, h_dot_v: Float, share: Float) -> Float:
    """(n, lobes) of the directions, by their share."""
    return lobes_of(h_dot_n, law) * (share * n_dot_l / h_dot_v**2)[:, None]


@lru_cache(maxsize=8)
def _alike(law: Law) -> tuple[Float, NDArray[np.float32], NDArray[np.float32]]:
    """alpha (ALPHAS,) that are tried; M (lobes, ALPHAS); |pi D V| (ALPHAS,)."""
    n_dot_l, n_dot_v, h_dot_n, _, share = directions = _directions()
    widest, sharpest = (np.sqrt(2 / s) for s in (min(law.sharpness), max(law.sharpness)))
    alpha = np.geomspace(np.clip(sharpest / 2, SMOOTHEST, 1), np.clip(2 * widest, SMOOTHEST, 1), ALPHAS)
    ours = _lobes(law, *directions)
    square = alpha**2
    smith = [x[:, None] + np.sqrt(square + (1 - square) * x[:, None] ** 2) for x in (n_dot_l, n_dot_v)]
    ggx = square / (h_dot_n[:, None] ** 2 * (square - 1) + 1) ** 2 / (smith[0] * smith[1]) * (share * n_dot_l)[:, None]
    length = np.linalg.norm(ggx, axis=0)
    return alpha, (ours.T @ ggx / length).astype(np.float32), length.astype(np.float32)


def _directions() -> tuple[Float, Float, Float, Float, Float]:
    """n.l, n.v, h.n, h.v (n,) of pairs of light and view up to SPREAD apart, and the root of their share of a picture: pixels, that is n.v
    of solid angle, times the light's solid angle. Half vectors lie densely around the normal, where sharp lobes are."""
    t, d, turn = np.meshgrid((np.arange(96) + 0.5) / 96, (np.arange(8) + 0.5) / 8, (np.arange(12) + 0.5) / 12, indexing="ij")
    tilt, apart, around = (a.ravel() for a in (STEEPEST * t**3, SPREAD / 2 * d, 2 * np.pi * turn))
    side = np.sin(tilt) * np.sin(apart) * np.cos(around)
    n_dot_l, n_dot_v = (np.cos(tilt) * np.cos(apart) + sign * side for sign in (1, -1))
    # Of h and the angle between h and v:  dl dv = 4 cos(apart) sin(apart) sin(tilt), and  d tilt ~ t^2 dt.
    share = n_dot_v * np.cos(apart) * np.sin(apart) * np.sin(tilt) * t.ravel() ** 2
    above = (n_dot_l > 0) & (n_dot_v > 0)
    return n_dot_l[above], n_dot_v[above], np.cos(tilt)[above], np.cos(apart)[above], np.sqrt(share[above])


def reflectance_scale(material: Material) -> float:
    """g of the model above for a material's vertices: what albedo is divided by so that colours lie in [0, 1]."""
    return white_level(material.albedo + specular_energy(material.specular_weight, material.sharpness))


def white_level(reflectance: Float) -> float:
    """The level of the brightest thousandth of reflectances (n, 3), by their brightest channel; 1 where all are black."""
    brightest = reflectance.max(1)
    return (float(np.percentile(brightest, BRIGHTEST)) or float(brightest.max()) or 1.0) if len(brightest) else 1.0


def linear_of_srgb(code: Float) -> Float:
    """Linear values of sRGB ones, both in [0, 1] (IEC 61966-2-1)."""
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def srgb_bytes(linear: Float) -> NDArray[np.uint8]:
    """8-bit sRGB (IEC 61966-2-1) of linear values, clipped to [0, 1]."""
    x: Any = np.clip(linear, 0, 1)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)
    coded: NDArray[np.uint8] = np.rint(encoded * 255).astype(np.uint8)
    return coded
