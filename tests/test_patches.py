"""Patches whose mean slope their rim decides."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch
import trimesh

from mvps.joint.blocks import Vertices, tangents
from mvps.joint.patches import SAME_SIDE, VERTICES_OF_PATCH, Patches, drawn_patches, held
from mvps.mesh import normalise, vertex_areas, vertex_normals
from mvps.scene import Surface

CPU = torch.device("cpu")


def ball(radius: float = 30.0) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return Surface(np.array(mesh.vertices), np.array(mesh.faces))


def on(surface: Surface, count: int = 500) -> Patches:
    seen = np.flatnonzero(surface.vertices[:, 2] > 0)
    return drawn_patches(seen, surface, vertex_normals(surface), count, np.random.default_rng(0), CPU)


def test_areas_of_vertices_add_up_to_the_surface() -> None:
    surface = ball()
    assert vertex_areas(surface).sum() == pytest.approx(trimesh.Trimesh(surface.vertices, surface.faces).area)


def test_patches_are_disjoint_one_sided_and_seen() -> None:
    surface = ball()
    patches = on(surface)
    assert patches.count == 500 // VERTICES_OF_PATCH and len(patches.vertex.unique()) == len(patches.vertex) == 500
    assert (torch.bincount(patches.of) == VERTICES_OF_PATCH).all() and (surface.vertices[patches.vertex.numpy(), 2] > 0).all()
    assert ((torch.tensor(vertex_normals(surface))[patches.vertex] * patches.plane).sum(1) > SAME_SIDE).all()
    assert torch.allclose(patches.summed(patches.area), torch.ones(patches.count))
    few = patches.first(3)
    assert few.count == 3 and len(few.vertex) == 3 * VERTICES_OF_PATCH


@pytest.mark.parametrize(
    "mesh", [trimesh.creation.icosphere(subdivisions=0), trimesh.creation.box(), trimesh.creation.icosphere(subdivisions=1)]
)
def test_small_meshes_have_smaller_patches_with_one_side(mesh: trimesh.Trimesh) -> None:
    surface = Surface(np.array(mesh.vertices), np.array(mesh.faces))
    normal = vertex_normals(surface)
    patches = drawn_patches(np.arange(len(normal)), surface, normal, 100, np.random.default_rng(0), CPU)
    assert 0 < len(patches.vertex) <= len(normal) and torch.isfinite(patches.slope).all()
    assert torch.allclose(patches.summed(patches.area), torch.ones(patches.count))
    assert ((torch.tensor(normal, dtype=torch.float32)[patches.vertex] * patches.plane).sum(1) > 0).all()


def test_relief_inside_a_patch_leaves_its_mean_slope() -> None:
    """Stokes: waves on a flat grid that end at its rim turn normals by 30 degrees, but not their mean slope."""
    n = 61
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    wave = 0.05 * np.sin(12 * x + 1) * np.cos(9 * y + 2) * (1 - x**2) ** 2 * (1 - y**2) ** 2
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([corner, corner + n, corner + n + 1], 1), np.stack([corner, corner + n + 1, corner + 1], 1)])
    flat, relief = (Surface(np.stack([x, y, z], -1).reshape(-1, 3), faces) for z in (0 * x, wave))
    whole = torch.zeros(n * n, dtype=torch.long)
    normal, area = (torch.tensor(f(flat), dtype=torch.float32) for f in (vertex_normals, vertex_areas))
    basis = torch.stack(tangents(normal), 1)
    patch = Patches(torch.arange(n * n), whole, normal, basis, area / area.sum(), torch.zeros(n * n, 2))
    waved = torch.tensor(vertex_normals(relief), dtype=torch.float32)
    moved, _ = patch.moved(waved)
    assert torch.rad2deg(torch.acos(waved[:, 2].min())) > 20
    assert patch.summed(moved).norm() < 1e-3 < 0.1 * float((moved / patch.area.double()[:, None]).norm(dim=1).median())


def test_derivative_of_slopes_against_finite_differences() -> None:
    surface = ball()
    patches = on(surface, 100)
    patches = Patches(*(a.double() if a.is_floating_point() else a for a in (getattr(patches, f.name) for f in fields(patches))))
    normal = torch.tensor(vertex_normals(surface))[patches.vertex]
    _, A = patches.moved(normal)
    for k, tangent in enumerate(tangents(normal)):
        up, down = (torch.nn.functional.normalize(normal + sign * 1e-5 * tangent, dim=1) for sign in (1, -1))
        numerical = (patches.moved(up)[0] - patches.moved(down)[0]) / 2e-5
        assert torch.allclose(A[..., k], numerical, atol=1e-5 * float(A.abs().max()))


def test_held_steps_keep_the_mean_slope_and_turn_the_rest() -> None:
    """Random vertices' steps: afterwards the linearised mean slope is the mesh's, for the least change in the metric of the hessian."""
    surface, g = ball(), torch.Generator().manual_seed(0)
    patches = on(surface, 200)
    n = len(patches.vertex)
    normal = torch.tensor(normalise(vertex_normals(surface)[patches.vertex] + 0.05 * torch.randn(n, 3, generator=g).numpy())).float()
    root = torch.randn(n, 4, 4, generator=g)
    hessian, step = root @ root.transpose(1, 2) + torch.eye(4), 0.1 * torch.randn(n, 4, generator=g)
    vertices = Vertices(normal, torch.ones(n, 2), 0.5 + torch.rand(n, generator=g))
    after = held(step, hessian, vertices, patches)
    moved, A = patches.moved(normal)

    def off(d: torch.Tensor) -> torch.Tensor:
        return patches.summed(moved + (A @ d[:, :2, None].double())[..., 0])

    assert off(after).abs().max() < 1e-3 * off(step).abs().max()
    assert torch.allclose(held(after, hessian, vertices, patches), after, atol=1e-4)
    # The change is H^-1 A^T m with one m for all vertices of a patch.
    force = (hessian.double() / vertices.scale.double()[:, None, None] ** 2 @ (step - after)[..., None].double())[..., 0]
    assert force[:, 2:].abs().max() < 1e-2 * force[:, :2].abs().max()
