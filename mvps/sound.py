"""What is wrong with a capture, found and mended before it is reconstructed.

Each check is a function of a capture: it gives back the capture, mended where it can be, and what it found. Checks read photographs, masks
and cameras alone, in an order in which each may trust what those before it have mended. What photographs alone leave in doubt, a curve, is
tried out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mvps.checks.ambient import ambient
from mvps.checks.contents import contents
from mvps.checks.exponent import looks_curved
from mvps.checks.lens import lens
from mvps.checks.photographs import photographs
from mvps.checks.poses import poses
from mvps.checks.radiometry import curve_undone, is_metal, linear, power
from mvps.checks.silhouettes import silhouettes
from mvps.cores import blas_as_asked
from mvps.curves import exponent_left_in
from mvps.finding import Finding
from mvps.progress import Progress
from mvps.scene import Capture

Check = Callable[[Capture], tuple[Capture, list[Finding]]]

OF_VALUES: Sequence[Check] = (contents, lens, silhouettes, curve_undone)
"""In their order: whether there is anything at all; whether photographs are a pinhole's; what the object is in every view, for which
photographs may be read again; their values."""

OF_LINEAR: Sequence[Check] = (photographs, ambient, poses)
"""What does not belong, and what all have in common; where the cameras are, which trusts masks and photographs."""


def sound(capture: Capture, progress: Progress) -> tuple[Capture, list[Finding]]:
    """The capture as it is reconstructed, and what was wrong with it."""
    blas_as_asked()
    with progress.stage("checks") as stage:
        recorded, findings = _checked(capture, OF_VALUES)
        capture, found = _checked(recorded, OF_LINEAR)
        if looks_curved(capture) and not is_metal(capture):
            stage.status("the photographs look as if a curve had been left in: trying")
            capture, found = _tried_out(recorded, capture, found)
        findings += found
        stage.status("; ".join(f"{one.where}: {one.text}" for one in findings) or "nothing found")
    return capture, findings


def _checked(capture: Capture, checks: Sequence[Check]) -> tuple[Capture, list[Finding]]:
    """The capture after some checks, and what they found."""
    findings: list[Finding] = []
    for check in checks:
        capture, found = check(capture)
        findings += found
    return capture, findings


def _tried_out(recorded: Capture, checked: Capture, found: list[Finding]) -> tuple[Capture, list[Finding]]:
    """The checked capture and what was found, or the recorded one with an exponent undone and checked, where solutions tell one."""
    told = exponent_left_in(lambda e: checked if e == 1 else _checked(_to_the_power(recorded, e), OF_LINEAR)[0])
    if told is None:
        return checked, found
    exponent, factor = told
    words = f"the photographs are not linear: {factor:.1f} times less is unexplained without an exponent of {exponent:.2f}; undone"
    checked, found = _checked(_to_the_power(recorded, exponent), OF_LINEAR)
    return checked, [Finding("radiometry", "all views", words, True), *found]


def _to_the_power(capture: Capture, exponent: float) -> Capture:
    """The capture with its samples, over full scale, to this power."""
    return Capture(capture.name, tuple(linear(view, power(exponent)) for view in capture.views))
