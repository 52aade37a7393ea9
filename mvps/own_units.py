"""A capture in a world of its own, so that it does not matter in which unit and from where the world is measured.

    L = sqrt(mean_i |c_i - mean c|^2),      t'_i = (t_i + R_i o) / L rounded to multiples of 2^-40,      x = o + L x'

c_i the cameras' centres, R_i and t_i their rotations and translations. The same cameras in metres or in millimetres differ in the last
bits, and a mesh that is made anew in every round makes much of last bits; rounded, they are the same numbers. The rounding is a millionth
of a millionth of the cameras' distances, which is a billionth of a pixel.

o is 0, the world's own origin, where that lies near the object; where it is far away (coordinates of a building or a map) o is the
object's place: places measured from afar make equations that are solved until they hold to a part of their right sides, and of a surface
that moves by less than that part nothing is solved any more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mvps.camera import pixel_centres, rays
from mvps.scene import Camera, Capture, Float, Reconstruction, Surface

STEP = 2.0**-40
"""What translations are rounded to: 13 bits above a double's last one at the length itself."""

FAR = 10.0
"""Object sizes from the origin to the object: at 10 fusions still move a surface as at 0, at 100 not at all."""


class Own(NamedTuple):
    """L and o (3,) above, world units."""

    length: float
    origin: Float


def own_units(capture: Capture) -> Own:
    """The capture's own length and origin."""
    cameras = [view.camera for view in capture.views]
    length, (place, size) = own_length(cameras), object_place(capture)
    return Own(length, place if np.linalg.norm(place) > FAR * size else np.zeros(3))


def own_length(cameras: Sequence[Camera]) -> float:
    """L above, world units; where all stand in one place, their distance from the world's origin, or 1 if that is 0 too."""
    centre = np.array([camera.centre for camera in cameras])
    apart, away = (float(np.sqrt((offset**2).sum(1).mean())) for offset in (centre - centre.mean(0), centre))
    return next((length for length in (apart, away) if length > STEP * away), 1.0)


def object_place(capture: Capture) -> tuple[Float, float]:
    """The point (3,) that lines of sight through the masks' middles pass nearest to (least squares), and the object's size: the median
    diameter of discs of the masks' areas there; world units."""
    lines = [rays(view.camera, pixel_centres(view.pixels.mean(0)[None])) for view in capture.views]
    start, along = (np.concatenate(parts) for parts in zip(*lines, strict=True))
    middle = start.mean(0)
    across = np.eye(3) - along[:, :, None] * along[:, None]
    away = np.linalg.lstsq(across.reshape(-1, 3), np.einsum("nij,nj->ni", across, start - middle).ravel(), rcond=None)[0]
    distances = np.linalg.norm(start - middle - away, axis=1)
    sizes = [d / v.camera.focal_length * 2 * np.sqrt(len(v.pixels) / np.pi) for d, v in zip(distances, capture.views, strict=True)]
    return middle + away, float(np.median(sizes))


def in_own_units(capture: Capture, own: Own) -> Capture:
    """The capture in a world whose unit is `own.length` units of its own, measured from `own.origin`."""
    views = []
    for view in capture.views:
        translation = view.camera.translation + view.camera.rotation @ own.origin
        translation = np.round(translation / own.length / STEP) * STEP
        views.append(view.taken_by(replace(view.camera, translation=translation)))
    return Capture(capture.name, tuple(views))


def in_world_units(result: Reconstruction, own: Own) -> Reconstruction:
    """The result of a capture in such a world, in units of the capture's own and where it stands there."""
    return replace(result, surface=Surface(result.surface.vertices * own.length + own.origin, result.surface.faces))
