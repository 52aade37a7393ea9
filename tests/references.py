"""What tests compare with and the program itself has no use for."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from mvps.joint.blocks import Vertices
from mvps.joint.lights import subset
from mvps.joint.observe import ViewSamples
from mvps.joint.patches import Patches, drawn_patches
from mvps.joint.steps import Anchor
from mvps.mesh import vertex_normals
from mvps.scene import Camera, Float, Surface


def unproject(camera: Camera, image: Float, depth: Float) -> Float:
    """World points (..., 3) at image coordinates (..., 2) and depth (...,)."""
    homogeneous = np.concatenate([image, np.ones_like(image[..., :1])], -1)
    local = homogeneous @ np.linalg.inv(camera.K).T * np.asarray(depth)[..., None]
    points: Float = (local - camera.translation) @ camera.rotation
    return points


def is_closed(surface: Surface) -> bool:
    """True where every edge has exactly two faces."""
    halves = np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(halves[:, 0] * len(surface.vertices) + halves[:, 1], return_counts=True)
    return bool((count == 2).all())


def signed_volume(surface: Surface) -> float:
    """Volume of a closed mesh, positive where the faces point outwards."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def linear_from_srgb(encoded: NDArray[np.uint8]) -> Float:
    """Linear values in [0, 1] of 8-bit sRGB."""
    x = np.asarray(encoded, np.float64) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def in_patches(
    surface: Surface, views: list[ViewSamples], vertices: Vertices, anchor: Anchor
) -> tuple[list[ViewSamples], Vertices, Anchor, Patches]:
    """The joint problem on patches of the vertices that are seen."""
    seen = torch.cat([s.vertex for s in views]).unique().cpu().numpy()
    patches = drawn_patches(seen, surface, vertex_normals(surface), len(seen), np.random.default_rng(0), vertices.normal.device)
    return *subset(views, vertices, anchor, patches.vertex), patches
