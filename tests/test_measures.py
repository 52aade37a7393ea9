"""Measures against scenes whose errors are known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from known_shapes import LOOKING_DOWN, SIX_SIDES, lights, photographed, plane, reconstruction, ring, seen, sphere, tilted

from mvps import measures
from mvps.mesh import face_normals, vertex_normals
from mvps.scene import Camera, Capture, Lights, Material, Reconstruction, Surface, Truth, View
from mvps.visibility import RayCaster

# surface distance


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("offset", [0.7, -0.7])
def test_concentric_spheres_are_their_radii_apart(offset: float, scale: float) -> None:
    truth, result = sphere(25 * scale), sphere((25 + offset) * scale)
    capture = seen(sphere(25), [LOOKING_DOWN, *SIX_SIDES])
    cameras = [Camera(c.K, c.rotation, c.translation * scale, 64, 64) for c in (v.camera for v in capture.views)]
    capture = Capture("test", tuple(replace(v, camera=c) for v, c in zip(capture.views, cameras, strict=True)))
    errors = measures.surface_errors(result, truth, capture)
    # The facets of both are parallel, and closer than the spheres by the ratio of inscribed to circumscribed radius.
    assert errors["accuracy_mm"] == pytest.approx(abs(offset) * scale, rel=3e-3)
    assert errors["completeness_mm"] == pytest.approx(abs(offset) * scale, rel=3e-3)
    assert errors["chamfer_mm"] == pytest.approx((errors["accuracy_mm"] + errors["completeness_mm"]) / 2)
    assert errors["pixel_mm"] == pytest.approx(500 / 400 * scale)
    assert errors["chamfer_px"] == pytest.approx(abs(offset) * 400 / 500, rel=3e-3)
    assert errors["offset_px"] == pytest.approx(offset * 400 / 500, rel=3e-3)
    assert errors["offset_median_px"] == pytest.approx(offset * 400 / 500, rel=3e-3)
    if scale == 1:
        assert (errors["f_score_0_5_mm"], errors["f_score_1_mm"]) == (0, 1)
        assert errors["mesh_coverage"] == (1 if offset > 0 else pytest.approx(0.95, abs=0.05))


def test_a_moved_plane_is_as_far_as_it_was_moved() -> None:
    truth = plane(-20, 20, 0)
    capture = seen(truth, [LOOKING_DOWN])
    errors = measures.surface_errors(plane(-40, 40, -0.3), truth, capture)
    assert errors["completeness_mm"] == pytest.approx(0.3, abs=1e-9)
    assert errors["offset_px"] == pytest.approx(-0.3 / errors["pixel_mm"], rel=1e-3)


def test_the_missing_half_of_a_plane_counts_in_completeness_alone() -> None:
    truth = plane(-20, 20, 0)
    capture = seen(truth, [LOOKING_DOWN])
    errors = measures.surface_errors(plane(-20, 0, 0), truth, capture)
    x = measures.first_hit_points(truth, capture)[:, 0]
    assert errors["accuracy_mm"] == pytest.approx(0, abs=1e-9)
    assert errors["completeness_mm"] == pytest.approx(np.maximum(x, 0).mean())
    recall = (x < 0.5).mean()
    assert errors["f_score_0_5_mm"] == pytest.approx(2 * recall / (1 + recall))
    assert errors["mesh_coverage"] == pytest.approx((x < 0).mean())


def test_signs_are_right_everywhere_around_a_coarse_sphere() -> None:
    """Near edges and corners too, where the nearest face's own normal would err."""
    surface = sphere(10, 1)
    points = np.random.default_rng(0).normal(size=(5000, 3)) * 8
    distance, signed = measures.distance_to(points, surface)
    # Convex: inside is below the planes of all faces.
    corner = surface.vertices[surface.faces[:, 0]]
    inside = ((points[:, None] - corner) * face_normals(surface)).sum(-1).max(1) < 0
    assert inside.any() and not inside.all()
    assert np.array_equal(signed < 0, inside)
    assert np.array_equal(np.abs(signed), distance)
    assert (distance[inside] <= 10).all()


@pytest.mark.parametrize("surface", [sphere(10, 2), plane(-20, 20, 0)])
def test_a_truth_that_shows_its_back_is_turned_around(surface: Surface) -> None:
    capture = seen(surface, [LOOKING_DOWN])
    assert measures.seen_from_outside(surface, capture) is surface
    turned = measures.seen_from_outside(Surface(surface.vertices, surface.faces[:, ::-1]), capture)
    np.testing.assert_array_equal(turned.faces, surface.faces)


