"""Environments that need no file: pictures of all directions, linear radiance, rows from straight up to straight down.

White ones have a mean radiance over the sphere of 1, so that a white body without shadow shows as 1 on average (illumination.py).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from mvps.scene import Float

HEIGHT = 64
"""Rows: three degrees, finer than the lights that stand for a picture lie apart."""


def _grid() -> tuple[Float, Float]:
    """Elevation (HEIGHT, 1) and azimuth (1, 2 HEIGHT) of the pixels, radians."""
    elevation = np.pi / 2 - np.pi * (np.arange(HEIGHT) + 0.5) / HEIGHT
    azimuth = 2 * np.pi * (np.arange(2 * HEIGHT) + 0.5) / (2 * HEIGHT)
    return elevation[:, None], azimuth[None]


def _lamp(elevation_deg: float, azimuth_deg: float, width_deg: float, height_deg: float) -> Float:
    """(HEIGHT, 2 HEIGHT) 1 in a rectangle of directions around one, else 0."""
    elevation, azimuth = _grid()
    aside = np.angle(np.exp(1j * (azimuth - np.radians(azimuth_deg))))
    high = np.abs(elevation - np.radians(elevation_deg)) < np.radians(height_deg) / 2
    lit: Float = np.where(high & (np.abs(aside) < np.radians(width_deg) / 2), 1.0, 0.0)
    return lit


def overcast() -> Float:
    """A grey sky, three times as bright straight up as at the horizon (Moon and Spencer 1942; CIE), over a darker ground."""
    elevation, azimuth = _grid()
    sky: Float = np.where(elevation > 0, (1 + 2 * np.sin(elevation)) / 3, 0.1) + 0 * azimuth
    light: Float = sky[..., None] * np.array([0.95, 1.0, 1.08])
    return light


def window() -> Float:
    """Daylight from one side of a dim room."""
    light: Float = 0.05 + _lamp(20, 60, 40, 50)[..., None] * np.array([0.9, 1.0, 1.15])
    return light


def studio() -> Float:
    """Two soft boxes, a warm and a cold one, and a lamp from above in a dark room."""
    warm, cold, above = _lamp(35, 45, 50, 40), _lamp(25, 150, 35, 40), _lamp(85, 0, 360, 12)
    light = 1.6 * warm[..., None] * np.array([1.1, 1.0, 0.85]) + cold[..., None] * np.array([0.8, 1.0, 1.25])
    whole: Float = light + above[..., None] + 0.02
    return whole


MADE: Mapping[str, Callable[[], Float]] = MappingProxyType({"overcast sky": overcast, "window": window, "studio": studio})


def made(name: str) -> NDArray[np.float32]:
    """The environment of that name (HEIGHT, 2 HEIGHT, 3). KeyError where there is none."""
    picture = MADE[name]()
    share = np.cos(_grid()[0])[..., None]
    mean = (picture * share).sum() / (3 * 2 * HEIGHT * share.sum())
    white: NDArray[np.float32] = (picture / mean).astype(np.float32)
    return white
