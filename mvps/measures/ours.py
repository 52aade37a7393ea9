"""How far a reconstruction is from the truth, by measures of our own: what was photographed counts, and nothing else.

First hits       p_i of the rays through the mask's pixel centres of all views, on the result and on the truth: every part of
                 the surface counts as often as it was photographed, and what no camera saw does not count.
Distance         d(p, S) = min over the triangles of S of |p - q|, exact; accuracy = mean d(p_result, truth), completeness =
                 mean d(p_truth, result), Chamfer = (accuracy + completeness) / 2, not squared. Figures called _mm are in
                 the capture's own unit, millimetres by convention; _px are divided by what a pixel covers at the object.
F-score          harmonic mean of the shares of both point sets that are nearer than a threshold (Knapitsch et al. 2017).
Signed offset    mean and median of +-d(p_result, truth), negative inside: the sign of (p - q) . normal(q). The median is what the whole
                 surface is shifted by; the mean also counts hollows that stay too shallow.
Normals          angle(a, b) = 2 atan2(|a - b|, |a + b|) (Kahan), exact for small angles too.
Confidence       pixels by rising stated error in groups of equal number; stated mean angle sqrt(pi / 2) sigma (Rayleigh's distribution,
                 sigma along either tangent) beside the measured one, and the largest factor between them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from mvps.camera import pixel_footprint, view_directions
from mvps.measures.images import photograph_errors
from mvps.measures.lights import by_photograph, held_out_photographs, held_out_views, light_errors, true_lights, unseen_views
from mvps.measures.points import f_score
from mvps.mesh import angles_deg, centres, face_normals, nearest, normalise, vertex_normals
from mvps.scene import Capture, CaptureError, Float, Material, Reconstruction, Surface, Truth, View, expected_error_deg
from mvps.visibility import Hits, RayCaster, camera_hits, interpolate, ray_caster

CONFIDENCE_GROUPS = 10

LEAST_ERROR_DEG = 0.01
"""Errors below it count as this much: single precision has no finer angles."""

F_SCORE_THRESHOLDS = (0.5, 1.0)
"""Units of the capture (mm): the two thresholds usual for objects the size of a hand."""


def first_hit_points(surface: Surface, capture: Capture) -> Float:
    """(n, 3) world points where the rays through the mask's pixels of all views first meet the surface."""
    caster = ray_caster(surface)
    points = []
    for view in capture.views:
        hits = camera_hits(caster, view.camera, view.pixels)
        points.append(interpolate(surface, hits, surface.vertices)[hits.face >= 0])
    return np.concatenate(points)


def seen_from_outside(surface: Surface, capture: Capture) -> Surface:
    """The surface, its faces turned around where cameras see mostly their backs: of a true mesh whose corners are ordered the other way
    inside would be outside, and its vertices hidden."""
    caster, fronts, seen = ray_caster(surface), 0, 0
    for view in capture.views:
        face = camera_hits(caster, view.camera, view.pixels).face
        face = face[face >= 0]
        towards = view_directions(view.camera, centres(surface)[face])
        fronts, seen = fronts + int(((face_normals(surface)[face] * towards).sum(1) > 0).sum()), seen + len(face)
    return surface if 2 * fronts >= seen else Surface(surface.vertices, surface.faces[:, ::-1])


def distance_to(points: Float, surface: Surface) -> tuple[Float, Float]:
    """Distance (n,) of points (n, 3) to the nearest point of the surface, and the same with a sign, negative inside."""
    distance, point, face, barycentric = nearest(surface, points)
    # The normal interpolated from the vertices tells inside from outside on edges and corners too, where a face's does not.
    normal = interpolate(surface, Hits(face, barycentric, distance), vertex_normals(surface))
    inside = ((points - point) * normal).sum(-1) < 0
    return distance, np.where(inside, -distance, distance)


def object_centre(surface: Surface) -> Float:
    """(3,) centre of the bounding box."""
    centre: Float = (surface.vertices.min(0) + surface.vertices.max(0)) / 2
    return centre


