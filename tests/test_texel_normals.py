"""Normals of texels: detail that pixels show and vertices lack comes in, noise stays out."""

from __future__ import annotations

import numpy as np
import pytest
from sphere_scene import make_sphere

from mvps.mesh import angles_deg, normalise, vertex_normals
from mvps.scene import Float, Surface
from mvps.texel_normals import Places, Shown, texel_normals

VIEWS = 6


@pytest.fixture(scope="module")
def ball() -> Surface:
    return make_sphere(3).reconstruction.surface


def places_on(surface: Surface, generator: np.random.Generator) -> Places:
    """Four points on each face."""
    face = np.repeat(np.arange(len(surface.faces)), 4)
    return Places(face, generator.dirichlet(np.ones(3), len(face)))


def shown(normals: Float, spread: float, generator: np.random.Generator, views: int = VIEWS) -> Shown:
    """What views with errors of this spread, radians, show of normals (n, 3)."""
    seen = [normalise(normals + spread * generator.normal(size=normals.shape)) for _ in range(views)]
    one = np.ones(len(normals))
    return Shown(np.sum(seen, axis=0), views * one, views * one)


def mean_error(found: Float, true: Float) -> float:
    return float(angles_deg(found, true).mean())


@pytest.mark.parametrize(("detail", "noise", "most"), [(0.2, 0.0, 0.01), (0.2, 0.1, 1.0), (0.1, 0.2, 0.9), (0.05, 0.2, 1.0)])
def test_the_mean_is_no_worse_than_either(ball: Surface, detail: float, noise: float, most: float) -> None:
    """Vertices that lack the detail, and views that show it with noise. most: of the error of the better one."""
    own, true, views, places = seen_with(ball, detail, noise)
    found = texel_normals(ball, places, own, views)
    assert np.allclose(np.linalg.norm(found, axis=1), 1)
    assert mean_error(found, true) <= most * min(mean_error(own, true), mean_error(normalise(views.total), true) + 1e-3)


def test_noise_alone_stays_out(ball: Surface) -> None:
    own, true, views, places = seen_with(ball, 0.0, 0.2)
    assert mean_error(texel_normals(ball, places, own, views), true) < 0.3 * mean_error(normalise(views.total), true)


def seen_with(ball: Surface, detail: float, noise: float) -> tuple[Float, Float, Shown, Places]:
    """The vertices' normals at points of the ball, true ones with a detail of their own, and what views show of these."""
    draw = np.random.default_rng(0)
    places = places_on(ball, draw)
    own = normalise(np.einsum("nk,nkc->nc", places.barycentric, vertex_normals(ball)[ball.faces[places.face]]))
    true = normalise(own + detail * draw.normal(size=own.shape))
    return own, true, shown(true, noise, draw), places


def test_where_no_two_views_see_it_the_vertices_decide(ball: Surface) -> None:
    draw = np.random.default_rng(1)
    places = places_on(ball, draw)
    own = normalise(np.einsum("nk,nkc->nc", places.barycentric, vertex_normals(ball)[ball.faces[places.face]]))
    nothing = Shown(np.zeros_like(own), np.zeros(len(own)), np.zeros(len(own)))
    assert np.allclose(texel_normals(ball, places, own, nothing), own)
    assert np.allclose(texel_normals(ball, places, own, shown(np.roll(own, 1, axis=1), 0.0, draw, views=1)), own)
