"""The measures of the field's papers, on shapes and images whose figures are known in closed form."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from known_shapes import LOOKING_DOWN, SIX_SIDES, lights, photographed, plane, reconstruction, ring, seen, sphere, tilted, view
from scipy.spatial.transform import Rotation

from mvps import evaluate, measures
from mvps.measures import points, psnerf
from mvps.mesh import edges, face_areas
from mvps.scene import CaptureError, Surface, Truth
from mvps.visibility import RayCaster

UP = np.array([0.0, 0, 1])


def bumpy(divisions: int = 4) -> Surface:
    """A body without symmetry, about 40 wide."""
    ball = sphere(1, divisions)
    x, y, z = ball.vertices.T
    radius = 20 + 3 * np.sin(3 * x) + 2 * np.cos(4 * y + 1) * z + 2 * x * y
    return Surface(ball.vertices * radius[:, None], ball.faces)


def cube(side: float, cells: int) -> Surface:
    """A cube of triangles about the origin, its vertices shared along the edges."""
    u = np.linspace(-0.5, 0.5, cells + 1)
    corners = []
    for axis in range(3):
        for sign in (-1, 1):
            a, b = (g.ravel() for g in np.meshgrid(u[:-1], u[:-1], indexing="ij"))
            for shift in ([(0, 0), (1, 0), (1, 1)], [(0, 0), (1, 1), (0, 1)]):
                face = np.empty((len(a), 3, 3))
                for k, (s, t) in enumerate(shift if sign > 0 else shift[::-1]):
                    face[:, k, axis] = sign / 2
                    face[:, k, (axis + 1) % 3], face[:, k, (axis + 2) % 3] = a + s / cells, b + t / cells
                corners.append(face)
    all_corners = np.concatenate(corners).reshape(-1, 3)
    vertices, index = np.unique(np.round(all_corners * cells * 2).astype(int), axis=0, return_inverse=True)
    return Surface(side * vertices / cells / 2, index.reshape(-1, 3))


# point sets


def test_nearest_neighbours_in_both_norms() -> None:
    a, b = np.array([[0.0, 0, 0]]), np.array([[1.0, 1, 1], [2.5, 0, 0]])
    assert points.nearest(a, b)[0] == pytest.approx([np.sqrt(3)]) and points.nearest(a, b)[1].tolist() == [0]
    assert points.nearest(a, b, norm=1)[0] == pytest.approx([2.5]) and points.nearest(a, b, norm=1)[1].tolist() == [1]


def test_icp_undoes_a_rigid_motion() -> None:
    body = bumpy().vertices
    moved = body @ Rotation.from_rotvec([0.03, -0.05, 0.04]).as_matrix() + np.array([0.6, -0.4, 0.5])
    assert points.two_way(moved, body)[0].mean() > 0.5
    rotation, shift = points.icp(moved, body)
    assert np.abs(moved @ rotation.T + shift - body).max() < 1e-6 and np.linalg.det(rotation) == pytest.approx(1)


def test_samples_are_uniform_by_area_and_the_same_each_time() -> None:
    two = Surface(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [8, 0, 0], [5, 1, 0.0]]), np.array([[0, 1, 2], [3, 4, 5]]))
    samples = points.surface_samples(two, 10_000, seed=3)
    assert np.array_equal(samples, points.surface_samples(two, 10_000, seed=3))
    assert (samples[:, 0] > 3).mean() == pytest.approx(0.75, abs=0.02)
    assert (samples[:, 2] == 0).all() and (samples[:, 1] >= 0).all()


def test_mean_curvature_of_balls_and_of_a_cube() -> None:
    for radius in (0.5, 25.0):
        assert points.mean_curvature(sphere(radius)) == pytest.approx(1 / radius, rel=1e-3)
    box = cube(10, 8)
    assert face_areas(box).sum() == pytest.approx(600)
    on_faces = (np.abs(np.abs(box.vertices) - 5) < 1e-9).sum(1)
    curvature = points.mean_curvature(box)
    assert np.abs(curvature[on_faces == 1]).max() < 1e-9
    # Across an edge the surface turns by 90 degrees within the cells beside it: 2 sin 45 deg / 2 over the width of a cell.
    assert np.median(curvature[on_faces == 2]) == pytest.approx(np.sqrt(0.5) / (10 / 8), rel=0.01)


def test_split_surfaces_are_the_same_surfaces() -> None:
    body = bumpy(2)
    split = points.split_to(body, 2.0)
    pairs = edges(split)
    assert np.linalg.norm(split.vertices[pairs[:, 0]] - split.vertices[pairs[:, 1]], axis=1).max() <= 2
    assert face_areas(split).sum() == pytest.approx(face_areas(body).sum())
    assert np.array_equal(split.vertices[: len(body.vertices)], body.vertices)
    assert points.split_to(body, 100) is body


# SuperNormal


@pytest.mark.parametrize(("height", "f_score"), [(0.3, 1.0), (0.7, 0.0)])
def test_supernormal_of_a_lowered_plane(height: float, f_score: float) -> None:
    """A ray that meets the plane p from the axis meets the lowered one p h / 500 further out, and its pixel's point stays the nearest."""
    truth, result = plane(-20, 20, 0), plane(-40, 40, -height)
    capture = seen(truth, [LOOKING_DOWN])
    axis = np.linalg.norm(measures.first_hit_points(truth, capture)[:, :2], axis=1)
    errors = measures.supernormal_errors(result, truth, capture)
    assert errors["supernormal_chamfer_mm"] == pytest.approx(height * np.sqrt(1 + (axis / 500) ** 2).mean(), rel=1e-6)
    assert errors["supernormal_f_score"] == f_score
    with pytest.raises(ValueError, match="wanted surfaces in front"):
        measures.supernormal_errors(plane(5000, 5020, 0), truth, capture)


