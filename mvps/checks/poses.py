"""Cameras that are off by little: found by silhouettes, mended by silhouettes and photographs.

Found where one step of all cameras that half of the outline points asks for lowers the misses of the other half by more than CERTAIN
standard errors, both ways taken together (outlines.py). If one shift of all principal points explains it, they are moved (principal.py).
What is left then is the poses': cameras move by one half of the points until it misses least, which has to lower the other half's misses
again; from there by all points, if misses are more than masks' rounding makes or photographs are then predicted better; and last by the
photographs (photographed.py). The mean pose stays: a motion of the whole world shows in no photograph.
"""

from __future__ import annotations

import numpy as np

from mvps.camera import project
from mvps.checks.outlines import (
    DOUBTFUL_PIXELS,
    Motions,
    Outlines,
    after,
    by_other_half,
    fallen,
    fitted,
    in_words,
    misfit,
    outlines_of,
    positive,
    tie_of,
)
from mvps.checks.photographed import by_photographs, confirmed
from mvps.checks.principal import FRAME_PIXELS, pointed
from mvps.finding import Finding
from mvps.material import CERTAIN
from mvps.mesh import lengths
from mvps.motions import Object, with_motions
from mvps.scene import Capture, Float

ALONG_NORMALS = np.sqrt(3 / 2) / 2
"""Of a motion that photographs show as one: they show two of its three coordinates, and a closed surface moves along its normals by half
of a motion in the mean."""

LEAST_VIEWS = 3
"""Two views share the lines of sight through two outline points alone."""


def poses(capture: Capture) -> tuple[Capture, list[Finding]]:
    """The capture with its cameras where silhouettes and photographs want them, and by how much they moved."""
    if len(capture.views) < LEAST_VIEWS or not _wrong(outlines_of(capture)):
        return capture, []
    capture, findings = pointed(capture)
    outlines = outlines_of(capture)
    if findings and not _wrong(outlines):
        return capture, findings
    moved, of_poses = _moved(capture, outlines)
    return moved, [*findings, *of_poses]


def _wrong(outlines: Outlines) -> bool:
    """Whether half of the points says of the cameras what the other half confirms."""
    fall, error = by_other_half(outlines)
    return fall > CERTAIN * error


def _moved(capture: Capture, outlines: Outlines) -> tuple[Capture, list[Finding]]:
    """The capture, whose cameras are wrong, with every camera moved on its own, and by how much."""
    found = outlines.misses()
    seen, rounding = in_words(found), misfit(found) <= DOUBTFUL_PIXELS
    mended, factors = followed(capture, outlines, rounding)
    if mended is capture:
        if rounding:
            return capture, []
        text = f"{seen}, and moving the cameras does not mend it: masks or calibration are wrong in another way; check both"
        return capture, [Finding("pose", "all views", text, False)]
    shift = displacement(capture, mended, outlines.body)
    text = f"{seen}; cameras were moved by {np.median(shift):.2f} px (median; at most {shift.max():.2f}), which leaves"
    text += f" {misfit(outlines_of(mended).misses()):.2f} px"
    if factors:
        text += f"; what photographs moved of it lowers the error of held-out lights by {100 * (1 - np.prod(factors)):.0f} %"
    findings = [Finding("pose", "all views", text, True)]
    if ALONG_NORMALS * np.median(shift) > FRAME_PIXELS:
        words = "where the object lies and how large it is are known no better than the cameras were"
        text = f"{words} ({np.median(shift):.1f} px): no photograph shows a motion or a scale of the whole world"
        findings.append(Finding("pose", "all views", text, False))
    return mended, findings


def followed(capture: Capture, outlines: Outlines, rounding: bool) -> tuple[Capture, list[float]]:
    """The capture with its cameras where silhouettes want them, unless masks' rounding might be why (`rounding`) and photographs
    contradict, and then where photographs do; as it was where neither moves them. And by which factors the errors of held-out lights fell
    in the photographs' turns."""
    motions = by_silhouettes(outlines)
    if motions is None:
        return capture, []
    believed = not rounding or confirmed(capture, outlines.body, motions)
    return by_photographs(with_motions(capture, outlines.body, motions) if believed else capture, outlines.body)


def by_silhouettes(outlines: Outlines) -> Float | None:
    """Motions (views, 6) that half of the outline points ask for and the other half confirms, by all points; None where it does not.

    No camera moves by more than the largest miss.
    """
    of, found, held = Motions(), outlines.misses(), outlines.half(1)
    tie, bound = tie_of(found), float(positive(found).max())
    motions = fitted(outlines.half(0), of, of.zero(outlines.cameras), tie, bound)
    fall, error = fallen(held.misses(), after(held, of, motions).misses())
    return fitted(outlines, of, motions, tie, bound) if fall > CERTAIN * error else None


def displacement(before: Capture, mended: Capture, body: Object) -> Float:
    """(views,) mean distance in pixels by which the projections of points around the object's centre moved."""
    points = body.centre + body.radius / 2 * np.concatenate([np.eye(3), -np.eye(3)])
    return np.array(
        [
            lengths(project(b.camera, points)[0] - project(a.camera, points)[0]).mean()
            for a, b in zip(before.views, mended.views, strict=True)
        ]
    )
