"""Parts that no view sees."""

from __future__ import annotations

import numpy as np
import pytest
from references import is_closed, signed_volume
from sphere_scene import RADIUS, make_sphere

from mvps.joint.unseen import closed_over
from mvps.scene import Surface
from mvps.silhouette import mask_distances

SCENE = make_sphere(4)
BALL = SCENE.reconstruction.surface
DISTANCE = mask_distances(SCENE.capture)
SEEN = BALL.vertices[:, 2] > -0.8 * RADIUS


@pytest.mark.parametrize("deep", [0.0, 15.0, -15.0])
def test_an_unseen_cap_closes_round_whatever_it_was(deep: float) -> None:
    left = BALL.vertices.copy()
    left[~SEEN, 2] = -0.8 * RADIUS - deep
    closed = closed_over(Surface(left, BALL.faces), SEEN, SCENE.capture, DISTANCE)
    assert np.array_equal(closed.vertices[SEEN], BALL.vertices[SEEN]) and is_closed(closed) and signed_volume(closed) > 0
    # A cap of 8 units: a thin plate is a little flatter than a ball.
    depth = RADIUS - np.linalg.norm(closed.vertices[~SEEN], axis=1)
    assert depth.min() > -0.1 and depth.max() < 2.5


def test_an_unseen_part_stays_inside_the_masks() -> None:
    """The seen part of a smaller ball is drawn out at its rim: the plate would go on so, beyond the masks, which hold it."""
    drawn_out = 0.85 * BALL.vertices * np.where(BALL.vertices[:, 2:] < -0.6 * RADIUS, [[1, 1, 1.25]], 1)
    free = closed_over(Surface(drawn_out, BALL.faces), SEEN, SCENE.capture, [np.full_like(field, -1) for field in DISTANCE])
    held = closed_over(Surface(drawn_out, BALL.faces), SEEN, SCENE.capture, DISTANCE)
    out = [np.linalg.norm(s.vertices[~SEEN], axis=1).max() - RADIUS for s in (free, held)]
    assert out[0] > 1 and out[1] < 0.3


def test_nothing_unseen_or_nothing_seen_changes_nothing() -> None:
    for seen in (np.ones(len(SEEN), bool), np.zeros(len(SEEN), bool)):
        assert closed_over(BALL, seen, SCENE.capture, DISTANCE) is BALL