def test_mvscps_counts_what_lies_beside_the_mask() -> None:
    truth, wide = plane(-20, 20, 0), plane(-30, 30, 0)
    capture = seen(truth, [LOOKING_DOWN])
    assert measures.supernormal_errors(wide, truth, capture)["supernormal_chamfer_mm"] == pytest.approx(0, abs=1e-5)
    everywhere = seen(wide, [LOOKING_DOWN])
    x = np.abs(measures.first_hit_points(wide, everywhere)[:, 0])
    last = x[x <= 20].max()
    expected = np.maximum(x - last, 0).mean() / 2
    errors = measures.mvscps_errors(wide, truth, capture)
    assert errors["mvscps_chamfer_mm"] == pytest.approx(expected, rel=1e-5)
    precision = (x - last < 0.5).mean()
    assert errors["mvscps_f_score"] == pytest.approx(2 * precision / (1 + precision))


# PS-NeRF, surfaces


@pytest.mark.parametrize("unit", [1e-3, 1.0, 40.0])
def test_psnerf_of_concentric_spheres_in_units_of_the_truth(unit: float) -> None:
    move = np.array([7.0, -3, 11]) * unit
    truth, result = (Surface(s.vertices + move, s.faces) for s in (sphere(25 * unit), sphere(25.5 * unit)))
    centre, scale = measures.unit_box(truth)
    assert centre == pytest.approx(move) and scale == pytest.approx(25 * unit)
    chamfer = measures.psnerf_chamfer(result, truth, centre, scale)
    assert chamfer == pytest.approx(1000 * 0.5 / 25, rel=3e-3)
    assert chamfer == measures.psnerf_chamfer(result, truth, centre, scale)


def test_psnerf_counts_what_no_camera_sees() -> None:
    truth = sphere(25)
    inner = sphere(5)
    both = Surface(np.concatenate([truth.vertices, inner.vertices]), np.concatenate([truth.faces, inner.faces + len(truth.vertices)]))
    share = 5**2 / (25**2 + 5**2)
    chamfer = measures.psnerf_chamfer(both, truth, *measures.unit_box(truth))
    # The samples of the inner ball are 20 away, the others and those of the truth on both surfaces.
    assert chamfer == pytest.approx(1000 * 20 / 25 * share / 2, rel=0.05)


