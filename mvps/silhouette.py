"""Silhouettes: where a mask ends, and the outline of a mesh in a view with what a move of its vertices does to it.

Mask. A mask's boundary runs between the centres of its last foreground and its first background pixel, half a pixel from either. The signed
distance to it, smoothed over a pixel, is m(q), negative inside.

Outline. The surface turns away from a view where n(x) . v(x) = 0. With normals interpolated between vertices this line crosses every face
whose corners differ in the sign of n . v, as one segment (Hertzmann and Zorin 2000); its centre x has barycentric coordinates b. A segment
belongs to the outline where a ray that passes just beside it misses the whole mesh. There n is at right angles to the line of sight, so
a slide along the surface moves the outline by nothing and a move by d along n moves it in the image by

    d rate u,      J n = rate u,   |u| = 1,      J the derivative of the projection at x

exactly to first order (Cipolla and Giblin 2000). The mask therefore wants  d = -m / (rate dm/du).

A face cuts off what the smooth surface that it stands for bulges by. Along an edge from x_i to x_j a quadratic surface bulges by
(n_i - n_j) . (x_i - x_j) / 8 at most, over a face at b by

    h = 1/2 sum over its edges of b_i b_j (n_i - n_j) . (x_i - x_j)

so that there the outline is h rate farther out along u than the segment. (Left out, masks pulled the vertices of 2 pixels' edges out by
0.05 px on balls with hollows and by 0.1 px of 0.3 along the sharp edges of a gear; docs/findings/vertices.md.)
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter

from mvps.camera import footprint, inside_image, project, rays
from mvps.cores import on_cores
from mvps.mesh import lengths, normalise
from mvps.once import once_for
from mvps.scene import Bool, Camera, Capture, Float, Int
from mvps.visibility import RayCaster

STAIRCASE_PIXELS = 1.0
"""Standard deviation, pixels, that smooths the distance to a binary mask: its boundary is a staircase of one-pixel steps. A straight
boundary stays where it is; one of radius r pixels moves by 1 / (2 r) pixels."""

BESIDE_PIXELS = 0.2
"""How far beside an outline the ray passes: more than faces cut off a curve (0.1 pixels for edges of 1.5 and a radius of 3), less than a
pixel of a mask tells (0.29)."""

PROBE_PIXELS = 1e-3
"""Step of the difference quotient that stands for J n."""

REMAP_LIMIT = 1 << 14
"""Points per call of cv2.remap, which takes no side longer than a signed 16-bit integer."""


@dataclass(frozen=True, eq=False)
class Outline:
    """n segments of a mesh's outline in a view. face (n,); barycentric (n, 3) of the centre; image (n, 2) of the smooth surface's outline
    beside it and length (n,) in pixels; outward (n, 2) u, unit; rate (n,) pixels of image per world unit along the normal."""

    face: Int
    barycentric: Float
    image: Float
    length: Float
    outward: Float
    rate: Float


@once_for
def mask_distance(mask: Bool) -> NDArray[np.float32]:
    """(height, width) signed distance in pixels from pixel centres to the mask's boundary, negative inside."""
    # scipy rather than OpenCV, whose blur and distance differ in the last bits from call to call.
    inside, outside = distance_transform_edt(mask), distance_transform_edt(~mask)
    signed = np.where(mask, 0.5 - inside, outside - 0.5)
    smooth: NDArray[np.float32] = gaussian_filter(signed, STAIRCASE_PIXELS, mode="nearest").astype(np.float32)
    return smooth


def mask_distances(capture: Capture) -> list[NDArray[np.float32]]:
    """`mask_distance` of every view, made once for a mask, on all cores."""
    return on_cores(lambda view: mask_distance(view.mask), capture.views)


def sampled(field: NDArray[np.float32], image: Float, border: int = cv2.BORDER_REPLICATE) -> NDArray[np.float32]:
    """Bilinear values (n[, channels]) of a field (height, width[, channels]) at image coordinates (n, 2) (OpenCV before 5 rounds these to a
    32nd of a pixel); beyond the border its nearest value, or 0 with cv2.BORDER_CONSTANT."""
    return sampled_at(field, image[:, 0], image[:, 1], border)


