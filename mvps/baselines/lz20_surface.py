"""LZ20: the surface, from the visual hull over points and contours to positions and normals that agree.

A fusion: points on which views agree, and outlines -> carried along the contours of all views -> joined with the normals that the azimuths
of the views make (Nehab et al. 2005). Rounds have smaller and smaller faces and reach less and less far.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvps.baselines.lz20_azimuth import Azimuths
from mvps.baselines.lz20_contours import carried
from mvps.baselines.lz20_points import agreement, seen_by, tangents_at
from mvps.joint.agreement import Agreement
from mvps.joint.vertices import fuse, with_masks
from mvps.mesh import face_normals, isotropic_remesh, lengths, unbiased
from mvps.scene import Capture, Float, Int, Surface
from mvps.silhouette import mask_distances


@dataclass(frozen=True)
class Round:
    """edge of the faces; reach of the vertices to either side and step of their slide, pixels; number of fusions."""

    edge: float
    reach: float
    step: float
    fusions: int


ROUNDS = (Round(3.0, 4.0, 0.5, 4), Round(2.0, 2.0, 0.5, 2), Round(1.5, 1.5, 0.5, 1), Round(1.0, 1.0, 0.5, 2))
"""From the hull, a few pixels off, to faces that hold what the pixels' azimuths do. A vertex that has to go farther than its reach goes on
in the next fusion."""

SURE = 1.0
"""Pixels of standard deviation up to which a point counts as found."""

LEAST_SIGMA = 0.05
"""Pixels: contours and outlines are no better, whatever their number."""

NORMAL_SIGMA = 0.03
"""Radians: error of a normal from several views' azimuths; on matt and moderately glossy objects they are 1 to 2 degrees off."""


def moved(
    capture: Capture,
    surface: Surface,
    maps: tuple[Azimuths, ...],
    images: list[NDArray[np.float32]],
    pixel: float,
    on_fusion: Callable[[float], None],
) -> tuple[Surface, list[float]]:
    """The surface after all rounds, and by how many pixels each fusion moved the vertices in the mean.

    images: `tensors` of every view; pixel: what one covers at the object, world units; on_fusion is told every mean.
    """
    shifts = []
    for plan in ROUNDS:
        surface = isotropic_remesh(surface, plan.edge * pixel)
        for _ in range(plan.fusions):
            after = _fused(capture, surface, maps, images, plan, pixel)
            shifts.append(float(lengths(after.vertices - surface.vertices).mean()) / pixel)
            on_fusion(shifts[-1])
            surface = after
    return unbiased(surface), shifts


def _fused(
    capture: Capture, surface: Surface, maps: tuple[Azimuths, ...], images: list[NDArray[np.float32]], plan: Round, pixel: float
) -> Surface:
    seen = seen_by(capture, surface)
    count = round(plan.reach / plan.step)
    points = agreement(capture, surface, images, seen, plan.step * pixel * np.arange(-count, count + 1))
    sure = Agreement(points.offset, np.where(points.sigma < SURE * pixel, points.sigma, np.inf))
    sure = with_masks(sure, capture, surface, mask_distances(capture), LEAST_SIGMA * pixel)
    everywhere = carried(capture, surface, maps, sure, plan.reach * pixel, seen)
    held = Agreement(everywhere.offset, np.maximum(everywhere.sigma, LEAST_SIGMA * pixel))
    return fuse(surface, _face_targets(capture, surface, images, seen), held, NORMAL_SIGMA)[0]


def _face_targets(capture: Capture, surface: Surface, images: list[NDArray[np.float32]], seen: list[Int]) -> Float:
    """(F, 3) normals that the views' azimuths make at the faces' centres. seen: per view the vertices; a face is seen with all its
    corners."""
    of_faces: list[Int] = []
    for index in seen:
        visible = np.zeros(len(surface.vertices), bool)
        visible[index] = True
        of_faces.append(np.flatnonzero(visible[surface.faces].all(1)))
    return tangents_at(capture, images, surface.vertices[surface.faces].mean(1), face_normals(surface), of_faces)[0]
