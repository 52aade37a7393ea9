"""Photographs on the vertices of a mesh, with all that predicts them but colour, and their samples in colour."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mvps.camera import bilinear, project
from mvps.joint.blocks import DirectionalLights, Vertices, evaluate, robust
from mvps.joint.observe import ViewSamples
from mvps.scene import Capture, Int, Law, Surface

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