# MVPSNet


def test_mvpsnet_is_the_sum_of_both_mean_l1_distances() -> None:
    """Of two balls with vertices in the same directions; that the cut is below both and nothing is to be aligned makes it exact."""
    truth, result = sphere(25, 3), sphere(25.3, 3)
    direction = truth.vertices / 25
    expected = 2 * 0.3 * np.abs(direction).sum(1).mean()
    assert measures.mvpsnet_errors(result, truth, support=-40)["mvpsnet_chamfer_mm"] == pytest.approx(expected, rel=1e-6)


def test_mvpsnet_aligns_and_looks_above_the_support_only() -> None:
    truth = bumpy()
    support = float(truth.vertices[:, 2].min())
    low = truth.vertices[:, 2] < support + 5
    broken = truth.vertices - np.where(low, 9, 0)[:, None] * UP
    assert measures.mvpsnet_errors(Surface(broken, truth.faces), truth, support)["mvpsnet_chamfer_mm"] == pytest.approx(0, abs=1e-6)
    raised = np.where(truth.vertices[:, 2:] > support + 12, 1.01, 1) * truth.vertices
    assert measures.mvpsnet_errors(Surface(raised, truth.faces), truth, support)["mvpsnet_chamfer_mm"] > 0.05
    # A small motion that takes no vertex across the cut is undone.
    gap = Surface(truth.vertices - np.where(low, 3, 0)[:, None] * UP, truth.faces)
    moved = Surface(gap.vertices + np.array([0.3, -0.2, 0]), truth.faces)
    assert measures.mvpsnet_errors(moved, gap, support)["mvpsnet_chamfer_mm"] == pytest.approx(0, abs=1e-4)
    assert measures.mvpsnet_errors(truth, truth, support=1000) == {}


# RNb-NeuS


def test_rnbneus_of_concentric_spheres() -> None:
    truth, result = sphere(25, 3), sphere(25.3, 3)
    capture = seen(truth, [LOOKING_DOWN, *SIX_SIDES])
    errors = measures.rnbneus_errors(result, truth, capture)
    assert errors["rnbneus_chamfer_mm"] == pytest.approx(0.3, rel=1e-6)
    assert errors["rnbneus_split_chamfer_mm"] == pytest.approx(0.3, rel=1e-2)
    assert not [name for name in errors if "curvature" in name], "1 / 25 is below 1.6"
    small = measures.rnbneus_errors(sphere(0.51, 3), sphere(0.5, 3), capture)
    assert small["rnbneus_high_curvature_chamfer_mm"] == pytest.approx(0.01, rel=1e-6), "1 / 0.5 is above it"


def test_rnbneus_knows_what_few_views_see() -> None:
    truth = sphere(25, 4)
    capture = seen(truth, [LOOKING_DOWN])
    # From 500 away the camera sees what is higher than r^2 / 500.
    height = truth.vertices[:, 2]
    few = measures.low_visibility(truth, capture)
    assert few[height < 0].all() and not few[height > 4].any()
    # The lower half is 0.8 too far out, the upper half is right.
    off = np.where(height < 0, 25.8 / 25, 1)[:, None]
    errors = measures.rnbneus_errors(Surface(truth.vertices * off, truth.faces), truth, capture)
    assert errors["rnbneus_low_visibility_chamfer_mm"] == pytest.approx(0.8 * (height < 0).sum() / few.sum(), rel=0.02)
    assert errors["rnbneus_chamfer_mm"] == pytest.approx(0.8 * (height < 0).mean(), rel=0.02)


