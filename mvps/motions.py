"""Small motions of cameras, in units that all move the object's projection by about a pixel.

In the frame of camera i let c be the object's centre, r its radius, s what a pixel covers there. A motion (a, b) in R^3 x R^3, in pixels,

    x' = exp([a] s / r) (x - c) + c + (b_1 s, b_2 s, b_3 c_z s / r)

turns the object about its centre, shifts it, and changes its distance, each by as much as moves its rim by so many pixels (turns about
the image's axes: its depth). Similarities of the world move all cameras together and change no photograph; these seven motions are the
gauge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mvps.camera import project
from mvps.scene import Camera, Capture, Float

UNKNOWNS = 6
"""Of a camera: three turns, two shifts, the distance."""


@dataclass(frozen=True, eq=False)
class Object:
    """Where the object is, world units: centre (3,) and radius."""

    centre: Float
    radius: float

    @classmethod
    def between(cls, low: Float, high: Float) -> Object:
        """In the ball around a box with these corners (3,)."""
        return cls((low + high) / 2, float(np.linalg.norm(high - low)) / 2)


def units(camera: Camera, body: Object) -> tuple[Float, Float]:
    """The object's centre (3,) in the camera's frame, and what each unknown of a motion (6,) is in radians and world units a pixel."""
    centre = camera.rotation @ body.centre + camera.translation
    pixel = float(centre[2]) / camera.focal_length
    turn = pixel / body.radius
    return centre, np.array([turn, turn, turn, pixel, pixel, centre[2] * turn])


def derivatives(camera: Camera, body: Object, local: Float) -> Float:
    """(n, 3, 6) derivatives of points (n, 3), in the camera's frame, by its motion."""
    centre, unit = units(camera, body)
    x, y, z = (local - centre).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    turned = np.stack([np.stack(row, -1) for row in ((zero, z, -y), (-z, zero, x), (y, -x, zero))], 1)
    shifted = one[:, None, None] * np.eye(3)
    return np.concatenate([turned, shifted], 2) * unit


def image_derivatives(camera: Camera, points: Float) -> Float:
    """(n, 2, 3) derivatives of the projections of world points (n, 3), in pixels, by the points' place in the camera's frame."""
    image, depth = project(camera, points)
    slope: Float = (camera.K[:2] - image[..., None] * camera.K[2]) / depth[:, None, None]
    return slope


def moved(camera: Camera, body: Object, motion: Float) -> Camera:
    """The camera after a motion (6,)."""
    centre, unit = units(camera, body)
    turn = Rotation.from_rotvec(motion[:3] * unit[:3]).as_matrix()
    return replace(
        camera, rotation=turn @ camera.rotation, translation=turn @ (camera.translation - centre) + centre + motion[3:] * unit[3:]
    )


def gauge(cameras: Sequence[Camera], body: Object) -> Float:
    """(6 cameras, 7) orthonormal motions of all cameras that similarities of the world undo."""
    blocks = []
    for camera in cameras:
        centre, unit = units(camera, body)
        none = np.zeros((3, 3))
        turn, shift = np.concatenate([camera.rotation, none]), np.concatenate([none, camera.rotation])
        # A world of another size stays as it looks where cameras keep their distance over that size.
        size = np.concatenate([np.zeros(3), centre])[:, None]
        blocks.append(np.concatenate([turn * unit[3], shift, size], 1) / unit[:, None])
    return np.asarray(np.linalg.qr(np.concatenate(blocks))[0])


def without_gauge(motions: Float, basis: Float) -> Float:
    """Motions (cameras, 6) less what a similarity of the world does: the mean pose stays."""
    flat = motions.ravel()
    return (flat - basis @ (basis.T @ flat)).reshape(motions.shape)


def with_motions(capture: Capture, body: Object, motions: Float) -> Capture:
    """The capture after motions (views, 6) of its cameras."""
    views = zip(capture.views, motions, strict=True)
    return Capture(capture.name, tuple(view.taken_by(moved(view.camera, body, motion)) for view, motion in views))
