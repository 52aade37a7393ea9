"""The neural residual of the reflectance: a small network where albedo and lobes fit badly. Differentiable (torch), any device.

    radiance = intensity * visibility * R max(n . l, 0) * exp(m g(x)),    |g| <= LARGEST

R is the reflectance of shading.py; m is 1 on the vertices that have a residual and 0 on the others, so that inside triangles the factor
fades to one. g is a multi-layer perceptron over

    x = (n.l n.v, n.l + n.v, h.n, sqrt(1 - h.n), log(1 - h.n + 0.001), v.l, z_0, z_1 . t, t^T Z t, d),    t = h - (h.n) n

Nothing in x changes when light and view change places, so what is reciprocal stays so, and a factor exp(.) makes no radiance negative.
z_0, z_1 (a vector) and Z (a symmetric matrix), in the world frame, are the vertex's own: how normals are spread about the shading normal
inside a pixel turns and stretches the distribution of half vectors. d describes the vertex to the network (joint/neural.py). Vectors and
matrices in the world frame interpolate without a seam.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvps.scene import Float, Residual
from mvps.shading import against, half_dot_normal

LARGEST = 4.0
"""Of the factor's logarithm, and of what the moments say: a photograph of 16 bits holds no larger range under one light."""

MOMENTS = 10
"""Numbers in z_0, z_1 and Z, in this order; Z as xx, yy, zz, xy, xz, yz."""

Layers = list[tuple[Tensor, Tensor]]
"""Weights (out, in) and biases (out,)."""


def moments(normal: Tensor, view: Tensor, light: Tensor) -> Tensor:
    """(n, lights, MOMENTS) what z_0, z_1 and Z are multiplied with: 1, t and the products of t's entries. normal, view (n, 3); light
    (lights, 3); unit, in one frame."""
    half = torch.nn.functional.normalize(view[:, None] + light, dim=-1)
    t = half - (half * normal[:, None]).sum(-1, keepdim=True) * normal[:, None]
    x, y, z = t.unbind(-1)
    return torch.stack([torch.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], -1)


def inputs(normal: Tensor, view: Tensor, light: Tensor, code: Tensor) -> Tensor:
    """(n, lights, 9 + descriptors) the network's x for codes (n, MOMENTS + descriptors); the rest as in `moments`."""
    n_dot_l, v_dot_l = against(normal, light).clamp_min(0), against(view, light)
    n_dot_v = (normal * view).sum(-1, keepdim=True).clamp_min(0)
    half = half_dot_normal(n_dot_v, n_dot_l, v_dot_l)
    away = 1 - half
    terms = moments(normal, view, light) * code[:, None, :MOMENTS]
    said = [terms[..., part].sum(-1).clamp(-LARGEST, LARGEST) for part in (slice(0, 1), slice(1, 4), slice(4, MOMENTS))]
    angles = [n_dot_l * n_dot_v, n_dot_l + n_dot_v, half, away.sqrt(), torch.log(away + 1e-3), v_dot_l]
    descriptors = code[:, None, MOMENTS:].expand(-1, light.shape[-2], -1)
    return torch.cat([torch.stack(angles + said, -1), descriptors], -1)


def log_factor(x: Tensor, layers: Layers) -> Tensor:
    """g (...) for x (..., inputs)."""
    for weight, bias in layers[:-1]:
        x = (x @ weight.T + bias).relu()
    weight, bias = layers[-1]
    return (x @ weight.T + bias)[..., 0].clamp(-LARGEST, LARGEST)


def factor(residual: Residual, share: Float, code: Float, normal: Float, view: Float, light: Float) -> NDArray[np.float32]:
    """(n, lights) by which the radiance of points is multiplied; share (n,) is m, code as interpolated; the rest as in `moments`."""
    out = np.ones((len(share), light.shape[-2]), np.float32)
    some = np.flatnonzero(share > 0)
    layers = [(torch.tensor(w), torch.tensor(b)) for w, b in residual.layers]
    n, v, c = (torch.tensor(a[some], dtype=torch.float32) for a in (normal, view, code))
    towards = torch.tensor(light if light.ndim == 2 else light[some], dtype=torch.float32)
    g = log_factor(inputs(n, v, towards, c), layers).numpy()
    out[some] = np.exp(share[some, None].astype(np.float32) * g)
    return out
