"""mvps.joint.fused: what views' normal maps say of a face's normal, and how well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sphere_scene import make_sphere
from test_agreement import true_maps

from mvps.joint.fused import NORMAL_SIGMA, SHARED_SIGMA, face_targets
from mvps.joint.observe import visible_in
from mvps.mesh import normalise
from mvps.scene import Capture

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