def test_denser_vertices_leave_less_of_the_spacing() -> None:
    """The same body in vertices of its own: from vertex to vertex it is off by their spacing, and split it is less so."""
    truth = sphere(25, 5)
    coarse = sphere(25, 3)
    turned = Surface(coarse.vertices @ Rotation.from_rotvec([0.3, 0.5, 0.7]).as_matrix(), coarse.faces)
    errors = measures.rnbneus_errors(turned, truth, seen(truth, SIX_SIDES))
    assert errors["rnbneus_split_chamfer_mm"] < 0.5 * errors["rnbneus_chamfer_mm"]


def test_rnbneus_normals_are_those_of_the_mesh_in_all_views() -> None:
    made, capture, truth = reconstruction({"hold_out_views": [2]})
    turned = Truth(truth.views, {name: tilted(n, 5) for name, n in truth.normals.items()}, {}, {}, truth.surface)
    assert measures.rnbneus_normal_error(made.surface, turned, capture)["rnbneus_normal_error_deg"] == pytest.approx(5, rel=1e-4)
    assert measures.rnbneus_normal_error(made.surface, Truth(truth.views, {}, {}, {}, None), capture) == {}


# PS-NeRF, pixels


def test_psnerf_normals_are_a_mean_over_views_of_their_means() -> None:
    ball = sphere(20)
    full = seen(ball, [LOOKING_DOWN, *SIX_SIDES])
    first = full.views[0]
    small = view(first.name, first.camera, first.mask & (np.arange(64) < 25)[:, None])
    capture = replace(full, views=(small, *full.views[1:]))
    normals = {v.name: measures.mesh_normals(RayCaster(ball), v) for v in full.views}
    true = Truth(tuple(normals), normals, {}, {}, ball)
    maps = {name: tilted(n, 20 if name == "view_01" else 5) for name, n in normals.items()}
    errors = measures.psnerf_normal_errors(maps, ball, true, capture, ())
    assert errors["psnerf_normal_error_deg"] == pytest.approx((20 + 5 + 5) / 3, rel=1e-4), "not a mean over pixels"
    assert errors["psnerf_mesh_normal_error_deg"] == pytest.approx(0, abs=1e-4)
    held_out = measures.psnerf_normal_errors(maps, ball, true, capture, ["view_01"])
    assert held_out["psnerf_normal_error_deg"] == pytest.approx(20, rel=1e-4)
    # Outside the result's mask nothing counts: a smaller ball with maps that are wrong around it.
    inside = np.isfinite(measures.mesh_normals(RayCaster(sphere(15)), full.views[1])).all(-1, keepdims=True)
    around = {"view_02": np.where(inside, normals["view_02"], -normals["view_02"])}
    assert measures.psnerf_normal_errors(around, sphere(15), true, capture, ["view_02"])["psnerf_normal_error_deg"] == pytest.approx(
        0, abs=1e-4
    )
    assert measures.psnerf_normal_errors(maps, ball, Truth(("view_01",), {}, {}, {}, None), capture, ()) == {}


def test_psnerf_lights_have_a_scale_of_their_own_in_every_view() -> None:
    t = np.radians(6)
    turn = np.array([[np.cos(t), -np.sin(t), 0], [np.sin(t), np.cos(t), 0], [0, 0, 1]])
    true = lights(ring(6), np.ones((6, 3))) | {("view_02", k): v for (_, k), v in lights(ring(3), np.ones((3, 3))).items()}
    found = lights(ring(6) @ turn.T, np.ones((6, 3))) | {("view_02", k): v for (_, k), v in lights(ring(3), np.full((3, 3), 9.0)).items()}
    errors = measures.psnerf_light_errors(found, true, ["view_01", "view_02"])
    assert errors == {"psnerf_light_error_deg": pytest.approx(3), "psnerf_intensity_error": pytest.approx(0, abs=1e-12)}
    assert measures.psnerf_light_errors(found, true, ["view_02"])["psnerf_light_error_deg"] == pytest.approx(0, abs=1e-9)
    assert measures.psnerf_light_errors(found, {}, ["view_01"]) == {}


