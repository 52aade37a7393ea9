"""Stage I: laws of the rendering, of the field, and what it makes of a sphere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from references import is_closed, signed_volume
from sphere_scene import RADIUS, SphereScene, make_sphere

from mvps.field import covering, gradient
from mvps.fieldrays import ring_pixels
from mvps.fieldtraining import crossing
from mvps.hull import default_cells, signed_distance
from mvps.mesh import normalise
from mvps.occupancy import CONTINUED, Occupancy, OccupancySettings, composite
from mvps.scene import Camera, Capture, NormalMap, Surface

QUICK = OccupancySettings(steps=120, rays=512, ring_rays=256)
CPU = torch.device("cpu")
PIXEL = 2 * RADIUS / (0.8 * 96)


def test_weights_are_a_part_of_one_and_an_opaque_wall_takes_all() -> None:
    distance = torch.randn(200, 8, generator=torch.Generator().manual_seed(0)) * 3
    weight, opacity = composite(distance, 0.7)
    assert (weight >= 0).all() and (weight.sum(1) <= 1 + 1e-5).all() and torch.allclose(weight.sum(1), opacity, atol=1e-4)
    wall = torch.tensor([[30.0, 10.0, -10.0, -30.0]])
    weight, opacity = composite(wall, 0.5)
    assert weight.argmax() == 2 and opacity > 0.999


def test_a_ray_crosses_a_wall_where_its_distance_is_zero() -> None:
    along = torch.tensor([[0.0, 1.0, 2.0, 3.0]])
    assert torch.allclose(crossing(along, 1.3 - along, torch.zeros(1)), torch.tensor([1.3]))
    assert crossing(along, along + 1, torch.tensor([9.0])) == 9


def test_interpolation_is_trilinear_and_its_gradients_are_right() -> None:
    def at(points: torch.Tensor) -> torch.Tensor:
        """Of degree one in each coordinate: trilinear interpolation is exact."""
        x, y, z = points.T
        return torch.stack([1 + x - 2 * y * z, x * y * z], 1)

    generator = torch.Generator().manual_seed(2)
    grid = covering(torch.tensor([1.0, 0.0, -2.0]).double(), torch.tensor([5.0, 3.0, 0.0]).double(), 1.0)
    axes = [low + torch.arange(n) for low, n in zip((1.0, 0.0, -2.0), grid.size, strict=True)]
    nodes = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    values = at(nodes.reshape(-1, 3)).T.reshape(1, 2, *grid.size).double().requires_grad_()
    points = (torch.rand(6, 3, dtype=torch.float64, generator=generator) * torch.tensor([4.0, 3, 2]) + grid.low).requires_grad_()
    assert grid.size == (5, 4, 3) and torch.allclose(grid.interpolate(values, points), at(points))
    assert torch.autograd.gradcheck(grid.interpolate, (values, points), atol=1e-6)
    outside = points.detach() + torch.tensor([0.0, 0.0, 9.0])
    border = torch.cat([points.detach()[:, :2], torch.zeros(6, 1)], 1)
    assert torch.allclose(grid.interpolate(values, outside), grid.interpolate(values, border))


def test_finite_differences_give_a_spheres_normals() -> None:
    class Ball:
        def signed_distance(self, points: torch.Tensor) -> torch.Tensor:
            return points.norm(dim=1) - 20

    points = 20 * torch.nn.functional.normalize(torch.randn(100, 3, generator=torch.Generator().manual_seed(3)), dim=1)
    found, mean = gradient(Ball(), points, 1.0)
    # One-sided over a step of 1 on a radius of 20: the error is of the order of their ratio.
    assert ((found * points / 20).sum(1) / found.norm(dim=1) > 0.999).all() and (found.norm(dim=1) - 1).abs().max() < 0.05
    assert mean.abs().max() < 0.2


def test_ring_lies_on_both_sides_of_the_silhouette() -> None:
    mask = np.zeros((30, 30), bool)
    mask[:, :15] = True
    columns = ring_pixels(mask, 3)[:, 1]
    assert columns.min() == 12 and columns.max() == 17


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(4)


def exact_maps(capture: Capture, unit: float = 1.0) -> tuple[NormalMap, ...]:
    """True normals and a patterned albedo of the sphere at every pixel."""
    from mvps.camera import pixel_centres, rays

    maps = []
    for view in capture.views:
        origin, direction = rays(view.camera, pixel_centres(view.pixels))
        origin = origin / unit
        along = -(origin * direction).sum(1)
        miss = np.maximum(RADIUS**2 - ((origin + along[:, None] * direction) ** 2).sum(1), 0)
        points = origin + (along - np.sqrt(miss))[:, None] * direction
        albedo = 0.5 + 0.2 * np.sin(points / 5)
        maps.append(NormalMap(normalise(points).astype(np.float32), albedo.astype(np.float32), np.ones(len(points), np.float32)))
    return tuple(maps)


def run(capture: Capture, maps: tuple[NormalMap, ...], seed: int = 0) -> Surface:
    return Occupancy(capture, signed_distance(capture, default_cells(capture)), QUICK, seed, CPU).trained(maps, QUICK, lambda _, __: None)


@pytest.fixture(scope="module")
def ball(scene: SphereScene) -> Surface:
    return run(scene.capture, exact_maps(scene.capture))


def test_six_views_of_a_sphere_make_a_sphere_without_bias(ball: Surface) -> None:
    # Six silhouettes alone leave a hull that bulges by several pixels.
    radius = np.linalg.norm(ball.vertices, axis=1)
    assert is_closed(ball) and signed_volume(ball) > 0
    assert abs(np.median(radius) - RADIUS) < 0.3 * PIXEL and np.abs(radius - RADIUS).mean() < 0.6 * PIXEL


def test_same_seed_gives_the_same_bytes(scene: SphereScene, ball: Surface) -> None:
    again = run(scene.capture, exact_maps(scene.capture))
    assert np.array_equal(again.vertices, ball.vertices) and np.array_equal(again.faces, ball.faces)


def test_a_fifth_of_wrong_normals_does_not_break_it(scene: SphereScene) -> None:
    rng = np.random.default_rng(4)
    spoiled = []
    for maps in exact_maps(scene.capture):
        normal = maps.normal.copy()
        wrong = rng.random(len(normal)) < 0.2
        normal[wrong] = normalise(rng.normal(size=(int(wrong.sum()), 3)))
        spoiled.append(replace(maps, normal=normal))
    radius = np.linalg.norm(run(scene.capture, tuple(spoiled)).vertices, axis=1)
    assert np.abs(radius - RADIUS).mean() < 0.8 * PIXEL


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_unit_of_length_does_not_matter(scene: SphereScene, ball: Surface, unit: float) -> None:
    views = []
    for view in scene.capture.views:
        camera = Camera(view.camera.K, view.camera.rotation, view.camera.translation * unit, view.camera.height, view.camera.width)
        views.append(replace(view, camera=camera))
    capture = Capture("scaled", tuple(views))
    radius = np.linalg.norm(run(capture, exact_maps(capture, unit)).vertices / unit, axis=1)
    # Rounding differs between units, and training follows it; the figures may not.
    assert abs(np.median(radius) - np.median(np.linalg.norm(ball.vertices, axis=1))) < 0.1 * PIXEL


def test_a_field_trained_on_wrong_normals_recovers_when_trained_again(scene: SphereScene, ball: Surface) -> None:
    """Normals that all lean by 20 degrees put the surface off; better ones bring it back without starting from the hull."""
    exact = exact_maps(scene.capture)
    leaning = tuple(replace(maps, normal=normalise(maps.normal + np.float32([0, 0, 0.36]))) for maps in exact)
    field = Occupancy(scene.capture, signed_distance(scene.capture, default_cells(scene.capture)), QUICK, 0, CPU)

    def error(surface: Surface) -> float:
        return float(np.abs(np.linalg.norm(surface.vertices, axis=1) - RADIUS).mean() / PIXEL)

    before = error(field.trained(leaning, QUICK, lambda _, __: None))
    after = error(field.trained(exact, replace(CONTINUED, rays=512, ring_rays=256), lambda _, __: None))
    assert after < 0.5 * before and after < 0.6
