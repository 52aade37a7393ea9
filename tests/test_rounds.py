"""mvps.joint.refine: a round whose vertices moved farther than its sweeps reach, or than it allows, is done again, others are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from sphere_scene import RADIUS, SphereScene, make_sphere

from mvps.camera import pixel_footprint
from mvps.joint import refine as rounds
from mvps.joint.refine import MOST_REPEATS, Refined, RefineSettings, RoundSettings, refine
from mvps.photometric import normal_maps
from mvps.scene import Law, Surface

REACH = 1.2


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(3)


def refined_from(scene: SphereScene, pixels: float, plan: RefineSettings) -> Refined:
    """From a surface that many pixels too large."""
    surface, device = scene.reconstruction.surface, torch.device("cpu")
    lights = scene.reconstruction.lights
    start = Surface(surface.vertices * (1 + pixels * pixel_of(scene) / RADIUS), surface.faces)
    maps = normal_maps(scene.capture, lights, device)
    return refine(scene.capture, start, lights, maps, Law((8.0,)), plan, 0, device, lambda *_: None)


def pixel_of(scene: SphereScene) -> float:
    return pixel_footprint([view.camera for view in scene.capture.views], np.zeros(3))


def swollen(scene: SphereScene, pixels: float, still: float = np.inf, fusions: int = 3, goes_on: float = 0.5) -> tuple[list[float], float]:
    """The vertices' mean change in every round, and the error of the radius, in pixels."""
    plan = RefineSettings((RoundSettings(3.0, REACH, 0.4, still=still, fusions=fusions),), free_lights=False, goes_on=goes_on)
    refined = refined_from(scene, pixels, plan)
    radius = np.linalg.norm(refined.surface.vertices, axis=1)
    return [one["vertex_change_px"] for one in refined.rounds], float(np.abs(radius - RADIUS).mean() / pixel_of(scene))


def test_a_round_is_done_again_where_vertices_moved_far(scene: SphereScene, monkeypatch: pytest.MonkeyPatch) -> None:
    changes, error = swollen(scene, 5.0, fusions=1)
    assert 1 < len(changes) <= 1 + MOST_REPEATS and all(change > REACH for change in changes[:-1])
    monkeypatch.setattr(rounds, "MOST_REPEATS", 0)
    once, error_once = swollen(scene, 5.0, fusions=1)
    assert len(once) == 1 and error < 0.8 * error_once


def test_a_round_that_found_its_place_is_the_last(scene: SphereScene) -> None:
    changes, _ = swollen(scene, 0.5)
    assert len(changes) == 1


def test_a_round_is_done_again_until_vertices_are_still(scene: SphereScene) -> None:
    (first,), _ = swollen(scene, 0.5)
    changes, _ = swollen(scene, 0.5, still=0.6 * first)
    assert changes[0] == first and len(changes) == 2 and changes[1] <= 0.6 * first
    assert len(swollen(scene, 0.5, still=1.5 * first)[0]) == 1


def test_where_photographs_abound_a_round_that_is_done_again_solves_vertices_alone(scene: SphereScene) -> None:
    """Lights, law and the views' normals are the first one's, as is what is known of whether they have settled."""
    once = RefineSettings((RoundSettings(3.0, REACH, 0.4, carving=True),), eased=True)
    plan = replace(once, rounds=(replace(once.rounds[0], still=0.01),))
    alone, again = (refined_from(scene, 0.5, one) for one in (once, plan))
    first, second = again.rounds
    assert first["light_change_deg"] > 0 == second["light_change_deg"] and first["light_step_deg"] == second["light_step_deg"]
    assert second["normal_change_deg"] > 0 and second["residual"] != first["residual"]
    for before, after in zip(alone.lights.direction, again.lights.direction, strict=True):
        np.testing.assert_array_equal(before, after)
    for one, other in zip(alone.maps, again.maps, strict=True):
        np.testing.assert_array_equal(one.normal, other.normal)
    assert refined_from(scene, 0.5, replace(plan, eased=False)).rounds[1]["light_change_deg"] > 0


def test_where_earlier_moves_did_not_go_on_a_round_stays_single(scene: SphereScene) -> None:
    (first,), _ = swollen(scene, 0.5)
    assert swollen(scene, 0.5, still=0.01 * first, goes_on=0.0)[0] == [first]


def test_a_round_that_goes_on_keeps_its_mesh(scene: SphereScene) -> None:
    """Its edges are not split once more, for moves are compared vertex by vertex."""
    plan = RefineSettings((RoundSettings(3.0, REACH, 0.4, still=0.01, crease=0.02),), free_lights=False)
    first, second = refined_from(scene, 0.5, plan).rounds
    assert first["vertices"] == second["vertices"] and first["goes_on"] == 0.5 > second["goes_on"]


def test_of_a_model_that_does_not_fit_no_round_is_done_again(scene: SphereScene, monkeypatch: pytest.MonkeyPatch) -> None:
    (first,), _ = swollen(scene, 0.5)
    monkeypatch.setattr(rounds, "POOR_FIT", 0.0)
    assert len(swollen(scene, 0.5, still=0.6 * first)[0]) == 1


def test_vertices_that_have_far_to_go_have_not_settled(scene: SphereScene, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = RefineSettings((RoundSettings(3.0, REACH, 0.4, still=0.01),), free_lights=False)
    first, second = refined_from(scene, 0.5, plan).rounds
    # One round says nothing of the next.
    assert first["left_px"] == 0 < second["left_px"]
    told = []
    for share in (0.5, 2.0):
        monkeypatch.setattr("mvps.joint.refine.AT_REST_PIXELS", share * second["left_px"])
        told.append(refined_from(scene, 0.5, plan))
    assert told[0].status == "not settled" and "px to go in the mean" in told[0].text
    assert "px to go in the mean" not in told[1].text


def test_where_lights_and_vertices_still_move_in_the_last_round_they_have_not_settled(
    scene: SphereScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = RefineSettings((RoundSettings(3.0, REACH, 0.4),) * 2)
    first, second = refined_from(scene, 0.5, plan).rounds
    # First lights are no rounds'.
    assert first["lights_moving_deg"] == 0 < second["lights_moving_deg"] == second["light_change_deg"]
    told = []
    for of_lights, of_vertices in ((0.5, 0.5), (2.0, 0.5), (0.5, 2.0)):
        monkeypatch.setattr("mvps.joint.refine.MOVING_DEG", of_lights * second["lights_moving_deg"])
        monkeypatch.setattr("mvps.joint.refine.MOVING_PIXELS", of_vertices * second["vertex_change_px"])
        told.append(refined_from(scene, 0.5, plan))
    assert told[0].status == "not settled"
    assert ["In the last round lights still turned" in one.text for one in told] == [True, False, False]
