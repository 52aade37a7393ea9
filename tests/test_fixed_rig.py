"""Lamps that stand still in the world while the camera moves: one set of unknowns for all views, and for views that were kept back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from references import in_patches
from sphere_scene import make_sphere

from mvps.camera import rig_frame
from mvps.joint.blocks import DirectionalLights, Vertices
from mvps.joint.grey import grey_lights
from mvps.joint.held_out import carried_over, fit_lights
from mvps.joint.lights import light_step, with_mean_one
from mvps.joint.observe import observe
from mvps.joint.steps import free_reflectance, vertex_step
from mvps.mesh import angles_deg, normalise, vertex_normals
from mvps.rendering import photograph
from mvps.scene import Capture, Lights, Reconstruction
from mvps.visibility import RayCaster

CPU = torch.device("cpu")


def under_lamps() -> tuple[Reconstruction, Capture, Lights]:
    """The sphere under ten lamps in front of its first view, in all six."""
    scene = make_sphere(subdivisions=4)
    r = scene.reconstruction
    direction, intensity, count = r.lights.direction[0], r.lights.intensity[0], len(scene.capture.views)
    caster = RayCaster(r.surface)
    views = [
        replace(
            view,
            samples=np.rint(photograph(caster, r.material, view.camera, view.pixels, direction, intensity) / view.scale).astype(np.uint16),
        )
        for view in scene.capture.views
    ]
    return r, replace(scene.capture, views=tuple(views)), Lights((direction,) * count, (intensity,) * count, True, True)


def test_lamps_come_back_to_the_truth_with_one_direction_in_all_views() -> None:
    r, capture, lamps = under_lamps()
    views, truth, law = observe(capture, r.surface, lamps, CPU), grey_lights(lamps, CPU), r.material.law
    values = np.column_stack([r.material.albedo.mean(1), r.material.specular_weight])
    normal, reflectance = (torch.tensor(a, dtype=torch.float32) for a in (r.material.normal, values))
    vertices = Vertices(normal, reflectance, torch.full((len(values),), 0.01))
    aside = normalise(truth[0].direction.numpy() + 0.09 * np.random.default_rng(0).normal(size=(10, 3)))
    lights = [DirectionalLights(torch.tensor(aside, dtype=torch.float32), truth[0].intensity)] * len(truth)
    rotations = [torch.tensor(rig_frame(lamps, view.camera), dtype=torch.float32) for view in capture.views]
    anchor = free_reflectance(torch.tensor(vertex_normals(r.surface), dtype=torch.float32), 0.3, 3)
    views, vertices, anchor, patches = in_patches(r.surface, views, vertices, anchor)
    for _ in range(8):
        lights, law = light_step(views, vertices, lights, law, anchor, patches, rotations, True)
        lights, vertices = with_mean_one(lights, vertices)
        for _ in range(2):
            vertices = vertex_step(views, vertices, lights, law, anchor, patches=patches)
    before, after = (angles_deg(direction, truth[0].direction.numpy()).mean() for direction in (aside, lights[0].direction.numpy()))
    assert before > 3 and after < 0.5
    assert all(torch.equal(of_view.direction, lights[0].direction) for of_view in lights)


def test_views_that_were_kept_back_are_under_the_same_lamps() -> None:
    r, capture, lamps = under_lamps()
    direction, intensity = carried_over(lamps, capture.views[0].camera, capture.views[3].camera)
    np.testing.assert_allclose(direction, lamps.direction[0])
    np.testing.assert_array_equal(intensity, lamps.intensity[0])
    fitted = fit_lights(capture, r.surface, r.material, True, CPU, fixed=True)
    assert fitted.fixed and all(np.array_equal(d, fitted.direction[0]) for d in fitted.direction)
    assert angles_deg(fitted.direction[0], lamps.direction[0]).mean() < 0.5
