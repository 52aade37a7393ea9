"""LZ20, last step: spatially varying isotropic reflectance as a mixture of a few basis BRDFs.

    radiance_c / intensity_c = max(n . l, 0) sum_k w_kc(x) B_k(theta_h, theta_d),      w, B >= 0

B_k are tables over the angles between the half vector and the normal and between the half vector and the light (the isotropic BRDF without
its dependence on phi_d: Romeiro et al. 2008). Weights and tables are solved in turn by constrained least squares (Lawrence et al. 2006):
for given tables every vertex and channel is a problem of K unknowns, for given weights every entry of the tables is one. Shadowed and
clipped samples are left out, and the tables are solved on part of the vertices.

For rendering the tables are projected onto a constant and spherical Gaussians of fixed sharpness by non-negative least squares, each entry
counted as often as it was seen.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls

from mvps.camera import bilinear, project, view_directions
from mvps.cores import on_cores
from mvps.mesh import normalise
from mvps.scene import Capture, Float, Int, Lights, Surface
from mvps.shading import gain_of
from mvps.visibility import cast_shadow, ray_caster
from solvers.least_squares import bounded_step

Array = NDArray[Any]

BASES = 3
"""A body, a sheen and a highlight; Lawrence et al. and LZ20 use two to four."""

HALF_BINS, DIFFERENCE_BINS = 45, 6
"""Entries over theta_h, as fine as 0.04 deg at the highlight and 4 deg at the horizon (quadratic steps: Matusik et al. 2003), and
theta_d."""

FIT_VERTICES = 3000
"""They stand for all when the tables are solved: 45 x 6 x 3 unknowns from some million samples."""

ALTERNATIONS = 12

PULL = 0.01
"""As if so small a share of a vertex's samples said that a basis has no part in it: highlights that no light shows stay out."""

SHARPNESS = (8.0, 32.0, 128.0)
"""Of the lobes on which tables are projected: half-value widths of 24, 12 and 6 degrees."""

STEEPEST = 0.1
"""Least n . l of a sample: below it a small error of the normal is a large one of the shading."""


class Samples(NamedTuple):
    """What a view says of n vertices, rows (n,): table entry and n . l, 0 where there is no data, (n, lights); radiance over intensity
    (n, lights, 3)."""

    rows: Int
    entry: Int
    shading: Array
    value: Array


class Mixture(NamedTuple):
    """Reflectance on the vertices: albedo (V, 3), specular_weight (V, lobes, 3); rms error of the samples the tables were solved on,
    relative to their rms; tables (K, HALF_BINS * DIFFERENCE_BINS)."""

    albedo: Float
    specular_weight: Float
    error: float
    tables: Float


