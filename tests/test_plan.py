"""Parts of the method that can be left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvps.coarse import rough_shape
from mvps.material import LARGEST, Model
from mvps.measures import distance_to
from mvps.methods import BUDGETS, METHODS
from mvps.plan import Parts, carving_pass, first_pass, last_pass
from mvps.progress import Progress
from mvps.reconstruct import Settings, reconstruct
from mvps.scene import Capture, Lights, Reconstruction
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings


@pytest.fixture(scope="module")
def capture() -> Capture:
    return render_capture(SceneSettings(views=5, lights=10, size=80))[0]


def draft(capture: Capture, parts: Parts) -> Reconstruction:
    return reconstruct(capture, Settings("made", preset="draft"), None, Progress(), parts)


def test_without_lobes_shadows_or_a_rig(capture: Capture) -> None:
    made = draft(capture, Parts(Model(), shadows=False, one_rig=False))
    assert made.material.specular_weight.shape[1] == 0 and made.material.bounce == 0 and not made.material.shadows
    assert made.metrics["model"]["components"] == [] and not made.lights.one_rig
    whole = draft(capture, Parts())
    assert whole.material.specular_weight.shape[1] > 0 and whole.material.shadows and whole.lights.one_rig


def test_vertices_that_do_not_move_stay_on_the_hull(capture: Capture) -> None:
    grid, hull = rough_shape(capture, Progress())
    away = [np.abs(distance_to(draft(capture, Parts(moves=moves)).surface.vertices, hull)[0]).mean() for moves in (False, True)]
    assert away[0] < 0.2 * grid.spacing < away[1]


def test_lights_that_stay_are_those_of_the_factorisation(capture: Capture) -> None:
    assert not Parts(free_lights=False).of(first_pass(True, True)).free_lights
    fixed, free = (draft(capture, Parts(free_lights=free)) for free in (False, True))
    assert np.abs(fixed.lights.direction[0] - free.lights.direction[0]).max() > 1e-3


@pytest.mark.parametrize("views", [5, 1])
def test_given_lights_stay_with_their_colours(views: int) -> None:
    """Under lamps that are said to be orange the same photographs show a bluer object."""
    capture, truth = render_capture(SceneSettings(views=views, lights=10, size=80))
    colour = np.array([1.5, 1.0, 0.5])
    white = Lights(tuple(truth.direction.values()), tuple(truth.intensity.values()), views > 1)
    orange = replace(white, intensity=tuple(of_view * colour for of_view in white.intensity))
    settings = Settings("made", preset="draft", calibrated_lights=True)
    one, other = (reconstruct(capture, settings, given, Progress()) for given in (white, orange))
    for given, made in ((white, one), (orange, other)):
        for at in range(views):
            scale = made.lights.intensity[at] / given.intensity[at]
            np.testing.assert_allclose(scale, scale.mean(), rtol=1e-5)
            np.testing.assert_allclose(made.lights.direction[at], given.direction[at], atol=1e-6)
    bluer = np.median(other.material.albedo, 0) / np.median(one.material.albedo, 0)
    np.testing.assert_allclose(bluer / bluer[1], 1 / colour, rtol=0.05)


BEFORE = [{"goes_on": 0.3}]


def test_given_lights_are_those_of_photographs_that_are_kept_back() -> None:
    """In other colours than the others', so that no rig nor fit would tell them."""
    capture, truth = render_capture(SceneSettings(views=5, lights=10, size=80))
    intensity = list(truth.intensity.values())
    intensity[3] = intensity[3] * [2.0, 1.0, 0.5]
    given = Lights(tuple(truth.direction.values()), tuple(intensity), False)
    settings = Settings("made", preset="draft", hold_out_views=(4,), hold_out_lights=(2,), calibrated_lights=True)
    made = reconstruct(capture, settings, given, Progress()).lights
    scale = np.concatenate(made.intensity) / np.concatenate(given.intensity)
    np.testing.assert_allclose(scale, scale.mean(), rtol=1e-5)
    np.testing.assert_allclose(np.concatenate(made.direction), np.concatenate(given.direction), atol=1e-6)


def test_colours_are_given_with_the_lights() -> None:
    for free in (True, False):
        for plan in (first_pass(free, True), carving_pass(free), last_pass("standard", free, False, BEFORE)):
            assert plan.free_colours is free
    assert Parts(free_lights=False).of(first_pass(True, True)).free_colours


def test_parts_change_nothing_else() -> None:
    for plan in (
        first_pass(True, False),
        first_pass(False, True),
        last_pass("standard", True, False, BEFORE),
        last_pass("fine", False, True, BEFORE),
    ):
        assert Parts().of(plan) == plan
    plan = last_pass("standard", True, False, BEFORE)
    coarse = Parts(edges=2.0).of(plan)
    assert [one.edge for one in coarse.rounds] == [2 * one.edge for one in plan.rounds] and coarse.model == LARGEST


def test_a_surface_that_is_far_off_is_pulled_by_photographs_first() -> None:
    for preset in ("standard", "fine"):
        near, far = (last_pass(preset, True, far, BEFORE).rounds for far in (False, True))
        assert last_pass(preset, True, False, BEFORE).goes_on == BEFORE[-1]["goes_on"]
        assert far[1:] == near and far[0].carving and far[0].reach > near[0].reach and np.isfinite(far[0].still)


def test_budgets_are_methods() -> None:
    assert set(BUDGETS) <= set(METHODS)


def test_coarse_rounds_are_done_again_while_vertices_move() -> None:
    (coarse,) = carving_pass(True).rounds
    assert coarse.carving and 0 < coarse.still < coarse.reach
    (eased,) = carving_pass(True, eased=True).rounds
    assert eased.edge > coarse.edge and eased.fusions < coarse.fusions and eased.still == coarse.still
    first, later = (last_pass("standard", True, False, BEFORE, eased=eased).rounds[0] for eased in (False, True))
    assert replace(first, fusions=later.fusions) == later and later.fusions < first.fusions
