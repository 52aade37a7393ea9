"""The capture that a result is shown, rendered or evaluated with: it must be of the same object, and as it was reconstructed.

    overlap of a view = |S and M| / |S or M|,     S the pixels that see the result's surface, M the view's mask

is 0.99 where they belong together, and 0.34 to 0.48 (median of the views) where one of DiLiGenT-MV's objects stands in another's place.

Where cameras were moved, masks mended or a curve undone before the reconstruction (sound.py), the files still hold what was wrong. The same
photographs are mended again: a surface fits the cameras that it was made with, and predicts linear photographs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mvps.load import read_capture
from mvps.progress import Progress
from mvps.scene import Bool, Camera, Capture, CaptureError, Reconstruction
from mvps.visibility import RayCaster, camera_hits, ray_caster

LEAST_OVERLAP = 0.5
"""Of the median view: below it the two share less than they differ by."""

CHANGES = ("photograph", "pose", "mask", "radiometry")
"""What findings are about that change photographs; two of a view may have changed places."""

PIXELS = 4096
"""Of a view that are looked at: their share is then known to 2 %."""


def capture_of(
    result: Reconstruction,
    path: Path,
    views: Sequence[int] | None = None,
    lights: Sequence[int] | Mapping[str, Sequence[int]] | None = None,
) -> Capture:
    """The capture at path, views and lights as for `read_capture`, all where there are none, the result's own views mended as they were for
    the result. CaptureError where it cannot be read, or shows another object than the result in the views that it shares with it."""
    capture = read_capture(path, views or None, lights or None)
    shared = [view for view in capture.views if view.name in result.views]
    if shared:
        caster = ray_caster(result.surface)
        overlap = float(np.median([overlap_of(caster, view.camera, view.mask) for view in shared]))
        if overlap < LEAST_OVERLAP:
            raise CaptureError(
                f"{path}: wanted photographs of the result's object, given masks that its surface and they share {overlap:.0%} of;"
                " give the capture that was reconstructed"
            )
    return _with_mends(result, path, capture) if shared and was_mended(result) else capture


def photographs_in(result: Reconstruction, path: Path) -> tuple[list[int], dict[str, tuple[int, ...]]]:
    """Numbers of the views of a result that a capture's folder has, and by their names those of its photographs: of all that `capture_of`
    may read what is needed to show the result."""
    there = {name: numbers for name, numbers in zip(result.views, result.light_names, strict=True) if (path / name).is_dir()}
    return [int(name[5:]) for name in there], there


def was_mended(result: Reconstruction) -> bool:
    """Whether a result was made from other cameras, masks or values than its capture's files hold."""
    return any(one.get("mended") and one.get("about") in CHANGES for one in result.metrics.get("findings") or [])


def _with_mends(result: Reconstruction, path: Path, capture: Capture) -> Capture:
    """The capture, what it shares with the result as it was mended for it. All of its photographs tell that."""
    from mvps.sound import sound

    settings, photographs = result.settings, read_capture(path, *photographs_in(result, path))
    one_rig = result.lights.one_rig or not settings.get("calibrated_lights")
    mended, _ = sound(photographs, Progress(), settings.get("hold_out_views") or (), one_rig)
    asked = {view.name: view.lights for view in capture.views}
    # One photograph is as good as another where they are asked for the camera alone.
    kept = {view.name: [n for n in view.lights if n in asked.get(view.name, ())] or view.lights[:1] for view in mended.views}
    again = {view.name: view for view in mended.select(kept).views}
    return Capture(capture.name, tuple(again.get(view.name, view) for view in capture.views))


def overlap_of(caster: RayCaster, camera: Camera, mask: Bool) -> float:
    """|S and M| / |S or M| of about PIXELS pixels of a view, mask (height, width); 0 where both are empty."""
    step = max(1, round((mask.size / PIXELS) ** 0.5))
    masked = mask[::step, ::step]
    pixels = step * np.indices(masked.shape).reshape(2, -1).T
    seen = camera_hits(caster, camera, pixels).face.reshape(masked.shape) >= 0
    return float((seen & masked).sum() / max(1, (seen | masked).sum()))
