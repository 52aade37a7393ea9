"""PJ16: Park, Sinha, Matsushita, Tai, Kweon, Robust Multiview Photometric Stereo Using Planar Mesh Parameterization (TPAMI 2017; first
Multiview Photometric Stereo Using Planar Mesh Parameterization, ICCV 2013).

A coarse mesh is flattened into charts; the photographs of all views and lights are warped into this parameter domain, where occlusion by
the mesh leaves entries missing; uncalibrated, robust Lambertian photometric stereo gives one normal and albedo a texel from all views
together, the coarse mesh's normals resolving the ambiguity of the lights; a displacement along the mesh's normals, linear in the domain,
makes a fine mesh that follows the normals and stays near the coarse mesh. From coarse to fine, the new mesh starting the next turn.

    visual hull -> [ parameter domain -> lights -> texel normals -> displacement ]  per level  -> domain, lights, normals once more

Written from the abstracts and from what is known of the method, without the full text. Departures from the paper, as far as that says:

- Coarse mesh: the visual hull of the masks (theirs: structure from motion and multiview stereo). What is added because of it, hollows that
  let go of the hull and outlines that hold to the masks, stands in pj16_displacement.py.
- Parameterisation: orthographic charts of bounded stretch (mvps/atlas.py; theirs: iso-charts), made anew at every level, because a hull is
  too far from the surface for one parameterisation to serve from the first level to the last.
- Displacement: unknown on the vertices of a mesh whose edges are one to two texels, where theirs is a texture; the slopes' equations are
  the same, and chart borders need no equations of their own. One level solves it several times, each time from where the last one ended.
- Lights: where they stand still in the camera's frame (one rig, found from the data), pixels of all views are factorised together in that
  frame and the mesh's normals resolve the ambiguity, anew at every level (mvps/calibrate.py; theirs: texels, each photograph's light its
  own). Where every view has lights of its own, or no diffuse body is there to be factorised, the lights are fitted to the texels of all
  views with the mesh's normals given (pj16_stereo.py): factors of single views leave some lights 40 degrees off.
- Robustness: Cauchy's weights in all fits, in place of the paper's estimators.
- Weights, texel sizes, number of levels and of sweeps are this program's.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from mvps.baselines.pj16_displacement import displaced
from mvps.baselines.pj16_domain import Domain, flattened, warped
from mvps.baselines.pj16_stereo import TexelNormals, lights_on, texel_normals
from mvps.calibrate import MINIMUM_LIGHTS, Calibration, uncalibrated_lights
from mvps.camera import surface_pixel
from mvps.hull import hull_grid, visual_hull
from mvps.mesh import face_normals, isotropic_remesh, lengths, normalise, vertex_normals
from mvps.progress import Progress
from mvps.scene import Capture, CaptureError, Float, Lights, Material, Reconstruction, SignedDistanceGrid, Surface, View
from mvps.visibility import RayCaster, camera_hits, ray_caster


class Level(NamedTuple):
    """Of the way from coarse to fine: length of the mesh's edges and side of a texel, pixels; number of displacements."""

    edge: float
    texel: float
    displacements: int


LEVELS = (Level(3.0, 2.0, 6), Level(3.0, 2.0, 6), Level(2.0, 1.5, 4), Level(1.5, 1.0, 3), Level(1.0, 1.0, 3))
"""Hulls are several pixels off in hollows, where photographs are warped to wrong places: the first levels bring them in at a low cost. The
last has a vertex for every texel, as in the paper. Half or twice as many displacements change nothing but the time."""

FINEST_TEXEL = 0.7
"""Of the last photometric stereo, pixels: interpolating twice (photograph, texture) loses less of what pixels hold than with 1."""

LAMBERTIAN = 0.25
"""Relative residual of the factorisation above which there is no diffuse body and the lights are not to be trusted (mvps/calibrate.py)."""


class Solved(NamedTuple):
    """A mesh in its parameter domain, the lights, and what photometric stereo says of the texels."""

    domain: Domain
    calibration: Calibration
    lights: Lights
    normals: TexelNormals


def pj16(capture: Capture, seed: int, progress: Progress) -> Reconstruction:
    """The method on a capture; seed: of the pixels and texels drawn for the lights.

    Normal maps are the texels' normals as the views see them; the material is Lambertian. CaptureError for fewer than two views or fewer
    than four photographs in one.
    """
    _check(capture)
    with progress.stage("visual hull"):
        coarse = hull_grid(capture)
        surface = visual_hull(coarse)
        pixel = surface_pixel(capture, surface)
    moved: Float = np.zeros(1)
    for level in LEVELS:
        surface = isotropic_remesh(surface, level.edge * pixel)
        solved = _photometric_stereo(capture, surface, level.texel * pixel, seed, progress)
        surface, moved = _refined(capture, solved, coarse, pixel, level, progress)
    solved = _photometric_stereo(capture, surface, FINEST_TEXEL * pixel, seed, progress)
    with progress.stage("normals of all views"):
        caster, picture = ray_caster(surface), solved.domain.picture(solved.normals.normal)
        maps = tuple(_normal_map(solved.domain, picture, caster, view) for view in capture.views)
    metrics: dict[str, Any] = {"stages": progress.stages, "status": _status(solved.calibration, float(np.median(np.abs(moved))) / pixel)}
    names, numbers = tuple(view.name for view in capture.views), tuple(view.lights for view in capture.views)
    settings = {"capture": capture.name, "method": "pj16", "seed": seed}
    return Reconstruction(surface, _material(solved), solved.lights, names, numbers, maps, metrics, settings)


