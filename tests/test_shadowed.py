"""The strength of inter-reflection from cast shadows, in a bowl whose rim shades a part of it under every light."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from mvps.gleam import coarse_senders
from mvps.joint.blocks import DirectionalLights, Vertices
from mvps.joint.grey import grey_lights
from mvps.joint.lights import _most_returned, light_step, subset, told_by_shadows
from mvps.joint.observe import ViewSamples, observe, with_gathered
from mvps.joint.patches import Patches, drawn_patches
from mvps.joint.photometry import Task, photometric_round
from mvps.joint.shadowed import bounce_in_shadow
from mvps.joint.state import State
from mvps.joint.steps import Anchor, free_reflectance, vertex_step
from mvps.joint.trial import held_out_errors
from mvps.material import Model, presumed
from mvps.mesh import normalise, vertex_normals
from mvps.rendering import light_arriving, photograph, points_under
from mvps.scene import Camera, Capture, Law, Lights, Material, Surface, View
from mvps.visibility import ray_caster

ALBEDO, BOUNCE = 0.4, 1.8
RADIUS, DISTANCE, SIZE = 10.0, 60.0, 96
CPU = torch.device("cpu")
DIFFUSE = Law(())


def bowl() -> Surface:
    """The inside of a ball, open at the top."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    faces = np.array(ball.faces)[:, ::-1]
    low = faces[(ball.vertices[faces][..., 2] < 0.2 * RADIUS).all(1)]
    used, number = np.unique(low, return_inverse=True)
    return Surface(np.array(ball.vertices)[used], number.reshape(-1, 3))


def camera_above(tilt: float, turn: float) -> Camera:
    backward = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    right = np.array([-np.sin(turn), np.cos(turn), 0.0])
    rotation = np.stack([right, np.cross(-backward, right), -backward])
    K = np.array([[2.2 * SIZE, 0, SIZE / 2], [0, 2.2 * SIZE, SIZE / 2], [0, 0, 1]])
    return Camera(K, rotation, np.array([0, 0, DISTANCE]), SIZE, SIZE)


class Seen:
    """Four views of the bowl under six lights, and its samples with what its walls send under the true strength, in grey; albedo: of its
    channels, ALBEDO in the mean."""

    def __init__(self, albedo: tuple[float, float, float] = (ALBEDO, ALBEDO, ALBEDO)) -> None:
        surface = bowl()
        count = len(surface.vertices)
        material = Material(
            vertex_normals(surface), np.tile(albedo, (count, 1)), np.zeros((count, 0)), np.zeros(0), np.ones(count), bounce=BOUNCE
        )
        caster, sent = ray_caster(surface), coarse_senders(surface, material, grey=True)
        turn = np.arange(6) * np.pi / 3
        direction = normalise(np.stack([np.cos(turn), np.sin(turn), np.full(6, 0.9)], 1))
        intensity = np.linspace(0.8, 1.2, 6)[:, None] * np.ones(3)
        views = []
        every = np.argwhere(np.ones((SIZE, SIZE), bool))
        for k in range(4):
            camera = camera_above(0.25, 0.3 + k * np.pi / 2)
            mask = points_under(caster, material, camera, every).hit.reshape(SIZE, SIZE)
            arriving = light_arriving(coarse_senders(surface, material), direction, camera.centre)
            image = photograph(caster, material, camera, np.argwhere(mask), direction, intensity, arriving)
            scale = float(image.max()) / 60000
            views.append(View(f"view_{k}", camera, mask, np.rint(image / scale).astype(np.uint16), scale, 65535, tuple(range(1, 7))))
        self.surface, self.capture = surface, Capture("bowl", tuple(views))
        self.lights = Lights((direction,) * 4, (intensity,) * 4, False)
        self.grey: list[DirectionalLights] = grey_lights(self.lights, CPU)
        assert sent is not None
        samples = observe(self.capture, surface, self.lights, CPU)
        self.samples: list[ViewSamples] = with_gathered(samples, self.capture, surface, sent, self.lights)
        normal = torch.tensor(vertex_normals(surface), dtype=torch.float32)
        self.vertices = Vertices(normal, torch.full((count, 1), ALBEDO), torch.full((count,), 0.01))


@pytest.fixture(scope="module")
def seen() -> Seen:
    return Seen()


def test_shadows_tell_how_strongly_walls_light_each_other(seen: Seen) -> None:
    told = bounce_in_shadow(seen.samples, seen.vertices, seen.grey, replace(DIFFUSE, bounce=0.3), 0.0)
    assert told is not None and abs(told / BOUNCE - 1) < 0.05


def test_two_fifths_of_the_shadows_that_are_lit_do_not_change_that(seen: Seen) -> None:
    g = torch.Generator().manual_seed(0)
    wrong = [
        replace(s, image=torch.where(torch.rand(s.image.shape, generator=g) < 0.4, s.image.new_tensor(ALBEDO), s.image))
        for s in seen.samples
    ]
    told = bounce_in_shadow(wrong, seen.vertices, seen.grey, DIFFUSE, 0.0)
    assert told is not None and abs(told / BOUNCE - 1) < 0.25


