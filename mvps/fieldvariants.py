"""Ablations of Stage I (Yang et al. 2022, "effectiveness of normal regularization"): radiance fields with and without the normals' loss.

    nerf, nerf+n          density, radiance of position and view direction
    unisurf, unisurf+n    occupancy, radiance of the normal too

capture -> visual hull -> lights -> (+n: photometric stereo of every view) -> radiance field -> Lambert's law on its mesh

All four have the same masks, start at the hull, rays, samples and steps, those of Stage I; rendering and losses differ (radiance.py).
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

from mvps.reconstruct import first_lights, rough_shape, versions
from mvps.scene import Capture, Reconstruction

if TYPE_CHECKING:
    from mvps.progress import Progress


def field_variant(capture: Capture, density: bool, with_normals: bool, seed: int, progress: Progress) -> Reconstruction:
    """The surface of a radiance field, a density (NeRF) or an occupancy (UNISURF), trained with or without the views' photometric stereo.

    Lights are those of the factorisation, the material is Lambertian, the normal maps are the mesh's own normals.
    """
    import numpy as np

    from mvps.device import chosen_device
    from mvps.joint.lambertian import lambertian_material
    from mvps.joint.thinned import thinned
    from mvps.measures import mesh_normals
    from mvps.photometric import normal_maps
    from mvps.radiance import RadianceSettings, radiance_surface
    from mvps.visibility import ray_caster

    device, plan, maps = chosen_device("auto"), RadianceSettings(), None
    grid, hull = rough_shape(capture, progress)
    lights = first_lights(capture, hull, None, seed, progress)
    if with_normals:
        with progress.stage("photometric stereo"):
            maps = normal_maps(*thinned(capture, lights), device)
    with progress.stage("radiance field", total=plan.steps) as stage:
        surface = radiance_surface(capture, grid, lights, maps, density, plan, seed, device, lambda _, loss: stage.advance(1, loss=loss))
    with progress.stage("albedo"):
        part, of_part = thinned(capture, lights)
        material = lambertian_material(part, surface, of_part, device)
    caster = ray_caster(surface)
    method = ("nerf" if density else "unisurf") + ("+n" if with_normals else "")
    return Reconstruction(
        surface,
        material,
        lights,
        tuple(view.name for view in capture.views),
        tuple(view.lights for view in capture.views),
        tuple(mesh_normals(caster, view).astype(np.float32) for view in capture.views),
        {"stages": progress.stages, "status": {"name": "trained", "text": f"{method}: {plan.steps} steps of {plan.rays} rays."}},
        {"capture": capture.name, "method": method, "seed": seed, **asdict(plan), "versions": versions()},
    )
