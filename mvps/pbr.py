"""From albedo and spherical Gaussians to the metallic-roughness model of glTF 2.0 (its appendix B).

Ours, pi times the reflection factor up to the unknown exposure g:   albedo + sum_k w_k exp(s_k (h.n - 1))
glTF's, times pi, without masking and Fresnel's rise:                base + F0 pi D(h.n) / 4,   D = GGX, pi D(1) = 1 / alpha^2

Both lobes get the same peak and the same integral over half vectors. The integral of exp(s (h.n - 1)) is 2 pi / s (up to
e^-2s), and GGX, whose projected integral is 1, has pi alpha^2 per unit of its peak, so with W = sum_k w_k, E = sum_k w_k / s_k

    alpha^2 = 2 E / W   (one lobe: s = 2 / alpha^2, as for Beckmann's),     roughness = sqrt(alpha),
    F0      = 4 alpha^2 W / g = 8 E / g,       base = albedo / g.

The exposure g is not observable. It is chosen so that base + F0, the share of light reflected, reaches 1 on the brightest
thousandth of the surface. Metallic is 0 everywhere: F0 carries the colour of a metal, by KHR_materials_specular.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.scene import Float, Material

BRIGHTEST = 99.9
"""Percentile of the reflectance that becomes 1: one vertex in a thousand may be an outlier and is clipped."""
SMOOTHEST = 1e-4
"""Smallest alpha^2: half of a sharper lobe (s over 20000) lies within half a degree, less than normals are known to."""


def specular_energy(specular_weight: Float, sharpness: Float) -> Float:
    """(n, 3) 8 sum_k w_k / s_k, which is g F0, from weights (n, lobes) or (n, lobes, 3) and sharpness (lobes,)."""
    weight = specular_weight if specular_weight.ndim == 3 else specular_weight[..., None].repeat(3, -1)
    energy: Float = 8 * np.einsum("nkc,k->nc", weight, 1 / sharpness)
    return energy


def roughness(specular_weight: Float, sharpness: Float) -> Float:
    """(n,) roughness of glTF in [0, 1]; 1 where there is no specular reflection."""
    weight = specular_weight.mean(-1) if specular_weight.ndim == 3 else specular_weight
    total = weight.sum(1)
    alpha_squared = np.divide(2 * (weight @ (1 / sharpness)), total, out=np.ones(len(weight)), where=total > 0)
    rough: Float = alpha_squared.clip(SMOOTHEST, 1) ** 0.25
    return rough


def reflectance_scale(material: Material) -> float:
    """g of the model above for a material's vertices: what albedo is divided by so that colours lie in [0, 1]."""
    return white_level(material.albedo + specular_energy(material.specular_weight, material.sharpness))


def white_level(reflectance: Float) -> float:
    """The level of the brightest thousandth of reflectances (n, 3), by their brightest channel; 1 where all are black."""
    brightest = reflectance.max(1)
    return (float(np.percentile(brightest, BRIGHTEST)) or float(brightest.max()) or 1.0) if len(brightest) else 1.0


def srgb_bytes(linear: Float) -> NDArray[np.uint8]:
    """8-bit sRGB (IEC 61966-2-1) of linear values, clipped to [0, 1]."""
    x: Any = np.clip(linear, 0, 1)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)
    coded: NDArray[np.uint8] = np.rint(encoded * 255).astype(np.uint8)
    return coded
