"""Borders of cast shadows, in a bowl whose rim shades a part of it under every light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from test_shadowed import CPU, SIZE, camera_above

from mvps.camera import pixel_footprint
from mvps.joint.blocks import Vertices
from mvps.joint.borders import RIM_PIXELS, Borders, shadow_borders, told_by
from mvps.joint.grey import grey_lights
from mvps.joint.observe import ViewSamples, observe
from mvps.joint.reflectance import Observed
from mvps.mesh import normalise, vertex_normals
from mvps.rendering import photograph, points_under
from mvps.scene import Capture, Law, Lights, Material, Surface, View
from mvps.visibility import ray_caster

RADIUS, ALBEDO, LIGHTS = 10.0, 0.4, 16


def bowl(subdivisions: int) -> Surface:
    """The inside of half a ball."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    faces = np.array(ball.faces)[:, ::-1]
    used, number = np.unique(faces[(ball.vertices[faces][..., 2] < 0.01 * RADIUS).all(1)], return_inverse=True)
    return Surface(np.array(ball.vertices)[used], number.reshape(-1, 3))


class Bowl:
    """Four views of a bowl under lights all around, 25 to 55 degrees from its axis; a coarser mesh of it; a pixel's footprint."""

    def __init__(self) -> None:
        fine = bowl(6)
        count = len(fine.vertices)
        material = Material(vertex_normals(fine), np.full((count, 3), ALBEDO), np.zeros((count, 0)), np.zeros(0), np.ones(count))
        turn, tilt = 2 * np.pi * np.arange(LIGHTS) / LIGHTS, np.radians(np.linspace(25, 55, LIGHTS)[np.arange(LIGHTS) * 5 % LIGHTS])
        direction = np.column_stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        intensity, views, caster = np.ones((LIGHTS, 3)), [], ray_caster(fine)
        for k in range(4):
            camera = camera_above(0.3, np.pi / 2 * k)
            mask = points_under(caster, material, camera, np.argwhere(np.ones((SIZE, SIZE), bool))).hit.reshape(SIZE, SIZE)
            image = photograph(caster, material, camera, np.argwhere(mask), direction, intensity, side=2)
            scale = float(image.max()) / 60000
            numbers = tuple(range(1, LIGHTS + 1))
            views.append(View(f"view_{k}", camera, mask, np.rint(image / scale).astype(np.uint16), scale, 65535, numbers))
        self.capture, self.surface = Capture("bowl", tuple(views)), bowl(4)
        self.lights = Lights((direction,) * 4, (intensity,) * 4, False)
        self.pixel = pixel_footprint([view.camera for view in views], self.surface.vertices.mean(0))

    def raised(self, pixels: float) -> Surface:
        """The mesh with its bottom, all below half of its depth, too shallow by so much."""
        depth = -self.surface.vertices[:, 2] / RADIUS
        by = pixels * self.pixel * np.clip(4 * depth - 1, 0, 1)
        return Surface(self.surface.vertices + by[:, None] * vertex_normals(self.surface), self.surface.faces)

    def observed(self, surface: Surface, lights: Lights | None = None) -> Observed:
        """The bowl's photographs on a mesh; lights: what they are taken to be, the true ones if not given."""
        lights = lights or self.lights
        samples: list[ViewSamples] = observe(self.capture, surface, lights, CPU)
        count = len(surface.vertices)
        normal = torch.tensor(vertex_normals(surface), dtype=torch.float32)
        vertices = Vertices(normal, torch.full((count, 1), ALBEDO), torch.full((count,), 0.01))
        return Observed(self.capture, surface, samples, vertices, grey_lights(lights, CPU), Law(()))


@pytest.fixture(scope="module")
def seen() -> Bowl:
    return Bowl()


def told_at_the_bottom(seen: Bowl, of: Observed) -> tuple[float, np.ndarray]:
    """Which part of what is below half of the bowl's depth is to move, and by how many pixels. (Its rim is that of coarse triangles.)"""
    told = told_by(shadow_borders(of, seen.pixel), of.surface, seen.pixel)
    bottom, known = seen.surface.vertices[:, 2] < -0.5 * RADIUS, np.isfinite(told.sigma)
    assert (told.sigma >= RIM_PIXELS * seen.pixel).all() and (told.offset[known] < 0).all()
    return float(known[bottom].mean()), told.offset[bottom & known] / seen.pixel


@pytest.mark.parametrize("pixels", [0.8, 1.2])
def test_borders_tell_that_a_hollow_is_too_shallow(seen: Bowl, pixels: float) -> None:
    part, offset = told_at_the_bottom(seen, seen.observed(seen.raised(pixels)))
    # What is within the bound of the rims and one standard deviation is left.
    assert part > 0.9 and -pixels < offset.mean() < -pixels + 0.4


