"""A finer mesh than the one photometry was solved on: a ball whose pixels' normals are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp
import trimesh
from sphere_scene import RADIUS, make_sphere
from test_agreement import true_maps

from mvps.joint.detail import detailed, interpolated
from mvps.joint.observe import visible_in
from mvps.joint.vertices import Moved
from mvps.measures.ours import mesh_normal_errors, surface_errors
from mvps.mesh import isotropic_remesh, nearest
from mvps.scene import Residual


def test_a_split_mesh_follows_the_pixels_normals() -> None:
    scene = make_sphere(subdivisions=5, seen_from=trimesh.creation.icosahedron().vertices, waves=0.0)
    truth, capture = scene.reconstruction.surface, scene.capture
    coarse = isotropic_remesh(truth, RADIUS / 10)
    place = nearest(truth, coarse.vertices).point
    seen = [index for index, _ in visible_in(capture, coarse)]
    given = Moved(replace(coarse, vertices=place), place, np.full(len(place), 0.1))
    found = detailed(capture, given, true_maps(scene), seen, 0.03)
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
    between = sp.csr_matrix(([1.0, 0.5, 0.5], ([0, 1, 1], [0, 0, 1])), (2, count))
    found = interpolated(material, between)
    for of in ("albedo", "specular_weight", "confidence"):
        given = getattr(material, of)
        assert np.allclose(getattr(found, of), [given[0], (given[0] + given[1]) / 2])
    assert np.allclose(np.linalg.norm(found.normal, axis=1), 1) and np.allclose(found.normal[0], material.normal[0])
    assert (
        found.residual is not None and np.allclose(found.residual.code, [[0, 1], [1, 2]]) and np.array_equal(found.residual.share, [1, 1])
    )
