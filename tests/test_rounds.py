"""mvps.joint.refine: a round whose vertices moved farther than its sweeps reach, or than it allows, is done again, others are not."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from sphere_scene import RADIUS, SphereScene, make_sphere

from mvps.camera import pixel_footprint
from mvps.joint import refine as rounds
from mvps.joint.refine import MOST_REPEATS, RefineSettings, RoundSettings, refine
from mvps.photometric import normal_maps
from mvps.scene import Law, Surface

REACH = 1.2


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(3)


def swollen(scene: SphereScene, pixels: float, still: float = np.inf, fusions: int = 3) -> tuple[list[float], float]:
    """From a surface that many pixels too large: the vertices' mean change in every round, and the error of the radius, in pixels."""
    surface, device = scene.reconstruction.surface, torch.device("cpu")
    lights = scene.reconstruction.lights
    pixel = pixel_footprint([view.camera for view in scene.capture.views], np.zeros(3))
    start = Surface(surface.vertices * (1 + pixels * pixel / RADIUS), surface.faces)
    maps = normal_maps(scene.capture, lights, device)
    plan = RefineSettings((RoundSettings(3.0, REACH, 0.4, still=still, fusions=fusions),), free_lights=False)
    refined = refine(scene.capture, start, lights, maps, Law((8.0,)), plan, 0, device, lambda *_: None)
    radius = np.linalg.norm(refined.surface.vertices, axis=1)
    return [one["vertex_change_px"] for one in refined.rounds], float(np.abs(radius - RADIUS).mean() / pixel)


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


def test_of_a_model_that_does_not_fit_no_round_is_done_again(scene: SphereScene, monkeypatch: pytest.MonkeyPatch) -> None:
    (first,), _ = swollen(scene, 0.5)
    monkeypatch.setattr(rounds, "POOR_FIT", 0.0)
    assert len(swollen(scene, 0.5, still=0.6 * first)[0]) == 1
