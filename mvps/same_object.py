"""The capture that a result is shown, rendered or evaluated with: it must be of the same object.

    overlap of a view = |S and M| / |S or M|,     S the pixels that see the result's surface, M the view's mask

is 0.99 where they belong together, and 0.34 to 0.48 (median of the views) where one of DiLiGenT-MV's objects stands in another's place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mvps.load import read_capture
from mvps.scene import Bool, Camera, Capture, CaptureError, Reconstruction
from mvps.visibility import RayCaster, camera_hits, ray_caster

LEAST_OVERLAP = 0.5
"""Of the median view: below it the two share less than they differ by."""

PIXELS = 4096
"""Of a view that are looked at: their share is then known to 2 %."""


def capture_of(
    result: Reconstruction,
    path: Path,
    views: Sequence[int] | None = None,
    lights: Sequence[int] | Mapping[str, Sequence[int]] | None = None,
) -> Capture:
    """The capture at path, views and lights as for `read_capture`. CaptureError where it cannot be read, or shows another object than the
    result in the views that it shares with it."""
    capture = read_capture(path, views, lights)
    shared = [view for view in capture.views if view.name in result.views]
    if shared:
        caster = ray_caster(result.surface)
        overlap = float(np.median([overlap_of(caster, view.camera, view.mask) for view in shared]))
        if overlap < LEAST_OVERLAP:
            raise CaptureError(
                f"{path}: wanted photographs of the result's object, given masks that its surface and they share {overlap:.0%} of;"
                " give the capture that was reconstructed"
            )
    return capture


def overlap_of(caster: RayCaster, camera: Camera, mask: Bool) -> float:
    """|S and M| / |S or M| of about PIXELS pixels of a view, mask (height, width); 0 where both are empty."""
    step = max(1, round((mask.size / PIXELS) ** 0.5))
    masked = mask[::step, ::step]
    pixels = step * np.indices(masked.shape).reshape(2, -1).T
    seen = camera_hits(caster, camera, pixels).face.reshape(masked.shape) >= 0
    return float((seen & masked).sum() / max(1, (seen | masked).sum()))
