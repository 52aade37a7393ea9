"""Whether there is anything to go by: an object in every mask, all three colours, samples that are neither black nor clipped.

What is refused here no other stage could do anything with: arrays would be empty, and sums of nothing no numbers. Of photographs that are
clipped throughout no sample counts anywhere; others tell the object, and these are named.
"""

from __future__ import annotations

from mvps.finding import Finding
from mvps.scene import Capture, CaptureError, View

LEAST_PIXELS = 64
"""Of a mask: an object eight pixels across, which the coarsest grid of the hull has as cells (mvps/hull.py)."""


def contents(capture: Capture) -> tuple[Capture, list[Finding]]:
    """The capture as it is, and the photographs that say nothing. CaptureError where a view, or a colour in all of them, shows nothing."""
    for view in capture.views:
        size = int(view.mask.sum())
        if size < LEAST_PIXELS:
            raise CaptureError(
                f"{view.name}/mask.png: wanted an object of {LEAST_PIXELS} pixels and more, given {size};"
                " photograph it from nearer, or leave the view out with --views"
            )
        _check_samples(view)
    for channel, colour in enumerate(("red", "green", "blue")):
        if not any(view.samples[..., channel].any() for view in capture.views):
            raise CaptureError(
                f"{capture.name}: wanted photographs in red, green and blue, or grey ones, given no {colour} in any;"
                " save what has one colour as grey"
            )
    return capture, [finding for view in capture.views for finding in _clipped(view)]


def _clipped(view: View) -> list[Finding]:
    """The photographs of which every sample in the mask is clipped."""
    words = "is clipped everywhere inside the mask, so that nothing tells its light; left out"
    silent = (number for number, shown in zip(view.lights, view.shown, strict=True) if not shown)
    return [Finding("photograph", f"{view.name}/{number:03d}", words, True) for number in silent]


def _check_samples(view: View) -> None:
    lights = range(len(view.lights))
    given = ""
    if not any(view.samples[:, k].any() for k in lights):
        given = "nothing but black there"
    elif not any((view.samples[:, k] < view.saturation).all(-1).any() for k in lights):
        given = f"nothing but clipped samples there, {view.saturation} and above"
    if given:
        raise CaptureError(
            f"{view.name}: wanted photographs that show the object inside the mask, given {given};"
            " expose anew, correct the mask, or leave the view out with --views"
        )
