"""Light that surfaces send each other by way of their lobes: into highlights, out of highlights, and both.

Inter-reflection among diffuse surfaces (bounce.py) knows albedo alone. With lobes k of weights w_k, towards v and from w,

    f_k(v, w) = gain lobe_k(h . n),   h = (v + w) / |v + w|,   gain = 1 / (h . v)^2, bounded (shading.py)

a point y sends x, along -w, under a light l (shadow V, per unit intensity e)

    L(y, w) = V max(n_y . l, 0) (a_y + sum_k w_yk f_k(-w, l)) + R_y A_y,      R = b a + g sum_k w_k r_k,      A = S(L_1 + R A)

where later bounces are as if diffuse: r_k is the lobe's albedo (shading.returned), L_1 = V max(n.l, 0) (a + sum_k w_k r_k), S the mean over
first hits of cosine-distributed rays. x then returns, towards the eye v,

    e (b a G_0 + g (a G_1 + sum_k w_k G_2+k)),      G_0 what diffuse surfaces alone send (bounce.py),
    G_1 = mean L - G_0,      G_2+k = mean f_k(v, w) L

b (bounce) and g (gleam) are both the object's reflectance over the photographs' units. They are solved apart: a lobe too wide for the
object sends too much, which would take b down with it.

A patch stands for normals that vary by a variance t along a tangent: its lobes have the sharpness s / (1 + s t) and as much less height
(Toksvig 2005).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mvps.bounce import (
    BOUNCES,
    PATCH_EDGES,
    RAYS,
    SHELTERED_EDGES,
    Gather,
    Sources,
    gather,
    gathered,
    lit_by,
    lit_by_points,
    series,
    sources_on,
)
from mvps.mesh import mean_edge_length, normalise
from mvps.scene import Float, Law, Material, Surface
from mvps.shading import PARALLEL, gain_of, lobe_of, returned

LEAST_SHARE = 0.25
"""Of the light that the median point returns, what lobes must return to be counted: as much as a patch errs in what it gathers
(bounce.RAYS). It lies in the gap between glossy paint and plastic, 5 to 20 %, and metals and half-bare ones, 45 to 90
(docs/findings/reflectance.md)."""

LOBES_PATCH_EDGES = 1.0
"""Size of a patch over the mesh's edges where lobes take part: about a vertex. Between the folds of a copper statue patches of 3, 1.5 and 1
edges leave 41, 29 and 26 % of what surfaces send unexplained (docs/findings/reflectance.md)."""

SAMPLES_PER_CHUNK = 1 << 19
"""Rays times lights at once."""

Single = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Senders:
    """What sends light on to other parts, under a law: sources and the weights (n, lobes) or (n, lobes, channels) of their lobes; None
    where lobes take no part."""

    sources: Sources
    law: Law
    weight: Float | None = None


def senders(of: Gather, surface: Surface, law: Law, albedo: Float, weight: Float | None) -> Senders:
    """Those of a surface whose vertices have albedo (V,) or (V, channels), and weights (V, lobes) or (V, lobes, channels) of lobes that
    take part; None: they do not."""
    sources = sources_on(of, surface, albedo)
    if weight is None or not law.sharpness:
        return Senders(sources, law)
    flat = sources_on(of, surface, weight.reshape(len(weight), -1)).albedo
    return Senders(sources, law, flat.reshape(len(flat), *weight.shape[1:]))


def shiny(law: Law, albedo: Float, weight: Float) -> bool:
    """Whether lobes of weights (n, lobes) take a part in what points of albedo (n,) return, that counts."""
    lobes = weight @ returned(law.sharpness, law.microfacet)[1:]
    return bool(np.median(lobes / np.maximum(albedo + lobes, 1e-300)) > LEAST_SHARE)


def patches_of(surface: Surface, lobes: bool) -> Gather:
    """Its patches, as large as what they send needs: by lobes too, or by diffuse surfaces alone."""
    size, sheltered = (LOBES_PATCH_EDGES,) * 2 if lobes else (PATCH_EDGES, SHELTERED_EDGES)
    edge = mean_edge_length(surface)
    return gather(surface, size * edge, sheltered * edge)


def coarse_senders(surface: Surface, material: Material, grey: bool = False) -> Senders | None:
    """Those of a surface with a material, in three channels or in their mean; None without inter-reflection."""
    if not (material.bounce or material.gleam):
        return None
    albedo, weight = material.albedo, material.specular_weight
    if grey:
        albedo, weight = albedo.mean(1), weight.mean(2) if weight.ndim == 3 else weight
    of = patches_of(surface, bool(material.gleam))
    return senders(of, surface, material.law, albedo, weight if material.gleam else None)


def terms(of: Senders, direction: Float, eye: Float) -> Single:
    """G (n, lights, 1 or 2 + lobes) on the patches, or (n, lights, 1 or 2 + lobes, channels), under lights direction (lights, 3), seen from
    a camera at eye (3,). One term where lobes take no part."""
    return _terms(of, direction, lit_by(of.sources.of, direction), eye)


def terms_of_points(of: Senders, position: Float, eye: Float) -> Single:
    """The same under points of light, position (points, 3), over their strength (illumination.py) in place of the lights' intensity."""
    return _terms(of, *lit_by_points(of.sources.of, position), eye)