def test_a_face_without_area_does_no_harm() -> None:
    ball = sphere(10, 2)
    a, b, _ = ball.faces[0]
    broken = Surface(ball.vertices, np.concatenate([ball.faces, [[0, 0, 0], [a, a, b]]]))
    points = np.concatenate([ball.vertices * 1.2, ball.vertices * 0.9])
    for whole, given in zip(measures.distance_to(points, ball), measures.distance_to(points, broken), strict=True):
        assert np.allclose(np.abs(whole), np.abs(given)) and np.isfinite(given).all()


def test_surfaces_that_no_camera_sees_are_refused() -> None:
    truth = plane(-20, 20, 0)
    capture = seen(truth, [LOOKING_DOWN])
    with pytest.raises(ValueError, match="result mesh: wanted a surface in front"):
        measures.surface_errors(plane(5000, 5020, 0), truth, capture)
    with pytest.raises(ValueError, match="truth mesh: wanted a surface in front"):
        measures.surface_errors(truth, plane(5000, 5020, 0), capture)


# normals


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 5.0, 89.9, 179.9999, 180.0])
def test_angles_are_exact_from_nothing_to_opposite(degrees: float) -> None:
    t = np.radians(degrees)
    angle = measures.angles_deg(np.array([1.0, 0, 0]), np.array([np.cos(t), np.sin(t), 0]))
    assert angle == pytest.approx(degrees, rel=1e-6, abs=1e-12)


def test_normals_tilted_by_five_degrees_are_five_degrees_off() -> None:
    ball = sphere(20)
    capture = seen(ball, [LOOKING_DOWN, *SIX_SIDES])
    truth = {v.name: measures.mesh_normals(RayCaster(ball), v) for v in capture.views}
    estimated = {name: tilted(n, 5 if name != "view_02" else 20).astype(np.float32) for name, n in truth.items()}
    errors = measures.normal_errors(estimated, truth, capture, ["view_02"])
    pixels = np.array([v.mask.sum() for v in capture.views])
    assert errors["fitted_normal_error_deg"] == pytest.approx(5, rel=1e-4)
    assert errors["held_out_normal_error_deg"] == pytest.approx(20, rel=1e-4)
    assert errors["normal_error_deg"] == pytest.approx((pixels * (5, 20, 5)).sum() / pixels.sum(), rel=1e-4)
    assert errors["normal_error_median_deg"] == pytest.approx(5, rel=1e-4)
    together = measures.normal_errors(estimated, truth, capture)
    assert together["normal_error_deg"] == errors["normal_error_deg"]
    assert set(together) == {"normal_error_deg", "normal_error_median_deg", "normal_coverage"}


def test_pixels_without_an_estimate_show_in_the_coverage() -> None:
    ball = sphere(20)
    capture = seen(ball, [LOOKING_DOWN, *SIX_SIDES])
    truth = {v.name: measures.mesh_normals(RayCaster(ball), v) for v in capture.views}
    half = {name: n.copy() for name, n in truth.items()}
    half["view_01"][:, :32] = np.nan
    del half["view_03"]
    errors = measures.normal_errors(half, truth, capture)
    pixels = [int(v.mask.sum()) for v in capture.views]
    assert errors["normal_error_deg"] == 0
    right = int(capture.views[0].mask[:, 32:].sum())
    assert errors["normal_coverage"] == pytest.approx((right + pixels[1]) / sum(pixels))
    hole = {name: n.copy() for name, n in truth.items()}
    hole["view_02"][:32] = np.nan
    assert measures.normal_errors(truth, hole, capture)["normal_error_deg"] == 0, "a pixel without truth is no error"
    assert measures.normal_errors(truth, hole, capture)["normal_coverage"] == 1, "nor does it count as not covered"
    assert measures.normal_errors({}, truth, capture) == {"normal_coverage": 0}
    assert measures.normal_errors(truth, {}, capture) == {}


def test_a_smaller_ball_has_the_normals_of_the_law_of_sines() -> None:
    """The ray at distance b from the centre meets a ball of radius r where the normal leaves its direction by asin(b / r)."""
    truth_ball, result = sphere(20, 5), sphere(22, 5)
    capture = seen(truth_ball, [LOOKING_DOWN])
    v = capture.views[0]
    truth = {v.name: measures.mesh_normals(RayCaster(truth_ball), v)}
    errors = measures.mesh_normal_errors(result, truth, capture)
    _, direction = measures_rays(v)
    b = np.linalg.norm(np.cross(v.camera.centre, direction), axis=-1)
    expected = np.degrees(np.arcsin(np.minimum(b / 20, 1)) - np.arcsin(b / 22))
    assert errors["normal_error_deg"] == pytest.approx(expected.mean(), rel=0.02)
    assert errors["normal_error_median_deg"] == pytest.approx(np.median(expected), rel=0.02)


def measures_rays(v: View) -> tuple[np.ndarray, np.ndarray]:
    from mvps.camera import pixel_centres, rays

    return rays(v.camera, pixel_centres(v.pixels))


