"""LZ20: multi-view photometric stereo for spatially varying isotropic materials, with calibrated lights.

Li, Zhou, Wu, Shi, Diao and Tan, "Multi-View Photometric Stereo: A Robust Solution and Benchmark Dataset for Spatially Varying Isotropic
Materials", IEEE Transactions on Image Processing 29, 2020; before it Zhou, Wu and Tan, CVPR 2013.

    azimuth of every pixel from isotropy             lz20_azimuth.py
    points on which several views agree              lz20_points.py
    depths carried along iso-depth contours, fusion  lz20_contours.py, lz20_surface.py
    mixture of basis BRDFs                           lz20_brdf.py

Written from the abstracts and from what is known of the method, without the full texts or the authors' code; all constants are this
module's. What departs from them, as far as that says:

Lights     Theirs stand on rings about the camera, so that mirrored lights exist; near lights are allowed for. Here lights are directional
           and stand anywhere: the mirrored light's observation is interpolated, a robust linear fit plus the other lights' residuals.
Points     Theirs are matched features (structure from motion) and points clicked by hand. Here they are found without either: vertices
           slide along the surface's normal to where the azimuths of the views agree on one tangent plane, and are kept where that place is
           sharp; and the outlines of the masks, which lie on the surface.
Contours   Theirs are traced from point to point, new points added and traced in other views until nothing is added, with depths. Here a
           surface exists from the start, the visual hull; contours carry offsets from it, in all views at once, and that is repeated
           (`ROUNDS`) with smaller faces. Every point carries a standard deviation that grows along the contour and ends it.
Surface    Theirs is Poisson's, from oriented points. Here the hull's vertices move, so that topology is the hull's; what no view sees stays
           where the normals of its surroundings put it. Positions and normals are then joined as theirs are, by Nehab et al. 2005.
Normals    On the surface from the azimuths of all views. Maps: a pixel's own azimuth, its elevation from the surface (theirs: the mesh's).
BRDF       Their tables have phi_d as well; lights of one rig hardly vary it. Weights are per channel, so that colours need no basis of
           their own. For the files the tables are projected onto a constant and three spherical Gaussians.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from mvps.baselines.lz20_azimuth import Azimuths, azimuths
from mvps.baselines.lz20_brdf import BASES, SHARPNESS, mixture
from mvps.baselines.lz20_points import LEAST_VIEWS, confident, seen_by, tangents_at, tensors
from mvps.baselines.lz20_surface import ROUNDS, moved
from mvps.camera import pixel_footprint
from mvps.hull import hull_grid, visual_hull
from mvps.mesh import normalise, vertex_normals
from mvps.progress import Progress
from mvps.scene import Capture, CaptureError, Float, Lights, Material, Reconstruction, View
from mvps.visibility import RayCaster, camera_hits, interpolate, ray_caster

LEAST_LIGHTS = 6
"""Half of them may be in shadow, and the linear part has three unknowns."""


def lz20(capture: Capture, lights: Lights, progress: Progress) -> Reconstruction:
    """The whole method: photographs and calibrated lights, in the capture's order, to surface, reflectance and normal maps.

    CaptureError where lights are missing, views have fewer than LEAST_LIGHTS of them, or there are fewer than LEAST_VIEWS views.
    """
    _check(capture, lights)
    with progress.stage("azimuths"):
        maps = azimuths(capture, lights)
        images = [tensors(view, of) for view, of in zip(capture.views, maps, strict=True)]
    with progress.stage("visual hull") as stage:
        surface = visual_hull(hull_grid(capture))
        stage.status(f"{len(surface.vertices)} vertices")
    with progress.stage("points, contours and surface", total=sum(plan.fusions for plan in ROUNDS)) as stage:
        pixel = pixel_footprint([view.camera for view in capture.views], (surface.vertices.min(0) + surface.vertices.max(0)) / 2)
        surface, shifts = moved(capture, surface, maps, images, pixel, lambda shift: stage.advance(1, vertex_change_px=shift))
    with progress.stage("basis BRDFs") as stage:
        seen = seen_by(capture, surface)
        normal, sigma = tangents_at(capture, images, surface.vertices, vertex_normals(surface), seen)
        fit = mixture(capture, lights, surface, normal, seen)
        stage.status(f"{BASES} bases leave {100 * fit.error:.1f} % of the radiance")
    with progress.stage("normal maps"):
        pictures = tuple(_picture(ray_caster(surface), normal, *of) for of in zip(capture.views, maps, strict=True))
    material = Material(normal, fit.albedo, fit.specular_weight, np.array(SHARPNESS), confident(sigma))
    text = f"the last fusion moved the surface by {shifts[-1]:.3f} px; {BASES} basis BRDFs leave {100 * fit.error:.1f} % of the radiance"
    return Reconstruction(
        surface,
        material,
        lights,
        tuple(view.name for view in capture.views),
        tuple(view.lights for view in capture.views),
        pictures,
        {"stages": progress.stages, "status": {"name": "finished", "text": text}, "vertex_change_px": shifts, "brdf_error": fit.error},
        {"method": "lz20", "capture": capture.name},
    )


def _check(capture: Capture, lights: Lights) -> None:
    def complain(wanted: str, given: str, advice: str) -> CaptureError:
        return CaptureError(f"{capture.name}: LZ20 wanted {wanted}, given {given}; {advice}")

    if len(capture.views) < LEAST_VIEWS:
        raise complain(f"at least {LEAST_VIEWS} views", str(len(capture.views)), "use more views")
    if len(lights.direction) != len(capture.views):
        raise complain(f"lights of {len(capture.views)} views", f"those of {len(lights.direction)}", "give the lights of every view")
    for view, direction in zip(capture.views, lights.direction, strict=True):
        if len(direction) != len(view.lights):
            given = f"{len(direction)} directions"
            raise complain(f"a light for each of the {len(view.lights)} photographs of {view.name}", given, "give the missing lights")
        if len(view.lights) < LEAST_LIGHTS:
            raise complain(f"at least {LEAST_LIGHTS} lights a view", f"{len(view.lights)} in {view.name}", "use more photographs")


def _picture(caster: RayCaster, normal: Float, view: View, azimuth: Azimuths) -> NDArray[np.float32]:
    """(height, width, 3) normals of a view: the vertices' (V, 3) interpolated, turned into the plane of sight and azimuth. NaN outside."""
    hits = camera_hits(caster, view.camera, view.pixels)
    of_shape = normalise(interpolate(caster.surface, hits, normal))
    told = np.isfinite(azimuth.sigma)[:, None] * np.einsum("ni,ni->n", of_shape, azimuth.along)[:, None]
    picture = np.full((*view.mask.shape, 3), np.nan, np.float32)
    picture[view.mask] = np.where((hits.face >= 0)[:, None], normalise(of_shape - told * azimuth.along), np.nan)
    if (hits.face >= 0).any():
        # A pixel that misses the mesh takes its nearest neighbour's.
        nearest = distance_transform_edt(np.isnan(picture[..., 0]), return_distances=False, return_indices=True)
        picture = picture[tuple(nearest)]
    picture[~view.mask] = np.nan
    return picture