@pytest.mark.parametrize("pixels", [0.0, -0.6])
def test_a_hollow_that_is_deep_enough_stays(seen: Bowl, pixels: float) -> None:
    part, offset = told_at_the_bottom(seen, seen.observed(seen.raised(pixels)))
    assert part * np.abs(offset).sum() / max(len(offset), 1) < 0.02


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_albedo_that_is_off_moves_borders_little(seen: Bowl, factor: float) -> None:
    of = seen.observed(seen.raised(0.8))
    wrong = of._replace(vertices=replace(of.vertices, reflectance=factor * of.vertices.reflectance))
    (part, offset), (_, right) = told_at_the_bottom(seen, wrong), told_at_the_bottom(seen, of)
    assert part > 0.9 and abs(offset.mean() - right.mean()) < 0.15


def test_no_shadow_says_nothing(seen: Bowl) -> None:
    flat = Surface(seen.surface.vertices * (1, 1, 0), seen.surface.faces)
    told = told_by(shadow_borders(seen.observed(flat), seen.pixel), flat, seen.pixel)
    assert np.isinf(told.sigma).all() and not told.offset.any()


def test_what_is_saturated_is_no_shadow(seen: Bowl) -> None:
    """Half of what the brightest places send is cut off: in the light they look as dark as where half of a pixel is in shadow."""
    of = seen.observed(seen.raised(0.0))
    levels = [int(np.quantile(view.samples, 0.97)) // 2 for view in seen.capture.views]
    views = tuple(
        replace(view, samples=np.minimum(view.samples, level), saturation=level)
        for view, level in zip(seen.capture.views, levels, strict=True)
    )
    samples = [replace(s, image=s.image.clamp_max(level * v.scale)) for s, v, level in zip(of.views, views, levels, strict=True)]
    assert told_at_the_bottom(seen, of._replace(capture=Capture("bowl", views), views=samples))[0] < 0.05


def test_borders_move_with_the_lights_as_the_derivative_says(seen: Bowl) -> None:
    """|J|^2 / 2 is the mean of (J . dl)^2 over turns dl of length one across the light: what f - S changes by, in four of them."""
    angle, direction = 0.03, seen.lights.direction[0]
    across = normalise(np.cross(direction, (0.3, 0.2, 0.9)))
    other = np.cross(direction, across)
    right = shadow_borders(seen.observed(seen.surface), seen.pixel)
    predicted = np.average(right.turn, weights=right.weight) * angle**2
    found = []
    for turn in (across, -across, other, -other):
        lights = Lights((normalise(direction + angle * turn),) * 4, seen.lights.intensity, False)
        turned = shadow_borders(seen.observed(seen.surface, lights), seen.pixel)
        found.append(np.average(turned.missing**2, weights=turned.weight))
    without = np.average(right.missing**2, weights=right.weight)
    assert without < 0.3 * predicted and 0.6 < (np.mean(found) - without) / predicted < 1.6


def test_far_rims_are_believed_less(seen: Bowl) -> None:
    """A light that is off moves the shadow of a rim the farther, the farther that is."""
    pixel = seen.pixel
    same = Borders(np.full(60, 5), np.ones(60), np.full(60, -0.6), np.full(60, 0.3 / pixel), np.zeros(60))
    near, far = (told_by(same._replace(turn=np.full(60, far**2)), seen.surface, pixel).sigma.min() for far in (1.0, 30.0))
    assert RIM_PIXELS * pixel < near < 0.8 * far < np.inf


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("albedo", [0.0, 1e-42, 1e30])
def test_what_reflects_nothing_or_any_amount_gives_numbers(seen: Bowl, albedo: float) -> None:
    of = seen.observed(seen.raised(0.8))
    extreme = of._replace(vertices=replace(of.vertices, reflectance=torch.full_like(of.vertices.reflectance, albedo)))
    told = told_by(shadow_borders(extreme, seen.pixel), of.surface, seen.pixel)
    assert np.isfinite(told.offset).all() and not np.isnan(told.sigma).any()
    assert albedo or np.isinf(told.sigma).all()


def test_views_that_see_little_or_nothing_say_nothing(seen: Bowl) -> None:
    of = seen.observed(seen.raised(0.8))
    for count in (0, 3):
        few = of.views[0].of_pairs(torch.arange(count))
        assert np.isinf(told_by(shadow_borders(of._replace(views=[few] * 4), seen.pixel), of.surface, seen.pixel).sigma).all()
