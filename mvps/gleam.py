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
from typing import Any, NamedTuple

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
    interpolation,
    lit_by,
    lit_by_points,
    series,
    sources_on,
)
from mvps.mesh import mean_edge_length, normalise
from mvps.scene import Float, Int, Law, Material, Surface
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
    """Whether lobes of weights (n, lobes) take a part in what points of albedo (n,) return, that counts; points without either are not
    shown by any view."""
    lobes = weight @ returned(law.sharpness, law.microfacet)[1:]
    known = albedo + lobes > 0
    return bool(known.any() and np.median(lobes[known] / (albedo + lobes)[known]) > LEAST_SHARE)


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


class Terms:
    """G on the patches under some lights, seen from an eye: (n, lights, 1 or 2 + lobes), or (n, lights, 1 or 2 + lobes, channels); one term
    where lobes take no part.

    What lobes do is worked out patch by patch, when one is asked for: a camera sees a part of them. For one thread at a time.
    """

    def __init__(self, of: Senders, direction: Float, lit: Single, eye: Float) -> None:
        """direction (lights, 3), or (n, lights, 3) of every patch; lit (n, lights)."""
        self._net = of.sources.of
        diffuse = gathered(of.sources, lit, of.law.bounce)
        self._lobes = None if of.weight is None else _lobes_under(of, direction, lit, eye)
        if self._lobes is None:
            self._G = np.expand_dims(diffuse, 2)
            return
        coloured, terms = of.sources.albedo.ndim == 2, 2 + len(of.law.sharpness)
        self._G = np.zeros((*lit.shape, terms, 3) if coloured else (*lit.shape, terms), np.float32)
        self._G[:, :, 0] = diffuse
        self._known = np.zeros(len(lit), bool)

    def on(self, patches: Int) -> Single:
        """On some patches (m,): (m, lights, ...)."""
        self._work_out(patches)
        return self._G[patches]

    def through(self, weight: sp.csr_matrix, lights: slice = slice(None)) -> Single:
        """(points, lights, ...) of some of the lights, interpolated with weights (points, n)."""
        self._work_out(weight.indices)
        G = self._G[:, lights]
        values: Single = weight @ G.reshape(len(G), -1)
        return values.reshape(-1, *G.shape[1:])

    def at(self, points: Float, normal: Float, lights: slice = slice(None)) -> Single:
        """(points, lights, ...) of some of the lights, interpolated at points with normals (points, 3)."""
        return self.through(interpolation(self._net, points, normal), lights)

    def _work_out(self, patches: NDArray[Any]) -> None:
        if self._lobes is None:
            return
        asked = np.zeros_like(self._known)
        asked[patches] = True
        asked &= ~self._known & (np.diff(self._net.start) > 0)
        self._known |= asked
        new = np.flatnonzero(asked)
        for some in _parts(self._net, new, self._G.shape[1]):
            means = _means(self._lobes, some)
            self._G[some, :, 1:] = means if self._G.ndim == 4 else means[..., 0]
            self._G[some, :, 1] -= self._G[some, :, 0]


def terms(of: Senders, direction: Float, eye: Float) -> Terms:
    """Under lights direction (lights, 3), seen from a camera at eye (3,)."""
    return Terms(of, direction, lit_by(of.sources.of, direction), eye)


def terms_of_points(of: Senders, position: Float, eye: Float) -> Terms:
    """The same under points of light, position (points, 3), over their strength (illumination.py) in place of the lights' intensity."""
    return Terms(of, *lit_by_points(of.sources.of, position), eye)


class _Lobes(NamedTuple):
    """Lobes of n patches under lights, seen from an eye: spread (n,) of their normals, normal, view (n, 3); light (lights, 3), or
    (n, lights, 3); lit (n, lights). Channels first: albedo (channels, n), weight (channels, lobes, n), later (channels, n, lights), what
    the header calls R A."""

    net: Gather
    law: Law
    spread: Single
    normal: Single
    view: Single
    light: Single
    lit: Single
    albedo: Single
    weight: Single
    later: Single


