"""The object of the synthetic captures: its shape as the zero set of a function, and what it is made of."""

from __future__ import annotations

import numpy as np

from mvps.mesh import normalise
from mvps.scene import Float, Material, Surface

# Lumps of the object as centre and radii, in units of half its extent. A body with a head, two arms and a foot: overlaps,
# creases and parts that shadow one another.
LUMPS = np.array(
    [
        [[0.0, 0.0, -0.1], [0.52, 0.46, 0.52]],
        [[0.1, -0.06, 0.56], [0.29, 0.27, 0.3]],
        [[0.55, -0.05, 0.02], [0.27, 0.2, 0.19]],
        [[-0.5, 0.1, -0.12], [0.22, 0.26, 0.3]],
        [[0.0, 0.05, -0.58], [0.58, 0.54, 0.24]],
    ]
)
BLEND = 0.05
"""Width over which two lumps melt into one another, and the rim of the bowl is rounded."""

BOWL = np.array([0.05, -0.52, -0.12]), 0.3
"""Centre and radius of the ball that is carved out of the body."""

FOLD_LENGTH, FOLD_HEIGHT = 0.24, 0.018
"""Wavelength and amplitude of the folds: slopes up to 2 pi height / length = 0.47, normals tilted by up to 25 degrees."""

PATCHES = 14
"""Number of patches of albedo."""

SHARPNESS = np.array([12.0, 90.0])
"""Of the two specular lobes: a sheen 30 degrees wide and a highlight 10 degrees wide."""


class Shape:
    """The function f(x) whose zero set is the object, with the seed's folds and small shifts of the lumps."""

    LIPSCHITZ = 1 + 2 * np.pi * FOLD_HEIGHT / FOLD_LENGTH * 1.5
    """Bound of |grad f|: distances have 1, the folds add their slope, at most 1.5 times the plain wave's for their bends."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.lumps = LUMPS + np.stack([rng.normal(0, 0.02, (len(LUMPS), 3)), np.zeros((len(LUMPS), 3))], 1)
        across = normalise(np.array([1.0, 0.6, 0.25]) + rng.normal(0, 0.3, 3))
        self.wave = 2 * np.pi / FOLD_LENGTH * across
        self.bend = normalise(rng.normal(size=3)) * np.pi
        self.phase = rng.uniform(0, 2 * np.pi)

    def __call__(self, x: Float) -> Float:
        """f (...,) at points x (..., 3), negative inside."""
        distances = [(np.linalg.norm((x - centre) / radii, axis=-1) - 1) * radii.min() for centre, radii in self.lumps]
        total = sum(np.exp(-np.minimum(d, 4.0) / BLEND) for d in distances)
        # The folds hang from the body's waist downwards.
        hanging = 1 / (1 + np.exp((x[..., 2] - 0.1) / 0.1))
        folds = FOLD_HEIGHT * hanging * np.sin(x @ self.wave + np.sin(x @ self.bend) + self.phase)
        solid = -BLEND * np.log(total) + folds
        outside_bowl = BOWL[1] - np.linalg.norm(x - BOWL[0], axis=-1)
        rounded: Float = np.logaddexp(solid / BLEND * 2, outside_bowl / BLEND * 2) * BLEND / 2
        return rounded

    def gradient(self, x: Float) -> Float:
        """grad f (n, 3), by central differences."""
        step = np.cbrt(np.finfo(np.float64).eps)
        return np.stack([(self(x + step * e) - self(x - step * e)) / (2 * step) for e in np.eye(3)], -1)


COARSE = 4
"""The function is first evaluated on every fourth node of the grid, then on all nodes of the blocks that the surface may cross."""


def mesh_of(shape: Shape, cells: int) -> tuple[Surface, Float]:
    """The zero set inside [-1.1, 1.1]^3 on a grid of about `cells` cells along each axis, and its unit normals (V, 3)."""
    from skimage.measure import marching_cubes

    blocks = -(-cells // COARSE)
    step = 2.2 / (blocks * COARSE)
    nodes = -1.1 + step * np.arange(blocks * COARSE)
    middles = nodes.reshape(blocks, COARSE).mean(1)
    coarse = shape(np.stack(np.meshgrid(middles, middles, middles, indexing="ij"), -1))
    # A cell that the surface crosses may stick out of its block by one step: both diagonals bound |f| in the block's middle.
    crossed = np.abs(coarse) <= shape.LIPSCHITZ * np.sqrt(3) * step * (COARSE / 2 + 1)
    values = coarse
    for axis in range(3):
        values, crossed = np.repeat(values, COARSE, axis), np.repeat(crossed, COARSE, axis)
    near = np.argwhere(crossed)
    values[crossed] = shape(nodes[near])
    # Descent: the object is where the values are low, so that faces point outwards.
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent", allow_degenerate=False)
    vertices = -1.1 + step * vertices.astype(np.float64)
    for _ in range(3):
        gradient = shape.gradient(vertices)
        vertices -= shape(vertices)[:, None] * gradient / (gradient**2).sum(-1, keepdims=True)
    return Surface(vertices, faces), normalise(shape.gradient(vertices))


def make_material(vertices: Float, normal: Float, strength: float, rng: np.random.Generator) -> Material:
    """Patches of albedo, a glossy side and a matt side; vertices (V, 3) in units of half the extent."""
    sites = rng.uniform(-0.8, 0.8, (PATCHES, 3))
    # Light greys and muted colours, none black: a black patch would only test the specular lobes.
    colours = rng.uniform(0.25, 0.8, (PATCHES, 1)) * rng.uniform(0.4, 1.0, (PATCHES, 3))
    nearest = ((vertices[:, None] - sites) ** 2).sum(-1).argmin(1)
    variation = 1 + 0.15 * np.sin(vertices @ rng.normal(0, 3, 3))
    albedo = colours[nearest] * variation[:, None]
    glossy = 1 / (1 + np.exp(-(vertices @ normalise(rng.normal(size=3))) / 0.1))
    weight = strength * (0.03 + glossy[:, None] * np.array([0.12, 0.9]))
    return Material(normal, albedo, weight, SHARPNESS, np.ones(len(vertices)))
