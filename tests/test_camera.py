"""mvps.camera: projection and its inverses, pixel centres, frames, interpolation."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from references import unproject

from mvps.camera import (
    DILIGENT_FROM_CAMERA,
    bilinear,
    footprint,
    inside_image,
    pixel_centres,
    pixel_footprint,
    project,
    rays,
    view_directions,
)
from mvps.scene import Camera


def camera_of(seed: int, angle: float = 1.0) -> Camera:
    """A camera with skew and unequal focal lengths, turned by `angle` about a random axis."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    K = np.array([[rng.uniform(100, 2000), rng.uniform(-5, 5), 160], [0, rng.uniform(100, 2000), 120], [0, 0, 1]])
    return Camera(K, rotation, rng.normal(size=3) * 10, 240, 320)


# Angles near 0 and near pi are where rotation formulas break.
cameras = st.builds(camera_of, st.integers(0, 2**31), st.sampled_from([0.0, 1e-9, 0.3, 1.5, np.pi - 1e-9, np.pi]))


def image_points(seed: int, n: int = 50) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-50, -50], [370, 290], (n, 2))


@given(cameras, st.integers(0, 1000), st.sampled_from([1e-3, 1.0, 1e5]))
def test_project_undoes_unproject(camera: Camera, seed: int, scale: float) -> None:
    image, depth = image_points(seed), scale * np.random.default_rng(seed).uniform(0.5, 2, 50)
    points = unproject(camera, image, depth)
    # A point stored with |t| + depth at 2^-53 loses f / depth times as much in the image.
    tolerance = 1e-15 * camera.K[:2, :2].max() * (1 + 100 / depth.min()) * 100
    found, found_depth = project(camera, points)
    np.testing.assert_allclose(found, image, atol=tolerance, rtol=0)
    np.testing.assert_allclose(found_depth, depth, rtol=1e-12, atol=1e-12)


@given(cameras, st.integers(0, 1000))
def test_rays_pass_through_their_pixels(camera: Camera, seed: int) -> None:
    image = image_points(seed)
    origins, directions = rays(camera, image)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1)
    np.testing.assert_allclose(origins, np.broadcast_to(camera.centre, origins.shape))
    found, depth = project(camera, origins + 30 * directions)
    np.testing.assert_allclose(found, image, atol=1e-8)
    assert (depth > 0).all()
    np.testing.assert_allclose(view_directions(camera, origins + 30 * directions), -directions, atol=1e-12)


@given(cameras)
def test_projection_by_its_definition(camera: Camera) -> None:
    # Slow twin: one point at a time, with the formula of the module's docstring.
    points = unproject(camera, image_points(1, 5), np.full(5, 3.0))
    image, depth = project(camera, points)
    for point, xy, z in zip(points, image, depth, strict=True):
        local = camera.rotation @ point + camera.translation
        homogeneous = camera.K @ local
        np.testing.assert_allclose(xy, homogeneous[:2] / homogeneous[2], rtol=1e-12)
        np.testing.assert_allclose(z, local[2], rtol=1e-12)


def test_known_answers() -> None:
    camera = Camera(np.array([[100.0, 0, 16], [0, 100, 12], [0, 0, 1]]), np.eye(3), np.array([0, 0, 10.0]), 24, 32)
    # x to the right and y down: a point at +x +y lies right of and below the principal point.
    image, depth = project(camera, np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]))
    np.testing.assert_allclose(image, [[16, 12], [26, 12], [16, 22]])
    np.testing.assert_allclose(depth, 10)
    np.testing.assert_allclose(camera.centre, [0, 0, -10])
    np.testing.assert_allclose(footprint(camera, np.zeros(3)), 0.1)
    assert pixel_footprint([camera, camera], np.zeros(3)) == footprint(camera, np.zeros(3))
    np.testing.assert_array_equal(pixel_centres(np.array([[0, 0], [2, 5]])), [[0.5, 0.5], [5.5, 2.5]])
    np.testing.assert_array_equal(
        inside_image(camera, np.array([[0, 0], [31.9, 23.9], [32, 5], [5, 24], [-0.1, 5]])), [True, True, False, False, False]
    )


def test_diligent_frame() -> None:
    # x right stays, y down becomes y up, z away becomes z towards the camera; a proper rotation, its own inverse.
    np.testing.assert_array_equal(DILIGENT_FROM_CAMERA @ [1, 2, 3], [1, -2, -3])
    np.testing.assert_array_equal(DILIGENT_FROM_CAMERA @ DILIGENT_FROM_CAMERA, np.eye(3))
    assert np.linalg.det(DILIGENT_FROM_CAMERA) == 1


def test_bilinear_reproduces_linear_functions() -> None:
    mask = np.ones((7, 9), bool)
    index = np.arange(63).reshape(7, 9)
    image = np.random.default_rng(0).uniform([0.5, 0.5], [8.5, 6.5], (200, 2))
    positions, weights = bilinear(index, image)
    centres = pixel_centres(np.argwhere(mask))
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-6)
    np.testing.assert_allclose((centres[positions] * weights[..., None]).sum(1), image, atol=1e-5)


def test_bilinear_at_the_silhouette_uses_only_the_foreground() -> None:
    index = np.full((4, 4), -1)
    index[1, 1], index[2, 2] = 0, 1
    positions, weights = bilinear(index, np.array([[1.5, 1.5], [2.0, 2.0], [0.6, 3.4], [1.9, 1.5], [-3, 40]]))
    total = [dict(zip(p, w, strict=True)) for p, w in zip(positions[:2].tolist(), weights[:2].tolist(), strict=True)]
    assert weights[0].sum() == 1 and (weights[0] * (positions[0] == 0)).sum() == 1
    assert sorted(w for w in weights[1] if w) == [0.5, 0.5] and total
    assert weights[2].sum() == 0 and weights[4].sum() == 0
    assert (weights[3] * (positions[3] == 0)).sum() == 1
