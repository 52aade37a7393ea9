"""Where single photographs of a textured ball agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from sphere_scene import RADIUS, make_sphere

from mvps.camera import pixel_footprint
from mvps.joint.agreement import Agreement
from mvps.joint.blocks import Vertices
from mvps.joint.grey import grey_lights
from mvps.joint.observe import observe
from mvps.joint.photoconsistency import photoconsistency, shown_in
from mvps.joint.refine import RefineSettings, RoundSettings, refine
from mvps.joint.reflectance import Observed
from mvps.photometric import normal_maps
from mvps.rendering import photograph
from mvps.scene import Capture, Law, Lights, Material, Surface
from mvps.visibility import RayCaster

CPU = torch.device("cpu")
TOO_SMALL = 0.8
OFFSETS = np.arange(-2.0, 2.01, 0.25)


def photographed(material: Material, lights: int) -> tuple[Capture, Lights, Surface]:
    """A ball of this material from twelve directions, under so many lights a view, others in each."""
    scene = make_sphere(subdivisions=5, seen_from=trimesh.creation.icosahedron().vertices)
    surface, rig = scene.reconstruction.surface, scene.reconstruction.lights
    caster, views, directions, intensities = RayCaster(surface), [], [], []
    for i, view in enumerate(scene.capture.views):
        some = [(i + k) % 10 for k in range(lights)]
        direction, intensity = rig.direction[i][some], rig.intensity[i][some]
        radiance = photograph(caster, material, view.camera, view.pixels, direction, intensity)
        samples = np.rint((radiance / 2).clip(0, 1) * 65535).astype(np.uint16)
        views.append(replace(view, samples=samples, lights=tuple(k + 1 for k in some)))
        directions.append(direction)
        intensities.append(intensity)
    return Capture("ball", tuple(views)), Lights(tuple(directions), tuple(intensities), False), surface


def painted(texture: float) -> Material:
    """Of a ball: one lobe, and an albedo that waves by this part along all axes."""
    ball = make_sphere(subdivisions=5).reconstruction.surface
    outward = ball.vertices / RADIUS
    waves = np.sin(ball.vertices[:, [1, 2, 0]] / 2).prod(1)[:, None] * np.array([1.0, 0.5, -0.5])
    return Material(outward, 0.5 * (1 + texture * waves), np.full((len(outward), 1), 0.1), np.array([20.0]), np.ones(len(outward)))


def agreed(capture: Capture, lights: Lights, surface: Surface, material: Material) -> Agreement:
    """Of a ball that is too small."""
    small = Surface(surface.vertices * (1 - TOO_SMALL / RADIUS), surface.faces)
    reflectance = np.column_stack([material.albedo.mean(1), material.specular_weight])
    normal, values = (torch.tensor(a, dtype=torch.float32) for a in (material.normal, reflectance))
    vertices = Vertices(normal, values, 0.1 * values[:, 0])
    of = Observed(capture, small, observe(capture, small, lights, CPU), vertices, grey_lights(lights, CPU), material.law)
    return photoconsistency(shown_in(of, lights), small, OFFSETS)


@pytest.mark.parametrize("texture", [0.0, 0.8])
@pytest.mark.parametrize("lights", [1, 2, 3, 7])
def test_photographs_agree_where_the_surface_is(texture: float, lights: int) -> None:
    material = painted(texture)
    found = agreed(*photographed(material, lights), material)
    told = np.isfinite(found.sigma)
    assert told.mean() > 0.8 and abs(np.median(found.offset[told]) - TOO_SMALL) < 0.05


def test_photographs_that_were_left_out_are_not_asked() -> None:
    material = painted(0.8)
    capture, lights, surface = photographed(material, 7)
    # Every third of seven, from the first on, is asked otherwise.
    less = capture.without({view.name: [view.lights[k] for k in (0, 2, 4)] for view in capture.views})
    found = agreed(less, lights, surface, material)
    told = np.isfinite(found.sigma)
    assert told.mean() > 0.8 and abs(np.median(found.offset[told]) - TOO_SMALL) < 0.05


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_photographs_without_a_usable_value_say_nothing() -> None:
    material = painted(0.8)
    capture, lights, surface = photographed(material, 1)
    dazzled = Capture("dazzled", tuple(replace(view, saturation=0) for view in capture.views))
    found = agreed(dazzled, lights, surface, material)
    assert np.isinf(found.sigma).all() and not found.offset.any()


def test_a_carving_round_goes_by_photographs_where_normals_agree_that_all_is_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a hollow that is too shallow: the pixels' normals agree where the surface already is."""
    capture, lights, surface = photographed(painted(0.8), 5)
    pixel = pixel_footprint([view.camera for view in capture.views], np.zeros(3))
    small = Surface(surface.vertices * (1 - pixel / RADIUS), surface.faces)

    def content(_: Capture, of: Surface, *__: object) -> Agreement:
        return Agreement(np.zeros(len(of.vertices)), np.full(len(of.vertices), 0.05 * pixel))

    monkeypatch.setattr("mvps.joint.refine.agreement", content)

    def off(carving: bool) -> float:
        plan = RefineSettings((RoundSettings(2.0, 2.4, 0.3, carving=carving),), free_lights=False)
        maps = normal_maps(capture, lights, CPU)
        refined = refine(capture, small, lights, maps, Law((20.0,)), plan, 0, CPU, lambda *_: None)
        return float(np.abs(np.linalg.norm(refined.surface.vertices, axis=1) - RADIUS).mean() / pixel)

    assert off(carving=True) < 0.1 and off(carving=False) > 0.5


def test_together_the_surer_decides_and_what_is_unknown_does_not() -> None:
    known = Agreement(np.array([1.0, 1.0, 0.0]), np.array([0.1, 0.01, np.inf]))
    other = Agreement(np.array([2.0, 2.0, 0.0]), np.array([0.1, 1.0, np.inf]))
    both = known.joined(other, 0.05)
    assert np.allclose(both.offset[:2], [1.5, (400 + 2) / 401]) and np.allclose(both.sigma[:2], [0.1 / 2**0.5, 401**-0.5])
    assert both.offset[2] == 0 and np.isinf(both.sigma[2])
