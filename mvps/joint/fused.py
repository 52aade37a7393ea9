"""What the views' normal maps say together, on the vertices and on the faces of a mesh: means weighted by confidence and viewing angle."""

from __future__ import annotations

import cv2
import numpy as np

from mvps.camera import bilinear, project, view_directions
from mvps.cores import on_cores
from mvps.mesh import face_normals, lengths, normalise
from mvps.scene import Capture, Float, Int, NormalMap, Surface
from mvps.silhouette import sampled

LEAST_WEIGHT = 1e-3
"""Length of a weighted sum of normals below which it says nothing: one view at 88 degrees."""


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


def face_targets(capture: Capture, surface: Surface, maps: tuple[NormalMap, ...], seen: list[Int], otherwise: Float) -> Float:
    """(F, 3) normals of the faces from the maps at their centres: a mean over corners would blur creases by an edge.

    seen: per view the vertices it sees; a face is seen where all its corners are. otherwise (V, 3): vertex normals for unseen faces.
    """
    faces = surface.faces
    centre, facing = surface.vertices[faces].mean(1), face_normals(surface)
    total = np.zeros((len(faces), 3))

    def of_view(i: int) -> tuple[Int, Float]:
        view, photometric = capture.views[i], maps[i]
        visible = np.zeros(len(surface.vertices), bool)
        visible[seen[i]] = True
        chosen = np.flatnonzero(visible[faces].all(1))
        image = np.zeros((*view.mask.shape, 3), np.float32)
        image[view.mask] = photometric.normal * photometric.confidence[:, None]
        points = centre[chosen]
        cosine = np.einsum("ni,ni->n", facing[chosen], view_directions(view.camera, points)).clip(0)
        return chosen, sampled(image, project(view.camera, points)[0], cv2.BORDER_CONSTANT) * (cosine**2)[:, None]

    for chosen, summed in on_cores(of_view, range(len(capture.views))):
        total[chosen] += summed
    unknown = lengths(total) <= LEAST_WEIGHT
    target = normalise(total)
    target[unknown] = normalise(otherwise[faces[unknown]].sum(1))
    return target