def test_psnr_and_ssim_of_known_images() -> None:
    grey = np.full((32, 40, 3), 0.5)
    assert measures.psnr_db(grey, grey + 0.1) == pytest.approx(20)
    assert measures.psnr_db(grey, grey) == 100
    assert measures.similarity(grey, grey) == pytest.approx(1)
    # Of two even images only the luminance term is left, with C1 = 0.01^2.
    a, b = 0.2, 0.6
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    assert measures.similarity(np.full((32, 40, 3), a), np.full((32, 40, 3), b)) == pytest.approx(expected)


def test_images_are_scaled_rounded_and_white_outside() -> None:
    mask = np.zeros((20, 30), bool)
    mask[5:15, 10:20] = True
    photograph = np.random.default_rng(0).uniform(0.1, 0.9, (100, 3))
    hit = np.arange(100) % 10 > 0
    image, true, both = psnerf.comparable(photograph / 2, photograph, mask, hit)
    assert np.array_equal(image, true) and image.shape == (20, 30, 3)
    assert both.sum() == 90 and (image[~both] == 1).all()
    assert np.allclose(image[both], np.rint(photograph[hit] * 255) / 255)
    # The mean of the channels' scales: 2, 2 and 1.
    image, _, _ = psnerf.comparable(photograph * (0.5, 0.5, 1), photograph, mask, hit)
    assert image[both][:, 2] == pytest.approx(np.rint(np.minimum(photograph[hit][:, 2] * 5 / 3, 1) * 255) / 255)


def test_photographs_of_diligent_mv_are_cut_about_the_object() -> None:
    mask = np.zeros((512, 612), bool)
    mask[100:300, 350:611] = True
    photograph = np.full((mask.sum(), 3), 0.5)
    _, true, both = psnerf.comparable(photograph, photograph, mask, np.ones(len(photograph), bool))
    assert true.shape == (400, 400, 3) and both.sum() == mask.sum()
    assert np.flatnonzero(both.any(1))[[0, -1]].tolist() == [100, 299] and np.flatnonzero(both.any(0))[[0, -1]].tolist() == [138, 398]


def test_photographs_are_divided_by_what_their_lights_are_over_the_fourth() -> None:
    v = view("view_01", seen(sphere(20), [LOOKING_DOWN]).views[0].camera, np.ones((64, 64), bool), np.zeros((64 * 64, 3, 3), np.uint16))
    v = replace(v, lights=(2, 4, 5))
    true = {"view_01": np.arange(1, 7)[:, None] * (1.0, 2.0, 3.0)}
    assert psnerf.relative_intensity(v, [0, 1, 2], true) == pytest.approx(np.repeat([[0.5], [1], [1.25]], 3, axis=1))
    assert (psnerf.relative_intensity(v, [0, 2], {}) == 1).all()


def image_errors(noise: float, gain: float, perceptual: measures.Perceptual | None = None) -> dict[str, float]:
    ball, material, known, capture = photographed(noise, gain)
    of_second = {photograph: light for photograph, light in known.items() if photograph[0] == "view_02"}
    return measures.psnerf_image_errors(ball, material, of_second, {}, capture, perceptual)


def test_psnerf_images_of_a_true_rendering_and_of_known_noise() -> None:
    exact = image_errors(0, gain=3)
    assert exact["psnerf_psnr_db"] > 60 and exact["psnerf_ssim"] == pytest.approx(1, abs=1e-4)
    noisy = image_errors(0.02, gain=3)
    assert noisy["psnerf_psnr_db"] == pytest.approx(-20 * np.log10(0.02), abs=0.3)
    # Three lights are averaged.
    assert noisy["psnerf_average_psnr_db"] == pytest.approx(-20 * np.log10(0.02 / np.sqrt(3)), abs=0.4)
    assert not [name for name in exact if "lpips" in name]
    assert measures.psnerf_image_errors(*photographed(0, 1)[:2], {}, {}, photographed(0, 1)[3]) == {}


