"""Whether a reconstruction is to be trusted, from what can be seen without the truth.

Means and medians are over the surface that is seen, every vertex counting by its area: meshes are finer where a surface is creased, and
over vertices a few creases would decide.

misfit        median of what the image model leaves, as a share of a vertex's signal, without the share that is noise
outline_px    area between the mesh's silhouettes and the masks over the masks' outlines: by how far outlines are off, in the mean
views_deg     median of the standard deviation of different views' normals at the same vertex
expected_deg  mean of the normals' expected errors: sqrt(pi / 2) times the stated standard deviation along a tangent (stated.py)
depth_px      mean of e L: what one view alone sees has its depth from normals, and with an error of e (expected,
              radians) all over the distance of L pixels from the nearest vertex that a second view sees, it is e L off; 0 where two see
photographs   median of how many photographs show a vertex
hidden_px     mean of how deep hollows may be where the model explains nothing (hollows.py)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mvps.camera import project, surface_pixel, view_directions
from mvps.cores import neighbours, on_cores
from mvps.finding import Finding
from mvps.hollows import beyond_noise, hidden
from mvps.material import POOR_FIT
from mvps.mesh import lengths, normalise, vertex_areas, vertex_normals
from mvps.noise import samples_noise
from mvps.scene import Capture, Float, Int, Material, Surface, View, expected_error_deg
from mvps.silhouette import mask_distances, sampled
from mvps.visibility import RayCaster, camera_hits, ray_caster, visible_vertices

BAD_DEG = 10.0
"""Mean error of normals from which a result is of no use as a measurement."""

CONTRADICTION_DEG = BAD_DEG / np.sqrt(2)
"""Standard deviation between views above which they contradict each other: with as large an error that they share the sum is BAD_DEG."""

DEPTH_PIXELS = 1.0
"""Of depth_px and hidden_px: surfaces of made objects in three or four views were 0.8 to 1.5 of the first off, those with hollows that were
not dug 0.8 to 3 of the second, and off by a pixel in the mean they are of no use as a measurement."""

UNKNOWNS = 3
"""Of a vertex of one colour: two of its normal, its albedo. With no more photographs than that smoothness decides, residuals vanish, and no
figure that rests on them tells the error."""

LEAST_FACING = 0.2
"""Cosine of the angle between normal and view from which a view tells where the surface is: across it a pixel is five times as long."""

OUTLINE_PIXELS = 1.0
"""Mean error of outlines that masks of whole pixels cannot explain."""

BAND_PIXELS = 8.0
"""Farthest from a mask's outline that pixels are asked for the mesh."""


def median(values: Float, area: Float) -> float:
    """The value (n,) that half of the area (n,) is not above; 0 of none."""
    return float(np.quantile(values, 0.5, weights=area, method="inverted_cdf")) if len(values) and area.any() else 0.0


def expected_deg(material: Material, area: Float) -> float:
    """Mean expected error of normals where vertices of this area (V,) are seen, degrees, none over 90; 90 where none is seen."""
    seen = (material.confidence > 0) & (area > 0)
    return float(np.average(expected_error_deg(material.confidence[seen]), weights=area[seen])) if seen.any() else 90.0


def _silhouette(caster: RayCaster, view: View, distance: NDArray[np.float32]) -> tuple[float, float]:
    """Pixels between the mesh's silhouette and the mask, and the length of the mask's outline in pixels."""
    near = np.argwhere(np.abs(distance) < BAND_PIXELS)
    hit = camera_hits(caster, view.camera, near).face >= 0
    # The band of half a pixel to either side has the outline's length as its area.
    return float((hit != view.mask[tuple(near.T)]).sum()), float((np.abs(distance) < 0.5).sum())


def outline_px(capture: Capture, surface: Surface) -> float:
    """Mean distance of the mesh's outlines from the masks', pixels."""
    caster = ray_caster(surface)
    wrong, length = np.sum(on_cores(lambda v, d: _silhouette(caster, v, d), capture.views, mask_distances(capture)), axis=0)
    return float(wrong / max(length, 1.0))


def seen_by(capture: Capture, surface: Surface) -> list[Int]:
    """Per view the indices of the vertices that it sees."""
    caster = ray_caster(surface)
    return on_cores(lambda view: np.flatnonzero(visible_vertices(caster, view.camera)), capture.views)


def depth_px(capture: Capture, surface: Surface, material: Material, seen: Sequence[Int]) -> float:
    """`depth_px` above, where views see the vertices `seen`. Where none is seen twice, L is the object's radius;
    0 for a single view, which has no depth at all."""
    if len(capture.views) == 1:
        return 0.0
    normal, views = vertex_normals(surface), np.zeros(len(surface.vertices), np.int64)
    for view, index in zip(capture.views, seen, strict=True):
        facing = (normal[index] * view_directions(view.camera, surface.vertices[index])).sum(1)
        views[index[facing > LEAST_FACING]] += 1
    alone, several = surface.vertices[views == 1], surface.vertices[views > 1]
    if not len(alone):
        return 0.0
    pixel = surface_pixel(capture, surface)
    radius = lengths(surface.vertices - surface.vertices.mean(0)).mean()
    away = neighbours(cKDTree(several), alone)[0] if len(several) else np.full(len(alone), radius)
    error = np.radians(expected_error_deg(material.confidence[views == 1]))
    area = vertex_areas(surface)
    return float((error * away * area[views == 1]).sum() / pixel / max(area[views > 0].sum(), np.finfo(float).tiny))