def mixture(capture: Capture, lights: Lights, surface: Surface, normal: Float, seen: list[Int]) -> Mixture:
    """The mixture on a surface with shading normals (V, 3). seen: per view the vertices that it sees, in order."""
    every = max(1, len(normal) // FIT_VERTICES)
    part = [rows[rows % every == 0] for rows in seen]
    samples = on_cores(lambda i: _samples(capture, lights, surface, normal, i, part[i]), range(len(seen)))
    tables = _first_tables()
    for _ in range(ALTERNATIONS):
        weight = _weights(samples, tables, len(normal))
        tables = _tables(samples, weight, tables)
    error, counts = _error(samples, _weights(samples, tables, len(normal)), tables), _counts(samples)
    constant, lobes = _projected(tables, counts)
    hessian, gradient = np.zeros((len(normal), BASES, BASES)), np.zeros((len(normal), BASES, 3))
    for i, rows in enumerate(seen):
        _add(hessian, gradient, _samples(capture, lights, surface, normal, i, rows), tables)
    solved = _solved(hessian, gradient)
    return Mixture(np.einsum("vkc,k->vc", solved, constant), np.einsum("vkc,kl->vlc", solved, lobes), error, tables)


def _samples(capture: Capture, lights: Lights, surface: Surface, normal: Float, i: int, rows: Int) -> Samples:
    view, light = capture.views[i], lights.direction[i]
    x, n = surface.vertices[rows], normal[rows]
    corners, weights = bilinear(view.pixel_index, project(view.camera, x)[0])
    of_pixels = view.radiance() / lights.intensity[i].astype(np.float32)
    value, known = np.zeros((len(rows), *of_pixels.shape[1:]), np.float32), np.ones((len(rows), len(light)), bool)
    usable = view.usable()
    for k in range(4):
        value += weights[:, k, None, None] * of_pixels[corners[:, k]]
        known &= usable[corners[:, k]] | (weights[:, k, None] == 0)
    half = normalise(view_directions(view.camera, x)[:, None] + light)
    to_normal = np.clip(np.einsum("nlc,nc->nl", half, n), 0, 1)
    to_light = np.clip(np.einsum("nlc,lc->nl", half, light), 0, 1)
    shading = n @ light.T
    shading[~known | (shading < STEEPEST) | cast_shadow(ray_caster(surface), rows, light)] = 0
    entry = _half_bin(np.arccos(to_normal)) * DIFFERENCE_BINS + np.minimum(
        (np.arccos(to_light) / (np.pi / 2) * DIFFERENCE_BINS).astype(np.int64), DIFFERENCE_BINS - 1
    )
    return Samples(rows, entry, shading, value)


def _half_bin(angle: Array) -> Array:
    return np.minimum((HALF_BINS * np.sqrt(angle / (np.pi / 2))).astype(np.int64), HALF_BINS - 1)


def _half_angles() -> Float:
    """(HALF_BINS,) theta_h in the middle of the entries."""
    return np.pi / 2 * ((np.arange(HALF_BINS) + 0.5) / HALF_BINS) ** 2


def _first_tables() -> Float:
    """(K, entries): a constant, and lobes from wide to narrow."""
    rows = [np.ones(HALF_BINS), *(np.exp(s * (np.cos(_half_angles()) - 1)) for s in SHARPNESS[-(BASES - 1) :])]
    return np.repeat(np.stack(rows), DIFFERENCE_BINS, 1)


def _add(hessian: Float, gradient: Float, samples: Samples, tables: Float) -> None:
    """The normal equations of the weights, added to hessian (V, K, K) and gradient (V, K, 3)."""
    basis = np.moveaxis(tables[:, samples.entry], 0, -1) * samples.shading[..., None]
    hessian[samples.rows] += np.swapaxes(basis, 1, 2) @ basis
    gradient[samples.rows] += np.swapaxes(basis, 1, 2) @ samples.value


def _solved(hessian: Float, gradient: Float) -> Float:
    """(V, K, 3) non-negative weights."""
    pull = PULL * np.trace(hessian, axis1=1, axis2=2)[:, None, None] / BASES * np.eye(BASES)
    H, zero = torch.tensor(hessian + pull), torch.zeros(len(hessian), BASES, dtype=torch.float64)
    columns = [bounded_step(H, -torch.tensor(np.ascontiguousarray(gradient[..., c])), zero, 1e-6) for c in range(3)]
    solved: Float = torch.stack(columns, -1).numpy()
    return solved


def _weights(samples: list[Samples], tables: Float, count: int) -> Float:
    hessian, gradient = np.zeros((count, BASES, BASES)), np.zeros((count, BASES, 3))
    for of_view in samples:
        _add(hessian, gradient, of_view, tables)
    return _solved(hessian, gradient)


def _tables(samples: list[Samples], weight: Float, before: Float) -> Float:
    """(K, entries) non-negative tables; an entry that was never seen keeps what it had. A table's mean over what was seen is one."""
    entries = before.shape[1]
    hessian, gradient = np.zeros((entries, BASES, BASES)), np.zeros((entries, BASES))
    for rows, entry, shading, value in samples:
        flat, square = entry.ravel(), shading**2
        products = np.einsum("nkc,njc->nkj", weight[rows], weight[rows])
        told = np.einsum("nkc,nlc->nlk", weight[rows], value) * shading[..., None]
        for k in range(BASES):
            gradient[:, k] += np.bincount(flat, told[..., k].ravel(), entries)
            for j in range(BASES):
                hessian[:, k, j] += np.bincount(flat, (square * products[:, None, k, j]).ravel(), entries)
    # A table is smooth: an entry that few samples speak of stays near what it was.
    pull = 1e-3 * np.trace(hessian.mean(0)) / BASES
    hessian += pull * np.eye(BASES)
    gradient += pull * before.T
    zero = torch.zeros(entries, BASES, dtype=torch.float64)
    tables: Float = bounded_step(torch.tensor(hessian), -torch.tensor(gradient), zero, 1e-6).numpy().T
    seen = _counts(samples) > 0
    scaled: Float = tables / np.maximum(tables[:, seen].mean(1, keepdims=True), np.finfo(float).tiny)
    return scaled


def _counts(samples: list[Samples]) -> Array:
    """(entries,) how often each entry of the tables was seen."""
    entries = HALF_BINS * DIFFERENCE_BINS
    return sum(np.bincount(of.entry.ravel(), (of.shading > 0).ravel(), entries) for of in samples) + np.zeros(entries)


def _error(samples: list[Samples], weight: Float, tables: Float) -> float:
    wrong = right = 0.0
    for rows, entry, shading, value in samples:
        predicted = np.einsum("nlk,nkc->nlc", np.moveaxis(tables[:, entry], 0, -1), weight[rows]) * shading[..., None]
        lit = shading > 0
        wrong += float(((predicted - value)[lit] ** 2).sum())
        right += float((value[lit] ** 2).sum())
    return float(np.sqrt(wrong / max(right, np.finfo(float).tiny)))


def _projected(tables: Float, counts: Array) -> tuple[Float, Float]:
    """Constants (K,) and weights of the lobes (K, lobes) nearest to the tables (K, entries)."""
    cosine = np.repeat(np.cos(_half_angles()), DIFFERENCE_BINS)
    to_light = np.cos(np.pi / 2 * (np.arange(DIFFERENCE_BINS) + 0.5) / DIFFERENCE_BINS)
    gained = np.tile(gain_of((2 * to_light).astype(np.float32)), HALF_BINS)
    basis = np.stack([np.ones_like(cosine), *(gained * np.exp(s * (cosine - 1)) for s in SHARPNESS)], 1)
    root = np.sqrt(counts)
    solved = np.stack([nnls(basis * root[:, None], table * root)[0] for table in tables])
    return solved[:, 0], solved[:, 1:]