# lights


def test_lights_turned_by_three_degrees_are_three_degrees_off() -> None:
    t = np.radians(3)
    turn = np.array([[np.cos(t), -np.sin(t), 0], [np.sin(t), np.cos(t), 0], [0, 0, 1]])
    intensity = np.random.default_rng(0).uniform(0.5, 2, (12, 3))
    errors = measures.light_errors(lights(ring(12) @ turn.T, 7.3 * intensity), lights(ring(12), intensity))
    assert errors["light_error_deg"] == pytest.approx(3)
    assert errors["light_error_max_deg"] == pytest.approx(3)
    assert errors["intensity_error"] == pytest.approx(0, abs=1e-12)


def test_one_light_ten_per_cent_brighter() -> None:
    """Of n equal lights one is estimated as 1.1: the scale is (n + 0.1) / (n + 0.21)."""
    n, ones = 10, np.ones((10, 3))
    brighter = ones.copy()
    brighter[0] = 1.1
    scale = (n + 0.1) / (n + 0.21)
    errors = measures.light_errors(lights(ring(n), brighter), lights(ring(n), ones))
    assert errors["intensity_error"] == pytest.approx((abs(1.1 * scale - 1) + (n - 1) * abs(scale - 1)) / n)
    one_channel = ones * (1, 1, 1.1)
    assert measures.light_errors(lights(ring(n), one_channel), lights(ring(n), ones))["intensity_error"] > 0.03


def test_lights_are_matched_by_view_and_number() -> None:
    truth = Truth(("view_01", "view_02"), {}, {"view_01": ring(6)}, {"view_01": np.ones((6, 3))}, None)
    known = measures.true_lights(truth)
    assert set(known) == {("view_01", k) for k in range(1, 7)}, "of view_02 nothing is known"
    some = Lights((ring(6)[[4, 1]], ring(6)), (np.ones((2, 3)), np.ones((6, 3))), False)
    estimated = measures.by_photograph(some, ("view_01", "view_02"), ((5, 2), (1, 2, 3, 4, 5, 6)))
    errors = measures.light_errors(estimated, known)
    assert (errors["light_error_deg"], errors["intensity_error"]) == (0, 0)
    assert measures.light_errors(estimated, {}) == {}


def test_directions_and_intensities_are_measured_each_where_they_are_known() -> None:
    names, directions, intensities = ("view_01", "view_02"), {"view_01": ring(6)}, {"view_02": np.ones((6, 3))}
    found = Lights((ring(6), ring(6)), (np.full((6, 3), 3.0), np.full((6, 3), 5.0)), False)
    estimated = measures.by_photograph(found, names, ((1, 2, 3, 4, 5, 6),) * 2)
    for direction, intensity, keys in (
        (directions, {}, {"light_error_deg", "light_error_max_deg"}),
        ({}, intensities, {"intensity_error"}),
        (directions, intensities, {"light_error_deg", "light_error_max_deg", "intensity_error"}),
    ):
        known = measures.true_lights(Truth(names, {}, direction, intensity, None))
        assert measures.light_errors(estimated, known) == dict.fromkeys(keys, 0.0)
        of_psnerf = {f"psnerf_{key}" for key in keys} - {"psnerf_light_error_max_deg"}
        assert measures.psnerf_light_errors(estimated, known, names) == dict.fromkeys(of_psnerf, 0.0)


# photographs


def test_psnr_of_known_noise() -> None:
    ball, material, known, capture = photographed(0.01, gain=3.0)
    errors = measures.photograph_errors(ball, material, known, capture, ["view_02"])
    assert errors["held_out_views_psnr_db"] == pytest.approx(40, abs=0.2)
    assert errors["held_out_lights_psnr_db"] == pytest.approx(40, abs=0.2)
    assert errors["photograph_scale"] == pytest.approx(1 / 3, rel=1e-3)


def test_psnr_without_noise_is_that_of_rounding() -> None:
    ball, material, known, capture = photographed(0.0, gain=1.0)
    errors = measures.photograph_errors(ball, material, known, capture)
    assert errors["held_out_lights_psnr_db"] == pytest.approx(20 * np.log10(65535) + 10 * np.log10(12), abs=1)
    assert "held_out_views_psnr_db" not in errors


def test_only_held_out_photographs_count() -> None:
    ball, material, known, capture = photographed(0.01, gain=1.0)
    wrong = Capture("test", tuple(replace(v, samples=np.where(np.arange(3)[None, :, None] == 1, v.samples, 0)) for v in capture.views))
    only_second = {photo: light for photo, light in known.items() if photo[1] == 2}
    assert measures.photograph_errors(ball, material, only_second, wrong)["held_out_lights_psnr_db"] > 39
    assert measures.photograph_errors(ball, material, known, wrong)["held_out_lights_psnr_db"] < 30
    assert measures.photograph_errors(ball, material, {}, capture) == {}


