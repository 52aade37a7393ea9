"""Patches of the mesh whose mean slope is known, which is what keeps lights from drifting.

The integral of the normal over a piece of a surface depends on the piece's rim alone (Stokes: int n dA = 1/2 oint x cross dx). Over the
plane of a patch with unit normal N and tangents B (2, 3) the slope of a normal n is s(n) = B n / (N.n), and

    sum_j a_j s(n_j) = sum_j a_j s(n0_j)        a_j area of vertex j over that plane, n0_j the mesh's normal

holds for the true normals as soon as the rim lies on the true surface, however wrong the mesh is inside: folds too narrow or too deep
for it turn its normals by many degrees, but not their mean. Single normals are left to the photographs. Along the generalised bas-relief
family (Belhumeur et al. 1999), which no image can tell, all patches of a round object would turn.

With vertices' steps d_j = (normal's turn, reflectance) and blocks H_j, g_j the constraint sum_j a_j (s_j - s0_j + J_j d_j) = 0 adds two
multipliers to each patch. With A_j = a_j J_j, c = sum_j a_j (s_j - s0_j) and E = sum_j A_j H_j^-1 A_j^T the step without it, d, becomes

    d_j - H_j^-1 A_j^T E^-1 (c + sum_i A_i d_i)
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from mvps.joint.blocks import Vertices, tangents
from mvps.mesh import vertex_areas
from mvps.scene import Float, Int, Surface
from solvers.least_squares import columns_of_inverse

VERTICES_OF_PATCH = 25
"""Five by five. Patches of 12: lights follow the mesh's errors again; of 49 and 200: nothing more is gained, and thin parts have none with
one side (docs/findings/lights.md)."""

SAME_SIDE = 0.3
"""Least cosine between the normals of a patch: a thin part has two sides, and slopes end at 90 degrees."""


@dataclass(frozen=True)
class Patches:
    """n vertices in patches: vertex (n,) of the mesh, in order; of (n,) their patch; plane (n, 3) its unit normal; basis (n, 2, 3) its
    tangents; area (n,) over the plane, summing to 1 in a patch; slope (n, 2) of the mesh."""

    vertex: Tensor
    of: Tensor
    plane: Tensor
    basis: Tensor
    area: Tensor
    slope: Tensor

    @property
    def count(self) -> int:
        """Number of patches."""
        return int(self.of.max()) + 1

    def first(self, count: int) -> Patches:
        """Only so many patches, which are random ones."""
        rows = self.of < count
        return Patches(*(getattr(self, field.name)[rows] for field in fields(self)))

    def summed(self, values: Tensor) -> Tensor:
        """(k, ...) sums over the vertices (n, ...) of each patch."""
        return values.new_zeros(self.count, *values.shape[1:]).index_add_(0, self.of, values)

    def moved(self, normal: Tensor) -> tuple[Tensor, Tensor]:
        """a (s - s0) (n, 2) for normals (n, 3), and its derivative A (n, 2, 2) by steps along their `tangents`. float64."""
        slope, derivative = _slopes(normal, self.plane, self.basis)
        along = derivative @ torch.stack(tangents(normal), 2)
        area = self.area.double()
        return area[:, None] * (slope - self.slope).double(), area[:, None, None] * along.double()


def _slopes(normal: Tensor, plane: Tensor, basis: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes (n, 2) and their derivatives by the normal (n, 2, 3)."""
    # Beyond the horizon of its patch a normal has no slope; SAME_SIDE keeps the mesh's well within.
    height = (normal * plane).sum(1).clamp_min(SAME_SIDE / 2)[:, None]
    slope = (basis @ normal[..., None])[..., 0] / height
    return slope, (basis - slope[..., None] * plane[:, None]) / height[..., None]


def _drawn(seen: Int, surface: Surface, normal: Float, count: int, size: int, generator: np.random.Generator) -> Int:
    """(V,) patch of each vertex, -1 outside of all; all -1 where the mesh has no piece of `size` vertices with one side."""
    tree, wanted = cKDTree(surface.vertices[seen]), -(-count // size)
    patch, number = np.full(len(normal), -1), 0
    order = generator.permutation(len(seen))
    # Neighbours of no more vertices than it takes: few of them begin a patch.
    for start in range(0, len(order), wanted):
        rows = order[start : start + wanted]
        near = seen[tree.query(surface.vertices[seen[rows]], k=np.arange(1, min(2 * size, len(seen)) + 1))[1]]
        for row, around in zip(rows, near, strict=True):
            if number == wanted:
                return patch
            around = around[(patch[around] < 0) & (normal[around] @ normal[seen[row]] > SAME_SIDE)][:size]
            # What other patches have left over is no piece of surface.
            if len(around) == size:
                patch[around] = number
                number += 1
    return patch


def drawn_patches(seen: Int, surface: Surface, normal: Float, count: int, generator: np.random.Generator, device: torch.device) -> Patches:
    """Random disjoint patches of about `count` vertices among those seen (n,), on a mesh with normals (V, 3)."""
    size = min(VERTICES_OF_PATCH, len(seen))
    patch = _drawn(seen, surface, normal, count, size, generator)
    while (patch < 0).all():
        # A small or crumpled mesh: its patches are smaller, at least a vertex each.
        size = -(-size // 2)
        patch = _drawn(seen, surface, normal, count, size, generator)
    chosen = np.flatnonzero(patch >= 0)
    vertex, of = (torch.from_numpy(a).to(device) for a in (chosen, patch[chosen]))
    n, areas = (torch.tensor(a[chosen], dtype=torch.float32, device=device) for a in (normal, vertex_areas(surface)))
    patches = int(patch.max()) + 1
    plane = torch.nn.functional.normalize(n.new_zeros(patches, 3).index_add_(0, of, areas[:, None] * n), dim=1)[of]
    basis = torch.stack(tangents(plane), 1)
    area = areas * (n * plane).sum(1).clamp_min(0)
    area = area / area.new_zeros(patches).index_add_(0, of, area)[of]
    return Patches(vertex, of, plane, basis, area, _slopes(n, plane, basis)[0])


def held(step: Tensor, hessian: Tensor, vertices: Vertices, patches: Patches) -> Tensor:
    """Vertices' steps (n, p) with normal equations (n, p, p) so that every patch keeps its mean slope."""
    # The equations of a vertex are in units of its own residuals.
    inverse = columns_of_inverse(hessian, 2).double() * vertices.scale.double()[:, None, None] ** 2
    moved, A = patches.moved(vertices.normal)
    E = patches.summed(A @ inverse[:, :2] @ A.transpose(1, 2))
    off = patches.summed(moved + (A @ step[:, :2, None].double())[..., 0])
    multiplier = torch.linalg.solve(E, off[..., None])
    back: Tensor = (inverse @ A.transpose(1, 2) @ multiplier[patches.of])[..., 0]
    return step - back.to(step)