def sampled_at(field: NDArray[np.float32], x: Float, y: Float, border: int = cv2.BORDER_REPLICATE) -> NDArray[np.float32]:
    """`sampled` at x and y (n,), which need not lie side by side."""
    x, y = (of.astype(np.float32) - np.float32(0.5) for of in (x, y))
    values = np.empty((len(x), *field.shape[2:]), np.float32)
    for start in range(0, len(x), REMAP_LIMIT):
        part = slice(start, start + REMAP_LIMIT)
        values[part] = cv2.remap(field, x[None, part], y[None, part], cv2.INTER_LINEAR, borderMode=border)[0]
    return values


def beyond_mask(camera: Camera, field: NDArray[np.float32], image: Float, frame_open: bool = False) -> NDArray[np.float32]:
    """Signed distance (n,) in pixels of image coordinates (n, 2) to a mask, negative inside; field: its `mask_distance`.

    Beyond the image nothing was photographed: there it is outside, at least by its distance to the image. frame_open: where the image's
    border cuts the object off nothing is known of what lies beyond, and the distance is -inf.
    """
    pixels = sampled(field, image)
    outside = np.flatnonzero(~inside_image(camera, image))
    limit = np.array([camera.width, camera.height])
    beyond = lengths(np.maximum(np.maximum(-image[outside], image[outside] - limit), 0))
    cut = frame_open & (pixels[outside] < 0)
    pixels[outside] = np.where(cut, -np.inf, np.maximum(pixels[outside], 0.5) + beyond)
    return pixels


def outline(caster: RayCaster, camera: Camera) -> Outline:
    """The outline of the caster's mesh in a view."""
    x, normal, faces = caster.surface.vertices, caster.vertex_normals, caster.surface.faces
    # Not over the distance to the camera, which hardly differs between a face's corners: only the sign and ratios count.
    facing = normal @ camera.centre - np.einsum("ni,ni->n", normal, x)
    turned = facing > 0
    first, second, third = (np.take(turned, faces[:, k]) for k in range(3))
    chosen = np.flatnonzero((first != second) | (second != third))
    of_corners, facing = turned[faces[chosen]], facing[faces[chosen]]
    # The corner on a side of its own comes first.
    alone = np.where(of_corners.sum(1) == 1, of_corners.argmax(1), (~of_corners).argmax(1))
    order = (alone[:, None] + np.arange(3)) % 3
    s = np.take_along_axis(facing, order, 1)
    corners = np.take_along_axis(faces[chosen], order, 1)
    part = s[:, :1] / (s[:, :1] - s[:, 1:])
    ends = x[corners[:, :1]] + part[..., None] * (x[corners[:, 1:]] - x[corners[:, :1]])
    image = project(camera, ends)[0]
    turned_back = np.argsort(order, axis=1)
    barycentric = np.take_along_axis(np.column_stack([1 - part.mean(1), part / 2]), turned_back, 1)
    centre, middle = ends.mean(1), image.mean(1)
    outward = normalise(np.einsum("nk,nkc->nc", barycentric, normal[faces[chosen]]))
    step = PROBE_PIXELS * footprint(camera, centre)
    moved = (project(camera, centre + step[:, None] * outward)[0] - project(camera, centre)[0]) / step[:, None]
    rate, u = lengths(moved), normalise(moved)
    free = ~caster.occluded(*rays(camera, middle + BESIDE_PIXELS * u))
    bulging = middle + (rate * _bulge(x[faces[chosen]], normal[faces[chosen]], barycentric))[:, None] * u
    return Outline(chosen[free], barycentric[free], bulging[free], lengths(image[:, 0] - image[:, 1])[free], u[free], rate[free])


def _bulge(corners: Float, normal: Float, barycentric: Float) -> Float:
    """h (n,) over faces with corners and their normals (n, 3, 3)."""
    side, turn = (of - np.roll(of, -1, axis=1) for of in (corners, normal))
    bulge: Float = np.einsum("nk,nkc,nkc->n", barycentric * np.roll(barycentric, -1, axis=1), turn, side) / 2
    return bulge
