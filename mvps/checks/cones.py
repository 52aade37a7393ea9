"""Do silhouettes agree? Every view's mask against the hull that the other views leave.

An object is inside the silhouette cones of all views, so every ray through view i's mask meets the hull of the others (Laurentini 1994).
With m_j(x) the signed distance in pixels from the projection of a point x to mask j, negative inside, the others' hull is

    H_i = { x : m_j(x) <= slack for all j != i },

and pixels of mask i on which no point of H_i falls are *uncovered* (inconsistent silhouettes, Landabaso et al. 2008): either they are
none of the object, or another view carves away what is. Points are those of a grid around the object; the slack is what a pose to be
refined may move a silhouette, or a cell's width where that is more.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import cv2
import numpy as np
from numpy.typing import NDArray

from mvps.camera import footprint, inside_image, project, rays
from mvps.hull import encloses
from mvps.mesh import lengths
from mvps.motions import Object
from mvps.scene import Bool, Camera, Capture, Float
from mvps.silhouette import beyond_mask, mask_distances

POSE_PIXELS = 3.0
"""How far off a pose may put a silhouette and still be one to be refined, not one to be left out."""

CELLS = (32, 64)
"""Along the longest side: of a grid that finds the object's place, and of the one that judges."""

WRONG_VIEWS = 5
"""One view in so many may be wrong, and one at least."""

ENOUGH = (2 * POSE_PIXELS) ** 2
"""Uncovered pixels of a mask from which on silhouettes disagree: a patch as wide as two poses, each off by POSE_PIXELS, can make one."""


def wrong_at_most(views: int) -> int:
    """How many of so many views may be wrong."""
    return max(1, views // WRONG_VIEWS)


def _around(capture: Capture) -> tuple[Float, float]:
    """A point (3,) near the object and a radius that holds it, world, whatever a few wrong views say. Middles and extents of masks that the
    frame cuts off are not the object's: they do not count where the others enclose it by themselves."""
    whole = tuple(view for view in capture.views if not _cut_off(view.mask))
    if 0 < len(whole) < len(capture.views) and encloses(Capture(capture.name, whole)):
        capture = Capture(capture.name, whole)
    start, toward, pixels = [], [], []
    for view in capture.views:
        middle = view.pixels.mean(0)
        origin, direction = rays(view.camera, middle[None, ::-1] + 0.5)
        start.append(origin[0])
        toward.append(direction[0])
        pixels.append(lengths(view.pixels - middle).max())
    c, u = np.array(start), np.array(toward)
    across, weight = np.eye(3) - u[:, :, None] * u[:, None], np.ones(len(c))
    # Reweighted towards the least sum of distances: lines of sight that pass elsewhere do not count.
    for _ in range(20):
        point = np.linalg.lstsq((weight[:, None, None] * across).sum(0), np.einsum("v,vij,vj->i", weight, across, c), rcond=None)[0]
        weight = 1 / np.maximum(lengths(np.einsum("vij,vj->vi", across, point - c)), 1e-3 * np.median(lengths(point - c)))
    radius = np.array([p * abs(footprint(view.camera, point)) for p, view in zip(pixels, capture.views, strict=True)])
    return point, float(min(radius.max(), 2 * np.median(radius)))


def _cut_off(mask: Bool) -> bool:
    """Whether a mask (height, width) reaches the image's border."""
    return bool(mask[[0, -1]].any() or mask[:, [0, -1]].any())


class Cones:
    """The silhouette cones of a capture at the points of a grid around the object: points (n, 3) world that not too many views exclude, and
    out (views, n), whether a view does."""

    def __init__(self, capture: Capture) -> None:
        self.capture, fields = capture, mask_distances(capture)
        point, radius = _around(capture)
        low, high = point - radius, point + radius
        for cells in CELLS:
            spacing = float((high - low).max()) / cells
            cell = [spacing / abs(float(footprint(view.camera, point))) for view in capture.views]
            self._slack = [max(POSE_PIXELS, width) for width in cell]
            axes = [np.arange(low[k], high[k] + spacing, spacing) for k in range(3)]
            self.points, self.out = self._kept(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), fields)
            if not len(self.points):
                break
            low, high = self.points.min(0) - spacing, self.points.max(0) + spacing
        self._at = [self._pixels(view.camera) for view in capture.views]

    def body(self) -> Object | None:
        """Where the object is, whatever a few wrong views say; None where nothing is left of it."""
        return Object.between(self.points.min(0), self.points.max(0)) if len(self.points) else None

    def _kept(self, points: Float, fields: Sequence[NDArray[np.float32]]) -> tuple[Float, Bool]:
        """Points that no more views exclude than may be wrong and one more, and which do."""
        most, count = wrong_at_most(len(fields)) + 1, np.zeros(len(points), np.int32)
        place, excluded = np.arange(len(points)), np.zeros((len(fields), len(points)), bool)
        for view, field in enumerate(fields):
            out = excluded[view, place] = self._excluded(view, field, points)
            count += out
            keep = np.flatnonzero(count <= most)
            points, count, place = np.take(points, keep, axis=0), count[keep], place[keep]
        return points, excluded[:, place]

    def _excluded(self, view: int, field: NDArray[np.float32], points: Float) -> Bool:
        camera = self.capture.views[view].camera
        image, depth = project(camera, points)
        out: Bool = (beyond_mask(camera, field, image) > self._slack[view]) | (depth <= 0)
        # Where the image cuts the object off, it says nothing of what lies beside it.
        return out & inside_image(camera, image) if _cut_off(self.capture.views[view].mask) else out

    def _pixels(self, camera: Camera) -> NDArray[np.int32]:
        """(n,) the pixel of an image, counted by rows, on which each point falls; one more than there are where it is beside the image."""
        image = project(camera, self.points)[0]
        inside = inside_image(camera, image)
        column, row = np.floor(np.where(inside[:, None], image, 0)).astype(np.int32).T
        return np.where(inside, row * camera.width + column, camera.height * camera.width).astype(np.int32)

    def covered(self, view: int, among: Sequence[int], dissent: int = 0) -> Bool:
        """(height, width) True where the hull of the views `among`, without `view` itself, falls on a view's image; points that `dissent`
        of them exclude count too."""
        camera = self.capture.views[view].camera
        inside = np.count_nonzero(self.out[[j for j in among if j != view]], axis=0) <= dissent
        free = np.ones(camera.height * camera.width + 1, np.uint8)
        free[self._at[view][inside]] = 0
        picture = free[:-1].reshape(camera.height, camera.width)
        if picture.all():
            return np.zeros(picture.shape, bool)
        # A pixel beside the slack: neighbouring points fall on the image a cell apart.
        near: Bool = cv2.distanceTransform(picture, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= self._slack[view] + 1
        return near

    def with_parts(self, parts: Sequence[Bool]) -> Cones:
        """The cones of masks that have these parts (height, width) of every view besides; pixels to be covered stay the masks' own."""
        shown = [np.append(part.ravel(), False)[at] for part, at in zip(parts, self._at, strict=True)]
        other = copy(self)
        other.out = self.out & ~np.array(shown)
        return other

    def uncovered(self, among: Sequence[int]) -> list[int]:
        """Pixels of each mask of the views `among` that the hull of the others among them does not cover."""
        return [int((self.capture.views[i].mask & ~self.covered(i, among)).sum()) for i in among]
