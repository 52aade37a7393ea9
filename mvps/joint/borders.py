"""Borders of cast shadows: what they say of the places that shadows fall on.

A photograph shows which share f of the light that would reach a vertex unhindered does reach it, 1 in the light and 0 in cast shadow, and
rays through the mesh say the same, S (visibility.py):

    f = (I - I_G) / (q R)          q R what comes straight from the lamp, I_G what other surfaces send (blocks.py)

A vertex x raised by t along its normal n is lit as the place x - t l_t / (n.l) of its tangent plane is, l_t = l - (n.l) n; and what hides
light l from it, at a distance D, moves by D dl across the rays of a light turned by dl. To first order

    f - S = p t + J . dl,          p = -grad S . l_t / (n.l),    J = D (grad S + p n)

with the gradient along the surface. Both f, which a pixel blurs, and S, a step, are means over the RINGS around a vertex, and the gradient
is that of their mean, so that both ends of a displacement count alike (Lucas and Kanade 1981). Rays start a height h over the mesh: S is
that of vertices raised by h. Vertices in a window of AROUND edges move alike,

    t = sum w p (f - S) / sum w p^2,    w = (weight of the pair) / (s^2 / SHARED + |J|^2 LIGHT_SIGMA^2 / 2)
    sigma_t^2 = 1 / sum w p^2 + RIM_PIXELS^2

s the scatter of f - S. The nearer what casts a shadow, the less lights' errors move its border: hollows, which see their own rims, are told
best. Only t < -(sigma_t + RIM_PIXELS) is believed, as far as it is beyond that: what looks lighter than shadow may have light from
elsewhere, what looks darker than light lies deeper; and the mesh rounds rims, so that their shadows are a little too short. Albedo, normals
and what walls send each other say how bright a place in the light would be, no more: wrong by a quarter, they move no border (HALF_LIT).
In a hollow that is too shallow shadows are too short, whatever they are. (Shape from shadows: Shafer and Kanade 1983, Savarese et al. 2007.
Here they mend a surface that is nearly right.)
"""

from __future__ import annotations

from typing import NamedTuple

import igl
import numpy as np
import scipy.sparse as sp

from mvps.cores import on_cores
from mvps.joint.agreement import Agreement
from mvps.joint.blocks import evaluate
from mvps.joint.observe import saturated
from mvps.joint.reflectance import Observed
from mvps.joint.vertices import SHARED
from mvps.mesh import face_areas
from mvps.scene import Bool, Float, Int, Surface
from mvps.visibility import RayCaster, distances_to_shade, ray_caster

RINGS = 2
"""Edges around a vertex over which f and S are means: as far as the mesh knows a border (SHADOW_MARGIN in observe.py)."""

AROUND = 4
"""Edges of a window whose vertices move alike: RINGS on either side of a border. Other numbers were not tried in whole runs."""

HALF_LIT = 0.25, 0.75
"""Shares of the light from which a sample is in it at all, and wholly: a quarter is what albedo, lobes and light from other surfaces may
be off by."""

LEAST_COSINE = 0.15
"""Of the angle between light and normal, 81 degrees: p grows with its tangent, and a normal that is off by some degrees, the mesh's or a
facet's, changes it by half there. Other numbers were not tried."""

SEEN = 0.5
"""Part of the vertices around that must be seen, and lit from above the horizon."""

LEAST_SLOPE = 0.01
"""Of p, per pixel: a tenth of what the means around a border have (0.1 to 0.5). What is below takes no part: it is far from any."""

LIGHT_SIGMA = 0.01
"""Standard deviation of lights, radians: they are known to some tenths of a degree (SHARED_SIGMA in fused.py)."""

RIM_PIXELS = 0.1
"""Standard deviation, and bound, of the place of what casts shadows, whose edges the mesh rounds by about as much; 0, 0.1 and 0.2 were
tried (docs/findings/shadows.md)."""

LARGEST_SIGMA_PIXELS, FARTHEST_PIXELS = 2.0, 3.0
"""Standard deviation and displacement beyond which borders say nothing: RINGS edges of a last mesh, and the most that means over RINGS
edges of a first one follow."""


class Borders(NamedTuple):
    """Samples beside borders of cast shadows, n of them: vertex (n,); weight (n,) of the pair of view and vertex; missing (n,) f - S; slope
    (n,) p, per world unit; turn (n,) |J|^2 / 2, of either direction that a light may turn in."""

    vertex: Int
    weight: Float
    missing: Float
    slope: Float
    turn: Float


def _gradient(surface: Surface) -> list[sp.csr_matrix]:
    """Of values on the vertices, x, y and z of their gradient along the surface, (V, V) each: means over the faces around, by area."""
    count, faces = len(surface.faces), np.ascontiguousarray(surface.faces, np.int64)
    of_faces = igl.grad(np.ascontiguousarray(surface.vertices), faces).tocsr()
    at = np.repeat(face_areas(surface), 3), (faces.ravel(), np.repeat(np.arange(count), 3))
    areas = sp.csr_matrix(at, (len(surface.vertices), count))
    mean = _rows_of_one(areas)
    return [(mean @ of_faces[k * count : (k + 1) * count]).astype(np.float32).tocsr() for k in range(3)]


