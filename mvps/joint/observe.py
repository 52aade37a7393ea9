"""What the photographs say about the vertices of a mesh: one grey sample per (vertex, view, light).

A vertex takes part in a view that sees it; its sample under light l is the bilinear value at its projection,

    I_l = mean over channels of radiance_c / ratio_lc,     ratio = intensity over its mean over the channels,

so that what is left of a light is one number, its mean intensity; channels that a light lacks count less (`channel_shares`). Samples that
are saturated or whose light another part of the mesh hides are no data, nor are those beside them. A pair (vertex, view) is weighted by
cos^2 of the viewing angle (a pixel covers 1 / cos of the surface, and an error of the position moves the projection by as much again),
times the part of its four pixels that is foreground at least one pixel away from the mask's boundary, where pixels mix object and
background.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvps.bounce import on_vertices
from mvps.camera import bilinear, project, view_directions
from mvps.cores import on_cores
from mvps.gleam import Senders, terms
from mvps.once import once_for
from mvps.pixel_samples import channel_shares
from mvps.scene import Bool, Capture, Float, Int, Lights, Surface, View
from mvps.visibility import RayCaster, ray_caster, shade_of, visible_vertices

SAMPLES_PER_CHUNK = 1 << 17
"""Samples handled at once: smaller chunks wait for the interpreter, larger ones leave the processor's last cache
(docs/findings/cost.md)."""

SAMPLES_PER_LAUNCH = 1 << 21
"""The same on a GPU: to read and write so many at 1 to 4 TB/s takes about as long as to start an operation, 5 to 10 us."""

LIGHTEST_PAIR = 1e-3
"""A pair of less weight (seen at over 88 degrees, or on a silhouette) is left out."""

SHADOW_MARGIN = 2
"""Pixels, or edges of the mesh, beside a cast shadow that are no data either: a pixel mixes what is on both sides of the border, and the
mesh says where that is to about another."""

HIDDEN_MARGIN = 1
"""Edges between what a view sees and what another part hides from it: their pixels mix both."""


@dataclass(frozen=True, eq=False)
class ViewSamples:
    """One view's samples of the n vertices it sees. All in torch; directions in the world frame.

    vertex (n,) index; towards (n, 3) unit vector to the camera; weight (n,) of the pair; image (n, lights) grey radiance;
    data (n, lights) bool, False where saturated, in cast shadow or beside it; gathered (n, lights, terms) what other surfaces send
    (gleam.py), None where that is not asked for; dark (n, lights) bool, True deep in cast shadow and not saturated, None without shadows.
    """

    vertex: Tensor
    towards: Tensor
    weight: Tensor
    image: Tensor
    data: Tensor
    gathered: Tensor | None = None
    dark: Tensor | None = None

    def gathered_of(self, part: slice) -> Tensor | None:
        """`gathered` of some pairs."""
        return None if self.gathered is None else self.gathered[part]

    def of_pairs(self, rows: Tensor) -> ViewSamples:
        """Only some of the pairs."""
        gathered, dark = (None if a is None else a[rows] for a in (self.gathered, self.dark))
        return ViewSamples(self.vertex[rows], self.towards[rows], self.weight[rows], self.image[rows], self.data[rows], gathered, dark)

    def of_vertices(self, some: Tensor, count: int) -> ViewSamples:
        """Only the pairs of some of the mesh's `count` vertices, indices (n,)."""
        chosen = torch.zeros(count, dtype=torch.bool, device=some.device)
        chosen[some] = True
        return self.of_pairs(chosen[self.vertex].nonzero()[:, 0])

    def of_lights(self, rows: slice | Tensor) -> ViewSamples:
        """Only some of the lights."""
        gathered, dark = (None if a is None else a[:, rows].contiguous() for a in (self.gathered, self.dark))
        image, data = (values[:, rows].contiguous() for values in (self.image, self.data))
        return ViewSamples(self.vertex, self.towards, self.weight, image, data, gathered, dark)

    @property
    def pairs_at_once(self) -> int:
        """Pairs that hold about as many samples as are handled at once."""
        samples = SAMPLES_PER_CHUNK if self.image.device.type == "cpu" else SAMPLES_PER_LAUNCH
        return max(1, samples // max(1, self.image.shape[1]))

    def chunks(self) -> Iterator[slice]:
        """Slices of the pairs that are handled at once."""
        step = self.pairs_at_once
        return (slice(start, start + step) for start in range(0, len(self.vertex), step))


@once_for
def interior(view: View) -> NDArray[np.float32]:
    """(pixels,) 1 where all eight neighbours of a foreground pixel are foreground, else 0."""
    eroded = cv2.erode(view.mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    inside: NDArray[np.float32] = eroded[view.mask].astype(np.float32)
    return inside


def channel_ratio(intensity: Float) -> Float:
    """(lights, 3) intensity of the channels over their mean."""
    ratio: Float = intensity / intensity.mean(1, keepdims=True)
    return ratio


def grey_radiance(view: View, intensity: Float) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Of a view's foreground pixels (pixels, lights): grey radiance, what is left of a light being its mean intensity, and where no
    channel is saturated."""
    ratio = channel_ratio(intensity)
    per_channel = (view.scale * channel_shares(ratio) / (3 * ratio)).astype(np.float32)
    red, green, blue = (view.samples[..., c] * per_channel[:, c] for c in range(3))
    red += green
    red += blue
    return red, view.usable()


def _sampled(
    image: NDArray[np.float32], usable: NDArray[np.bool_], positions: Int, weights: Float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Grey radiance (n, lights) at bilinear positions, weights (n, 4) of the foreground list, and whether all four are usable."""
    corners = _corners(positions, weights, len(image))
    return corners @ image, ~_lost(usable, corners)


def _corners(positions: Int, weights: Float, pixels: int) -> sp.csr_matrix:
    """(n, pixels) from values of pixels to those at bilinear positions, weights (n, 4)."""
    ends = np.arange(0, positions.size + 1, 4)
    return sp.csr_matrix((weights.astype(np.float32).ravel(), positions.ravel(), ends), (len(positions), pixels))


def _lost(usable: NDArray[np.bool_], corners: sp.csr_matrix) -> NDArray[np.bool_]:
    """(n, lights) whether one of the pixels that corners (n, pixels) take part in is not usable (pixels, lights)."""
    if usable.all():
        return np.zeros((corners.shape[0], usable.shape[1]), bool)
    return np.asarray((corners @ (~usable).astype(np.float32)) > 0)


def saturated(view: View, points: Float) -> NDArray[np.bool_]:
    """(n, lights) whether a view's photographs say only that points (n, 3) of the object are no darker than so."""
    positions, weights = bilinear(view.pixel_index, project(view.camera, points)[0])
    usable = view.usable()
    return _lost(usable, _corners(positions, weights, len(usable)))


def _pairs(view: View, caster: RayCaster, among: Bool | None = None) -> tuple[Int, Float, Int, Float]:
    """Vertices (n,) that a view sees, with the weight of the pair (n,) and the bilinear positions and weights (n, 4). among (V,): only
    these."""
    visible = visible_vertices(caster, view.camera, HIDDEN_MARGIN)
    vertex = np.flatnonzero(visible if among is None else visible & among)
    points, normal = caster.surface.vertices[vertex], caster.vertex_normals[vertex]
    positions, weights = bilinear(view.pixel_index, project(view.camera, points)[0])
    pure = (interior(view)[positions] * weights).sum(1)
    pair = pure * np.maximum(np.einsum("ni,ni->n", normal, view_directions(view.camera, points)), 0) ** 2
    keep = pair > LIGHTEST_PAIR
    return vertex[keep], pair[keep], positions[keep], weights[keep]


def visible_in(capture: Capture, surface: Surface) -> list[tuple[Int, Float]]:
    """Per view the vertices that it sees (n,) and the weight of each pair (n,)."""
    caster = ray_caster(surface)
    return on_cores(lambda view: _pairs(view, caster)[:2], capture.views)


def observe(
    capture: Capture, surface: Surface, lights: Lights, device: torch.device, among: Bool | None = None, shadows: bool = True
) -> list[ViewSamples]:
    """The samples of all views on the vertices of `surface`, or on those `among` (V,); visibility is traced anew, and cast shadows if
    the law has them."""
    caster = ray_caster(surface)

    def one(i: int) -> ViewSamples:
        view = capture.views[i]
        vertex, pair, positions, weights = _pairs(view, caster, among)
        towards = view_directions(view.camera, surface.vertices[vertex])
        image, usable = _sampled(*grey_radiance(view, lights.intensity[i]), positions, weights)
        dark = None
        if shadows:
            shade = shade_of(caster, vertex, lights.direction[i], SHADOW_MARGIN)
            usable, dark = usable & ~shade.beside, torch.from_numpy(usable & shade.deep).to(device)
        of_pairs = (vertex, towards.astype(np.float32), pair.astype(np.float32), image, usable)
        vertex_, towards_, pair_, image_, usable_ = (torch.from_numpy(values).to(device) for values in of_pairs)
        return ViewSamples(vertex_, towards_, pair_, image_, usable_, dark=dark)

    return on_cores(one, range(len(capture.views)))


def with_gathered(views: list[ViewSamples], capture: Capture, surface: Surface, senders: Senders, lights: Lights) -> list[ViewSamples]:
    """The samples of a capture's views with what other surfaces send to them under the lights."""
    weight = on_vertices(senders.sources.of, surface)

    def one(i: int) -> ViewSamples:
        sent = terms(senders, lights.direction[i], capture.views[i].camera.centre)
        values = sent.through(weight[views[i].vertex.cpu().numpy()])
        return replace(views[i], gathered=torch.from_numpy(values).to(views[i].image.device))

    return on_cores(one, range(len(views)))
