"""Agreement of views on the waves of a ball whose pixels' normals are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from sphere_scene import RADIUS, SphereScene, make_sphere

from mvps.joint.agreement import VERTICES_AT_ONCE, Agreement, Swept, agreement, lowest_of
from mvps.joint.observe import visible_in
from mvps.mesh import isotropic_remesh
from mvps.rendering import points_under
from mvps.scene import NormalMap, Surface
from mvps.visibility import RayCaster

FROM = trimesh.creation.icosahedron().vertices


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(subdivisions=5, seen_from=FROM, waves=0.3)


def true_maps(scene: SphereScene) -> tuple[NormalMap, ...]:
    caster, maps = RayCaster(scene.reconstruction.surface), []
    for view in scene.capture.views:
        points = points_under(caster, scene.reconstruction.material, view.camera, view.pixels)
        maps.append(NormalMap(points.normal, np.full((len(points.normal), 3), 0.5), np.ones(len(points.normal))))
    return tuple(maps)


def agreed_from(scene: SphereScene, maps: tuple[NormalMap, ...]) -> Agreement:
    """On a ball that is too small by 0.8."""
    ball = scene.reconstruction.surface
    inside = isotropic_remesh(Surface(ball.vertices * (1 - 0.8 / RADIUS), ball.faces), 0.7)
    assert len(inside.vertices) > VERTICES_AT_ONCE
    seen = [index for index, _ in visible_in(scene.capture, inside)]
    return agreement(scene.capture, inside, maps, seen, np.arange(-2.0, 2.01, 0.25))


def test_views_agree_where_the_surface_is(scene: SphereScene) -> None:
    found = agreed_from(scene, true_maps(scene))
    told = np.isfinite(found.sigma)
    assert told.mean() > 0.9 and abs(np.median(found.offset[told]) - 0.8) < 0.05
    assert np.median(np.abs(found.offset[told] - 0.8)) < 0.1


def test_a_view_that_shows_something_else_is_an_outlier(scene: SphereScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """One view shows normals that are turned by 20 degrees; its vertices are seen in four or five."""
    maps = list(true_maps(scene))
    turn = trimesh.transformations.rotation_matrix(np.radians(20), (0.3, 0.5, 0.8))[:3, :3]
    maps[2] = replace(maps[2], normal=maps[2].normal @ turn)
    robust = agreed_from(scene, tuple(maps))
    clean = agreed_from(scene, true_maps(scene))
    # So wide a scale is plain least squares.
    monkeypatch.setattr("mvps.joint.agreement.CAUCHY_95", 1e3)
    plain = agreed_from(scene, tuple(maps))
    moved = [np.abs(found.offset - clean.offset)[np.isfinite(found.sigma)].mean() for found in (robust, plain)]
    assert moved[0] < 0.6 * moved[1]


def test_reports_that_no_float32_holds_say_nothing_of_their_vertex_alone() -> None:
    """One NaN would spread over the whole surface in the fusion's solve."""
    offsets, rng = np.linspace(-1, 1, 9), np.random.default_rng(0)
    apart = (offsets - 0.3)[None, :] ** 2 * np.ones((5, 1))

    def report(i: int, some: slice) -> list[Swept]:
        b = (rng.normal(size=(3, 5, 1)) * apart).astype(np.float32)
        b[:, 2] = 1e25 * (-1) ** i
        weight = np.ones((5, 9), np.float32)
        weight[2, :4] = 0 if i else 1
        return [Swept(np.arange(5)[some], np.ones(5, np.float32)[some], weight[some], b[:, some])]

    with np.errstate(all="ignore"):
        found = lowest_of(5, report, [np.arange(5)] * 4, offsets)
        both = found.joined(found, 0.01)
    assert np.isinf(found.sigma[2]) and np.isfinite(found.offset).all() and np.isfinite(both.offset).all()
    assert np.abs(np.delete(found.offset, 2) - 0.3).max() < 0.1