def test_clipped_photographs_are_compared_with_a_clipped_rendering() -> None:
    ball, material, known, capture = photographed(0.0, gain=1.0)
    clipped = Capture("test", tuple(replace(v, samples=np.minimum(v.samples, 20000), saturation=20000) for v in capture.views))
    errors = measures.photograph_errors(ball, material, known, clipped)
    assert errors["held_out_lights_psnr_db"] > 90


# all together


def test_a_perfect_reconstruction_has_no_errors() -> None:
    errors = measures.evaluate(*reconstruction({}))
    assert errors["chamfer_mm"] == pytest.approx(0, abs=1e-6)
    for name in ("mesh_normal_error_deg", "map_normal_error_deg", "light_error_deg", "intensity_error"):
        assert errors[name] == pytest.approx(0, abs=1e-4), name
    assert errors["map_normal_coverage"] == 1
    assert not [name for name in errors if "held_out" in name or "fitted" in name or "psnr" in name]
    assert all(type(value) is float for value in errors.values())


def test_what_is_held_out_gets_its_own_figures() -> None:
    errors = measures.evaluate(*reconstruction({"hold_out_views": [2], "hold_out_lights": [3]}))
    for name in ("mesh_held_out_normal_error_deg", "mesh_fitted_normal_error_deg", "map_held_out_normal_error_deg"):
        assert name in errors
    made, _, _ = reconstruction({"hold_out_views": [2], "hold_out_lights": [3]})
    assert measures.held_out_views(made) == ("view_02",)
    assert set(measures.held_out_photographs(made)) == {("view_01", 3), ("view_02", 1), ("view_02", 2), ("view_02", 3)}
    assert errors["held_out_views_psnr_db"] == pytest.approx(40, abs=0.2)
    assert errors["held_out_lights_psnr_db"] == pytest.approx(40, abs=0.2)


def test_views_of_other_names_are_not_held_out_by_number() -> None:
    made, _, _ = reconstruction({"hold_out_views": [2, 10]})
    assert measures.held_out_views(replace(made, views=("view_010", "front"))) == ("view_010",)


def test_a_view_that_the_result_never_saw_counts_as_held_out() -> None:
    made, capture, truth = reconstruction({})
    first = slice(0, 1)
    alone = Lights(made.lights.direction[first], made.lights.intensity[first], False)
    made = Reconstruction(made.surface, made.material, alone, made.views[first], made.light_names[first], made.normal_maps[first], {}, {})
    errors = measures.evaluate(made, capture, truth)
    assert "mesh_held_out_normal_error_deg" in errors
    assert "map_held_out_normal_error_deg" not in errors


def test_what_the_truth_lacks_is_left_out() -> None:
    made, capture, truth = reconstruction({"hold_out_views": [2]})
    errors = measures.evaluate(made, capture, Truth(truth.views, {}, {}, {}, None))
    assert set(errors) == {"held_out_views_psnr_db", "photograph_scale"}


@pytest.mark.parametrize("overconfident", [1.0, 4.0])
def test_stated_errors_are_held_against_measured_ones(overconfident: float) -> None:
    """Normals with errors of known spread, stated right, or four times too small."""
    ball, rng = sphere(25, 5), np.random.default_rng(0)
    normal = vertex_normals(ball)
    # A field that is the same at the corners of a face: noise of single vertices would be averaged by the interpolation.
    sigma = np.radians(2 + 6 * (ball.vertices[:, 2] > 0))
    phase = 0.05 * rng.normal(size=(3, 64))
    field = np.cos(ball.vertices @ phase + rng.uniform(0, 2 * np.pi, 64)) @ rng.normal(size=(64, 3)) / np.sqrt(32)
    tilted = normal + sigma[:, None] * field
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    stated = 1 / (1 + (sigma / overconfident / 0.2) ** 2)
    material = Material(tilted, np.ones((len(normal), 3)), np.zeros((len(normal), 0)), np.zeros(0), stated)
    capture = seen(ball, SIX_SIDES)
    truth = {v.name: measures.mesh_normals(RayCaster(ball), v) for v in capture.views}
    errors = measures.confidence_errors(ball, material, truth, capture)
    pairs = [(errors[f"confidence_stated_{k:02d}_deg"], errors[f"confidence_measured_{k:02d}_deg"]) for k in (1, 10)]
    assert pairs[0][0] == pytest.approx(np.sqrt(np.pi / 2) * 2 / overconfident, rel=0.01)
    assert pairs[1][0] == pytest.approx(np.sqrt(np.pi / 2) * 8 / overconfident, rel=0.01)
    assert (errors["confidence_factor"] < 2) == (overconfident == 1)
    assert measures.confidence_errors(ball, material, {}, capture) == {}
