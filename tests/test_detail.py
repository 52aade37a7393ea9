"""A finer mesh than the one photometry was solved on: a ball whose pixels' normals are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp
import trimesh
from sphere_scene import RADIUS, make_sphere
from test_agreement import true_maps

from mvps.joint.detail import Detailed, detailed, directions, interpolated
from mvps.joint.observe import visible_in
from mvps.joint.vertices import Moved
from mvps.measures.ours import mesh_normal_errors, surface_errors
from mvps.mesh import face_areas, isotropic_remesh, nearest, normalise, unbiased, vertex_normals
from mvps.scene import Residual, Surface


def test_a_split_mesh_follows_the_pixels_normals() -> None:
    scene = make_sphere(subdivisions=5, seen_from=trimesh.creation.icosahedron().vertices, waves=0.0)
    truth, capture = scene.reconstruction.surface, scene.capture
    coarse = isotropic_remesh(truth, RADIUS / 10)
    place = nearest(truth, coarse.vertices).point
    seen = [index for index, _ in visible_in(capture, coarse)]
    given = Moved(replace(coarse, vertices=place), place, np.full(len(place), 0.1))
    found = detailed(capture, given, true_maps(scene), seen)
    assert len(found.surface.vertices) > 3 * len(place) and np.allclose(found.share.sum(1), 1)
    normals = {view.name: of for view, of in zip(capture.views, scene.reconstruction.normal_maps, strict=True)}
    before, after = (mesh_normal_errors(s, normals, capture)["normal_error_deg"] for s in (given.surface, found.surface))
    assert after < 0.6 * before
    off_before, off = (surface_errors(s, truth, capture)["chamfer_px"] for s in (given.surface, found.surface))
    assert off < off_before
    # Where nothing turns by more than normals err, nothing is split.
    assert np.array_equal(detailed(capture, given, true_maps(scene), seen, np.pi).surface.faces, given.surface.faces)


def test_reflectance_between_two_vertices_is_their_mean() -> None:
    material = make_sphere(2).reconstruction.material
    count = len(material.albedo)
    code = np.arange(2 * count, dtype=np.float32).reshape(count, 2)
    layers = ((np.ones((1, 5), np.float32), np.ones(1, np.float32)),)
    material = replace(material, residual=Residual(np.ones(count, np.float32), code, layers))
    between = sp.csr_matrix(([1.0, 0.5, 0.5, 1.0], ([0, 1, 1, 2], [0, 0, 1, 2])), (3, count))
    of = Detailed(Surface(np.eye(3), np.array([[0, 1, 2]])), between)
    found = interpolated(material, of)
    for name in ("albedo", "specular_weight", "confidence"):
        given = getattr(material, name)
        assert np.allclose(getattr(found, name), [given[0], (given[0] + given[1]) / 2, given[2]])
    assert np.allclose(np.linalg.norm(found.normal, axis=1), 1) and np.allclose(found.normal[0], material.normal[0])
    residual = found.residual
    assert residual is not None and np.allclose(residual.code, [[0, 1], [1, 2], [4, 5]]) and np.array_equal(residual.share, [1, 1, 1])
    assert interpolated(replace(material, specular_weight=np.zeros((count, 0)), sharpness=np.zeros(0)), of).specular_weight.shape == (3, 0)


def test_opposite_normals_have_no_mean() -> None:
    ball = make_sphere(2).reconstruction
    normal = ball.material.normal.copy()
    normal[1] = -normal[0]
    half = sp.csr_matrix(([0.5, 0.5], ([0, 0], [0, 1])), (1, len(normal)))
    of = Detailed(ball.surface, sp.vstack([sp.identity(len(normal), format="csr")[:-1], half], format="csr"))
    found = interpolated(replace(ball.material, normal=normal), of)
    assert np.allclose(found.normal[-1], vertex_normals(ball.surface)[-1])


def test_what_no_view_sees_stays_where_it_was_closed() -> None:
    """Agreed positions of a ball's lower half, from before it was closed over, lie outside."""
    scene = make_sphere(subdivisions=4, seen_from=trimesh.creation.icosahedron().vertices, waves=0.0)
    ball = scene.reconstruction.surface
    lower = ball.vertices[:, 2] < 0
    seen = [index[~lower[index]] for index, _ in visible_in(scene.capture, ball)]
    place = np.where(lower[:, None], 1.1, 1.0) * ball.vertices
    found = detailed(scene.capture, Moved(ball, place, np.full(len(place), 0.1)), true_maps(scene), seen)
    below = found.surface.vertices[found.surface.vertices[:, 2] < -0.2 * RADIUS]
    assert np.abs(np.linalg.norm(below, axis=1) - RADIUS).max() < 0.01 * RADIUS


def test_a_split_ball_is_neither_larger_nor_smaller() -> None:
    scene = make_sphere(subdivisions=5, seen_from=trimesh.creation.icosahedron().vertices, waves=0.0)
    coarse = isotropic_remesh(scene.reconstruction.surface, RADIUS / 10)
    place = RADIUS * normalise(coarse.vertices)
    seen = [index for index, _ in visible_in(scene.capture, coarse)]
    given = Moved(unbiased(replace(coarse, vertices=place)), place, np.full(len(place), 0.1))
    found = detailed(scene.capture, given, true_maps(scene), seen).surface
    before, after = (
        np.average(np.linalg.norm(s.vertices[s.faces].mean(1), axis=1) - RADIUS, weights=face_areas(s)) for s in (given.surface, found)
    )
    assert abs(after) < min(abs(before), 0.01)


def test_where_the_ends_of_an_edge_are_opposite_the_surface_s_normals_stay() -> None:
    surface = make_sphere(3).reconstruction.surface
    own, mean = vertex_normals(surface), 0.5 * normalise(surface.vertices)
    mean[5] = 0
    found = directions(mean, surface)
    assert (found[5] == own[5]).all() and np.allclose(np.delete(found, 5, 0), np.delete(2 * mean, 5, 0))
