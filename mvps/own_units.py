"""A capture in a length of its own, so that it does not matter in which unit the world is given.

    L = sqrt(mean_i |c_i - mean c|^2),      t'_i = t_i / L rounded to multiples of 2^-40,      x = L x'

c_i the cameras' centres, t_i the translations. The same cameras in metres or in millimetres differ in the last bits, and a mesh that is
made anew in every round makes much of last bits; rounded, they are the same numbers. The rounding is a millionth of a millionth of the
cameras' distances, which is a billionth of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mvps.scene import Camera, Capture, Reconstruction, Surface

STEP = 2.0**-40
"""What translations are rounded to: 13 bits above a double's last one at the length itself."""


def own_length(cameras: Sequence[Camera]) -> float:
    """L above, world units; where all stand in one place, their distance from the world's origin, or 1 if that is 0 too."""
    centre = np.array([camera.centre for camera in cameras])
    apart, away = (float(np.sqrt((offset**2).sum(1).mean())) for offset in (centre - centre.mean(0), centre))
    return next((length for length in (apart, away) if length > STEP * away), 1.0)


def in_lengths(capture: Capture, length: float) -> Capture:
    """The capture in a world whose unit is `length` units of its own."""
    views = []
    for view in capture.views:
        translation = np.round(view.camera.translation / length / STEP) * STEP
        views.append(view.taken_by(replace(view.camera, translation=translation)))
    return Capture(capture.name, tuple(views))


def in_world_units(result: Reconstruction, length: float) -> Reconstruction:
    """The result of a capture in such a world, in units of the capture's own."""
    return replace(result, surface=Surface(result.surface.vertices * length, result.surface.faces))
