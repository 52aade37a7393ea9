"""Discrete geometry: laws of the operators."""

import igl
import numpy as np
import trimesh
from references import is_closed, signed_volume
from scipy.spatial import Delaunay

from mvps import mesh
from mvps.scene import Surface


def sphere(subdivisions: int = 4, radius: float = 2.0) -> Surface:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Surface(np.array(ball.vertices), np.array(ball.faces))


def sheet(n: int = 8) -> Surface:
    x, y = np.meshgrid(np.arange(n, dtype=float), np.arange(n, dtype=float), indexing="ij")
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([corner, corner + n, corner + 1], 1), np.stack([corner + 1, corner + n, corner + n + 1], 1)])
    return Surface(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1), faces)


def test_areas_of_a_sphere_sum_to_its_area() -> None:
    ball = sphere()
    assert np.isclose(mesh.face_areas(ball).sum(), 4 * np.pi * 4, rtol=0.01)


def test_vertex_normals_of_a_sphere_point_outwards() -> None:
    ball = sphere()
    assert ((mesh.vertex_normals(ball) * ball.vertices / 2).sum(1) > np.cos(np.radians(0.5))).all()


def test_vertex_normals_are_made_once_for_a_surface_and_are_angle_weighted() -> None:
    ball = sphere(2)
    known = mesh.vertex_normals(ball)
    assert mesh.vertex_normals(ball) is known and not known.flags.writeable
    stretched = Surface(ball.vertices * (1, 2, 3), ball.faces)
    angle = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
    assert np.allclose(mesh.vertex_normals(stretched), igl.per_vertex_normals(stretched.vertices, stretched.faces, angle))


def test_edges_are_the_pairs_of_the_faces_corners_each_once_in_order() -> None:
    for surface in (sphere(2), sheet(5)):
        pairs = {tuple(sorted((int(f[k]), int(f[k - 1])))) for f in surface.faces for k in range(3)}
        assert [tuple(pair) for pair in mesh.edges(surface).tolist()] == sorted(pairs)


def test_degenerate_faces_do_not_spoil_normals() -> None:
    ball = sphere(2)
    spoiled = Surface(ball.vertices, np.concatenate([ball.faces, [[0, 0, 1], [2, 2, 2]]]))
    assert np.allclose(mesh.vertex_normals(spoiled), mesh.vertex_normals(ball))


def test_remeshing_reaches_the_edge_length_and_stays_closed_on_the_surface() -> None:
    fine = mesh.isotropic_remesh(sphere(), 0.15)
    assert abs(mesh.mean_edge_length(fine) - 0.15) < 0.02
    assert is_closed(fine) and signed_volume(fine) > 0
    assert np.abs(np.linalg.norm(fine.vertices, axis=1) - 2).max() < 0.02


def lens() -> Surface:
    """Two lids that meet in a sharp rim of radius 1."""
    rings = [r * np.exp(2j * np.pi * np.arange(60 * r) / (60 * r)) for r in np.linspace(0.1, 1, 10)]
    flat = np.concatenate([[0], *rings])
    faces = Delaunay(np.column_stack([flat.real, flat.imag])).simplices
    a, b, c = flat[faces].T
    clockwise = ((b - a) * (c - a).conj()).imag > 0
    faces[clockwise] = faces[clockwise][:, ::-1]
    inside = abs(flat) < 0.999
    below = np.where(inside, len(flat) + np.cumsum(inside) - 1, np.arange(len(flat)))
    height = np.concatenate([0.1 * (1 - abs(flat) ** 2), -0.1 * (1 - abs(flat[inside]) ** 2)])
    both = np.concatenate([flat, flat[inside]])
    return Surface(np.column_stack([both.real, both.imag, height]), np.concatenate([faces, below[faces[:, ::-1]]]))


def test_remeshing_keeps_the_sharp_rim_of_a_thin_part() -> None:
    thin = lens()
    assert is_closed(thin) and signed_volume(thin) > 0
    meshed = thin
    for _ in range(3):
        meshed = mesh.isotropic_remesh(meshed, 0.08)
    # Where vertices slide off the rim, a seventh of the area is lost.
    assert is_closed(meshed) and np.isclose(mesh.face_areas(meshed).sum(), mesh.face_areas(thin).sum(), rtol=0.01)
    assert np.isclose(np.linalg.norm(meshed.vertices[:, :2], axis=1).max(), 1, atol=0.01)


def test_largest_pieces_are_kept_and_unused_vertices_go() -> None:
    big, small = sphere(3), sphere(1, 0.5)
    both = Surface(np.concatenate([small.vertices + 9, big.vertices]), np.concatenate([small.faces, big.faces + len(small.vertices)]))
    kept = mesh.largest_pieces(both)
    assert len(kept.vertices) == len(big.vertices) and np.isclose(signed_volume(kept), signed_volume(big))
    assert mesh.piece_count(both) == 2 and mesh.piece_count(kept) == 1
    assert len(mesh.largest_pieces(both, 2).faces) == len(both.faces)
    assert mesh.piece_count(mesh.isotropic_remesh(both, 0.3)) == 2


def test_turning_the_faces_turns_the_volume_negative() -> None:
    ball = sphere(2)
    assert signed_volume(Surface(ball.vertices, ball.faces[:, ::-1])) < 0 < signed_volume(ball)


def test_splitting_edges_keeps_a_mesh_closed_its_volume_and_its_orientation() -> None:
    ball = sphere(3)
    for share in (0.0, 0.3, 1.0):
        marked = np.random.default_rng(0).random(len(mesh.edges(ball))) < share
        split = mesh.split_edges(ball, marked)
        assert is_closed(split) and len(split.vertices) == len(ball.vertices) + marked.sum()
        assert np.isclose(signed_volume(split), signed_volume(ball)) and np.isclose(
            mesh.face_areas(split).sum(), mesh.face_areas(ball).sum()
        )


def test_fewer_faces_stay_closed_and_near() -> None:
    ball = sphere(4)
    fewer = mesh.decimated(ball, 500)
    assert fewer is not None and len(fewer.faces) == 500 and is_closed(fewer)
    assert np.abs(np.linalg.norm(fewer.vertices, axis=1) - 2).max() < 0.05
    assert signed_volume(fewer) > 0.97 * signed_volume(ball)
    assert mesh.decimated(ball, len(ball.faces)) is ball


def test_an_edge_of_three_faces_is_not_decimated() -> None:
    fan = Surface(np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, -1, 0]]), np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]))
    assert mesh.decimated(fan, 1) is None


def test_nearest_points_by_trimesh() -> None:
    ball = sphere(2)
    points = np.random.default_rng(0).normal(size=(200, 3))
    found = mesh.nearest(ball, points)
    near, distance, _ = trimesh.proximity.closest_point_naive(trimesh.Trimesh(ball.vertices, ball.faces, process=False), points)
    np.testing.assert_allclose(found.distance, distance, atol=1e-9)
    np.testing.assert_allclose(found.point, near, atol=1e-9)
    corners = ball.vertices[ball.faces[found.face]]
    np.testing.assert_allclose(np.einsum("nk,nkc->nc", found.barycentric, corners), found.point, atol=1e-9)