def test_lit_shadows_do_not_make_surfaces_return_more_than_they_receive(seen: Seen) -> None:
    """Three in ten, where what arrives is known to a factor of two only: weights of what pixels hold then tell what cannot be."""
    g, wrong = torch.Generator().manual_seed(0), []
    for s in seen.samples:
        assert s.gathered is not None
        factor = torch.exp(0.8 * torch.randn(s.image.shape, generator=g))
        image = torch.where(torch.rand(s.image.shape, generator=g) < 0.3, s.image.new_tensor(ALBEDO), s.image)
        wrong.append(replace(s, gathered=(s.gathered.reshape(factor.shape) * factor).reshape(s.gathered.shape), image=image))
    most = 1 / ALBEDO
    runaway, told = (bounce_in_shadow(wrong, seen.vertices, seen.grey, DIFFUSE, 0.0, most=bound) for bound in (np.inf, most))
    assert runaway is not None and told is not None and runaway > most and abs(told / BOUNCE - 1) < 0.3
    assert told_by_shadows(wrong, seen.vertices, seen.grey, DIFFUSE, (True, True, False), 0.0)[0].bounce == pytest.approx(told)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_photographs_unit_is_of_no_account(seen: Seen, unit: float) -> None:
    other = [replace(s, image=unit * s.image, gathered=None if s.gathered is None else unit * s.gathered) for s in seen.samples]
    vertices = replace(seen.vertices, reflectance=unit * seen.vertices.reflectance)
    told = bounce_in_shadow(other, vertices, seen.grey, DIFFUSE, 0.0)
    assert told is not None and abs(unit * told / BOUNCE - 1) < 0.05


def test_without_shadows_nothing_is_told(seen: Seen) -> None:
    few = [replace(s, dark=None if s.dark is None else s.dark & (torch.arange(len(s.dark))[:, None] < 2)) for s in seen.samples]
    none = [replace(s, dark=None) for s in seen.samples]
    for views in (few, none):
        assert bounce_in_shadow(views, seen.vertices, seen.grey, DIFFUSE, 0.0) is None


@pytest.mark.parametrize("wrong", [0.8, 1.0])
def test_rounds_on_the_true_surface_come_to_the_true_strength(seen: Seen, wrong: float) -> None:
    """From a strength that is right, or too small: samples are lit by albedo that was solved under what arrived."""
    model = Model(bounce=True)
    state = State(seen.surface, seen.lights, (), replace(DIFFUSE, bounce=wrong * BOUNCE), model, 0.0, vertices=seen.vertices)
    task, generator = Task(False, True, False, False, True, True, CPU), np.random.default_rng(0)
    for _ in range(3):
        assert state.vertices is not None
        photometric_round(state, seen.capture, task, (seen.surface, state.vertices), generator)
    assert abs(state.law.bounce / BOUNCE - 1) < 0.03