def photographs(capture: Capture, surface: Surface, seen: Sequence[Int]) -> float:
    """`photographs` above, where views see the vertices `seen`."""
    count = np.zeros(len(surface.vertices), np.int64)
    for view, index in zip(capture.views, seen, strict=True):
        count[index] += int(view.shown.sum())
    return median(count[count > 0].astype(float), vertex_areas(surface)[count > 0])


def views_deg(capture: Capture, surface: Surface, pictures: Sequence[NDArray[np.float32]], seen: Sequence[Int]) -> float:
    """Median standard deviation of the normals of views where several see the surface, degrees; 0 where none do. pictures: the views'
    normals (height, width, 3), NaN outside the masks; seen: the vertices that each sees."""

    def of_view(view: View, picture: NDArray[np.float32], index: Int) -> tuple[Int, Float]:
        known = np.nan_to_num(picture)
        normal = sampled(known, project(view.camera, surface.vertices[index])[0]).astype(float)
        found = np.linalg.norm(normal, axis=1) > 0.5
        return index[found], normalise(normal[found])

    total, count = np.zeros((len(surface.vertices), 3)), np.zeros(len(surface.vertices))
    for index, normal in on_cores(of_view, capture.views, pictures, seen):
        total[index] += normal
        count[index] += 1
    several = count > 1
    # Of unit vectors: the mean square distance to their mean, over one view less than there are.
    n = count[several]
    variance = (1 - (total[several] ** 2).sum(1) / n**2) * n / (n - 1)
    return float(np.degrees(np.sqrt(max(median(variance, vertex_areas(surface)[several]), 0.0))))


def hidden_px(capture: Capture, surface: Surface, unexplained: Float, noise: float) -> float:
    """`hidden_px` above; 0 for a single view, which has no hull to bridge a hollow."""
    if len(capture.views) == 1:
        return 0.0
    pixel = surface_pixel(capture, surface)
    return hidden(surface, beyond_noise(unexplained, noise)) / pixel


def signs(
    capture: Capture,
    surface: Surface,
    material: Material,
    pictures: Sequence[NDArray[np.float32]],
    unexplained: Float,
) -> dict[str, float]:
    """The figures above. unexplained (V,): what the model leaves, as a share of every vertex's signal, NaN where no view sees it."""
    noise, seen, area = samples_noise(capture), seen_by(capture, surface), vertex_areas(surface)
    known = np.isfinite(unexplained)
    return {
        "misfit": median(beyond_noise(unexplained[known], noise), area[known]),
        "noise": noise,
        "outline_px": outline_px(capture, surface),
        "views_deg": views_deg(capture, surface, pictures, seen),
        "expected_deg": expected_deg(material, area),
        "depth_px": depth_px(capture, surface, material, seen),
        "photographs": photographs(capture, surface, seen),
        "hidden_px": hidden_px(capture, surface, unexplained, noise),
    }


def verdict(found: Mapping[str, float], settled: tuple[str, str], findings: Sequence[Finding] = ()) -> tuple[str, str]:
    """Status in a word or two, and a sentence, from `signs`, from whether the rounds settled (status and sentence) and from what checks of
    the capture found and could not mend."""
    if found["misfit"] > POOR_FIT:
        return "poor fit", (
            f"The model fits badly: it leaves {100 * found['misfit']:.0f} % of the images' signal unexplained (good fits leave under"
            f" {100 * POOR_FIT:.0f} %). Expect wrong normals and lights; metals and mirrors are likely reasons, as are wrong masks"
            " or poses."
        )
    doubts = [f"{one.where}: {one.text}" for one in findings if not one.mended]
    if found["outline_px"] > OUTLINE_PIXELS:
        doubts.append(f"outlines of the mesh and the masks are {found['outline_px']:.1f} px apart (good ones are under {OUTLINE_PIXELS:g})")
    if found["views_deg"] > CONTRADICTION_DEG:
        doubts.append(
            f"different views' normals at the same place are {found['views_deg']:.0f} deg apart (good ones under {CONTRADICTION_DEG:.0f})"
        )
    if found["expected_deg"] > BAD_DEG:
        doubts.append(f"normals are expected to be {found['expected_deg']:.0f} deg off in the mean")
    if found["photographs"] <= UNKNOWNS:
        doubts.append(
            f"half of what is seen is in no more than {found['photographs']:.0f} photographs, which leave nothing to check a normal"
            f" and an albedo by ({UNKNOWNS} unknowns)"
        )
    if found["depth_px"] > DEPTH_PIXELS:
        doubts.append(
            f"the depth of what one view alone sees is likely to be {found['depth_px']:.1f} px off in the mean over the"
            f" surface (good ones under {DEPTH_PIXELS:g})"
        )
    if found["hidden_px"] > DEPTH_PIXELS:
        doubts.append(
            "parts of what is seen fit nothing that the model knows, and hollows that they may hide would put the surface"
            f" {found['hidden_px']:.1f} px off in the mean (good ones under {DEPTH_PIXELS:g})"
        )
    if doubts:
        return "doubtful", (
            f"There is reason to doubt this shape: {'; '.join(doubts)}. Look at masks and poses first, then whether there are enough views"
            " and lights."
        )
    status, text = settled
    return status, f"Beside noise, the model leaves {100 * found['misfit']:.1f} % of the images' signal unexplained. {text}"
