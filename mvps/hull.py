"""The visual hull: intersection of the silhouette cones, as a signed distance on a grid.

For view i let m_i(x) be the signed distance in pixels from the projection of x to the boundary of the mask, negative inside.
At depth z_i a pixel covers z_i / f_i world units, so

    d(x) = max_i m_i(x) z_i / f_i

is zero on the hull and a lower bound of the distance near it (Laurentini 1994 for the hull). A view whose frame cuts the object off says
nothing of what lies beyond that border, if those that hold all of it enclose it by themselves; else what is beyond counts as outside.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from skimage.measure import marching_cubes

from mvps.camera import pixel_footprint, project
from mvps.cores import on_cores
from mvps.mesh import chosen_pieces, face_areas, labelled_pieces, largest_pieces, lengths
from mvps.once import once_for
from mvps.scene import Bool, Capture, CaptureError, Float, SignedDistanceGrid, Surface, View
from mvps.silhouette import beyond_mask, mask_distances

MARGIN_CELLS = 3
"""Cells of free space kept around the hull, so that the level set closes inside the grid."""

POINTS_PER_PART = 1 << 15
"""Points handled at once: their arrays stay in the processor's cache."""

ALONE = 0.01
"""Of the pixels of all masks, what a piece of the hull must be alone in covering: less are cells of noise."""

MINIMUM_CELLS_ACROSS = 8
"""A hull thinner than this many coarse cells is no solid that masks could have made."""


class Box(NamedTuple):
    """Corners low, high (3,) of a box around the object; frame_open: whether views say nothing of what lies beyond borders that cut it
    off."""

    low: Float
    high: Float
    frame_open: bool


@once_for
def masks_box(capture: Capture) -> Box:
    """The smallest axis-parallel box that holds the intersection of the masks' bounding pyramids, without the sides along which frames cut
    the object off, if those views that hold all of it enclose it by themselves.

    Raises CaptureError where the pyramids do not meet or leave the object unbounded (one view, or wrong poses).
    """
    whole = tuple(view for view in capture.views if not frame(view.mask).any())
    frame_open = len(whole) == len(capture.views) or (bool(whole) and encloses(Capture(capture.name, whole)))
    return Box(*bounds(capture, frame_open), frame_open)


def encloses(capture: Capture) -> bool:
    """Whether the masks' bounding pyramids meet and bound an object."""
    try:
        bounds(capture, False)
    except CaptureError:
        return False
    return True


def frame(mask: Bool) -> Bool:
    """(4,) whether a mask (height, width) reaches the image's left, right, upper and lower border."""
    return np.array([mask[:, 0].any(), mask[:, -1].any(), mask[0].any(), mask[-1].any()])


def bounds(capture: Capture, frame_open: bool) -> tuple[Float, Float]:
    """Corners (3,), (3,) of `masks_box`, with all sides of the masks' bounding rectangles, or without those on the frame.

    Each side cuts a half-space a . x <= b from the world; six linear programmes find the box.
    """
    normals, offsets = [], []
    for view in capture.views:
        rows, columns = np.nonzero(view.mask)
        P = view.camera.K @ np.column_stack([view.camera.rotation, view.camera.translation])
        sides = [(columns.min(), 0, 1.0), (columns.max() + 1, 0, -1.0), (rows.min(), 1, 1.0), (rows.max() + 1, 1, -1.0)]
        for (limit, axis, sign), on_frame in zip(sides, frame(view.mask), strict=True):
            if on_frame and frame_open:
                continue
            plane = sign * (limit * P[2] - P[axis])
            normals.append(plane[:3])
            offsets.append(-plane[3])
        normals.append(-P[2, :3])
        offsets.append(P[2, 3])
    A, b = np.array(normals), np.array(offsets)
    scale = np.linalg.norm(A, axis=1)
    # Distances to the first camera's centre as the unit keep the programme well scaled in any unit of the capture.
    origin = np.mean([view.camera.centre for view in capture.views], axis=0)
    unit = max(float(np.linalg.norm(view.camera.centre - origin)) for view in capture.views) or 1.0
    A, b = A / scale[:, None], (b / scale - A @ origin / scale) / unit
    corners = np.empty((2, 3))
    for axis in range(3):
        for side, sign in enumerate((1.0, -1.0)):
            solution = linprog(sign * np.eye(3)[axis], A, b, bounds=(None, None), method="highs")
            if solution.status != 0:
                why = "do not meet in one place" if solution.status == 2 else "leave the object unbounded"
                raise CaptureError(
                    f"{capture.name}: wanted masks and cameras that enclose one object, given {len(capture.views)} views whose"
                    f" silhouettes {why}; check Calib_Results.mat and the masks, or use views from more sides"
                )
            corners[side, axis] = solution.x[axis]
    low, high = corners * unit + origin
    if not (high > low).all():
        raise CaptureError(
            f"{capture.name}: wanted cameras around an object, given {len(capture.views)} views whose silhouettes enclose a box without"
            " volume; check the translations in Calib_Results.mat"
        )
    return low, high


def _distance(view: View, field: NDArray[np.float32], points: Float, frame_open: bool) -> NDArray[np.float32]:
    """Signed distance of world points (n, 3) to one view's silhouette cone, world units, -inf where the view cannot tell; behind a
    camera, where the grid's nodes may be if it stands near the object, that to its plane and a pixel more."""
    image, depth = project(view.camera, points)
    beyond = beyond_mask(view.camera, field, image, frame_open) * depth / view.camera.focal_length
    behind = -depth + lengths(points - view.camera.centre) / view.camera.focal_length
    return np.where(depth > 0, beyond, behind).astype(np.float32)


