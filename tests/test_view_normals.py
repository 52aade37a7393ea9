"""Normals of views: noise of single views gives way to the surface, detail that views share and the surface lacks stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sphere_scene import SphereScene, make_sphere

from mvps.camera import surface_pixel
from mvps.mesh import angles_deg, normalise, vertex_normals
from mvps.scene import Capture, Float, Surface
from mvps.view_normals import Picture, drawn_to_surface
from mvps.visibility import RayCaster, camera_hits, interpolate

VIEWS = 8


@pytest.fixture(scope="module")
def ball() -> SphereScene:
    around = [(np.cos(a), np.sin(a), 0.3) for a in 2 * np.pi * np.arange(VIEWS) / VIEWS]
    return make_sphere(4, seen_from=around)


def shown(capture: Capture, surface: Surface, normal: Float) -> list[Picture]:
    """Pictures of normals (V, 3) on a surface, NaN outside the masks."""
    caster, pictures = RayCaster(surface), []
    for view in capture.views:
        picture = np.full((*view.mask.shape, 3), np.nan, np.float32)
        picture[view.mask] = normalise(interpolate(surface, camera_hits(caster, view.camera, view.pixels), normal))
        pictures.append(picture)
    return pictures


def noisy(pictures: list[Picture], sigma: float) -> list[Picture]:
    draw = np.random.default_rng(0)
    return [normalise(picture + sigma * draw.normal(size=picture.shape)).astype(np.float32) for picture in pictures]


def error(found: list[Picture], true: list[Picture]) -> float:
    known = [np.isfinite(t).all(-1) for t in true]
    return float(np.concatenate([angles_deg(f[k], t[k]) for f, t, k in zip(found, true, known, strict=True)]).mean())


def test_noise_of_single_views_gives_way_to_the_surface(ball: SphereScene) -> None:
    surface = ball.reconstruction.surface
    true = shown(ball.capture, surface, vertex_normals(surface))
    given = noisy(true, 0.1)
    found = drawn_to_surface(ball.capture, surface, given)
    # Of 2.6 views, effectively, the surface counts as holding a third of each view's error.
    assert error(found, true) < 0.5 * error(given, true)
    for a, b in zip(found, given, strict=True):
        np.testing.assert_array_equal(np.isfinite(a), np.isfinite(b))
        np.testing.assert_allclose(np.linalg.norm(a[np.isfinite(a).all(-1)], axis=1), 1, atol=1e-6)


def test_detail_that_views_share_and_the_surface_lacks_stays(ball: SphereScene) -> None:
    surface = ball.reconstruction.surface
    true = shown(ball.capture, surface, ball.reconstruction.material.normal)
    assert error(shown(ball.capture, surface, vertex_normals(surface)), true) > 4
    assert error(drawn_to_surface(ball.capture, surface, true), true) < 0.1


def test_detail_that_other_views_show_blurred_stays(ball: SphereScene) -> None:
    surface, caster = ball.reconstruction.surface, RayCaster(ball.reconstruction.surface)
    true = []
    for view in ball.capture.views:
        hits = camera_hits(caster, view.camera, view.pixels)
        smooth, point = (interpolate(surface, hits, values) for values in (vertex_normals(surface), surface.vertices))
        # Waves of four pixels, which are lower by a third between pixels.
        picture = np.full((*view.mask.shape, 3), np.nan, np.float32)
        picture[view.mask] = normalise(smooth + 0.15 * np.sin(2 * np.pi * point / (4 * surface_pixel(ball.capture, surface))))
        true.append(picture)
    given = noisy(true, 0.03)
    assert error(shown(ball.capture, surface, vertex_normals(surface)), true) > 6
    assert error(drawn_to_surface(ball.capture, surface, given), true) < error(given, true)


@pytest.mark.parametrize(("noise", "wrong"), [(0.01, 0.1), (0.02, 0.1), (0.05, 0.05)])
def test_drawn_normals_are_no_worse_than_either(ball: SphereScene, noise: float, wrong: float) -> None:
    surface = ball.reconstruction.surface
    away = ball.reconstruction.material.normal - vertex_normals(surface)
    true = shown(ball.capture, surface, vertex_normals(surface) + wrong / 0.1 * away)
    given = noisy(true, noise)
    found = error(drawn_to_surface(ball.capture, surface, given), true)
    assert found < 1.02 * min(error(given, true), error(shown(ball.capture, surface, vertex_normals(surface)), true))


def test_of_one_view_alone_nothing_moves(ball: SphereScene) -> None:
    surface, one = ball.reconstruction.surface, Capture("one", ball.capture.views[:1])
    given = noisy(shown(one, surface, vertex_normals(surface)), 0.1)
    np.testing.assert_array_equal(drawn_to_surface(one, surface, given)[0], given[0])


def test_what_is_not_known_or_misses_the_surface_stays(ball: SphereScene) -> None:
    surface = ball.reconstruction.surface
    smaller = Surface(0.8 * surface.vertices, surface.faces)
    given = noisy(shown(ball.capture, surface, vertex_normals(surface)), 0.1)
    given[0][40:50] = np.nan
    found = drawn_to_surface(ball.capture, smaller, given)
    first = ball.capture.views[0]
    missed = first.mask.copy()
    missed[first.mask] = camera_hits(RayCaster(smaller), first.camera, first.pixels).face < 0
    assert missed.sum() > 500 and np.isnan(found[0][40:50]).all()
    np.testing.assert_array_equal(found[0][missed], given[0][missed])


def test_views_may_differ_in_size(ball: SphereScene) -> None:
    surface = ball.reconstruction.surface
    first, *rest = ball.capture.views
    camera = replace(first.camera, width=90)
    cut = replace(first, camera=camera, mask=first.mask[:, :90], samples=first.samples[first.mask[first.mask] & (first.pixels[:, 1] < 90)])
    capture = Capture("cut", (cut, *rest))
    true = shown(capture, surface, vertex_normals(surface))
    given = noisy(true, 0.1)
    assert error(drawn_to_surface(capture, surface, given), true) < 0.5 * error(given, true)


def test_a_view_is_not_its_own_witness_where_another_stands_beside_it(ball: SphereScene) -> None:
    """Half of the views twice, as with a second set of lights."""
    surface = ball.reconstruction.surface
    again = tuple(replace(view, name=f"again_{view.name}") for view in ball.capture.views[: VIEWS // 2])
    capture = Capture("twice", ball.capture.views + again)
    true = shown(capture, surface, vertex_normals(surface))
    given = noisy(true, 0.1)
    found = drawn_to_surface(capture, surface, given)
    alone = drawn_to_surface(ball.capture, surface, given[:VIEWS])
    assert error(found, true) < error(alone, true[:VIEWS])
