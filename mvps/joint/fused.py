"""What the views' normal maps say together, on the vertices and on the faces of a mesh: means weighted by confidence and viewing angle.

How well a face's normal is known. With weights w of n = (sum w)^2 / sum w^2 views, effectively, and R = |sum w n| / sum w, 1 - R is half of
the mean squared angle between views and their mean (Mardia and Jupp 2000), so that they scatter with the variance (1 - R) n / (n - 1) of
either tangential component. Taken over some twenty faces, because a variance from a handful of views is known to a factor of two at best,
it gives the mean's standard deviation

    sigma^2 = variance / n + SHARED_SIGMA^2        and no more than NORMAL_SIGMA

since what is wrong with the lights is wrong in all views, and since where views differ by more there is nothing better: positions come
from the same views.

What pixels blur is given back (sharpened.py).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import scipy.sparse as sp

from mvps.camera import bilinear, project, view_directions
from mvps.cores import on_cores
from mvps.joint.pixels import few_lights
from mvps.joint.sharpened import PIXEL_BLUR, pixel_area, sharpened, within
from mvps.mesh import centres, face_normals, lengths, normalise
from mvps.scene import Bool, Capture, Float, Int, NormalMap, Surface
from mvps.silhouette import sampled

LEAST_WEIGHT = 1e-3
"""Length of a weighted sum of normals below which it says nothing: one view at 88 degrees."""

NORMAL_SIGMA = 0.03
"""Largest standard deviation of a face's normal, and where views do not tell, radians: half of all pixels are better than 1 to 2
degrees."""

SHARED_SIGMA = 0.01
"""What is common to all views, radians: lights are known to some tenths of a degree."""

LEAST_VIEWS = 1.5
"""Effective number of views from which their normals scatter."""

ROUNDS = 2
"""Of averaging variances with the faces around."""


class FaceNormals(NamedTuple):
    """Of n faces: normal (n, 3), unit, and the standard deviation sigma (n,) of either tangential component, radians."""

    normal: Float
    sigma: Float


def vertex_maps(
    capture: Capture, surface: Surface, maps: tuple[NormalMap, ...], seen: list[tuple[Int, Float]]
) -> tuple[Float, Float, Float]:
    """Normal (V, 3), grey albedo (V,) and weight (V,) of the vertices; weight 0 where unseen. seen: per view vertices and weights."""
    normal = np.zeros((len(surface.vertices), 3))
    albedo, total = np.zeros(len(normal)), np.zeros(len(normal))
    for view, photometric, (index, weight) in zip(capture.views, maps, seen, strict=True):
        positions, corners = bilinear(view.pixel_index, project(view.camera, surface.vertices[index])[0])
        w = corners * photometric.confidence[positions] * weight[:, None]
        normal[index] += (photometric.normal[positions] * w[..., None]).sum(1)
        albedo[index] += (photometric.albedo.mean(1)[positions] * w).sum(1)
        total[index] += w.sum(1)
    return normalise(normal), albedo / np.maximum(total, 1e-12), total


def face_targets(capture: Capture, surface: Surface, maps: tuple[NormalMap, ...], seen: list[Int], otherwise: Float) -> FaceNormals:
    """Normals of the F faces from the maps at their centres: a mean over corners would blur creases by an edge.

    seen: per view the vertices it sees; a face is seen where all its corners are. otherwise (V, 3): vertex normals for unseen faces.
    """
    faces = surface.faces
    centre, facing = centres(surface), face_normals(surface)
    total, (weights, squares, blur) = np.zeros((len(faces), 3)), np.zeros((3, len(faces)))

    def of_view(i: int) -> tuple[Int, Float]:
        view, photometric = capture.views[i], maps[i]
        visible = np.zeros(len(surface.vertices), bool)
        visible[seen[i]] = True
        first, second, third = (np.take(visible, faces[:, k]) for k in range(3))
        chosen = np.flatnonzero(first & second & third)
        image = np.zeros((*view.mask.shape, 4), np.float32)
        image[view.mask] = np.column_stack([photometric.normal, np.ones(len(view.pixels), np.float32)]) * photometric.confidence[:, None]
        points = np.take(centre, chosen, axis=0)
        cosine = np.einsum("ni,ni->n", np.take(facing, chosen, axis=0), view_directions(view.camera, points)).clip(0)
        found = sampled(image, project(view.camera, points)[0], cv2.BORDER_CONSTANT) * (cosine**2)[:, None]
        area = pixel_area(view.camera, points, cosine)
        # Between pixels of a bent surface the mean is shorter, which is no scatter of views.
        return chosen, np.column_stack([normalise(found[:, :3]) * found[:, 3:], found[:, 3], area * found[:, 3]])

    for chosen, summed in on_cores(of_view, range(len(capture.views))):
        total[chosen] += summed[:, :3]
        weights[chosen] += summed[:, 3]
        squares[chosen] += summed[:, 3] ** 2
        blur[chosen] += summed[:, 4]
    unknown = lengths(total) <= LEAST_WEIGHT
    target = normalise(total)
    target[unknown] = normalise(otherwise[faces[unknown]].sum(1))
    count = weights**2 / np.maximum(squares, LEAST_WEIGHT**2)
    scatter = (1 - lengths(total) / np.maximum(weights, LEAST_WEIGHT)).clip(0)
    known = count >= LEAST_VIEWS
    error = _around(scatter * count / np.maximum(count - 1, LEAST_VIEWS - 1), known, surface) / np.maximum(count, 1)
    # Of few lights the maps hold the mesh's own normals (pixels.py), about which views are of one mind.
    sigma = np.inf if few_lights(capture) else np.sqrt(error + SHARED_SIGMA**2)
    blur *= PIXEL_BLUR / np.maximum(weights, LEAST_WEIGHT)
    return FaceNormals(_without_blur(target, blur, error, known, surface), np.broadcast_to(np.fmin(sigma, NORMAL_SIGMA), len(faces)))


def _without_blur(normal: Float, blur: Float, error: Float, known: Bool, surface: Surface) -> Float:
    """Normals (F, 3), unit, without their blur (F,); error (F,) of theirs along a tangent, NaN where not known."""
    centre = centres(surface) - surface.vertices.mean(0)
    corners = surface.faces.ravel(), np.arange(0, surface.faces.size + 1, 3)
    held = sp.csr_matrix((np.ones(surface.faces.size), *corners), (len(normal), len(surface.vertices)))
    around, over_some, beside = partial(_mean_around, held=held), partial(_around, known=known, surface=surface), held @ held.T
    once = sharpened(normal, centre, blur, error, around, over_some)
    # What turns by no more than lights may be off is no edge.
    return within(once, sharpened(once, centre, blur, error + SHARED_SIGMA**2, around, over_some), beside)


def _mean_around(values: Float, held: sp.csr_matrix) -> Float:
    """(F, k) means over the faces at a face's corners, corner by corner, of values (F, k). held (F, V): 1 where a vertex is a corner."""
    number = np.maximum(np.bincount(held.indices, minlength=held.shape[1]), 1)
    mean: Float = held @ (held.T @ values / number[:, None]) / 3
    return mean


def _around(values: Float, known: Bool, surface: Surface) -> Float:
    """(F,) values, where known, averaged with those of the faces around; NaN where none around is."""
    corners, count, (a, b, c) = surface.faces.ravel(), len(surface.vertices), surface.faces.T
    share = known.astype(np.float64)
    for _ in range(ROUNDS):
        of_corners = [np.bincount(corners, np.repeat(of_faces * share, 3), count) for of_faces in (values, np.ones_like(share))]
        top, bottom = (of_all[a] + of_all[b] + of_all[c] for of_all in of_corners)
        share = (bottom > 0).astype(np.float64)
        values = np.where(bottom > 0, top / np.where(bottom > 0, bottom, 1), 0)
    return np.where(share > 0, values, np.nan)