def _lobes_under(of: Senders, direction: Float, lit: Single, eye: Float) -> _Lobes:
    """direction, lit as in `Terms`."""
    assert of.weight is not None
    net, law, albedo = of.sources.of, of.law, of.sources.albedo
    a = np.ascontiguousarray((albedo if albedo.ndim == 2 else albedo[:, None]).T, np.float32)
    of_channels = of.weight if of.weight.ndim == 3 else np.broadcast_to(of.weight[..., None], (*of.weight.shape, len(a)))
    w = np.ascontiguousarray(of_channels.T, np.float32)
    of_all = returned(law.sharpness, law.microfacet)[1:, None].astype(np.float32)
    later = []
    for of_albedo, by_lobes in zip(a, (w * of_all).sum(1), strict=True):
        again = (law.bounce * of_albedo + law.gleam * by_lobes)[:, None]
        later.append(again * series(net.S, lit * (of_albedo + by_lobes)[:, None], again, BOUNCES - 1))
    spread, normal, view, light = (x.astype(np.float32) for x in (net.spread, net.normal, normalise(eye - net.tree.data), direction))
    return _Lobes(net, law, spread, normal, view, light, lit, a, w, np.stack(later))


def _parts(net: Gather, patches: Int, lights: int) -> Iterator[Int]:
    """Those of patches (m,) that are handled at once."""
    rays = np.cumsum(net.start[patches + 1] - net.start[patches]) * lights
    return (some for some in np.split(patches, np.flatnonzero(np.diff(rays // SAMPLES_PER_CHUNK)) + 1) if len(some))


def _means(of: _Lobes, patches: Int) -> Single:
    """(m, lights, 1 + lobes, channels) means of L, and of f_k(v, w) L, over the rays of patches (m,)."""
    first, count = of.net.start[patches], of.net.start[patches + 1] - of.net.start[patches]
    ends = np.concatenate([[0], np.cumsum(count)])
    rays = np.arange(ends[-1]) + np.repeat(first - ends[:-1], count)
    sent, taken = _sent(of, rays), _taken(of, rays)
    shape = (len(patches), len(rays))
    means = [sp.csr_matrix((share / RAYS, np.arange(len(rays)), ends), shape) for share in taken]
    return np.stack([np.stack([mean @ channel for mean in means], -1) for channel in sent], -1)


def _values(of: _Lobes, patch: Int, along: Single, summed_length: Single) -> list[Single]:
    """f_k (..., rays) for n . (v + w) and |v + w| (..., rays) at the rays' patches (rays,)."""
    h_dot_n, gained = np.clip(along / summed_length, -1, 1), gain_of(summed_length)
    spread = of.spread[patch]
    duller: list[Single] = [(1 + np.float32(s) * spread) ** np.float32(-1) for s in of.law.sharpness]
    return [lobe_of(h_dot_n, np.float32(s) * d, of.law.microfacet) * gained * d for s, d in zip(of.law.sharpness, duller, strict=True)]


def _sent(of: _Lobes, rays: Int) -> Iterator[Single]:
    """L (rays, lights) of some rays (rays,), channel by channel."""
    patch, along = of.net.column[rays], of.net.along[rays]
    normal = of.normal[patch]
    # Lights first: what rays have of their own then lies along numpy's long axis.
    if of.light.ndim == 2:
        of_ray, towards = of.light @ along.T, of.light @ normal.T
    else:
        of_ray, towards = (np.einsum("ri,rli->lr", vectors, of.light[patch]) for vectors in (along, normal))
    towards -= np.einsum("ri,ri->r", normal, along)
    values = _values(of, patch, towards, np.sqrt(np.maximum(2 - 2 * of_ray, PARALLEL)))
    lit = of.lit[patch]
    for albedo, weight, later in zip(of.albedo, of.weight, of.later, strict=True):
        sent = sum((value * w for value, w in zip(values, weight[:, patch], strict=True)), start=albedo[patch])
        yield np.ascontiguousarray(sent.T) * lit + later[patch]


def _taken(of: _Lobes, rays: Int) -> list[Single]:
    """1 and f_k(v, w) of some rays (rays,), by which their patch returns them to the eye."""
    patch, along = of.net.row[rays], of.net.along[rays]
    normal, view = of.normal[patch], of.view[patch]
    length = np.sqrt(np.maximum(2 + 2 * np.einsum("ri,ri->r", view, along), PARALLEL))
    return [np.ones(len(patch), np.float32), *_values(of, patch, np.einsum("ri,ri->r", normal, view + along), length)]
