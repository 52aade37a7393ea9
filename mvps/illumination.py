"""Light for new pictures: directional, from points, from an environment map.

Units follow the image model (shading.py), in which a diffuse point of albedo rho under directional light of intensity E, straight above,
has radiance rho E. So

    direction   intensity E
    point       intensity J at a distance r arrives as E = J / r^2
    environment radiance L from the solid angle dw arrives as E = L dw / pi: a uniform one of radiance 1 shows a white body as 1

An environment is a picture of all directions, rows of equal elevation (first row: straight up), columns of equal azimuth. Its lights are
regions of about equal energy, each a directional light with the region's colour and mean direction (median cut: Debevec 2005): importance
sampling without noise, which keeps the sum of E exactly. Lobes are made duller by the variance of a region's directions, along its longer
side (shading.lobes): else a polished body would show the lights one by one.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mvps.mesh import normalise
from mvps.scene import Float

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear red, green and blue (Rec. 709)."""

NONE: Float = np.zeros((0, 3))


@dataclass(frozen=True, eq=False)
class Illumination:
    """direction, intensity (lights, 3): directional lights, unit, from the surface towards the light; position, strength (points, 3):
    points of light in world units and their J. spread (lights,): variance of the directions that a directional light stands for,
    along the tangent where it is largest, radians^2; 0 where it is not given."""

    direction: Float = field(default_factory=NONE.copy)
    intensity: Float = field(default_factory=NONE.copy)
    position: Float = field(default_factory=NONE.copy)
    strength: Float = field(default_factory=NONE.copy)
    spread: Float = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not len(self.spread):
            object.__setattr__(self, "spread", np.zeros(len(self.direction)))

    def with_also(self, other: Illumination) -> Illumination:
        """Both together."""
        names = ("direction", "intensity", "position", "strength", "spread")
        return Illumination(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


def frame_of(up: Float) -> Float:
    """(3, 3) axes of an environment as columns: x and y of its horizon, z up."""
    up = normalise(np.asarray(up, float))
    helper = np.eye(3)[np.abs(up).argmin()]
    x = normalise(helper - (helper @ up) * up)
    return np.stack([x, np.cross(up, x), up], 1)


def directions_of(height: int, width: int, up: Float, azimuth_deg: float) -> tuple[Float, Float]:
    """Directions (height, width, 3) of an environment's pixels, world frame, and their solid angles (height, width), which sum to 4 pi.

    azimuth_deg turns it about `up` (3,), counter-clockwise seen from above.
    """
    edges = np.linspace(0, np.pi, height + 1)
    polar = (edges[1:] + edges[:-1]) / 2
    azimuth = np.radians(azimuth_deg) - 2 * np.pi * (np.arange(width) + 0.5) / width
    sine = np.sin(polar)[:, None]
    local = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.broadcast_to(np.cos(polar)[:, None], (height, width))], -1)
    angle = np.broadcast_to(((np.cos(edges[:-1]) - np.cos(edges[1:])) * 2 * np.pi / width)[:, None], (height, width))
    return local @ frame_of(up).T, angle


def environment_lights(picture: NDArray[np.float32], count: int, up: Float, azimuth_deg: float = 0.0) -> Illumination:
    """At most `count` directional lights for an environment (height, width, 3) of linear radiance."""
    direction, angle = directions_of(picture.shape[0], picture.shape[1], up, azimuth_deg)
    arriving = picture.astype(float) * angle[..., None] / np.pi
    energy = arriving @ LUMINANCE
    sums = np.pad(energy, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    whole = (0, picture.shape[0], 0, picture.shape[1])
    # The largest energy comes out of a heap first.
    heap = [(-_energy(sums, *whole), whole)]
    single: list[tuple[int, int, int, int]] = []
    while heap and len(heap) + len(single) < count:
        _, region = heappop(heap)
        halves = _halved(sums, region)
        for half in halves:
            heappush(heap, (-_energy(sums, *half), half))
        single += [] if halves else [region]
    regions = [*single, *(region for _, region in heap)]
    lights = [(direction[a:b, c:d], arriving[a:b, c:d], energy[a:b, c:d]) for a, b, c, d in regions if energy[a:b, c:d].sum() > 0]
    share = [(vectors, power / power.sum()) for vectors, _, power in lights]
    mean = np.array([np.einsum("hwi,hw->i", vectors, part) for vectors, part in share]).reshape(-1, 3)
    square = np.array([np.einsum("hwi,hwj,hw->ij", vectors, vectors, part) for vectors, part in share]).reshape(-1, 3, 3)
    spread = np.linalg.eigvalsh(square - mean[:, :, None] * mean[:, None])[:, -1]
    intensity = np.array([colour.sum((0, 1)) for _, colour, _ in lights]).reshape(-1, 3)
    return Illumination(normalise(mean), intensity, spread=np.maximum(spread, 0))


def turned(light: Illumination, up: Float, azimuth_deg: float) -> Illumination:
    """Directional lights turned about `up` (3,), counter-clockwise seen from above: those of an environment turned by as much, whose
    regions do not hang on where it stands."""
    turn = Rotation.from_rotvec(np.radians(azimuth_deg) * normalise(np.asarray(up, float))).as_matrix()
    return replace(light, direction=light.direction @ turn.T)


def _energy(sums: Float, top: int, bottom: int, left: int, right: int) -> float:
    return float(sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left])


def _halved(sums: Float, region: tuple[int, int, int, int]) -> list[tuple[int, int, int, int]]:
    """The region in two of energies as equal as its pixels allow, across its longer side; nothing where it is one pixel."""
    top, bottom, left, right = region
    # Columns of an environment lie closer together away from the horizon.
    wide = (right - left) * np.sin(np.pi * (top + bottom) / 2 / (len(sums) - 1))
    down = bottom - top >= max(wide, 2) or right - left < 2
    if down and bottom - top < 2:
        return []
    if down:
        cuts = [_energy(sums, top, k, left, right) for k in range(top + 1, bottom)]
        k = top + 1 + int(np.abs(np.array(cuts) - _energy(sums, *region) / 2).argmin())
        return [(top, k, left, right), (k, bottom, left, right)]
    cuts = [_energy(sums, top, bottom, left, k) for k in range(left + 1, right)]
    k = left + 1 + int(np.abs(np.array(cuts) - _energy(sums, *region) / 2).argmin())
    return [(top, bottom, left, k), (top, bottom, k, right)]
