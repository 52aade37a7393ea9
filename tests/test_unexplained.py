"""What the model leaves of a vertex's photographs, where a part that is not there shades a bowl."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from test_borders import RADIUS, Bowl

from mvps.joint.state import relative_residuals
from mvps.joint.unexplained import unexplained_share
from mvps.scene import Surface
from mvps.visibility import cast_shadow, ray_caster


@pytest.fixture(scope="module")
def bowl() -> Bowl:
    return Bowl()


def shaded(surface: Surface) -> Surface:
    """The bowl with a ball in it."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.25 * RADIUS)
    ball.apply_translation((0, 0, -0.3 * RADIUS))
    vertices = np.concatenate([surface.vertices, np.array(ball.vertices)])
    return Surface(vertices, np.concatenate([surface.faces, np.array(ball.faces) + len(surface.vertices)]))


def test_on_the_right_surface_it_is_what_is_left_in_the_light(bowl: Bowl) -> None:
    of = bowl.observed(bowl.surface)
    found, in_light = unexplained_share(of), relative_residuals(of.views, of.vertices).numpy()
    inside = (bowl.surface.vertices[:, 2] < -0.3 * RADIUS) & np.isfinite(in_light)
    # What is deep in shadow is as dark as it should be; its samples count in the signal.
    assert inside.any() and (found[inside] <= 1.01 * in_light[inside]).all() and (found[inside] > 0.5 * in_light[inside]).all()


def test_what_is_lit_in_a_shadow_is_unexplained(bowl: Bowl) -> None:
    of = bowl.observed(shaded(bowl.surface))
    found, count = unexplained_share(of), len(bowl.surface.vertices)
    contradicted = np.zeros(len(of.surface.vertices), bool)
    for samples, lights in zip(of.views, of.lights, strict=True):
        index = samples.vertex.numpy()
        on_bowl = np.flatnonzero(index < count)
        # Well inside the light that is there: a place beside a true shadow may be dark.
        lit = ~cast_shadow(ray_caster(bowl.surface), index[on_bowl], lights.direction.double().numpy())
        assert samples.dark is not None
        contradicted[index[on_bowl[(samples.dark.numpy()[on_bowl] & lit).any(1)]]] = True
    bottom = np.flatnonzero(np.isfinite(found[:count]) & (bowl.surface.vertices[:, 2] < -0.3 * RADIUS))
    told = contradicted[bottom]
    # One of sixteen lights brings a fourth of the root of the sum of squares.
    assert told.sum() > 100 and np.median(found[bottom][told]) > 0.2 and (found[bottom][~told] < 0.1).all()


def test_where_no_view_looks_nothing_is_told(bowl: Bowl) -> None:
    of = bowl.observed(shaded(bowl.surface))
    below = of.surface.vertices[:, 2] < -0.5 * RADIUS
    below[: len(bowl.surface.vertices)] = False
    assert below.any() and np.isnan(unexplained_share(of)[below]).all()
