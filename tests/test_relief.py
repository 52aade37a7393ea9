"""Depth from normals, rough normals of a silhouette, and the ambiguity of unknown lights, on shapes whose answer is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvps.camera import pixel_centres, rays
from mvps.load import read_capture, read_truth
from mvps.mesh import angles_deg, face_normals, normalise
from mvps.relief.ambiguity import factors, outer_band, resolved
from mvps.relief.integrate import integrate
from mvps.relief.silhouette import inflated_normals
from mvps.relief.surface import pixel_surface
from mvps.scene import Camera, Capture, View
from mvps.visibility import camera_hits, ray_caster

SIZE = 64
CAMERA = Camera(np.array([[600.0, 0, 32], [0, 600.0, 32], [0, 0, 1]]), np.eye(3), np.zeros(3), SIZE, SIZE)
DISTANCE = 100.0


def ball(radius: float = 4.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mask, depth and normals (camera frame) of a ball on the axis at DISTANCE."""
    pixels = np.indices((SIZE, SIZE)).reshape(2, -1).T
    direction = rays(CAMERA, pixel_centres(pixels))[1]
    along = direction[:, 2] * DISTANCE
    root = along**2 - DISTANCE**2 + radius**2
    hit = root > 0
    reach = along[hit] - np.sqrt(root[hit])
    points = direction[hit] * reach[:, None]
    return hit.reshape(SIZE, SIZE), points[:, 2], normalise(points - [0, 0, DISTANCE])


def depth_error_px(log_depth: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """In units of a pixel's footprint, up to one scale."""
    off = log_depth - np.log(depth)
    return np.abs(off - np.median(off)) * CAMERA.focal_length


def test_a_ball_integrates_to_a_ball() -> None:
    mask, depth, normal = ball()
    made = integrate(CAMERA, mask, normal, np.ones(len(normal)))
    error = depth_error_px(made.log_depth, depth)
    assert np.median(error) < 0.05
    # Between a pixel on the rim and its neighbour the normal turns by half a right angle.
    assert np.quantile(error, 0.95) < 0.5


def test_a_tilted_plane_is_exact_under_perspective() -> None:
    mask = np.ones((SIZE, SIZE), bool)
    normal = normalise(np.array([0.4, -0.3, -1.0]))
    direction = rays(CAMERA, pixel_centres(np.argwhere(mask)))[1]
    depth = direction[:, 2] / (direction @ normal)
    made = integrate(CAMERA, mask, np.tile(normal, (SIZE * SIZE, 1)), np.ones(SIZE * SIZE))
    # One-sided differences of log depth meet the tangent to second order of a pixel's angle.
    assert depth_error_px(made.log_depth, depth * np.sign(depth[0])).max() < 0.05


@pytest.mark.parametrize("confidence", [1.0, 0.05])
def test_a_wave_as_long_as_a_large_photograph_keeps_its_height(confidence: float) -> None:
    """A cylinder's strip of 6000 pixels, one wave across."""
    height, width, high = 3, 6000, 0.05
    f = 3.0 * width
    camera = Camera(np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]]), np.eye(3), np.zeros(3), height, width)
    mask = np.ones((height, width), bool)
    ray = np.concatenate([pixel_centres(np.argwhere(mask)), np.ones((height * width, 1))], 1) @ np.linalg.inv(camera.K).T
    phase = 2 * np.pi * pixel_centres(np.argwhere(mask))[:, 0] / width
    slope = -high * 2 * np.pi / width * np.sin(phase)
    normal = normalise(np.cross(slope[:, None] * ray + [1 / f, 0, 0], np.broadcast_to([0, 1 / f, 0], ray.shape)))
    normal *= -np.sign((normal * ray).sum(1, keepdims=True))
    wave = high * (np.cos(phase) - np.cos(phase).mean())
    found = integrate(camera, mask, normal, np.full(len(normal), confidence)).log_depth
    assert (found * wave).sum() / (wave**2).sum() == pytest.approx(1, abs=0.005)


