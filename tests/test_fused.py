"""mvps.joint.fused: what views' normal maps say of a face's normal, and how well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.special import erf
from sphere_scene import make_sphere
from test_agreement import true_maps

from mvps.joint.fused import NORMAL_SIGMA, SHARED_SIGMA, _without_blur, face_targets
from mvps.joint.observe import visible_in
from mvps.joint.sharpened import SHARPENING, within
from mvps.mesh import angles_deg, normalise
from mvps.scene import Capture, Surface

SCENE = make_sphere(4)
SURFACE = SCENE.reconstruction.surface
SEEN = [index for index, _ in visible_in(SCENE.capture, SURFACE)]
VIEWS = np.sum([np.isin(SURFACE.faces, index).all(1) for index in SEEN], axis=0)


def sigmas(scatter_deg: float, capture: Capture = SCENE.capture, seen: list[np.ndarray] = SEEN, trials: int = 30) -> np.ndarray:
    """(F,) root mean squares over trials in which every view's normals are turned by an error of its own."""
    rng, truth = np.random.default_rng(3), true_maps(SCENE)[: len(capture.views)]
    squares = np.zeros(len(SURFACE.faces))
    for _ in range(trials):
        turns = rng.normal(0, np.radians(scatter_deg), (len(truth), 3))
        maps = tuple(replace(of_view, normal=normalise(of_view.normal + turn)) for of_view, turn in zip(truth, turns, strict=True))
        squares += face_targets(capture, SURFACE, maps, seen, normalise(SURFACE.vertices)).sigma ** 2
    return np.sqrt(squares / trials)


@pytest.mark.parametrize("scatter_deg", [0.0, 0.5, 1.0])
def test_a_normal_is_known_as_well_as_its_views_agree(scatter_deg: float) -> None:
    """Of n views whose errors are their own, by the root of n better than of one."""
    expected = np.hypot(np.radians(scatter_deg) / np.sqrt(np.maximum(VIEWS, 1)), SHARED_SIGMA)
    many = VIEWS >= 3
    assert many.sum() > 100
    np.testing.assert_allclose(np.median(sigmas(scatter_deg)[many] / expected[many]), 1, atol=0.2)


def test_no_normal_is_known_worse_than_where_views_say_nothing() -> None:
    assert (sigmas(20.0, trials=2) <= NORMAL_SIGMA).all()


def test_of_one_view_or_few_lights_nothing_is_told() -> None:
    one = Capture("one", SCENE.capture.views[:1])
    assert (sigmas(0.0, one, SEEN[:1], 1) == NORMAL_SIGMA).all()
    few = SCENE.capture.select({view.name: view.lights[:2] for view in SCENE.capture.views})
    assert (sigmas(0.0, few, SEEN, 1) == NORMAL_SIGMA).all()


def test_exact_normals_of_a_ball_stay() -> None:
    """They are the same where they are means around."""
    plain = make_sphere(4, waves=0)
    found = face_targets(plain.capture, SURFACE, tuple(true_maps(plain)), SEEN, normalise(SURFACE.vertices)).normal
    true = normalise(normalise(SURFACE.vertices)[SURFACE.faces].sum(1))
    assert angles_deg(found[VIEWS >= 2], true[VIEWS >= 2]).mean() < 0.3


N = 12
X, Y = (of.ravel() for of in np.meshgrid(np.arange(-N, N + 1.0), np.arange(-N, N + 1.0), indexing="ij"))


def sheet(z: np.ndarray) -> tuple[Surface, np.ndarray, np.ndarray]:
    """A square mesh of heights z (V,), the x of its faces' centres, and which faces are not near its border."""
    number = np.arange(len(X)).reshape(2 * N + 1, 2 * N + 1)
    a, b, c, d = (number[i : 2 * N + i, j : 2 * N + j].ravel() for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)))
    made = Surface(np.stack([X, Y, z], 1), np.concatenate([np.stack([a, b, c], 1), np.stack([d, c, b], 1)]))
    centre = made.vertices[made.faces].mean(1)
    return made, centre[:, 0], np.abs(centre[:, :2]).max(1) < N - 2


@pytest.mark.parametrize("away", [0.0, 1e7])
def test_a_blurred_ridge_is_sharpened(away: float) -> None:
    """Of two planes at a right angle, seen as a mean with a standard deviation of 0.6 along x, anywhere in the world. Along the slope
    lengths are longer. One pass leaves 0.56 of the error."""
    ridge, x, inner = sheet(-np.abs(X))
    ridge = Surface(ridge.vertices + away, ridge.faces)
    blurred = normalise(np.stack([erf(x / (0.6 * np.sqrt(2))), 0 * x, np.ones_like(x)], 1))
    true = normalise(np.stack([np.sign(x), 0 * x, np.ones_like(x)], 1))
    everywhere = np.ones(len(x))
    found = _without_blur(blurred, 2 * 0.6**2 / SHARPENING * everywhere, 0 * everywhere, everywhere > 0, ridge)
    near = inner & (np.abs(x) < 1.5)
    assert angles_deg(found[near], true[near]).mean() < 0.4 * angles_deg(blurred[near], true[near]).mean()


def test_a_normal_turns_no_farther_than_those_beside_it() -> None:
    """Three in a row at 0, 10 and 20 degrees: the middle one may turn to either end and not beyond, the ends only inwards."""
    tilt = np.radians([0.0, 10.0, 20.0])
    normal = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], 1)
    beside = sp.csr_matrix(np.array([[1, 1, 0], [1, 1, 1], [0, 1, 1]]))
    for wanted, got in (([-5, 15, 25], [0, 15, 20]), ([5, 40, 15], [5, 20, 15])):
        towards = np.radians(wanted)
        found = within(normal, np.stack([np.sin(towards), 0 * tilt, np.cos(towards)], 1), beside)
        np.testing.assert_allclose(np.degrees(np.arctan2(found[:, 0], found[:, 2])), got, atol=0.3)


def test_what_is_error_alone_is_not_sharpened() -> None:
    flat, x, inner = sheet(0 * X)
    up = np.broadcast_to([0.0, 0.0, 1.0], (len(x), 3))
    given = normalise(up + np.random.default_rng(5).normal(0, 0.05, up.shape) * [1, 1, 0])
    blur, error = np.full((2, len(x)), [[0.5], [0.05**2]])
    found = _without_blur(given, blur, error, error > 0, flat)
    # Knowing nothing of errors, the same blur makes them half as large again.
    believed = _without_blur(given, blur, 0 * error, error > 0, flat)
    plain, kept, blown = (angles_deg(of[inner], up[inner]).mean() for of in (given, found, believed))
    assert kept < 1.15 * plain and blown > 1.3 * plain
