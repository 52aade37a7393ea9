"""mvps.between_views: which of two lights make views say the same of places that they share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sphere_scene import camera_at

from mvps import calibrate
from mvps.between_views import apart, nearer, nearest, said
from mvps.calibrate import uncalibrated_lights
from mvps.hull import default_cells, hull_of_masks, signed_distance
from mvps.mesh import angles_deg, normalise
from mvps.scene import Capture, Lights, Surface, Truth
from mvps.sharing import VertexSamples
from mvps.synthetic.scene import make_scene, render_capture
from mvps.synthetic.settings import SceneSettings

RNG = np.random.default_rng(0)
CAMERAS = [camera_at(direction, 64) for direction in normalise(RNG.normal(size=(5, 3)))]
PSEUDO = normalise(RNG.normal(size=(300, 3))) * RNG.uniform(0.2, 0.9, (300, 1))
"""Albedo times normal, world frame, of places that the views share."""
LIGHTS = [normalise(np.concatenate([RNG.normal(0, 0.5, (8, 2)), -np.ones((8, 1))], 1)) * RNG.uniform(0.5, 2, (8, 1)) for _ in CAMERAS]
NOISE = 1e-4


def shown(view: int) -> VertexSamples:
    """What a view shows of the places that face it."""
    facing = PSEUDO @ CAMERAS[view].rotation.T
    vertex = np.flatnonzero(facing[:, 2] < 0)
    image = facing[vertex] @ LIGHTS[view].T
    normal = normalise(PSEUDO[vertex])
    in_camera = normalise(facing[vertex])
    return VertexSamples(vertex, np.full(len(vertex), view), normal, in_camera, np.maximum(image, 0), image > 0.02)


SHOWN = [shown(view) for view in range(len(CAMERAS))]


def under(lights: list[np.ndarray]) -> list[np.ndarray]:
    """What views say under lights of each."""
    return [said(of, s, camera, NOISE) for of, s, camera in zip(SHOWN, lights, CAMERAS, strict=True)]


TRUE = under(LIGHTS)
TILTED = Rotation.from_euler("x", 15, degrees=True).as_matrix() @ np.diag([1.0, 0.8, 1.3])
WRONG = under([s @ TILTED.T for s in LIGHTS])


def test_what_a_view_says_is_albedo_times_normal_in_the_world() -> None:
    for of, values in zip(SHOWN, TRUE, strict=True):
        known = of.known.sum(1) >= 4
        assert known.any() and not known.all() and np.isnan(values[~known]).all()
        assert np.abs(values[known] - PSEUDO[of.vertex[known]]).max() < 1e-4


def test_views_are_together_under_the_truth_and_apart_under_what_factors_leave_open() -> None:
    assert apart(SHOWN, TRUE, True) < 1e-4 and apart(SHOWN, WRONG, True) > 0.1
    # How strong lights are is told of each view alone by its own albedo, about.
    stronger = [(1 + 0.2 * k) * values for k, values in enumerate(TRUE)]
    assert apart(SHOWN, stronger, True) > 0.1 > 5 * apart(SHOWN, stronger, False)
    assert apart(SHOWN[:1], TRUE[:1], True) == np.inf


def test_other_lights_are_believed_where_they_bring_views_together() -> None:
    count = len(CAMERAS)
    assert nearer(SHOWN, WRONG, TRUE, True) == [True] * count and nearer(SHOWN, TRUE, WRONG, True) == [False] * count
    assert nearer(SHOWN, TRUE, TRUE, True) == [False] * count and nearer(SHOWN, TRUE, TRUE, False) == [False] * count
    off = [False, True, False, False, True]
    mixed, others = (
        [(wrong if is_off else true) for true, wrong, is_off in zip(TRUE, WRONG, which, strict=True)]
        for which in (off, [not x for x in off])
    )
    assert nearer(SHOWN, mixed, others, False) == off


def test_a_bound_says_how_much_nearer_others_must_be() -> None:
    count = len(CAMERAS)
    # Halfway between the wrong ones and the true ones views are about half as far apart.
    half = [(a + b) / 2 for a, b in zip(WRONG, TRUE, strict=True)]
    ratio = apart(SHOWN, half, True) / apart(SHOWN, WRONG, True)
    assert 0.3 < ratio < 0.8
    assert nearer(SHOWN, WRONG, half, True, 1.0) == [True] * count and nearer(SHOWN, WRONG, half, True, 0.2) == [False] * count


def test_of_several_lights_those_that_bring_views_together_are_the_nearest() -> None:
    assert nearest(SHOWN, [WRONG, TRUE, WRONG], True) == 1 and nearest(SHOWN, [WRONG, TRUE, WRONG], False) == 1
    # Of a single view nothing tells, and the last is as good as any.
    assert nearest(SHOWN[:1], [WRONG[:1], TRUE[:1], WRONG[:1]], False) == 2


def light_error(capture: Capture, lights: Lights, truth: Truth) -> float:
    return float(np.mean([angles_deg(d, truth.direction[v.name]).mean() for v, d in zip(capture.views, lights.direction, strict=True)]))


def hull_of(capture: Capture) -> Surface:
    return hull_of_masks(capture, signed_distance(capture, default_cells(capture)))


@pytest.mark.parametrize("free", [False, True])
def test_lights_of_few_views_whose_hull_has_wrong_normals(monkeypatch: pytest.MonkeyPatch, free: bool) -> None:
    capture, truth = render_capture(SceneSettings(views=3, lights=10, size=64, free_lights=free))
    hull = hull_of(capture)
    found = uncalibrated_lights(capture, hull, 0)
    assert found.under_normals and found.lights.one_rig == (not free) and light_error(capture, found.lights, truth) < 13
    monkeypatch.setattr(calibrate, "nearer", lambda of, *_: [False] * len(of))
    # What the hull's normals make of the factors.
    assert light_error(capture, uncalibrated_lights(capture, hull, 0).lights, truth) > 20


def test_lights_of_wide_lobes_that_do_not_speak_for_a_metal(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = SceneSettings(views=6, lights=8, size=64)
    scene = make_scene(settings)
    of = scene.material
    dull = replace(of, albedo=0.1 * of.albedo, specular_weight=3 * of.specular_weight, sharpness=np.array([2.0, 8.0]))
    capture, truth = render_capture(settings, replace(scene, material=dull))
    found = uncalibrated_lights(capture, hull_of(capture), 0)
    assert not found.metallic and found.under_normals and found.residual > calibrate.BODY
    assert light_error(capture, found.lights, truth) < 19
    # Factors, and lights that wrong normals have drawn away in twenty sweeps.
    monkeypatch.setattr(calibrate, "BODY", 1.0)
    assert light_error(capture, uncalibrated_lights(capture, hull_of(capture), 0).lights, truth) > 24
