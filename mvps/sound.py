"""What is wrong with a capture, found and mended before it is reconstructed.

Each check is a function of a capture: it gives back the capture, mended where it can be, and what it found. Checks read photographs, masks
and cameras alone, in an order in which each may trust what those before it have mended. What photographs alone leave in doubt, a curve, is
tried out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from mvps.checks.ambient import ambient
from mvps.checks.black import black_level
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

OF_VALUES: Sequence[Check] = (contents, black_level, lens, silhouettes, curve_undone)
"""In their order: whether there is anything at all; what cameras add to everything; whether photographs are a pinhole's; what the object is
in every view, for which photographs may be read again; their values."""

OF_LINEAR: Sequence[Check] = (photographs, ambient, poses)
"""What does not belong, and what all have in common; where the cameras are, which trusts masks and photographs."""


def sound(capture: Capture, progress: Progress, held: Sequence[int] = (), one_rig: bool = True) -> tuple[Capture, list[Finding]]:
    """The capture as it is reconstructed, and what was wrong with it.

    held: numbers of views that are kept back. Nothing that they show takes part in what becomes of the others; they themselves are mended
    with all others at hand, and stay as they are where they would be left out. one_rig: all views may be under the same lights; if that is
    known not to be so, photographs are not held against other views' of the same number.
    """
    apart = {view.name for view in capture.views if int(view.name[5:]) in held}
    rest = tuple(view for view in capture.views if view.name not in apart)
    # Shown by themselves, views that are kept back have no others to stay out of.
    if not apart or not rest:
        return _sound(capture, progress, one_rig)
    mended, findings = _sound(Capture(capture.name, rest), progress, one_rig)
    whole, of_all = _sound(capture, progress, one_rig)
    after = {view.name: view for view in whole.views if view.name in apart} | {view.name: view for view in mended.views}
    kept = [after.get(view.name, view) for view in capture.views if view.name in apart or view.name in after]
    of_held = [replace(one, text=f"kept back: {one.text}", mended=True) for one in of_all if one.where.split("/")[0] in apart]
    return Capture(capture.name, tuple(kept)), findings + of_held


def _sound(capture: Capture, progress: Progress, one_rig: bool) -> tuple[Capture, list[Finding]]:
    blas_as_asked()
    with progress.stage("checks") as stage:
        recorded, findings = _checked(capture, OF_VALUES)
        of_linear = [partial(check, one_rig=one_rig) if check is photographs else check for check in OF_LINEAR]
        capture, found = _checked(recorded, of_linear)
        if looks_curved(capture) and not is_metal(capture):
            stage.status("the photographs look as if a curve had been left in: trying")
            capture, found = _tried_out(recorded, capture, found, of_linear)
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


def _tried_out(recorded: Capture, checked: Capture, found: list[Finding], checks: Sequence[Check]) -> tuple[Capture, list[Finding]]:
    """The checked capture and what was found, or the recorded one with an exponent undone and checked, where solutions tell one."""
    told = exponent_left_in(lambda e: checked if e == 1 else _checked(_to_the_power(recorded, e), checks)[0])
    if told is None:
        return checked, found
    exponent, factor = told
    words = f"the photographs are not linear: {factor:.1f} times less is unexplained without an exponent of {exponent:.2f}; undone"
    checked, found = _checked(_to_the_power(recorded, exponent), checks)
    return checked, [Finding("radiometry", "all views", words, True), *found]


def _to_the_power(capture: Capture, exponent: float) -> Capture:
    """The capture with its samples, over full scale, to this power."""
    return Capture(capture.name, tuple(linear(view, power(exponent)) for view in capture.views))