def _terms(of: Senders, direction: Float, lit: Single, eye: Float) -> Single:
    """direction (lights, 3), or (n, lights, 3) of every patch; lit (n, lights)."""
    if of.weight is None:
        return np.expand_dims(gathered(of.sources, lit, of.law.bounce), 2)
    net, law, albedo = of.sources.of, of.law, of.sources.albedo
    coloured = albedo.ndim == 2
    a = (albedo if coloured else albedo[:, None]).astype(np.float32)
    w = of.weight if of.weight.ndim == 3 else of.weight[..., None]
    w = np.broadcast_to(w, (*w.shape[:2], a.shape[1])).astype(np.float32)
    later = _later(net, law, a, w, lit)
    G = np.zeros((*lit.shape, 2 + w.shape[1], a.shape[1]), np.float32)
    diffuse = gathered(of.sources, lit, law.bounce)
    G[:, :, 0] = diffuse if coloured else diffuse[..., None]
    for patches, rays in _parts(net, lit.shape[1]):
        sent, taken = _sent(net, law, a, w, lit, later, direction, rays), _taken(net, law, eye, rays)
        starts = net.start[patches.start : patches.stop + 1] - rays.start
        for k, share in enumerate(taken):
            mean = sp.csr_matrix((share / RAYS, np.arange(len(share)), starts), (len(starts) - 1, len(share)))
            G[patches, :, 1 + k] = (mean @ sent.reshape(len(sent), G[0, :, 0].size)).reshape(-1, *sent.shape[1:])
    G[:, :, 1] -= G[:, :, 0]
    return G if coloured else G[..., 0]


def _later(net: Gather, law: Law, a: Single, w: Single, lit: Single) -> Single:
    """R A (n, lights, channels)."""
    of_lobes = (w * returned(law.sharpness, law.microfacet)[1:, None].astype(np.float32)).sum(1)
    again = (law.bounce * a + law.gleam * of_lobes).astype(np.float32)
    first = (a + of_lobes).T[..., None]
    arriving = [series(net.S, lit * direct, R[:, None], BOUNCES - 1) for direct, R in zip(first, again.T, strict=True)]
    later: Single = again[:, None] * np.stack(arriving, -1)
    return later


def _parts(net: Gather, lights: int) -> Iterator[tuple[slice, slice]]:
    """Patches, and their rays, that are handled at once."""
    first, count = 0, len(net.normal)
    while first < count:
        most = net.start[first] + max(1, SAMPLES_PER_CHUNK // lights)
        last = min(max(int(np.searchsorted(net.start, most, side="right")) - 1, first + 1), count)
        yield slice(first, last), slice(int(net.start[first]), int(net.start[last]))
        first = last


def _lobes(law: Law, spread: Float, along: Single, summed_length: Single) -> list[Single]:
    """f_k (rays, ...) for n . (v + w) and |v + w| (rays, ...) at patches with a spread (rays,) of normals."""
    h_dot_n = np.clip(along / summed_length, -1, 1)
    gained = gain_of(summed_length)
    variance: Single = spread.astype(np.float32).reshape(-1, *(1,) * (along.ndim - 1))
    duller: list[Single] = [(1 + np.float32(s) * variance) ** np.float32(-1) for s in law.sharpness]
    return [lobe_of(h_dot_n, np.float32(s) * d, law.microfacet) * gained * d for s, d in zip(law.sharpness, duller, strict=True)]


def _sent(net: Gather, law: Law, a: Single, w: Single, lit: Single, later: Single, direction: Float, rays: slice) -> Single:
    """L (rays, lights, channels)."""
    column, along = net.column[rays], net.along[rays]
    normal, light = net.normal.astype(np.float32), direction.astype(np.float32)
    if light.ndim == 2:
        of_ray, of_normal = along @ light.T, (normal @ light.T)[column]
    else:
        of_ray, of_normal = (np.einsum("ri,rli->rl", vectors, light[column]) for vectors in (along, normal[column]))
    length = np.sqrt(np.maximum(2 - 2 * of_ray, PARALLEL))
    towards = of_normal - np.einsum("ri,ri->r", normal[column], along)[:, None]
    sent = np.broadcast_to(a[column, None], (*length.shape, a.shape[1])).copy()
    for k, value in enumerate(_lobes(law, net.spread[column], towards, length)):
        sent += value[..., None] * w[column, k][:, None]
    sent *= lit[column][..., None]
    sent += later[column]
    return sent


def _taken(net: Gather, law: Law, eye: Float, rays: slice) -> list[Single]:
    """1 and f_k(v, w) of the rays (rays,), by which their patch returns them to the eye."""
    row, along = net.row[rays], net.along[rays]
    normal, view = (v.astype(np.float32)[row] for v in (net.normal, normalise(eye - net.tree.data)))
    length = np.sqrt(np.maximum(2 + 2 * np.einsum("ri,ri->r", view, along), PARALLEL))
    return [np.ones(len(row), np.float32), *_lobes(law, net.spread[row], np.einsum("ri,ri->r", normal, view + along), length)]