def _check(capture: Capture) -> None:
    if len(capture.views) < 2:
        raise CaptureError(f"{capture.name}: pj16 wanted at least 2 views, given {len(capture.views)}; use more views")
    for view in capture.views:
        if len(view.lights) < MINIMUM_LIGHTS:
            raise CaptureError(
                f"{capture.name}/{view.name}: pj16 wanted at least {MINIMUM_LIGHTS} photographs under different lights in every view,"
                f" given {len(view.lights)}; use more lights, or leave the view out"
            )


def _photometric_stereo(capture: Capture, surface: Surface, texel: float, seed: int, progress: Progress) -> Solved:
    """Lights and texel normals on a surface, texels of side `texel`, world units."""
    with progress.stage("parameter domain") as stage:
        domain = flattened(surface, texel)
        photographs = warped(domain, capture)
        stage.status(f"{len(domain.position)} texels in {int(domain.atlas.chart.max()) + 1} charts")
    with progress.stage("lights") as stage:
        calibration = uncalibrated_lights(capture, surface, seed)
        lights, kind = calibration.lights, "factors of all views"
        if not lights.one_rig or calibration.residual > LAMBERTIAN:
            lights, kind = lights_on(domain, photographs, lights, seed), "fitted to the mesh's normals"
        stage.status(f"{kind}; three factors leave {100 * calibration.residual:.1f} % of the images")
    with progress.stage("texel normals") as stage:
        normals = texel_normals(domain, photographs, lights)
        stage.status(f"{100 * (normals.confidence > 0).mean():.0f} % of the texels solved")
    return Solved(domain, calibration, lights, normals)


def _refined(
    capture: Capture, solved: Solved, coarse: SignedDistanceGrid, pixel: float, level: Level, progress: Progress
) -> tuple[Surface, Float]:
    """The surface displaced, and by how much its vertices (V,) moved in the last displacement, world units."""
    with progress.stage("displacement", total=level.displacements) as stage:
        target, trust = _face_targets(solved)
        surface = solved.domain.surface
        moved: Float = np.zeros(1)
        for _ in range(level.displacements):
            before = surface
            surface = displaced(surface, target, trust, capture, coarse, pixel)
            moved = lengths(surface.vertices - before.vertices)
            stage.advance(1, median_move_px=float(np.median(moved)) / pixel)
    return surface, moved


def _face_targets(solved: Solved) -> tuple[Float, Float]:
    """Normals (F, 3) of the faces, from the texels at their centres, and the trust in them (F,); their own where there is none."""
    domain, confidence = solved.domain, solved.normals.confidence[:, None]
    picture = domain.picture(np.concatenate([solved.normals.normal * confidence, confidence], axis=1))
    at = domain.sampled_at(picture, domain.atlas.uv[domain.atlas.faces].mean(1))
    known = lengths(at[:, :3]) > 0
    return np.where(known[:, None], normalise(at[:, :3]), face_normals(domain.surface)), at[:, 3] * known


def _normal_map(domain: Domain, picture: NDArray[np.float32], caster: RayCaster, view: View) -> NDArray[np.float32]:
    """(height, width, 3) texel normals that a view sees, NaN outside its mask; a pixel off the mesh takes its nearest neighbour's."""
    hits = camera_hits(caster, view.camera, view.pixels)
    on = hits.face >= 0
    corners = domain.atlas.uv[domain.atlas.faces[hits.face[on]]]
    normal = np.full((len(on), 3), np.nan)
    normal[on] = normalise(domain.sampled_at(picture, np.einsum("mk,mkc->mc", hits.barycentric[on], corners)))
    seen = np.full((*view.mask.shape, 3), np.nan, np.float32)
    seen[view.mask] = normal
    if on.any():
        seen = seen[tuple(distance_transform_edt(np.isnan(seen[..., 0]), return_distances=False, return_indices=True))]
    seen[~view.mask] = np.nan
    return seen


def _material(solved: Solved) -> Material:
    """Normal, albedo and confidence of the vertices from the texels at them, weighted by confidence; where no view sees a vertex, the
    mesh's normal and the median albedo."""
    domain, found = solved.domain, solved.normals
    weight = found.confidence[:, None]
    picture = domain.picture(np.concatenate([found.normal * weight, found.albedo * weight, weight, np.ones_like(weight)], axis=1))
    total = np.zeros((len(domain.surface.vertices), 8))
    np.add.at(total, domain.atlas.vertex, domain.sampled_at(picture, domain.atlas.uv))
    known = (total[:, 6] > 0) & (lengths(total[:, :3]) > 0)
    normal = np.where(known[:, None], normalise(total[:, :3]), vertex_normals(domain.surface))
    albedo = total[:, 3:6] / np.where(known, total[:, 6], 1)[:, None]
    albedo[~known] = np.median(albedo[known], axis=0) if known.any() else 1.0
    confidence = np.where(known, total[:, 6] / np.maximum(total[:, 7], np.finfo(float).tiny), 0)
    return Material(normal, albedo.clip(0), np.zeros((len(normal), 0)), np.zeros(0), confidence.clip(0, 1))


def _status(calibration: Calibration, move: float) -> dict[str, str]:
    """How it ended, in words; move: median of the last displacement, pixels."""
    text = f"Three factors leave {100 * calibration.residual:.1f} % of the images; the last displacement was {move:.3f} pixels."
    if calibration.residual > LAMBERTIAN:
        return {"name": "poor fit", "text": f"{text} The object has no diffuse body, so lights and normals are not to be trusted."}
    return {"name": "finished", "text": f"{text} All {len(LEVELS)} levels done."}