def test_where_hardly_a_sample_counts_a_round_states_a_right_angle(seen: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    """Infinity is no number of metrics.json: a result was refused at its end."""

    def untold(*args: Any, **kwargs: Any) -> Vertices:
        step = vertex_step(*args, **kwargs)
        known = torch.arange(len(step.normal)) % 10 == 0
        return step if step.sigma is None else replace(step, sigma=torch.where(known, step.sigma, torch.inf))

    monkeypatch.setattr("mvps.joint.photometry.vertex_step", untold)
    state = State(seen.surface, seen.lights, (), replace(DIFFUSE, bounce=BOUNCE), Model(bounce=True), 0.0, vertices=seen.vertices)
    task, generator = Task(False, True, False, False, True, True, CPU), np.random.default_rng(0)
    assert photometric_round(state, seen.capture, task, (seen.surface, seen.vertices), generator)["stated_error_deg"] == 90


def with_noise(seen: Seen, samples: list[ViewSamples], sigma: float, lit_within: bool) -> list[ViewSamples]:
    """The samples in shadow with noise of sigma times the level in the light, never below zero in any of the four pixels of each;
    lit_within: added to what walls send each other, in place of it otherwise."""
    g = torch.Generator().manual_seed(2)
    level = float(torch.cat([s.image[s.data] for s in seen.samples]).square().mean().sqrt())
    noise = [torch.randn(4, *s.image.shape, generator=g).clamp_min(0).mean(0) * sigma * level for s in samples]
    return [replace(s, image=torch.where(s.data, s.image, lit_within * s.image + added)) for s, added in zip(samples, noise, strict=True)]


def test_where_all_shadows_are_within_the_noise_nothing_is_told(seen: Seen) -> None:
    noisy = with_noise(seen, seen.samples, 0.15, False)
    taken = bounce_in_shadow(noisy, seen.vertices, seen.grey, DIFFUSE, 0.0)
    assert taken is not None and ALBEDO * taken > 0.25
    assert bounce_in_shadow(noisy, seen.vertices, seen.grey, DIFFUSE, 0.15) is None


def test_noise_that_is_never_below_zero_is_no_light_of_other_surfaces(seen: Seen) -> None:
    # Nine tenths of the vertices receive a tenth of what the others do.
    g = torch.Generator().manual_seed(3)
    dim = [torch.where(torch.rand(len(s.vertex), generator=g) < 0.9, 0.1, 1.0) for s in seen.samples]
    samples = [
        replace(
            s,
            image=torch.where(s.data, s.image, d[:, None] * s.image),
            gathered=None if s.gathered is None else d[:, None, None] * s.gathered,
        )
        for s, d in zip(seen.samples, dim, strict=True)
    ]
    dark = with_noise(seen, samples, 0.04, False)
    taken, told = (bounce_in_shadow(dark, seen.vertices, seen.grey, DIFFUSE, noise) for noise in (0.0, 0.04))
    assert taken is not None and ALBEDO * taken > 0.4
    assert told is not None and ALBEDO * told < 0.1
    # With light between the walls both agree within a factor of two, and all samples tell it.
    lit = with_noise(seen, samples, 0.04, True)
    by_all, told = (bounce_in_shadow(lit, seen.vertices, seen.grey, DIFFUSE, noise) for noise in (0.0, 0.04))
    assert told is not None and told == by_all and abs(told / BOUNCE - 1) < 0.35


def drawn(seen: Seen) -> tuple[Patches, list[ViewSamples], Vertices, Anchor, list[torch.Tensor]]:
    """The problem on patches all over the bowl, and the views' rotations."""
    normal = vertex_normals(seen.surface)
    visible = torch.cat([s.vertex for s in seen.samples]).unique().numpy()
    patches = drawn_patches(visible, seen.surface, normal, len(normal), np.random.default_rng(0), CPU)
    few, part, tie = subset(seen.samples, seen.vertices, free_reflectance(seen.vertices.normal, 1.0, 1), patches.vertex)
    return patches, few, part, tie, [torch.tensor(view.camera.rotation, dtype=torch.float32) for view in seen.capture.views]


def test_errors_of_what_is_worked_out_to_arrive_do_not_make_the_strength_smaller(seen: Seen) -> None:
    g = torch.Generator().manual_seed(1)
    off = []
    for s in seen.samples:
        assert s.gathered is not None
        off.append(replace(s, gathered=s.gathered * torch.exp(0.4 * torch.randn(s.gathered.shape, generator=g))))
    told = bounce_in_shadow(off, seen.vertices, seen.grey, DIFFUSE, 0.0)
    assert told is not None and abs(told / BOUNCE - 1) < 0.05
    best = bounce_in_shadow(off, seen.vertices, seen.grey, DIFFUSE, 0.0, times=0)
    assert best is not None and best / BOUNCE == pytest.approx(np.exp(-(0.4**2)), abs=0.05)


def test_the_lights_take_the_strength_from_the_shadows_and_stay(seen: Seen) -> None:
    patches, few, part, tie, rotations = drawn(seen)
    law, free = told_by_shadows(seen.samples, seen.vertices, seen.grey, DIFFUSE, (True, True, False), 0.0)
    assert abs(law.bounce / BOUNCE - 1) < 0.05 and free == (True, False, False)
    lights, stepped = light_step(few, part, seen.grey, law, tie, patches, rotations, False, True, free)
    assert stepped.bounce == law.bounce
    turned = [torch.rad2deg(torch.arccos((a.direction * b.direction).sum(1).clamp(-1, 1))) for a, b in zip(lights, seen.grey, strict=True)]
    assert float(torch.cat(turned).max()) < 0.5
    for left in ((True, False, False), (True, True, True)):
        assert told_by_shadows(seen.samples, seen.vertices, seen.grey, DIFFUSE, left, 0.0) == (DIFFUSE, left)


def test_inter_reflection_is_kept_where_shadows_hold_light(seen: Seen) -> None:
    patches, few, part, tie, rotations = drawn(seen)
    errors = [
        held_out_errors(few, part, seen.grey, tie, patches, rotations, DIFFUSE, 0.0, Model(bounce=bounce)) for bounce in (False, True)
    ]
    (_, dark), (_, told) = errors
    assert np.nanmedian(dark) == 1 and np.nanmedian(told) < 0.1
    assert presumed("inter-reflection", *(np.stack(of_both) for of_both in errors)).kept


def test_the_strength_is_bounded_by_what_views_show(seen: Seen) -> None:
    """Of a surface of which more than half is seen by none, too."""
    vertices, n = seen.vertices, len(seen.vertices.normal)
    wide = replace(
        vertices, normal=vertices.normal.repeat(3, 1), reflectance=torch.cat([vertices.reflectance, 0 * vertices.reflectance.repeat(2, 1)])
    )
    assert len(wide.reflectance) == 3 * n
    assert _most_returned(DIFFUSE, wide) == pytest.approx(_most_returned(DIFFUSE, vertices))
    assert _most_returned(DIFFUSE, replace(vertices, reflectance=0 * vertices.reflectance)) == np.inf
