"""mvps.joint.onward: moves that go on from round to round are taken at once, others are not."""

from __future__ import annotations

import numpy as np
import pytest
from known_shapes import sphere

from mvps.joint.onward import MOST_GOES_ON, Moves, carried_on, onward
from mvps.mesh import vertex_normals
from mvps.scene import Surface

BALL = sphere(1.0)
ALL = np.ones(len(BALL.vertices), bool)


def dent(depth: float) -> np.ndarray:
    """A smooth move inwards around the ball's top, vertices elsewhere stay."""
    return -depth * np.exp(-((1 - BALL.vertices[:, 2]) ** 2) / 0.02)


@pytest.mark.parametrize("q", [0.2, 0.4, MOST_GOES_ON])
def test_a_hollow_that_deepens_by_a_part_each_round_arrives_in_the_second(q: float) -> None:
    whole = 1.0 / (1 - q)
    first = onward(BALL, dent(1.0), ALL, MOST_GOES_ON)
    assert np.array_equal(first.taken, dent(1.0)) and first.left == pytest.approx(np.abs(dent(1.0)).mean())
    second = onward(BALL, q * dent(1.0), ALL, first)
    assert np.allclose(first.taken + second.taken, dent(whole)) and second.goes_on == pytest.approx(q)
    assert second.left == pytest.approx(np.abs(second.taken - second.asked).mean())
    # Arrived, a third asks for nothing.
    third = onward(BALL, dent(0.0), ALL, second)
    assert third.left == 0 and not third.taken.any()


def test_a_step_too_far_comes_back_as_it_is_asked_to() -> None:
    """Of q = 0.3 the second round went as for 0.5; the third asks for what that was too much, by 0.7, and goes by the secant's rule."""
    first = Moves(dent(1.0), dent(1.0), 0.5, 0.0)
    second = Moves(dent(0.3), dent(0.6), 0.5, 0.0)
    asked = dent(0.7 * (1 / 0.7 - 1.6))
    third = onward(BALL, asked, ALL, second)
    assert np.allclose(first.taken + second.taken + third.taken, dent(1 / 0.7))


def test_moves_by_chance_are_not_drawn_out() -> None:
    g = np.random.default_rng(0)
    first = Moves(*(2 * (g.normal(size=len(ALL)),)), 0.5, 0.0)
    second = onward(BALL, g.normal(size=len(ALL)), ALL, first)
    assert np.median(second.taken / second.asked) < 1.2 and second.goes_on < 0.1
    assert np.array_equal(onward(BALL, -first.asked, ALL, first).taken, -first.asked)


def test_what_no_view_sees_says_nothing_of_others() -> None:
    seen = BALL.vertices[:, 2] > 0
    g = np.random.default_rng(1)
    elsewhere = np.where(seen, 0, g.normal(size=len(seen)))
    first = onward(BALL, dent(1.0) + 30 * elsewhere, seen, MOST_GOES_ON)
    second = onward(BALL, dent(0.4) + 30 * elsewhere, seen, first)
    top = BALL.vertices[:, 2] > 0.5
    assert np.allclose(second.taken[top], dent(0.4 / 0.6)[top]) and second.goes_on == pytest.approx(0.4)
    assert first.left == pytest.approx(np.abs(dent(1.0)[seen]).mean())
    assert onward(BALL, dent(1.0), ~ALL, first).left == 0


def test_vertices_go_on_along_their_normals_alone() -> None:
    normal = vertex_normals(BALL)
    aside = np.cross(normal, [0, 0, 1.0])
    before = Moves(dent(0.01), dent(0.01), 0.5, 0.0)
    moved = Surface(BALL.vertices + dent(0.005)[:, None] * normal + 0.002 * aside, BALL.faces)
    on, moves = carried_on(BALL, moved, ALL, before)
    assert np.allclose(on.vertices - BALL.vertices, dent(0.01)[:, None] * normal + 0.002 * aside, atol=1e-12)
    assert np.allclose(moves.taken, dent(0.01))