class _Masks:
    """The silhouette cones of all views."""

    def __init__(self, capture: Capture) -> None:
        self._views = list(zip(capture.views, mask_distances(capture), strict=True))
        self._frame_open = masks_box(capture).frame_open

    def cut(self, points: Float) -> NDArray[np.float32]:
        """The hull's signed distance (n,) at world points (n, 3)."""
        distance = np.full(len(points), -np.inf, np.float32)

        def of_part(start: int) -> None:
            part = slice(start, start + POINTS_PER_PART)
            for view, field in self._views:
                np.maximum(distance[part], _distance(view, field, points[part], self._frame_open), out=distance[part])

        on_cores(of_part, range(0, len(points), POINTS_PER_PART))
        return distance


def _grid_points(origin: Float, spacing: float, shape: tuple[int, int, int]) -> Float:
    axes = [origin[k] + spacing * np.arange(shape[k]) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def _sample(masks: _Masks, low: Float, high: Float, cells: int) -> SignedDistanceGrid:
    spacing = float((high - low).max()) / cells
    origin = low - MARGIN_CELLS * spacing
    nx, ny, nz = (int(n) + 2 * MARGIN_CELLS + 1 for n in np.ceil((high - low) / spacing))
    shape = (nx, ny, nz)
    values = masks.cut(_grid_points(origin, spacing, shape)).reshape(shape)
    return SignedDistanceGrid(values, origin, spacing)


def signed_distance(capture: Capture, cells: int) -> SignedDistanceGrid:
    """The hull's signed distance on a grid of `cells` along the longest side of the object.

    A coarse grid over `bounds` finds the hull's own box first. Raises CaptureError where no point is inside all masks.
    """
    low, high, _ = masks_box(capture)
    masks = _Masks(capture)
    coarse = _sample(masks, low, high, min(cells, 32))
    # A cell whose corner is nearer than its diagonal to the hull may hold a part of it.
    inside = np.argwhere(coarse.values < coarse.spacing * np.sqrt(3))
    if not (coarse.values < coarse.spacing).any() or len(inside) < MINIMUM_CELLS_ACROSS:
        raise CaptureError(
            f"{capture.name}: wanted masks that agree on one object, given {len(capture.views)} masks whose common part is empty;"
            " check that masks and poses belong together"
        )
    low = np.maximum(low, coarse.origin + coarse.spacing * (inside.min(0) - 1))
    high = np.minimum(high, coarse.origin + coarse.spacing * (inside.max(0) + 1))
    return _sample(masks, low, high, cells)


@once_for
def hull_grid(capture: Capture) -> SignedDistanceGrid:
    """`signed_distance` with `default_cells`."""
    return signed_distance(capture, default_cells(capture))


@once_for
def hull_of_masks(capture: Capture, grid: SignedDistanceGrid) -> Surface:
    """The hull with all pieces that masks ask for: the largest, and others, the one that covers most of them first, as long as it
    alone covers a share ALONE of the masks. What masks do not ask for are cells of noise, and ghosts where cones of several parts meet."""
    whole = _level_set(grid)
    asked = ALONE * int(sum(view.mask.sum() for view in capture.views))
    label, order = labelled_pieces(whole)
    area = np.bincount(label, face_areas(whole))
    # A closed piece shows a camera half of its area at most, and twice as near as the middle four times as many pixels.
    pixel = pixel_footprint([view.camera for view in capture.views], whole.vertices.mean(0))
    others = [k for k in order[1:] if 4 * len(capture.views) * area[k] / 2 > asked * pixel**2]
    kept = [order[0]]

    def with_also(k: int) -> int:
        return covered(chosen_pieces(whole, label, [*kept, k]), capture)

    before = covered(chosen_pieces(whole, label, kept), capture) if others else 0
    while others:
        gains = [with_also(k) - before for k in others]
        best = int(np.argmax(gains))
        if gains[best] < asked:
            break
        before += gains[best]
        kept.append(others.pop(best))
    return chosen_pieces(whole, label, kept)


def covered(surface: Surface, capture: Capture) -> int:
    """Pixels of masks that the surface covers, over all views."""
    from mvps.visibility import camera_hits, ray_caster

    caster = ray_caster(surface)
    return sum(int((camera_hits(caster, view.camera, view.pixels).face >= 0).sum()) for view in capture.views)


def visual_hull(grid: SignedDistanceGrid, pieces: int = 1) -> Surface:
    """The zero level set, its largest pieces, faces outwards, world units."""
    return largest_pieces(_level_set(grid), pieces)


def _level_set(grid: SignedDistanceGrid) -> Surface:
    if not grid.values.min() < 0 < grid.values.max():
        raise CaptureError(
            "visual hull: wanted masks that agree on one object, given masks whose common part is empty; check masks and poses"
        )
    vertices, faces, _, _ = marching_cubes(np.array(grid.values), 0.0)
    return Surface(grid.origin + grid.spacing * vertices.astype(np.float64), faces)


def default_cells(capture: Capture) -> int:
    """Cells along the object so that one cell is about two pixels: below that the masks themselves carry no shape."""
    low, high, _ = masks_box(capture)
    pixel = pixel_footprint([view.camera for view in capture.views], (low + high) / 2)
    return int(np.clip(round(float((high - low).max()) / (2 * pixel)), 24, 192))
