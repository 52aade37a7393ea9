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
    assert second.left == pytest.approx(np.abs(second.taken - q * dent(1.0)).mean())
    # Where it had arrived the second asks for nothing.
    arrived = onward(BALL, dent(0.0), ALL, first)
    assert arrived.left == 0 and not arrived.taken.any()


def test_moves_by_chance_are_not_drawn_out() -> None:
    g = np.random.default_rng(0)
    moved, asked = g.normal(size=(2, len(ALL)))
    first = Moves(moved, 0.5, 0.0)
    second = onward(BALL, asked, ALL, first)
    assert np.median(second.taken / asked) < 1.2 and second.goes_on < 0.1
    assert np.array_equal(onward(BALL, -moved, ALL, first).taken, -moved)


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
    before = Moves(dent(0.01), 0.5, 0.0)
    moved = Surface(BALL.vertices + dent(0.005)[:, None] * normal + 0.002 * aside, BALL.faces)
    on, moves = carried_on(BALL, moved, ALL, before)
    assert np.allclose(on.vertices - BALL.vertices, dent(0.01)[:, None] * normal + 0.002 * aside, atol=1e-12)
    assert np.allclose(moves.taken, dent(0.01))