FAR = Camera(np.array([[6e5, 0, 32], [0, 6e5, 32], [0, 0, 1]]), np.eye(3), np.zeros(3), SIZE, SIZE)
"""Nearly orthographic."""


def test_true_normals_of_a_real_object_give_its_depth_over_steps(captures: Path) -> None:
    """Bear's arms stand out from its body."""
    view = read_capture(captures / "bear", lights={"view_01": [1]}).views[0]
    truth = read_truth(captures / "bear")
    assert truth.surface is not None
    hits = camera_hits(ray_caster(truth.surface), view.camera, view.pixels)
    depth = hits.distance * (rays(view.camera, pixel_centres(view.pixels))[1] @ view.camera.rotation[2])
    normal = truth.normals[view.name][view.mask].astype(float) @ view.camera.rotation.T
    normal = np.where(np.isfinite(normal), normal, [0.0, 0.0, -1.0])
    made = integrate(view.camera, view.mask, normal, np.ones(len(normal)))
    off = (made.log_depth - np.log(depth))[hits.face >= 0]
    # Without the reweighting: 2.6 pixels.
    assert np.abs(off - np.median(off)).mean() * view.camera.focal_length < 0.3


def test_a_step_is_kept_and_the_mesh_is_cut_there() -> None:
    """The left half stands three pixels before the right one, and no pixel's equation holds another across."""
    pixels = np.indices((SIZE, SIZE)).reshape(2, -1).T
    flat = np.tile([0.0, 0.0, -1.0], (SIZE * SIZE, 1))
    made = integrate(FAR, np.ones((SIZE, SIZE), bool), flat, np.ones(len(flat)))
    left, weight = pixels[:, 1] < 32, made.weight.copy()
    weight[pixels[:, 1] == 31, 0] = weight[pixels[:, 1] == 32, 1] = 0
    surface = pixel_surface(FAR, pixels, flat, made._replace(log_depth=np.where(left, -3, 0) / FAR.focal_length, weight=weight), 6e5)
    assert len(surface.vertices) == (SIZE + 1) * (SIZE + 2) and len(surface.faces) == 2 * SIZE * SIZE
    height = surface.vertices[surface.faces][..., 2]
    assert np.ptp(height, axis=1).max() < 1e-6 and np.ptp(height) == pytest.approx(3, rel=1e-3)


def test_smooth_ground_is_not_cut() -> None:
    mask, pixels = np.ones((SIZE, SIZE), bool), np.indices((SIZE, SIZE)).reshape(2, -1).T
    flat = np.tile([0.0, 0.0, -1.0], (SIZE * SIZE, 1))
    made = integrate(FAR, mask, flat, np.ones(len(flat)))
    assert len(pixel_surface(FAR, pixels, flat, made, 6e5).vertices) == (SIZE + 1) ** 2


def test_the_mesh_lies_at_its_distance_and_faces_the_camera() -> None:
    mask, _, normal = ball()
    made = integrate(CAMERA, mask, normal, np.ones(len(normal)))
    surface = pixel_surface(CAMERA, np.argwhere(mask), normal, made, DISTANCE)
    assert np.median(surface.vertices[:, 2]) == pytest.approx(DISTANCE, rel=0.01)
    assert (face_normals(surface)[:, 2] < 0).all()


def test_an_inflated_disc_is_a_ball() -> None:
    mask, _, normal = ball()
    assert angles_deg(inflated_normals(mask), normal).mean() < 3


