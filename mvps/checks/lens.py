"""Distortion of the lens that a calibration gives: still in the photographs, or undone before.

Calibrations keep its numbers (distortion.py) when photographs are undistorted, so they do not say
whether photographs are. Silhouettes do: with the lens undone in the masks, or not, the lines of sight along the outlines miss what the
other views leave of the object by less (coherence.py). Where that is certain, photographs follow.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvps.checks.outlines import MASK_NOISE, fallen, misfit, outlines_of
from mvps.cores import on_cores
from mvps.distortion import free_of_lens, seen_at, straightener
from mvps.finding import Finding
from mvps.material import CERTAIN
from mvps.mesh import lengths
from mvps.scene import Capture, View

LEAST_VIEWS = 3
"""Two views share the lines of sight through two outline points alone."""

TOLD = 1.0
"""Pixels that a lens must bend the outline by: masks are rounded to pixels, and an outline that is 0.1 pixels wider or narrower all around
misses by more or less for no other reason."""

NOISE = float(np.sqrt(2) * MASK_NOISE)
"""Of a miss, pixels: that of two views' outlines. Misses no larger say nothing: those of a solid of revolution fall whenever masks get
smaller."""


def lens(capture: Capture) -> tuple[Capture, list[Finding]]:
    """The capture without distortion, and what the calibration and the silhouettes say of it."""
    by = max(bent(view) for view in capture.views)
    if by < MASK_NOISE:
        return capture, []
    given = f"the calibration's lens (kc) bends the object's outline by up to {by:.1f} px"
    taken = "photographs are taken as free of it, and should be undistorted where they are not"
    if len(capture.views) < LEAST_VIEWS or by < TOLD:
        return capture, [Finding("pose", "all views", f"{given}; {taken}", True)]
    straight = Capture(capture.name, tuple(on_cores(straightened, capture.views)))
    outlines = outlines_of(capture)
    points = [free_of_lens(camera, points) for camera, points in zip(outlines.cameras, outlines.points, strict=True)]
    as_given, undone = outlines.misses(), replace(outlines_of(straight), points=points).misses()
    fall, error = fallen(as_given, undone)
    left = f"lines of sight along the outlines miss by {misfit(as_given):.2f} px as photographs are, by {misfit(undone):.2f} without it"
    if fall > CERTAIN * error and misfit(as_given) > NOISE:
        return straight, [Finding("pose", "all views", f"{given}, and {left}: photographs were undistorted", True)]
    if fall < -CERTAIN * error and misfit(undone) > NOISE:
        return capture, []
    text = f"{given}, and silhouettes do not tell whether photographs still show that: {taken}"
    return capture, [Finding("pose", "all views", text, True)]


def bent(view: View) -> float:
    """By how much the lens moves the object's pixels at most, pixels, beside what a shift of the whole image does."""
    if not any(view.camera.distortion):
        return 0.0
    column, row = seen_at(view.camera)
    rows, columns = view.pixels.T
    moved = np.stack([column[rows, columns] - columns, row[rows, columns] - rows], -1)
    return float(lengths(moved - moved.mean(0)).max())


def straightened(view: View) -> View:
    """The view as a pinhole would have taken it, by bilinear interpolation among foreground pixels. What has a clipped sample in it is
    clipped. Its files show something else and are forgotten."""
    if not any(view.camera.distortion):
        return view
    at = straightener(view.camera)
    share = at(view.mask.astype(np.float32))
    mask = share > 0.5
    samples = np.empty((int(mask.sum()), *view.samples.shape[1:]), np.uint16)
    usable, image = view.usable(), np.zeros((*view.mask.shape, 4), np.float32)
    for k in range(len(view.lights)):
        image[view.mask] = np.column_stack([view.samples[:, k], ~usable[:, k]])
        found = at(image)[mask]
        samples[:, k] = np.rint(found[:, :3] / share[mask][:, None])
        samples[found[:, 3] > 0, k] = view.saturation
    frame = None if view.frame is None else at(view.frame)
    return replace(view, camera=replace(view.camera, distortion=()), mask=mask, samples=samples, frame=frame, files=())