def test_lpips_is_of_the_whole_images_and_in_hundredths() -> None:
    shapes = []

    def distance(image: np.ndarray, truth: np.ndarray) -> float:
        shapes.append((image.shape, truth.shape))
        return 0.25

    errors = image_errors(0, 1, distance)
    assert errors["psnerf_lpips_x100"] == errors["psnerf_average_lpips_x100"] == 25
    assert shapes == [((64, 64, 3), (64, 64, 3))] * 4


class Slices(torch.nn.Module):
    """The layers of AlexNet as the package lpips cuts them, reduced to one: the mean absolute difference times its weight."""

    def __init__(self, net: str, pnet_rand: bool, verbose: bool) -> None:
        super().__init__()
        assert net == "alex" and pnet_rand, "anything else looks for weights in the network"
        self.net = torch.nn.Module()
        self.net.slice1 = torch.nn.Sequential()
        self.net.slice1.add_module("0", torch.nn.Conv2d(3, 1, 1, bias=False))

    def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        weight: torch.Tensor = self.net.slice1[0].weight
        return (a - b).abs().mean() * weight.sum()


def test_lpips_takes_its_weights_from_the_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    package = ModuleType("lpips")
    package.LPIPS = Slices  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "lpips", package)
    torch.save({"features.0.weight": torch.full((1, 3, 1, 1), 2.0), "classifier.1.weight": torch.ones(1)}, tmp_path / "alex.pth")
    distance = measures.perceptual_distance(tmp_path / "alex.pth")
    # The package wants images in [-1, 1]: a difference of 0.25 is one of 0.5 there.
    assert distance(np.full((4, 5, 3), 0.5), np.full((4, 5, 3), 0.75)) == pytest.approx(0.5 * 6)
    torch.save({"other": torch.ones(1)}, tmp_path / "other.pth")
    (tmp_path / "text.pth").write_text("no weights")
    for name in ("other.pth", "text.pth"):
        with pytest.raises(CaptureError, match="wanted torchvision's weights of AlexNet"):
            measures.perceptual_distance(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        measures.perceptual_distance(tmp_path / "missing.pth")
    monkeypatch.setitem(sys.modules, "lpips", None)
    with pytest.raises(CaptureError, match="pip install mvps"):
        measures.perceptual_distance(tmp_path / "alex.pth")


# all together


def test_a_perfect_reconstruction_has_no_errors_by_any_protocol() -> None:
    made, capture, truth = reconstruction({"hold_out_views": [2]})
    for protocol in evaluate.PROTOCOLS:
        errors = measures.figures_of(protocol, made, capture, truth)
        assert errors and all(type(value) is float for value in errors.values())
        assert protocol == "ours" or all(name.startswith(f"{protocol}_") for name in errors)
        assert all(abs(value) < 1e-3 for name, value in errors.items() if "chamfer" in name or "error_deg" in name), errors
    with pytest.raises(ValueError, match="wanted ours, supernormal, mvscps"):
        measures.figures_of("nobody", made, capture, truth)


def test_without_a_true_surface_there_are_no_distances() -> None:
    made, capture, truth = reconstruction({})
    bare = Truth(truth.views, {}, {}, {}, None)
    assert all(measures.figures_of(protocol, made, capture, bare) == {} for protocol in evaluate.PROTOCOLS)


def test_the_table_has_a_line_for_every_figure() -> None:
    made, capture, truth = reconstruction({"hold_out_views": [2]})
    for protocol in set(evaluate.PROTOCOLS) - {"ours"}:
        errors = measures.figures_of(protocol, made, capture, truth)
        keys = {row.keys[0] for row in evaluate.ROWS[protocol]}
        assert set(errors) <= keys
        assert all("lpips" in key or "curvature" in key for key in keys - set(errors)), "the ball is not curved enough"
