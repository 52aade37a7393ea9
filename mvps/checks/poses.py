"""Poses that are off by little: found by silhouettes, mended by silhouettes and photographs.

Found where one step of all cameras that half of the outline points asks for lowers the misses of the other half by more than CERTAIN
standard errors, both ways taken together (outlines.py). Then cameras move by one half of the points until it misses least, which has to
lower the other half's misses again; from there by all points, if misses are more than masks' rounding makes or photographs are then
predicted better; and last by the photographs (photographed.py).

The mean pose stays: a motion of the whole world shows in no photograph. A principal point that is off in all views is a shift of the
object in every camera's frame; the part of it that is no motion of the world is undone by the cameras.
"""

from __future__ import annotations

import numpy as np

from mvps.camera import project
from mvps.checks.outlines import MASK_NOISE, Outlines, by_other_half, fallen, fitted, misfit, outlines_of, positive, tie_of
from mvps.checks.photographed import by_photographs, confirmed
from mvps.finding import Finding
from mvps.material import CERTAIN
from mvps.mesh import lengths
from mvps.motions import UNKNOWNS, Object, with_motions
from mvps.scene import Capture, Float

FRAME_PIXELS = 1.0
"""Mean distance of a surface from where it is, along its normals, from which the frame of the world is in doubt, and with it distances to
anything else in that frame: as much as makes a result useless otherwise (mvps/verdict.py)."""

ALONG_NORMALS = np.sqrt(3 / 2) / 2
"""Of a motion that photographs show as one: they show two of its three coordinates, and a closed surface moves along its normals by half
of a motion in the mean."""

DOUBTFUL_PIXELS = 2 * MASK_NOISE
"""Mean of the positive misses from which what cameras do not mend is in doubt: a miss has the noise of two views' masks, and is the largest
of several."""

LEAST_VIEWS = 3
"""Two views share the lines of sight through two outline points alone."""


def poses(capture: Capture) -> tuple[Capture, list[Finding]]:
    """The capture with its cameras where silhouettes and photographs want them, and by how much they moved."""
    if len(capture.views) < LEAST_VIEWS:
        return capture, []
    outlines = outlines_of(capture)
    fall, error = by_other_half(outlines)
    if fall <= CERTAIN * error:
        return capture, []
    still = np.zeros((len(capture.views), UNKNOWNS))
    before = outlines.misses(still)
    seen = f"lines of sight along the outlines miss what the other views leave of the object by {misfit(before):.2f} px in the mean"
    rounding = misfit(before) <= DOUBTFUL_PIXELS
    mended, factors = followed(capture, outlines, still, rounding)
    if mended is capture:
        if rounding:
            return capture, []
        text = f"{seen}, and moving the cameras does not mend it: masks or calibration are wrong in another way; check both"
        return capture, [Finding("pose", "all views", text, False)]
    shift = displacement(capture, mended, outlines.body)
    text = f"{seen}; cameras were moved by {np.median(shift):.2f} px (median; at most {shift.max():.2f}), which leaves"
    text += f" {misfit(outlines_of(mended).misses(still)):.2f} px"
    if factors:
        text += f"; what photographs moved of it lowers the error of held-out lights by {100 * (1 - np.prod(factors)):.0f} %"
    findings = [Finding("pose", "all views", text, True)]
    if ALONG_NORMALS * np.median(shift) > FRAME_PIXELS:
        words = "where the object lies and how large it is are known no better than the cameras were"
        text = f"{words} ({np.median(shift):.1f} px): no photograph shows a motion or a scale of the whole world"
        findings.append(Finding("pose", "all views", text, False))
    return mended, findings


def followed(capture: Capture, outlines: Outlines, still: Float, rounding: bool) -> tuple[Capture, list[float]]:
    """The capture with its cameras where silhouettes want them, unless masks' rounding might be why (`rounding`) and photographs
    contradict, and then where photographs do; as it was where neither moves them. And by which factors the errors of held-out lights fell
    in the photographs' turns."""
    motions = by_silhouettes(outlines, still)
    if motions is None:
        return capture, []
    believed = not rounding or confirmed(capture, outlines.body, motions)
    return by_photographs(with_motions(capture, outlines.body, motions) if believed else capture, outlines.body)


def by_silhouettes(outlines: Outlines, still: Float) -> Float | None:
    """Motions (views, 6) that half of the outline points ask for and the other half confirms, by all points; None where it does not.

    No camera moves by more than the largest miss.
    """
    found, held = outlines.misses(still), outlines.half(1)
    tie, bound = tie_of(found), float(positive(found).max())
    motions = fitted(outlines.half(0), still, tie, bound)
    fall, error = fallen(held.misses(still), held.misses(motions))
    return fitted(outlines, motions, tie, bound) if fall > CERTAIN * error else None


def displacement(before: Capture, after: Capture, body: Object) -> Float:
    """(views,) mean distance in pixels by which the projections of points around the object's centre moved."""
    points = body.centre + body.radius / 2 * np.concatenate([np.eye(3), -np.eye(3)])
    return np.array(
        [
            lengths(project(b.camera, points)[0] - project(a.camera, points)[0]).mean()
            for a, b in zip(before.views, after.views, strict=True)
        ]
    )
