"""What is wrong with a capture, found and mended before it is reconstructed.

Each check is a function of a capture: it gives back the capture, mended where it can be, and what it found. Checks read photographs, masks
and cameras alone, in an order in which each may trust what those before it have mended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mvps.checks.ambient import ambient
from mvps.checks.contents import contents
from mvps.checks.lens import lens
from mvps.checks.photographs import photographs
from mvps.checks.poses import poses
from mvps.checks.radiometry import curve_undone
from mvps.checks.silhouettes import silhouettes
from mvps.cores import blas_as_asked
from mvps.finding import Finding
from mvps.progress import Progress
from mvps.scene import Capture

Check = Callable[[Capture], tuple[Capture, list[Finding]]]

CHECKS: Sequence[Check] = (contents, lens, silhouettes, curve_undone, photographs, ambient, poses)
"""In their order: whether there is anything at all; whether photographs are a pinhole's; what the object is in every view, for which
photographs may be read again; their values; what does not belong, and what all have in common; where the cameras are, which trusts masks
and photographs."""


def sound(capture: Capture, progress: Progress) -> tuple[Capture, list[Finding]]:
    """The capture as it is reconstructed, and what was wrong with it."""
    blas_as_asked()
    findings: list[Finding] = []
    with progress.stage("checks") as stage:
        for check in CHECKS:
            capture, found = check(capture)
            findings += found
        stage.status("; ".join(f"{one.where}: {one.text}" for one in findings) or "nothing found")
    return capture, findings
