"""The image model: albedo and spherical Gaussians under directional light. Differentiable (torch), any device.

    radiance / intensity = visibility * (albedo D(n . l) D(n . v) + sum_k weight_k exp(sharpness_k (h . n - 1))) max(n . l, 0)
    h = (v + l) / |v + l|,   so that   h . n = (n . v + n . l) / sqrt(2 + 2 v . l)
    D(x) = 1 + grazing (1 - x)^p

D is what keeps a diffuse body from being Lambert's: a glossy coat lets less light in and out at grazing angles, a rough body sends more
back. Product and power follow Schlick 1994 and Burley 2012; p is GRAZING_POWER.

(spherical-Gaussian lobes over the half vector: Yang et al. 2022, eq. 9; Wang et al. 2009). Only three matrix products per
view are needed, n . l, v . l and n . v; everything else is elementwise on (points, lights).
"""

from __future__ import annotations

import torch
from torch import Tensor

from mvps.scene import GRAZING_POWER, Law

PARALLEL = 1e-6
"""Floor of 2 + 2 v.l: view and light exactly opposite have no half vector (and such a point is never lit and seen)."""


def half_dot_normal(n_dot_v: Tensor, n_dot_l: Tensor, v_dot_l: Tensor) -> Tensor:
    """h . n for n . v (points, 1), n . l (points, lights) and v . l (points, lights)."""
    return (n_dot_v + n_dot_l) / (2 + 2 * v_dot_l).clamp_min(PARALLEL).sqrt()


def lobes(h_dot_n: Tensor, sharpness: Tensor) -> Tensor:
    """(..., lobes) exp(sharpness (h . n - 1)) for h . n (...) and sharpness (lobes,)."""
    return torch.exp(sharpness * (h_dot_n[..., None] - 1))


def shade(normal: Tensor, view: Tensor, light: Tensor, albedo: Tensor, specular_weight: Tensor, law: Law) -> Tensor:
    """Radiance over intensity (points, lights, 3), attached shadow included, cast shadow not.

    normal, view (points, 3) unit; light (lights, 3) unit; albedo (points, 3); specular_weight (points, lobes) or
    (points, lobes, 3). All in one frame.
    """
    n_dot_l = normal @ light.T
    n_dot_v = (normal * view).sum(-1, keepdim=True)
    h_dot_n = half_dot_normal(n_dot_v, n_dot_l, view @ light.T)
    D_l, D_v = (1 + law.grazing * (1 - x.clamp_min(0)) ** GRAZING_POWER for x in (n_dot_l, n_dot_v))
    weight = specular_weight if specular_weight.ndim == 3 else specular_weight[..., None].expand(-1, -1, 3)
    specular = lobes(h_dot_n, torch.tensor(law.sharpness, dtype=normal.dtype, device=normal.device)) @ weight
    return (albedo[:, None] * (D_l * D_v)[..., None] + specular) * n_dot_l.clamp_min(0)[..., None]
