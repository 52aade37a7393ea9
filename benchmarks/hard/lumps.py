"""Objects by chance: ellipsoids that melt into one another, with waves over all.

f(x) = -BLEND log sum_i exp(-d_i / BLEND) + h sin(k . x + phase),   d_i = (|R_i (x - c_i) / r_i| - 1) min r_i

Every centre but the first lies on an earlier ellipsoid, so that the object is one piece.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mvps.mesh import largest_pieces, normalise
from mvps.scene import Float, Surface
from mvps.synthetic.shape import BLEND, Shape, mesh_of

CELLS = 128
"""Of the grid on which the surface is looked for, along an axis."""

STEEPEST = 0.4
"""Largest slope of the waves: they tilt normals by 22 degrees."""


class Lumps(Shape):
    """The function whose zero set is the object, inside the unit ball."""

    def __init__(self, rng: np.random.Generator) -> None:
        count = int(rng.integers(2, 8))
        radii = rng.uniform(0.15, 0.5, (count, 3))
        turn = Rotation.random(count, rng=rng).as_matrix()
        centre = np.zeros((count, 3))
        for i in range(1, count):
            on = int(rng.integers(i))
            centre[i] = centre[on] + turn[on].T @ (radii[on] * normalise(rng.normal(size=3)))
        centre -= centre.mean(0)
        # The waves lift the surface by less than BLEND.
        size = 0.95 / (np.linalg.norm(centre, axis=1) + radii.max(1) + BLEND).max()
        self.centre, self.radii, self.turn = size * centre, size * radii, turn
        length = rng.uniform(0.15, 0.6)
        self.wave = 2 * np.pi / length * normalise(rng.normal(size=3))
        self.height = rng.uniform(0, STEEPEST) * min(length / (2 * np.pi), BLEND / STEEPEST)
        self.phase = rng.uniform(0, 2 * np.pi)
        self.LIPSCHITZ = 1 + STEEPEST

    def __call__(self, x: Float) -> Float:
        """f (...,) at points x (..., 3), negative inside."""
        of_lumps = zip(self.centre, self.radii, self.turn, strict=True)
        distances = [(np.linalg.norm((x - c) @ R.T / r, axis=-1) - 1) * r.min() for c, r, R in of_lumps]
        solid = -BLEND * np.log(sum(np.exp(-np.minimum(d, 4.0) / BLEND) for d in distances))
        waved: Float = solid + self.height * np.sin(x @ self.wave + self.phase)
        return waved


def lumps(seed: int) -> Surface:
    """The object, centred in the unit ball; the same seed gives the same."""
    surface = largest_pieces(mesh_of(Lumps(np.random.default_rng((seed, 11))), CELLS)[0])
    middle = (surface.vertices.min(0) + surface.vertices.max(0)) / 2
    local = surface.vertices - middle
    return Surface(local / np.linalg.norm(local, axis=1).max(), surface.faces)
