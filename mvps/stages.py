"""Results of single stages, for comparison, each with Lambert's albedo under the lights of its time.

The visual hull; Stage I; and Stage I's ablations (Yang et al. 2022, "effectiveness of normal regularization"): radiance fields of density
(NeRF) or occupancy (UNISURF), with and without the normals' loss. All fields have the same masks, start at the hull, rays, samples and
steps, and see large photographs at half their size; rendering and losses differ (radiance.py).
"""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from mvps.coarse import begin, first_lights, rough_shape
from mvps.device import chosen_device
from mvps.joint.lambertian import lambertian
from mvps.joint.thinned import thinned
from mvps.measures import mesh_normals
from mvps.occupancy import Occupancy, OccupancySettings
from mvps.outcome import all_lights, versions
from mvps.passes import stage_one, stage_two
from mvps.photometric import normal_maps
from mvps.plan import Parts, first_pass
from mvps.progress import Progress
from mvps.pyramid import levels
from mvps.radiance import RadianceSettings, radiance_surface
from mvps.reconstruct import Settings, parted
from mvps.scene import Capture, Lights, Reconstruction, Surface
from mvps.visibility import ray_caster


def hull(capture: Capture, settings: Settings, given: Lights | None, progress: Progress) -> Reconstruction:
    """The visual hull, under the lights of the factorisation or given ones."""
    used, _ = parted(capture, settings.hold_out_views, settings.hold_out_lights)
    _, surface = rough_shape(used, progress)
    lights = first_lights(used, surface, given, settings.seed, progress)
    return on_surface(capture, surface, lights, settings, progress, "the visual hull")


def stage1(capture: Capture, settings: Settings, given: Lights | None, progress: Progress) -> Reconstruction:
    """What Stage I makes of the normals and lights that Stage II found on the hull."""
    used = levels(parted(capture, settings.hold_out_views, settings.hold_out_lights)[0])[-1]
    begun, plan = begin(used, used, settings, given, Parts(), progress), first_pass(given is None, False)
    rough = stage_two("first refinement", used, begun.surface, begun, plan, settings, progress)
    field = Occupancy(used, begun.grid, OccupancySettings(), settings.seed, chosen_device(settings.device))
    surface = stage_one(field, rough.maps, OccupancySettings(), progress)
    return on_surface(capture, surface, rough.lights, settings, progress, "Stage I alone")


def radiance(
    capture: Capture, settings: Settings, given: Lights | None, progress: Progress, density: bool, with_normals: bool
) -> Reconstruction:
    """The surface of a radiance field, a density or an occupancy, trained with or without the views' photometric stereo."""
    device, plan, maps = chosen_device(settings.device), RadianceSettings(), None
    used = levels(parted(capture, settings.hold_out_views, settings.hold_out_lights)[0])[-1]
    grid, rough = rough_shape(used, progress)
    lights = first_lights(used, rough, given, settings.seed, progress)
    if with_normals:
        with progress.stage("photometric stereo"):
            maps = normal_maps(*thinned(used, lights), device)
    with progress.stage("radiance field", total=plan.steps) as stage:
        surface = radiance_surface(
            used, grid, lights, maps, density, plan, settings.seed, device, lambda _, loss: stage.advance(1, loss=loss)
        )
    return on_surface(capture, surface, lights, settings, progress, "a radiance field alone")


def on_surface(capture: Capture, surface: Surface, lights: Lights, settings: Settings, progress: Progress, words: str) -> Reconstruction:
    """A result with Lambert's albedo and the surface's own normals. lights: of the photographs that are not held out; words: of what this
    is, for the status."""
    device = chosen_device(settings.device)
    used, held = parted(capture, settings.hold_out_views, settings.hold_out_lights)
    with progress.stage("albedo"):
        material = lambertian(*thinned(used, lights), surface, device)
        complete = all_lights(capture, used, held, lights, surface, material, device)
        caster = ray_caster(surface)
        pictures = tuple(mesh_normals(caster, view).astype(np.float32) for view in capture.views)
    return Reconstruction(
        surface,
        material,
        complete,
        tuple(view.name for view in capture.views),
        tuple(view.lights for view in capture.views),
        pictures,
        {"stages": progress.stages, "status": {"name": "not refined", "text": f"This is {words}."}},
        {**asdict(settings), "versions": versions()},
    )
