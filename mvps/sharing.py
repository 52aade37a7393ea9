"""Whether all views are under the same lights, and whether these stand still with the camera or in the world.

Lambert's law on vertices j of a rough surface with normals n_j, under light l of view i, without shadows:

    I_ijl = a_j (n_j . s_il)+        one albedo a_j in all views

Robust least squares for a and s in turn, three times: s_il of each view on its own; s_il = s_l in the cameras' frames; s_il = s_l in the
world's. A rough shape's normals are off, and so all three leave much; but with s_l in a frame in which the lights move, or of lights that
are others in every view, far more. What tells them apart is that a vertex has one albedo: a view alone would explain anything by albedo.
On hulls of captures whose views share lights these leave 0.9 to 1.5 times as much as lights of each view's own (median over samples), with
two exceptions up to 1.7; where they share none 1.7 to 4 times, of metals, whose highlights hide what normals tell, 1.2 and 1.4
(docs/findings/lights.md).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mvps.camera import project
from mvps.cores import on_cores
from mvps.scene import Bool, Capture, Float, Int, View
from mvps.values import channel_mean
from mvps.visibility import RayCaster, visible_vertices
from solvers.low_rank import robust_weights, solve_rows

VERTICES, LIGHTS = 1000, 8
"""As many as are looked at: with 4000 vertices and all lights the ratios of eighteen captures are the same within a tenth."""

SWEEPS = 20

DARK, BRIGHT = 0.1, 0.8
"""Samples below this part of a photograph's bright level, above this share of its vertices, count as shadow: as in pixel_samples.py."""

EXPLAINED = 1.6
"""Times what lights of each view's own leave, up to which lights of one rig explain the views."""

TOLD_APART = 1.5
"""Times what lights that stand still in one frame leave, from which they do not in the other: with rigs of cameras or of lamps it is 2 to
9, and 1.2 on a sheet whose hull has none of its normals."""

Frame = Literal["camera", "world"]


class VertexSamples(NamedTuple):
    """Of vertices in views: vertex (n,), its number among those looked at; view (n,); normal (n, 3), world, and in the camera's frame;
    image (n, lights) grey radiance; known (n, lights) neither clipped nor in shadow."""

    vertex: Int
    view: Int
    normal: Float
    in_camera: Float
    image: Float
    known: Bool


def _of_view(view: View, number: int, caster: RayCaster, among: Int, most: int) -> VertexSamples:
    chosen = among[visible_vertices(caster, view.camera)[among]]
    image, _ = project(view.camera, caster.surface.vertices[chosen])
    row, column = np.floor(image[:, ::-1]).astype(int).T
    pixel = view.pixel_index[row, column]
    chosen, pixel = chosen[pixel >= 0], pixel[pixel >= 0]
    lights = slice(None, None, max(1, len(view.lights) // most))
    values = channel_mean(view.samples[pixel][:, lights]) * view.scale
    bright = np.quantile(values, BRIGHT, axis=0) if len(values) else 0.0
    known = view.usable(lights)[pixel] & (values > DARK * bright)
    normal = caster.vertex_normals[chosen]
    return VertexSamples(
        np.searchsorted(among, chosen), np.full(len(chosen), number), normal, normal @ view.camera.rotation.T, values, known
    )


def _left(of: VertexSamples, normal: Float, group: NDArray[np.int64], noise: float) -> float:
    """Median of what is left of samples of vertices that several views see, by lights s of views grouped by `group` (n,)."""
    groups, count = int(group.max()) + 1, int(of.vertex.max()) + 1
    lights, albedo, weight = np.zeros((groups, of.image.shape[1], 3)), np.ones(count), of.known.astype(np.float64)
    for _ in range(SWEEPS):
        for g in range(groups):
            rows = group == g
            lights[g] = solve_rows(of.image[rows].T, weight[rows].T, albedo[of.vertex[rows], None] * normal[rows])
        shading = np.maximum(np.einsum("nc,nlc->nl", normal, lights[group]), 0)
        lit = (of.known & (shading > 0)).T
        weight = robust_weights((of.image - albedo[of.vertex, None] * shading).T, lit, noise).T
        top, bottom = (np.bincount(of.vertex, (weight * of_sample * shading).sum(1), count) for of_sample in (of.image, shading))
        albedo = np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1), 1.0)
        # The scale of albedo is free.
        albedo /= max(float(np.median(albedo)), np.finfo(float).tiny)
        residual = of.image - albedo[of.vertex, None] * shading
        weight = robust_weights(residual.T, lit, noise).T
    told = of.known & (np.bincount(of.vertex)[of.vertex] > 1)[:, None]
    return float(np.median(np.abs(residual)[told])) if told.any() else np.inf


def vertex_samples(capture: Capture, caster: RayCaster, generator: np.random.Generator, most: int | None = None) -> list[VertexSamples]:
    """What each view shows of some of the vertices, under about `most` of its lights."""
    among = np.sort(generator.permutation(len(caster.surface.vertices))[:VERTICES])
    return [_of_view(view, number, caster, among, most or len(view.lights)) for number, view in enumerate(capture.views)]


def shared_frame(capture: Capture, caster: RayCaster, generator: np.random.Generator) -> Frame | None:
    """In which frame one rig of lights explains the views of a capture, whose lights have the same numbers, on a rough surface; None where
    none does, or both do."""
    of_views = vertex_samples(capture, caster, generator, LIGHTS)
    of = VertexSamples(*(np.concatenate(parts) for parts in zip(*of_views, strict=True)))
    if not len(of.vertex):
        return None
    noise, one = float(np.mean([view.scale for view in capture.views])), np.zeros_like(of.view)
    apart, with_camera, in_world = on_cores(
        lambda normal, group: _left(of, normal, group, noise), (of.normal, of.in_camera, of.normal), (of.view, one, one)
    )
    less, more = sorted((with_camera, in_world))
    if less <= EXPLAINED * apart and more > TOLD_APART * less:
        return "world" if in_world < with_camera else "camera"
    return None