def _rows_of_one(matrix: sp.csr_matrix) -> sp.csr_matrix:
    """The matrix with rows that add up to one."""
    total = np.asarray(matrix.sum(1)).ravel()
    scaled: sp.csr_matrix = (sp.diags(1 / np.maximum(total, np.finfo(np.float64).tiny)) @ matrix).astype(np.float32).tocsr()
    return scaled


class Shown(NamedTuple):
    """Of n vertices and some lights, (n, lights) each: share of a light that a photograph shows to reach the vertex, f; whole, what it then
    brings, q R; clear, where that is told at all."""

    share: Float
    whole: Float
    clear: Bool


def shown_light(of: Observed, i: int) -> Shown:
    """What view i shows of lights on the vertices that it sees."""
    samples, index, lights = of.views[i], of.views[i].vertex, of.lights[i]
    shaded = evaluate(of.vertices.normal[index], of.vertices.reflectance[index], samples.towards, lights, of.law, samples.gathered)
    sent, image, predicted, cosine = (t.cpu().numpy() for t in (shaded.rest, samples.image, shaded.predicted, shaded.n_dot_l))
    low, high = HALF_LIT
    clear, whole = (cosine > LEAST_COSINE) & (predicted > sent), predicted - sent
    with np.errstate(over="ignore"):
        # Of what reflects next to nothing any light is all of it.
        lit = np.clip(((image - sent) / np.where(clear, whole, 1) - low) / (high - low), 0, 1)
    points = of.surface.vertices[index.cpu().numpy()]
    return Shown(np.where(saturated(of.capture.views[i], points), 1, lit), whole, clear)


def _of_view(of: Observed, i: int, caster: RayCaster, gradient: list[sp.csr_matrix], pixel: float) -> Borders:
    rows, direction = of.views[i].vertex.cpu().numpy(), of.lights[i].direction.cpu().numpy()
    normal = caster.vertex_normals[rows].astype(np.float32)
    n_dot_l = normal @ direction.T
    lit, _, clear = shown_light(of, i)
    clear = clear & (n_dot_l > LEAST_COSINE)
    distance = distances_to_shade(caster, rows, direction.astype(np.float64))
    hidden = np.isfinite(distance)

    around = caster.around[rows][:, rows]
    mean = _rows_of_one(around)
    means = np.hstack([lit * clear, ~hidden * clear, clear, np.where(hidden, distance, 0), hidden]).astype(np.float32)
    for _ in range(RINGS):
        means = mean @ means
    of_shown, of_said, seen, far, dark = np.split(means, 5, axis=1)
    shown, said = (share / np.maximum(seen, np.float32(1e-6)) for share in (of_shown, of_said))
    grad = np.stack([axis[rows][:, rows] @ ((shown + said) / 2) for axis in gradient], -1)
    along = (grad * direction).sum(-1) - (grad * normal[:, None]).sum(-1) * n_dot_l
    slope = -along / np.maximum(n_dot_l, LEAST_COSINE)

    inside = np.diff(around.indptr) == np.diff(caster.around.indptr)[rows]
    known = clear & inside[:, None] & (seen > SEEN) & (dark > 0) & (np.abs(slope) * pixel > LEAST_SLOPE)
    vertex, light = np.nonzero(known)
    p = slope[vertex, light]
    turn = (far[vertex, light] / dark[vertex, light])[:, None] * (grad[vertex, light] + p[:, None] * normal[vertex])
    across = (turn**2).sum(1) - (turn * direction[light]).sum(1) ** 2
    missing = (shown - said)[vertex, light] + p * caster.offset
    weight = of.views[i].weight.cpu().numpy()[vertex]
    return Borders(rows[vertex], *(values.astype(np.float64) for values in (weight, missing, p, np.maximum(across, 0) / 2)))


def shadow_borders(of: Observed, pixel: float) -> Borders:
    """What photographs show beside the borders of cast shadows; pixel: its footprint on the surface."""
    caster, gradient = ray_caster(of.surface), _gradient(of.surface)
    views = on_cores(lambda i: _of_view(of, i, caster, gradient, pixel), range(len(of.views)))
    return Borders(*(np.concatenate(values) for values in zip(*views, strict=True)))


def told_by(borders: Borders, surface: Surface, pixel: float) -> Agreement:
    """By how much the surface's vertices are to move inwards, along their normals, for shadows to end where photographs show them to."""
    count, tiny = len(surface.vertices), np.finfo(np.float64).tiny
    if not len(borders.vertex):
        return Agreement.unknown(count)
    scatter = np.median(np.abs(borders.missing)) / 0.6745
    weight = borders.weight / (scatter**2 / SHARED + borders.turn * LIGHT_SIGMA**2 + tiny)
    mean = _rows_of_one(ray_caster(surface).around)

    def of_windows(values: Float) -> Float:
        window = np.bincount(borders.vertex, values, count).astype(np.float64)
        for _ in range(AROUND):
            window = mean @ window
        return window

    total = of_windows(weight * borders.slope**2)
    offset = of_windows(weight * borders.slope * borders.missing) / np.maximum(total, tiny)
    rim = RIM_PIXELS * pixel
    sigma = np.sqrt(1 / np.maximum(total, tiny) + rim**2)
    known = (offset < -(sigma + rim)) & (sigma < LARGEST_SIGMA_PIXELS * pixel) & (-offset < FARTHEST_PIXELS * pixel)
    return Agreement(np.where(known, offset + sigma + rim, 0), np.where(known, sigma, np.inf))
