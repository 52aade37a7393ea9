"""mvps.verdict: each sign measures what it says, and each can change the verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sphere_scene import SphereScene, make_sphere

from mvps.camera import pixel_footprint, view_directions
from mvps.finding import Finding
from mvps.mesh import vertex_areas, vertex_normals
from mvps.scene import RELIABLE, Capture, Surface
from mvps.verdict import (
    LEAST_FACING,
    depth_px,
    expected_deg,
    median,
    outline_px,
    photographs,
    seen_by,
    signs,
    verdict,
    views_deg,
)

SETTLED = ("converged", "settled.")
GOOD = {
    "misfit": 0.02,
    "noise": 0.01,
    "outline_px": 0.2,
    "views_deg": 2.0,
    "expected_deg": 1.0,
    "depth_px": 0.1,
    "hidden_px": 0.1,
    "photographs": 40.0,
}


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(4)


def test_outlines_that_are_off(scene: SphereScene) -> None:
    surface = scene.reconstruction.surface
    pixel = 40.0 / (0.4 * 96)
    assert outline_px(scene.capture, surface) < 0.2
    for shift in (1.0, 3.0):
        grown = Surface(surface.vertices * (1 + shift * pixel / 40.0), surface.faces)
        assert outline_px(scene.capture, grown) == pytest.approx(shift, abs=0.35)


def test_views_that_contradict_each_other(scene: SphereScene) -> None:
    surface, maps = scene.reconstruction.surface, list(scene.reconstruction.normal_maps)
    seen = seen_by(scene.capture, surface)
    assert views_deg(scene.capture, surface, maps, seen) < 1.5
    about = [Rotation.from_rotvec(np.radians(12) * view.camera.rotation[2]).as_matrix() for view in scene.capture.views]
    turned = [(m @ R.T).astype(np.float32) for m, R in zip(maps, about, strict=True)]
    assert views_deg(scene.capture, surface, turned, seen) > 5
    assert views_deg(Capture("one", scene.capture.views[:1]), surface, maps[:1], seen[:1]) == 0


def test_expected_error_is_the_stated_one(scene: SphereScene) -> None:
    material = scene.reconstruction.material
    sigma, area = np.radians(4.0), vertex_areas(scene.reconstruction.surface)
    stated = replace(material, confidence=np.full(len(material.albedo), 1 / (1 + (sigma / RELIABLE) ** 2)))
    assert expected_deg(stated, area) == pytest.approx(4.0 * np.sqrt(np.pi / 2), rel=1e-6)
    assert expected_deg(replace(material, confidence=np.zeros(len(area))), area) == 90


def test_depth_of_what_one_view_sees_is_as_uncertain_as_its_normals_times_the_distance(scene: SphereScene) -> None:
    surface, count = scene.reconstruction.surface, len(scene.reconstruction.surface.vertices)
    sigma = np.radians(2.0)
    material = replace(scene.reconstruction.material, confidence=np.full(count, 1 / (1 + (sigma / RELIABLE) ** 2)))
    outward = vertex_normals(surface)
    faces = [(outward * view_directions(view.camera, surface.vertices)).sum(1) > LEAST_FACING for view in scene.capture.views]
    other = max(range(1, len(faces)), key=lambda k: int((faces[0] & faces[k]).sum()))
    two = Capture("two", (scene.capture.views[0], scene.capture.views[other]))
    first, second = np.flatnonzero(faces[0]), np.flatnonzero(faces[other])
    # Of all that the first view sees the second sees ten vertices: the distance to the nearest of them decides.
    both = np.intersect1d(first, second)[:10]
    pixel = pixel_footprint([view.camera for view in two.views], surface.vertices.mean(0))
    away = np.linalg.norm(surface.vertices[first][:, None] - surface.vertices[both], axis=2).min(1) / pixel
    mean = np.average(away, weights=vertex_areas(surface)[first])
    assert depth_px(two, surface, material, [first, both]) == pytest.approx(np.sqrt(np.pi / 2) * sigma * mean, rel=1e-6)
    assert depth_px(two, surface, material, [both, both]) == 0
    unknown = replace(material, confidence=np.zeros(count))
    assert depth_px(two, surface, unknown, [first, both]) == pytest.approx(np.pi / 2 * mean, rel=1e-6)
    # What a view sees from the side is not seen twice, and then nothing is: all is as far off as the object is large.
    aside = np.setdiff1d(first, second)[:10]
    radius = np.linalg.norm(surface.vertices - surface.vertices.mean(0), axis=1).mean() / pixel
    assert depth_px(two, surface, material, [first, aside]) == pytest.approx(np.sqrt(np.pi / 2) * sigma * radius, rel=1e-6)
    one = Capture("one", two.views[:1])
    assert depth_px(one, surface, material, [first]) == 0


def test_photographs_of_a_place_are_those_of_the_views_that_see_it(scene: SphereScene) -> None:
    two = scene.capture.select({view.name: view.lights[: k + 1] for k, view in enumerate(scene.capture.views[:2])})
    surface = scene.reconstruction.surface
    # The first view has one photograph, the second two.
    assert photographs(two, surface, [np.arange(10), np.arange(4)]) == 1 and photographs(two, surface, [np.arange(4), np.arange(10)]) == 2
    assert photographs(two, surface, [np.arange(10), np.arange(6)]) == 3 and photographs(two, surface, [np.arange(0), np.arange(0)]) == 0
    # What was left out shows nothing.
    less = two.without({two.views[1].name: two.views[1].lights[:1]})
    assert photographs(less, surface, [np.arange(10), np.arange(6)]) == 2


def test_noise_is_no_misfit(scene: SphereScene) -> None:
    r = scene.reconstruction
    everywhere = np.full(len(r.surface.vertices), 0.01)
    found = signs(scene.capture, r.surface, r.material, r.normal_maps, everywhere)
    assert found["hidden_px"] == 0
    # A hemisphere that nothing explains hides what it spans.
    half = np.where(r.surface.vertices[:, 2] > 0, 1.0, everywhere)
    radius = np.linalg.norm(r.surface.vertices, axis=1).mean() / pixel_footprint([v.camera for v in scene.capture.views], np.zeros(3))
    assert 0.15 < signs(scene.capture, r.surface, r.material, r.normal_maps, half)["hidden_px"] / radius < 0.45
    left = signs(scene.capture, r.surface, r.material, r.normal_maps, 20 * everywhere)
    assert left["misfit"] == pytest.approx(np.sqrt(0.04 - found["noise"] ** 2)) and set(found) == set(GOOD)


def test_a_fine_mesh_counts_no_more_than_a_coarse_one() -> None:
    assert median(np.array([1.0, 1.0, 1.0, 5.0]), np.array([0.1, 0.1, 0.1, 1.0])) == 5
    assert median(np.array([3.0, 1.0, 2.0]), np.ones(3)) == 2 and median(np.zeros(0), np.zeros(0)) == 0


def test_what_could_not_be_mended_is_a_doubt() -> None:
    name, text = verdict(GOOD, SETTLED, [Finding("mask", "view_02", "is odd", True), Finding("pose", "view_03", "is wrong", False)])
    assert name == "doubtful" and "view_03: is wrong" in text and "view_02" not in text


@pytest.mark.parametrize(
    ("change", "status", "said"),
    [
        ({}, "converged", "settled"),
        ({"misfit": 0.15}, "poor fit", "15 % of the images' signal"),
        ({"outline_px": 1.5}, "doubtful", "1.5 px apart"),
        ({"views_deg": 8.0}, "doubtful", "8 deg apart"),
        ({"expected_deg": 12.0}, "doubtful", "12 deg off"),
        ({"depth_px": 3.0}, "doubtful", "likely to be 3.0 px off"),
        ({"photographs": 3.0}, "doubtful", "no more than 3 photographs"),
        ({"hidden_px": 1.5}, "doubtful", "would put the surface 1.5 px off"),
        ({"views_deg": 8.0, "expected_deg": 12.0}, "doubtful", "same place are 8 deg"),
    ],
)
def test_every_sign_counts(change: dict[str, float], status: str, said: str) -> None:
    name, text = verdict(GOOD | change, SETTLED)
    assert name == status and said in text
