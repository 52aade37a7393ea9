"""What a synthetic capture shows, and how it is photographed."""

from __future__ import annotations

import math
from dataclasses import dataclass

LARGEST_SIZE = 10_000
"""Pixels: a capture's photographs have 100 megapixels at most."""


@dataclass(frozen=True)
class SceneSettings:
    """What is photographed, and how."""

    views: int = 10
    """Number of camera positions, on two rings around the object."""

    lights: int = 12
    """Number of photographs per view, each under one directional light."""

    size: int = 160
    """Height and width of the images, pixels."""

    free_lights: bool = False
    """False: one rig that moves with the camera, the same lights in every view's camera frame. True: other lights in every view."""

    strength: float = 1.0
    """Specular weights are multiplied by this; 0 makes the object Lambertian."""

    noise: float = 0.002
    """Standard deviation of the sensor's noise as a share of the clipping value."""

    intensity_spread: float = 0.35
    """Standard deviation of the lights' log intensities."""

    spread: float = 50.0
    """Largest angle between a light and the optical axis, degrees."""

    extent: float = 150.0
    """Radius of the object's bounding ball times two, in world units (mm)."""

    exposure: float = 0.999
    """Share of the samples on the object that are not clipped."""

    seed: int = 0
    """Of everything random: shape of the folds, patches, lights, noise."""

    def __post_init__(self) -> None:
        for name in ("views", "lights", "size"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: wanted at least 1, given {getattr(self, name)}")
        if self.size > LARGEST_SIZE:
            raise ValueError(f"size: wanted at most {LARGEST_SIZE}, given {self.size}")
        for name in ("strength", "noise", "intensity_spread", "seed"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}: wanted 0 or more, and finite, given {getattr(self, name)}")
        if not 0 <= self.spread < 90:
            raise ValueError(f"spread: wanted degrees in [0, 90), given {self.spread}")
        if not self.extent > 0:
            raise ValueError(f"extent: wanted a positive length, given {self.extent}")
        if not 0 < self.exposure <= 1:
            raise ValueError(f"exposure: wanted a share in (0, 1], given {self.exposure}")
