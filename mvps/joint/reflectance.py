"""The lights' colours, once normals, weights and grey intensities are known.

A light's colour r (mean 1 over its channels) is what is left when the vertex's own colour g is taken out, where the diffuse part d of the
grey prediction P outweighs the lobes (they may have the light's colour, the albedo's, or neither):

    radiance_c / e = g_c r_c P,     weights (d / P)^2 on top of the robust ones

is linear in g and in r, which are solved in turn as robust ratios of sums. One factor per channel is free: r has mean one over the lights.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mvps.camera import bilinear, project
from mvps.cores import on_cores
from mvps.joint.blocks import DirectionalLights, Vertices, evaluate, robust
from mvps.joint.observe import ViewSamples
from mvps.scene import Capture, Float, Int, Law, Surface

COLOUR_SWEEPS = 3
PAIRS_PER_CHUNK = 2048


class Observed(NamedTuple):
    """Photographs, the samples of vertices in their views, and all that predicts these but colour; lights and samples per view."""

    capture: Capture
    surface: Surface
    views: list[ViewSamples]
    vertices: Vertices
    lights: list[DirectionalLights]
    law: Law


class Chunk(NamedTuple):
    """Samples of some pairs of a view. rows (n,): their vertices; part: of the view's pairs; per light (n, lights): robust weight, basis
    q = dI/da, diffuse d and grey prediction P; image (n, lights, 3): radiance."""

    part: slice
    rows: Int
    weight: NDArray[np.float32]
    basis: NDArray[np.float32]
    diffuse: NDArray[np.float32]
    predicted: NDArray[np.float32]
    image: NDArray[np.float32]


def chunks(of: Observed, i: int) -> Iterator[Chunk]:
    """The samples of view i with their colours."""
    view, samples, vertices, lights = of.capture.views[i], of.views[i], of.vertices, of.lights[i]
    for start in range(0, len(samples.vertex), PAIRS_PER_CHUNK):
        part = slice(start, start + PAIRS_PER_CHUNK)
        index, towards = samples.vertex[part], samples.towards[part]
        shaded = evaluate(vertices.normal[index], vertices.reflectance[index], towards, lights, of.law, samples.gathered_of(part))
        residual = shaded.predicted - samples.image[part]
        weight = samples.weight[part, None] * samples.data[part] * robust(residual, vertices.scale[index], shaded.unsure)
        diffuse = shaded.basis[0] * vertices.reflectance[index, :1]
        rows = index.cpu().numpy()
        positions, weights = bilinear(view.pixel_index, project(view.camera, of.surface.vertices[rows])[0])
        image = np.einsum("pklc,pk->plc", view.samples[positions].astype(np.float32) * np.float32(view.scale), weights)
        w, basis, body, predicted = (t.cpu().numpy() for t in (weight, shaded.basis[0], diffuse, shaded.predicted))
        yield Chunk(part, rows, w, basis, body, predicted, image)


class _Sums(NamedTuple):
    """Numerators and denominators: of a vertex's colour, per pair (n, 3) and (n,); of a light's colour (lights, 3)."""

    colour: Float
    colour_weight: Float
    light: Float
    light_weight: Float


class _Told(NamedTuple):
    """What a chunk says of colours, whatever they are: part and rows of the chunk; P and P^2 with the weights (n, lights); image."""

    part: slice
    rows: Int
    predicted: NDArray[np.float32]
    squared: NDArray[np.float32]
    image: NDArray[np.float32]


def _told(of: Observed, i: int) -> list[_Told]:
    """All of view i."""
    told = []
    for chunk in chunks(of, i):
        body: Any = chunk.weight * (chunk.diffuse / np.maximum(chunk.predicted, 1e-12)) ** 2
        told.append(_Told(chunk.part, chunk.rows, body * chunk.predicted, body * chunk.predicted**2, chunk.image))
    return told


def _sums(told: list[_Told], pairs: int, ratio: NDArray[np.float32], colour: NDArray[np.float32]) -> _Sums:
    """Those of a view with so many pairs."""
    count = len(ratio)
    out = _Sums(np.zeros((pairs, 3)), np.zeros(pairs), np.zeros((count, 3)), np.zeros((count, 3)))
    for part, rows, predicted, squared, image in told:
        out.colour[part] = np.einsum("pl,plc->pc", predicted, image / ratio)
        out.colour_weight[part] = squared.sum(1)
        out.light[:] += np.einsum("pl,plc,pc->lc", predicted, image, colour[rows])
        out.light_weight[:] += np.einsum("pl,pc->lc", squared, colour[rows] ** 2)
    return out


def light_ratios(of: Observed, ratios: list[Float], one_rig: bool) -> list[Float]:
    """Per view the lights' channel ratios (lights, 3), from `ratios` on. All samples are kept meanwhile: those of some thousand vertices
    are enough."""
    colour = np.ones((len(of.vertices.normal), 3), np.float32)
    told = on_cores(lambda i: _told(of, i), range(len(of.views)))

    def sums() -> list[_Sums]:
        return on_cores(lambda i: _sums(told[i], len(of.views[i].vertex), ratios[i].astype(np.float32), colour), range(len(told)))

    for _ in range(COLOUR_SWEEPS):
        top, bottom = _over_views(of.views, [(s.colour, s.colour_weight) for s in sums()], len(colour))
        colour = (top / np.maximum(bottom, 1e-12)[:, None]).astype(np.float32)
        ratios = _ratios([(s.light, s.light_weight) for s in sums()], one_rig)
    return ratios


def _over_views(views: list[ViewSamples], sums: list[tuple[Float, Float]], vertices: int) -> tuple[Float, Float]:
    """Sums of pairs added up per vertex: (V, 3) and (V,)."""
    top, bottom = np.zeros((vertices, 3)), np.zeros(vertices)
    for samples, (numerator, denominator) in zip(views, sums, strict=True):
        index = samples.vertex.cpu().numpy()
        top[index] += numerator
        bottom[index] += denominator
    return top, bottom


def _ratios(sums: list[tuple[Float, Float]], one_rig: bool) -> list[Float]:
    if one_rig:
        sums = [(np.sum([t for t, _ in sums], axis=0), np.sum([b for _, b in sums], axis=0))] * len(sums)
    ratios = [top / np.maximum(bottom, 1e-300) for top, bottom in sums]
    # Of a photograph that was left out no sample speaks: white.
    ratios = [np.where(ratio.sum(1, keepdims=True) > 0, ratio, 1.0) for ratio in ratios]
    ratios = [ratio / np.maximum(ratio.mean(1, keepdims=True), 1e-300) for ratio in ratios]
    # A common tint of all lights is a tint of the object: the convention is lights that are white on average.
    tint = np.mean(np.concatenate(ratios), axis=0)
    ratios = [ratio / tint for ratio in ratios]
    return [ratio / ratio.mean(1, keepdims=True) for ratio in ratios]