@pytest.mark.parametrize("shown", [(slice(None), slice(40)), (slice(24, None), slice(None)), (slice(20, None), slice(44))])
def test_a_ball_that_the_frame_cuts_off_is_inflated_to_one(shown: tuple[slice, slice]) -> None:
    """Its right, its top, or both."""
    mask, _, normal = ball()
    everywhere = np.full((*mask.shape, 3), np.nan)
    everywhere[mask] = normal
    part = mask[shown]
    assert any(edge.any() for edge in (part[0], part[-1], part[:, 0], part[:, -1]))
    off = angles_deg(inflated_normals(part), everywhere[shown][part])
    assert off.mean() < 3 and np.quantile(off, 0.95) < 12
    # Pixels near the outline are those of the whole ball's.
    view = View(
        "view_01",
        replace(CAMERA, height=part.shape[0], width=part.shape[1]),
        part,
        np.zeros((int(part.sum()), 1, 3), np.uint16),
        1.0,
        1,
        (1,),
    )
    near, outer = np.zeros(part.shape, bool), np.zeros(mask.shape, bool)
    near[tuple(view.pixels[outer_band(view)].T)] = True
    whole = View("view_01", CAMERA, mask, np.zeros((int(mask.sum()), 1, 3), np.uint16), 1.0, 1, (1,))
    outer[tuple(whole.pixels[outer_band(whole)].T)] = True
    assert (near & ~outer[shown]).sum() < 0.1 * near.sum()


def test_a_frame_all_around_but_for_a_hole_has_normals_too() -> None:
    mask = np.ones((20, 30), bool)
    mask[8:12, 10:14] = False
    assert np.isfinite(inflated_normals(mask)).all()


def photographed(mask: np.ndarray, normal: np.ndarray, albedo: np.ndarray, lights: int, seed: int) -> tuple[View, np.ndarray]:
    """A Lambertian view and its lights, direction times intensity."""
    rng = np.random.default_rng(seed)
    direction = normalise(np.concatenate([rng.uniform(-0.7, 0.7, (lights, 2)), -np.ones((lights, 1))], 1))
    scaled = direction * np.exp(rng.normal(0, 0.4, (lights, 1)))
    shading = albedo[:, None] * np.maximum(normal @ scaled.T, 0)
    samples = np.rint(shading / shading.max() * 60000).astype(np.uint16)
    return View("view_01", CAMERA, mask, np.repeat(samples[..., None], 3, 2), 1 / 65535, 65535, tuple(range(1, lights + 1))), scaled


def bumpy() -> tuple[np.ndarray, np.ndarray]:
    """An ellipsoid with bumps, as heights over the image plane: mask and normals."""
    y, x = (np.indices((SIZE, SIZE)) + 0.5 - SIZE / 2) / 26
    inside = 1 - x**2 - (1.3 * y) ** 2
    z = 0.7 * np.sqrt(np.maximum(inside, 0)) + 0.05 * np.sin(5 * x + 1) * np.cos(4 * y) * np.maximum(inside, 0)
    down, right = np.gradient(z, 1 / 26)
    mask = inside > 0.02
    return mask, normalise(np.stack([right, down, np.ones_like(z)], -1) * [-1, -1, -1])[mask]


def test_the_ambiguity_is_resolved_for_a_lambertian_body_of_two_albedos() -> None:
    mask, normal = bumpy()
    albedo = np.where(np.argwhere(mask)[:, 1] < 28, 0.8, 0.4)
    view, scaled = photographed(mask, normal, albedo, 16, 0)
    generator = np.random.default_rng(1)
    pseudo, rough = factors(view, generator), inflated_normals(mask)
    # As far off as a bas-relief of half the depth and a lean of 17 degrees.
    truth = np.linalg.lstsq(pseudo.right, scaled, rcond=None)[0]
    start = np.array([[1.0, 0, 0], [0, 1, 0], [0.3, 0, 0.5]]).T @ np.linalg.inv(truth)

    def error(A: np.ndarray) -> float:
        return float(angles_deg(normalise(pseudo.right @ np.linalg.inv(A)), normalise(scaled)).mean())

    assert error(start) > 10
    assert error(resolved(view, pseudo, rough, start, generator)) < 2.5


def test_photographs_that_were_left_out_are_not_bright() -> None:
    mask, normal = bumpy()
    view, _ = photographed(mask, normal, np.full(len(normal), 0.5), 12, 0)
    dark = replace(view, samples=view.samples // 15)
    left = Capture("dark", (dark,)).without({"view_01": (2, 5, 7)}).views[0]
    shown = factors(left, np.random.default_rng(1)), factors(dark, np.random.default_rng(1))
    assert np.median(shown[0].bright / shown[1].bright) == pytest.approx(1, abs=0.1)