def surface_errors(surface: Surface, truth: Surface, capture: Capture) -> dict[str, float]:
    """Accuracy, completeness and Chamfer distance (units of the capture and pixels), F-scores and signed offset.

    Only the cameras and masks of the capture are used. ValueError where no ray meets one of the two surfaces.
    """
    result_points, truth_points = first_hit_points(surface, capture), first_hit_points(truth, capture)
    for name, points in (("result", result_points), ("truth", truth_points)):
        if not len(points):
            raise ValueError(f"{name} mesh: wanted a surface in front of the capture's cameras, given one that no mask's pixel sees")
    to_truth, signed = distance_to(result_points, truth)
    to_result, _ = distance_to(truth_points, surface)
    pixel = pixel_footprint([view.camera for view in capture.views], object_centre(truth))
    accuracy, completeness = float(to_truth.mean()), float(to_result.mean())
    distances = {"accuracy": accuracy, "completeness": completeness, "chamfer": (accuracy + completeness) / 2}
    errors = {f"{name}_mm": value for name, value in distances.items()}
    errors |= {f"{name}_px": value / pixel for name, value in distances.items()}
    offsets = {"offset_px": float(signed.mean()) / pixel, "offset_median_px": float(np.median(signed)) / pixel}
    errors |= offsets | {"pixel_mm": pixel}
    errors["mesh_coverage"] = len(result_points) / sum(int(view.mask.sum()) for view in capture.views)
    for threshold in F_SCORE_THRESHOLDS:
        errors[f"f_score_{threshold:g}_mm".replace(".", "_")] = f_score(to_truth, to_result, threshold)
    return errors


def mesh_normals(caster: RayCaster, view: View) -> Float:
    """(height, width, 3) vertex normals interpolated at the first hits of the mask's pixels, world frame, NaN elsewhere."""
    surface = caster.surface
    hits = camera_hits(caster, view.camera, view.pixels)
    normal = normalise(interpolate(surface, hits, vertex_normals(surface)))
    normal[hits.face < 0] = np.nan
    image = np.full((*view.mask.shape, 3), np.nan)
    image[view.mask] = normal
    return image


def normal_errors(
    estimated: Mapping[str, Float], truth: Mapping[str, Float], capture: Capture, held_out: Collection[str] = ()
) -> dict[str, float]:
    """Mean and median angle in degrees, and the share of the pixels that have an estimate at all.

    estimated, truth: view name -> (height, width, 3) unit, world frame, NaN outside the mask. Over all pixels of all views
    inside the capture's mask and both maps; where views are held out also over these alone (held_out_...) and over the others
    (fitted_...). Views without truth are left out; no truth at all gives no figures.
    """
    groups: dict[str, list[Any]] = {"": [], "fitted_": [], "held_out_": []}
    known: dict[str, list[Any]] = {name: [] for name in groups}
    for view in capture.views:
        if view.name not in truth:
            continue
        wanted = view.mask & np.isfinite(truth[view.name]).all(-1)
        given = np.asarray(estimated.get(view.name, np.full((*view.mask.shape, 3), np.nan)), np.float64)
        if given.shape != truth[view.name].shape:
            raise CaptureError(
                f"normals of {view.name}: wanted {view.mask.shape[1]} x {view.mask.shape[0]} pixels as in the capture, given"
                f" {given.shape[1]} x {given.shape[0]}; give the result of this capture"
            )
        both = wanted & np.isfinite(given).all(-1)
        angle = angles_deg(given[both], truth[view.name][both])
        for group in ("", "held_out_" if view.name in held_out else "fitted_"):
            groups[group].append(angle)
            known[group].append(wanted.sum())
    if not held_out:
        del groups["fitted_"]
    errors: dict[str, float] = {}
    for group, parts in groups.items():
        angles = np.concatenate(parts) if parts else np.zeros(0)
        if len(angles):
            errors[f"{group}normal_error_deg"] = float(angles.mean())
            errors[f"{group}normal_error_median_deg"] = float(np.median(angles))
        if parts:
            errors[f"{group}normal_coverage"] = len(angles) / max(1, int(sum(known[group])))
    return errors


