"""Parts that no view sees."""

from __future__ import annotations

import numpy as np
import pytest
from references import is_closed, signed_volume
from sphere_scene import RADIUS, make_sphere

from mvps.camera import view_directions
from mvps.joint import unseen
from mvps.joint.unseen import closed_over
from mvps.mesh import face_normals
from mvps.scene import Bool, Int, Surface
from mvps.silhouette import mask_distances
from mvps.visibility import camera_hits, ray_caster

SCENE = make_sphere(4)
BALL = SCENE.reconstruction.surface
DISTANCE = mask_distances(SCENE.capture)
SEEN = BALL.vertices[:, 2] > -0.8 * RADIUS


def in_views(seen: Bool) -> list[Int]:
    """Per view the vertices that face it, among those seen (V,)."""
    towards = (view_directions(view.camera, BALL.vertices) for view in SCENE.capture.views)
    facing = [(BALL.vertices * t).sum(1) > 0 for t in towards]
    nobody = ~np.any(facing, axis=0)
    return [np.flatnonzero(seen & (f | nobody)) for f in facing]


IN_VIEWS = in_views(SEEN)


@pytest.mark.parametrize("deep", [0.0, 15.0, -15.0])
def test_an_unseen_cap_closes_round_whatever_it_was(deep: float) -> None:
    left = BALL.vertices.copy()
    left[~SEEN, 2] = -0.8 * RADIUS - deep
    closed = closed_over(Surface(left, BALL.faces), IN_VIEWS, SCENE.capture, DISTANCE)
    assert np.array_equal(closed.vertices[SEEN], BALL.vertices[SEEN]) and is_closed(closed) and signed_volume(closed) > 0
    # A cap of 8 units: a thin plate is a little flatter than a ball.
    depth = RADIUS - np.linalg.norm(closed.vertices[~SEEN], axis=1)
    assert depth.min() > -0.1 and depth.max() < 2.5


def test_an_unseen_part_stays_inside_the_masks() -> None:
    """The seen part of a smaller ball is drawn out at its rim: the plate would go on so, beyond the masks, which hold it."""
    drawn_out = 0.85 * BALL.vertices * np.where(BALL.vertices[:, 2:] < -0.6 * RADIUS, [[1, 1, 1.25]], 1)
    free = closed_over(Surface(drawn_out, BALL.faces), IN_VIEWS, SCENE.capture, [np.full_like(field, -1) for field in DISTANCE])
    held = closed_over(Surface(drawn_out, BALL.faces), IN_VIEWS, SCENE.capture, DISTANCE)
    out = [np.linalg.norm(s.vertices[~SEEN], axis=1).max() - RADIUS for s in (free, held)]
    assert out[0] > 1 and out[1] < 0.3


def test_an_unseen_back_stays_behind_what_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a shell that bends in like a bowl, the plate that closes it from the rim would come through."""
    view = SCENE.capture.views[0]
    toward = view_directions(view.camera, np.zeros((1, 3)))[0]
    height = BALL.vertices @ toward
    front = height > 0.2 * RADIUS
    aside = BALL.vertices - height[:, None] * toward
    bowl = 0.04 * RADIUS + 0.8 * (aside**2).sum(1) / RADIUS
    bent = aside + np.where(front, bowl, 0.2 * RADIUS)[:, None] * toward
    seen = [np.flatnonzero(front) if k == 0 else np.zeros(0, int) for k in range(len(SCENE.capture.views))]
    masks = [np.full_like(field, -1) for field in DISTANCE]

    def backs() -> float:
        """Share of the pixels that show the back of a face."""
        closed = closed_over(Surface(bent, BALL.faces), seen, SCENE.capture, masks)
        hits = camera_hits(ray_caster(closed), view.camera, view.pixels)
        return float((face_normals(closed)[hits.face[hits.face >= 0]] @ toward < 0).mean())

    assert backs() < 0.01
    monkeypatch.setattr(unseen, "_back_behind", lambda caster, free, *_: (np.zeros(len(free), bool), caster.surface.vertices[free]))
    assert backs() > 0.5


def test_nothing_unseen_or_nothing_seen_changes_nothing() -> None:
    for seen in (np.ones(len(SEEN), bool), np.zeros(len(SEEN), bool)):
        assert closed_over(BALL, in_views(seen), SCENE.capture, DISTANCE) is BALL


def test_a_piece_of_which_nothing_is_seen_stays() -> None:
    """A void within the ball."""
    n = len(BALL.vertices)
    both = Surface(np.concatenate([BALL.vertices, 0.2 * BALL.vertices + 3]), np.concatenate([BALL.faces, BALL.faces[:, ::-1] + n]))
    closed = closed_over(both, IN_VIEWS, SCENE.capture, DISTANCE)
    np.testing.assert_array_equal(closed.vertices[n:], both.vertices[n:])
    np.testing.assert_array_equal(closed.vertices[:n], closed_over(BALL, IN_VIEWS, SCENE.capture, DISTANCE).vertices)
