"""Distances between surfaces as the papers of the field measure them, so that figures can stand beside theirs.

Papers print different things under one name. Here every figure has its protocol in its name; to_truth are the distances of the
result's points to the truth, to_result those of the truth's points to the result, all Euclidean unless said.

supernormal      SuperNormal (Cao and Taketomi, CVPR 2024; its exp_runner.py and cd_and_fscore.py). Points: first hits of the rays
                 through the mask's pixels of all views, on each of the two meshes. Chamfer = mean of mean to_truth and mean
                 to_result, from point to nearest point; F-score at 0.5 (mm).
mvscps           MVSCPS (Cao and Taketomi, ICCV 2025; its system_mvscps.py). The same with the rays through all pixels, whatever the
                 mask says. Its program keeps the largest piece of the result first; here every piece counts.
psnerf           PS-NeRF (Yang et al., ECCV 2022; its chamfer_dist.py). Points: 10,000 samples on each mesh, uniform by area, hidden
                 parts included. Chamfer = mean of mean to_truth and mean to_result, from point to triangle, times 1000, in units in
                 which the object lies in [-1, 1]. The paper prints these thousandths as mm. Its program takes meshes already in the
                 units of its cameras and does not say how they were made: here v -> (v - centre) / scale with the centre of the
                 truth's bounding box and half its longest side. What it measures on pixels is in psnerf.py.
mvpsnet          MVPSNet (Zhao et al., ICCV 2023; its evaluate.py). Points: vertices at least 5 mm above the support, cut before the
                 result is moved onto the truth by rigid ICP. Chamfer = mean to_truth + mean to_result (the sum), neighbours and
                 distances in the L1 norm: about three times what others print. Up is +z. The program cuts at z = 5, so DiLiGenT-MV's
                 support is taken to be at 0; for other captures it is at the truth's lowest vertex.
rnbneus          RNb-NeuS (Brument et al., CVPR 2024), the table of DiLiGenT-MV. Points: all vertices, hidden ones too, from vertex
                 to nearest vertex. Chamfer = mean of mean to_truth and mean to_result. Of two parts of the truth as well: high
                 curvature (absolute mean curvature above 1.6) and low visibility (vertices seen by fewer than 5 of the 20 views, none
                 counting too). Its program has no evaluation. Assumed: curvature in 1 / mm, on the true mesh; with other numbers of views a
                 quarter of them; a part's figure is the mean of mean to_result over its vertices and mean to_truth over those of the
                 result whose nearest true vertex is in it. Normals: mean angle over the mask's pixels of all views, of the mesh.

Between vertices the distance grows with their spacing, and a coarse mesh of the right shape looks wrong. So mvpsnet and rnbneus
have a second figure, ..._split_..., after the edges of both meshes were halved until none is longer than the mean edge of the
finer one: the shapes are the same, and the spacing tells less. ICP's motion is that of the meshes as they are.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvps.measures.images import Perceptual
from mvps.measures.ours import distance_to, evaluate, first_hit_points, mesh_normal_errors, object_centre
from mvps.measures.points import f_score, icp, mean_curvature, nearest, split_to, surface_samples, two_way
from mvps.measures.psnerf import psnerf_errors
from mvps.mesh import mean_edge_length
from mvps.scene import Bool, Capture, Float, Reconstruction, Surface, Truth
from mvps.visibility import ray_caster, visible_vertices

HITS_THRESHOLD = 0.5
"""Units of the capture (mm)."""

PSNERF_SAMPLES = 10_000

ABOVE_SUPPORT = 5.0
"""Units of the capture (mm)."""

HIGH_CURVATURE = 1.6
"""1 / unit of the capture (mm)."""

LOW_VISIBILITY = 5 / 20
"""Share of the views."""


def supernormal_errors(surface: Surface, truth: Surface, capture: Capture) -> dict[str, float]:
    """Chamfer distance and F-score between first hits inside the masks. ValueError where no ray meets one of the surfaces."""
    return _between_hits("supernormal", surface, truth, capture)


def mvscps_errors(surface: Surface, truth: Surface, capture: Capture) -> dict[str, float]:
    """The same between first hits of all pixels' rays."""
    whole = [np.ones(view.mask.shape, bool) for view in capture.views]
    samples = [np.zeros((mask.size, 0, 3), np.uint16) for mask in whole]
    views = (replace(v, mask=mask, samples=none, lights=()) for v, mask, none in zip(capture.views, whole, samples, strict=True))
    return _between_hits("mvscps", surface, truth, Capture(capture.name, tuple(views)))


def _between_hits(protocol: str, surface: Surface, truth: Surface, capture: Capture) -> dict[str, float]:
    points, true_points = (first_hit_points(s, capture) for s in (surface, truth))
    if not len(points) or not len(true_points):
        raise ValueError("mesh: wanted surfaces in front of the capture's cameras, given one that no mask's pixel sees")
    to_truth, to_result = two_way(points, true_points)
    return {
        f"{protocol}_chamfer_mm": float(to_truth.mean() + to_result.mean()) / 2,
        f"{protocol}_f_score": f_score(to_truth, to_result, HITS_THRESHOLD),
    }


def unit_box(truth: Surface) -> tuple[Float, float]:
    """Centre (3,) and scale: (v - centre) / scale lies in [-1, 1] and touches it along the longest side of the bounding box."""
    return object_centre(truth), float(np.ptp(truth.vertices, axis=0).max()) / 2