def mesh_normal_errors(surface: Surface, truth: Mapping[str, Float], capture: Capture, held_out: Collection[str] = ()) -> dict[str, float]:
    """`normal_errors` of the mesh's own normals at the first hits of the mask's pixels."""
    caster = ray_caster(surface)
    estimated = {view.name: mesh_normals(caster, view) for view in capture.views if view.name in truth}
    return normal_errors(estimated, truth, capture, held_out)


def confidence_errors(surface: Surface, material: Material, truth: Mapping[str, Float], capture: Capture) -> dict[str, float]:
    """Stated and measured mean error of the material's normals at first hits, deg, in groups, and the largest factor between them.

    truth: view name -> (height, width, 3) true normals, NaN where unknown. No common pixel gives no figures.
    """
    caster = ray_caster(surface)
    stated, measured = [], []
    for view in capture.views:
        if view.name not in truth:
            continue
        hits, true = camera_hits(caster, view.camera, view.pixels), truth[view.name][view.mask]
        certain = interpolate(surface, hits, material.confidence)
        known = np.isfinite(true).all(1) & (hits.face >= 0) & (certain > 0)
        normal = normalise(interpolate(surface, hits, material.normal)[known])
        stated.append(expected_error_deg(certain[known]))
        measured.append(angles_deg(normal, true[known]))
    said, found = (np.concatenate(parts) if parts else np.zeros(0) for parts in (stated, measured))
    if len(said) < CONFIDENCE_GROUPS:
        return {}
    groups = np.array_split(np.argsort(said, kind="stable"), CONFIDENCE_GROUPS)
    pairs = np.array([(said[group].mean(), found[group].mean()) for group in groups]).clip(LEAST_ERROR_DEG)
    errors = {"confidence_factor": float(np.exp(np.abs(np.log(pairs[:, 0] / pairs[:, 1])).max()))}
    for k, (a, b) in enumerate(pairs.tolist(), start=1):
        errors |= {f"confidence_stated_{k:02d}_deg": a, f"confidence_measured_{k:02d}_deg": b}
    return errors


def evaluate(reconstruction: Reconstruction, capture: Capture, truth: Truth) -> dict[str, float]:
    """All our measures under the names of the report, photographs and lights too; what cannot be said is left out.

    capture: cameras and masks of the views to look from, and the photographs that were held out (others are not looked at).
    Views that the result was not reconstructed from, held out or not in it at all, count as held out for the normals.
    mesh_... are the mesh's own normals, map_... the refined normal maps.
    """
    held_out, unseen = held_out_views(reconstruction), unseen_views(reconstruction, capture)
    errors = surface_errors(reconstruction.surface, truth.surface, capture) if truth.surface is not None else {}
    maps = dict(zip(reconstruction.views, reconstruction.normal_maps, strict=True))
    mapped = Capture(capture.name, tuple(view for view in capture.views if view.name in maps))
    errors |= {f"mesh_{k}": v for k, v in mesh_normal_errors(reconstruction.surface, truth.normals, capture, unseen).items()}
    errors |= {f"map_{k}": v for k, v in normal_errors(maps, truth.normals, mapped, unseen & set(maps)).items()}
    # What one view saw is open, at a distance of its own: no other camera sees what its normals are said of.
    own = {name: normal for name, normal in truth.normals.items() if name not in unseen}
    told = own if len(own) == 1 else truth.normals
    errors |= confidence_errors(reconstruction.surface, reconstruction.material, told, capture)
    lights = by_photograph(reconstruction.lights, reconstruction.views, reconstruction.light_names)
    errors |= light_errors(lights, true_lights(truth))
    photographs = held_out_photographs(reconstruction)
    return errors | photograph_errors(reconstruction.surface, reconstruction.material, photographs, capture, held_out)