def psnerf_chamfer(surface: Surface, truth: Surface, centre: Float, scale: float, seed: int = 0) -> float:
    """1000 times the Chamfer distance of samples to triangles in units of `scale` about `centre` (3,)."""
    first, second = (Surface((s.vertices - centre) / scale, s.faces) for s in (surface, truth))
    to_truth, _ = distance_to(surface_samples(first, PSNERF_SAMPLES, seed), second)
    to_result, _ = distance_to(surface_samples(second, PSNERF_SAMPLES, seed + 1), first)
    return 1000 * float(to_truth.mean() + to_result.mean()) / 2


def mvpsnet_errors(surface: Surface, truth: Surface, support: float) -> dict[str, float]:
    """Sum of the mean L1 distances between vertices above the support's height, after ICP; no figures where none is left."""
    above, true_above = (_above(s, support + ABOVE_SUPPORT) for s in (surface, truth))
    if not len(above) or not len(true_above):
        return {}
    rotation, shift = icp(above, true_above)
    errors = {}
    for name, meshes in _as_they_are_and_split(surface, truth).items():
        points, true_points = (_above(s, support + ABOVE_SUPPORT) for s in meshes)
        to_truth, to_result = two_way(points @ rotation.T + shift, true_points, norm=1)
        errors[f"mvpsnet_{name}chamfer_mm"] = float(to_truth.mean() + to_result.mean())
    return errors


def _above(surface: Surface, height: float) -> Float:
    return surface.vertices[surface.vertices[:, 2] >= height]


def rnbneus_errors(surface: Surface, truth: Surface, capture: Capture) -> dict[str, float]:
    """Chamfer distance between vertices: of all, of the strongly curved, of the hardly seen; parts that are empty are left out."""
    parts = {"": np.ones(len(truth.vertices), bool)}
    parts |= {"high_curvature_": mean_curvature(truth) > HIGH_CURVATURE, "low_visibility_": low_visibility(truth, capture)}
    errors = {}
    for name, (result, true) in _as_they_are_and_split(surface, truth).items():
        to_truth, index = nearest(result.vertices, true.vertices)
        to_result, _ = nearest(true.vertices, result.vertices)
        # A vertex in the middle of an edge belongs to the parts of the nearest vertex of the truth as it is.
        corner = nearest(true.vertices, truth.vertices)[1]
        for part, of_truth in parts.items():
            here = of_truth[corner]
            if here[index].any():
                errors[f"rnbneus_{name}{part}chamfer_mm"] = float(to_truth[here[index]].mean() + to_result[here].mean()) / 2
    return errors


def low_visibility(truth: Surface, capture: Capture) -> Bool:
    """(V,) True where fewer than a quarter of the capture's views see the vertex."""
    caster = ray_caster(truth)
    count = np.sum([visible_vertices(caster, view.camera) for view in capture.views], axis=0)
    few: Bool = count < LOW_VISIBILITY * len(capture.views)
    return few


def rnbneus_normal_error(surface: Surface, truth: Truth, capture: Capture) -> dict[str, float]:
    """Mean angle of the mesh's normals, deg, over the mask's pixels of all views; no figure without true normals."""
    errors = mesh_normal_errors(surface, truth.normals, capture)
    return {"rnbneus_normal_error_deg": errors["normal_error_deg"]} if "normal_error_deg" in errors else {}


def _as_they_are_and_split(surface: Surface, truth: Surface) -> dict[str, tuple[Surface, Surface]]:
    """Both meshes as they are, under "", and with their edges halved to the length of the finer one's, under "split_"."""
    longest = min(mean_edge_length(surface), mean_edge_length(truth))
    return {"": (surface, truth), "split_": (split_to(surface, longest), split_to(truth, longest))}


def figures_of(
    protocol: str,
    reconstruction: Reconstruction,
    capture: Capture,
    truth: Truth,
    support: float | None = None,
    perceptual: Perceptual | None = None,
) -> dict[str, float]:
    """All figures of one protocol ("ours" and those above), named after it; what cannot be said is left out.

    capture: all views, with the photographs that were held out. support: height above which mvpsnet looks, the truth's lowest vertex
    if None. perceptual: LPIPS for psnerf, left out if None. ValueError for an unknown protocol.
    """
    surface, true = reconstruction.surface, truth.surface
    if protocol == "ours":
        return evaluate(reconstruction, capture, truth)
    if protocol == "supernormal":
        return supernormal_errors(surface, true, capture) if true is not None else {}
    if protocol == "mvscps":
        return mvscps_errors(surface, true, capture) if true is not None else {}
    if protocol == "psnerf":
        chamfer = {"psnerf_chamfer": psnerf_chamfer(surface, true, *unit_box(true))} if true is not None else {}
        return chamfer | psnerf_errors(reconstruction, capture, truth, perceptual)
    if protocol == "mvpsnet":
        if true is None:
            return {}
        return mvpsnet_errors(surface, true, float(true.vertices[:, 2].min()) if support is None else support)
    if protocol == "rnbneus":
        return (rnbneus_errors(surface, true, capture) if true is not None else {}) | rnbneus_normal_error(surface, truth, capture)
    raise ValueError(f"protocol: wanted ours, supernormal, mvscps, psnerf, mvpsnet or rnbneus, given {protocol!r}")
