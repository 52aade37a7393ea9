"""LZ20: azimuths from isotropy, and the whole method on scenes whose answer is known."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch
from sphere_scene import camera_at

from mvps.baselines.lz20 import lz20
from mvps.baselines.lz20_azimuth import azimuths_of, linear_fit
from mvps.export import read_reconstruction, write_reconstruction
from mvps.hull import default_cells, signed_distance, visual_hull
from mvps.measures import mesh_normal_errors, normal_errors, surface_errors
from mvps.mesh import cross, normalise
from mvps.progress import Progress
from mvps.scene import Capture, CaptureError, Lights, Reconstruction, Truth
from mvps.shading import returned
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings


def lights_of(capture: Capture, truth: Truth) -> Lights:
    names = [view.name for view in capture.views]
    return Lights(tuple(truth.direction[name] for name in names), tuple(truth.intensity[name] for name in names), True)


@lru_cache(maxsize=1)
def matt() -> tuple[Capture, Truth, Reconstruction]:
    """A Lambertian scene and its reconstruction."""
    capture, truth = render_capture(SceneSettings(views=8, lights=16, size=96, strength=0))
    return capture, truth, lz20(capture, lights_of(capture, truth), Progress())


def test_matt_scene_is_better_than_the_hull() -> None:
    capture, truth, made = matt()
    assert truth.surface is not None
    maps = normal_errors(dict(zip(made.views, made.normal_maps, strict=True)), truth.normals, capture)
    assert maps["normal_error_deg"] < 4 and maps["normal_coverage"] == 1
    hull = visual_hull(signed_distance(capture, default_cells(capture)))
    before, after = (surface_errors(surface, truth.surface, capture) for surface in (hull, made.surface))
    assert after["chamfer_px"] < 0.6 * before["chamfer_px"]
    normals = [mesh_normal_errors(surface, truth.normals, capture, ())["normal_error_deg"] for surface in (hull, made.surface)]
    assert normals[1] < 0.6 * normals[0]


def test_reflectance_of_a_matt_scene_is_albedo(tmp_path: Path) -> None:
    _, _, made = matt()
    assert made.metrics["brdf_error"] < 0.15
    seen = made.material.confidence > 0.5
    of_lobes = made.material.specular_weight[seen].mean(2) @ returned(tuple(made.material.sharpness.tolist()), False)[1:]
    assert of_lobes.mean() < 0.2 * made.material.albedo[seen].mean()
    write_reconstruction(made, tmp_path / "made")
    assert (read_reconstruction(tmp_path / "made").material.albedo == made.material.albedo).all()


def test_units_of_length_and_exposure_change_nothing() -> None:
    capture, truth = render_capture(SceneSettings(views=6, lights=12, size=64, strength=0.5))
    lights = lights_of(capture, truth)
    factor = 1024.0
    cameras = [replace(view.camera, translation=factor * view.camera.translation) for view in capture.views]
    scaled = [replace(view, camera=camera, scale=8 * view.scale) for view, camera in zip(capture.views, cameras, strict=True)]
    made = [lz20(of, lights, Progress()) for of in (capture, Capture("scaled", tuple(scaled)))]
    errors = [normal_errors(dict(zip(of.views, of.normal_maps, strict=True)), truth.normals, capture)["normal_error_deg"] for of in made]
    # Powers of two round nothing, so that nothing may differ: with other factors remeshing decides otherwise where rounding does.
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)
    np.testing.assert_allclose(made[1].surface.vertices, factor * made[0].surface.vertices, rtol=1e-9)
    np.testing.assert_allclose(made[1].material.albedo, 8 * made[0].material.albedo, rtol=1e-9)


def shining_sphere() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Normals (n, 3), directions to the camera (n, 3), lights (48, 3), more of them on one side, and radiance (n, 48) of a wide lobe."""
    rng = np.random.default_rng(0)
    normal = normalise(rng.normal(size=(3000, 3)) * (1, 1, 0.5) + (0, 0, 1))
    normal = normal[(normal[:, 2] > 0.3) & (normal[:, 2] < 0.95)]
    towards = np.broadcast_to((0.0, 0.0, 1.0), normal.shape).copy()
    around, apart = rng.uniform(-0.8 * np.pi, 0.8 * np.pi, 48), 0.8 * np.sqrt(rng.uniform(0, 1, 48))
    light = np.stack([np.sin(apart) * np.cos(around), np.sin(apart) * np.sin(around), np.cos(apart)], 1)
    half = normalise(towards[:, None] + light)
    lobe = np.exp(8 * (np.einsum("nlc,nc->nl", half, normal) - 1))
    return normal, towards, light, np.maximum(normal @ light.T, 0) * (0.1 + lobe)


def azimuth_error(along: np.ndarray, normal: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """(n,) degrees between the azimuth that T stands for and the normal's."""
    aside, forward = (np.einsum("ni,ni->n", axis, normal) for axis in (along, cross(along, towards)))
    return np.degrees(np.arctan2(np.abs(aside), forward))


def test_azimuths_of_a_shining_sphere_are_right_where_lamberts_are_not() -> None:
    normal, towards, light, image = shining_sphere()
    known = np.ones(image.shape, bool)
    found = azimuths_of(image, known, light, towards, camera_at(np.array([0.0, 0.0, 1.0])), 1e-4)
    lit = image > 0.1 * np.quantile(image, 0.8, axis=1, keepdims=True)
    b = linear_fit(*(torch.tensor(a) for a in (image, lit, light)), 1e-4).b.numpy()
    errors = [azimuth_error(T, normal, towards) for T in (found.along, normalise(cross(towards, b)))]
    wrong = errors[1] > 5
    assert wrong.sum() > 100
    assert np.median(errors[0][wrong]) < 3 and errors[0].mean() < 0.5 * errors[1].mean()


def test_azimuths_state_their_errors() -> None:
    normal, towards, light, image = shining_sphere()
    found = azimuths_of(image, np.ones(image.shape, bool), light, towards, camera_at(np.array([0.0, 0.0, 1.0])), 1e-4)
    off = np.abs(np.einsum("ni,ni->n", found.along, normal))
    sure = found.sigma < np.median(found.sigma)
    assert off[sure].mean() < 0.5 * off[~sure].mean()
    few = azimuths_of(image[:, :3], np.ones((len(image), 3), bool), light[:3], towards, camera_at(np.array([0.0, 0.0, 1.0])), 1e-4)
    assert np.isinf(few.sigma).all()


def test_missing_lights_are_one_clear_sentence() -> None:
    capture, truth = render_capture(SceneSettings(views=4, lights=8, size=32))
    lights = lights_of(capture, truth)
    fewer = Lights(lights.direction[:3], lights.intensity[:3], True)
    with pytest.raises(CaptureError, match=r"LZ20 wanted lights of 4 views, given those of 3; give"):
        lz20(capture, fewer, Progress())
    short = Lights(tuple(d[:7] for d in lights.direction), tuple(e[:7] for e in lights.intensity), True)
    with pytest.raises(CaptureError, match=r"each of the 8 photographs of view_01, given 7 directions; give"):
        lz20(capture, short, Progress())
    four = capture.select({view.name: (1, 2, 3, 4) for view in capture.views})
    of_four = Lights(tuple(d[:4] for d in lights.direction), tuple(e[:4] for e in lights.intensity), True)
    with pytest.raises(CaptureError, match=r"at least 6 lights a view, given 4 in view_01; use more"):
        lz20(four, of_four, Progress())
    two = Capture("two", capture.views[:2])
    with pytest.raises(CaptureError, match=r"two: LZ20 wanted at least 3 views, given 2; use more"):
        lz20(two, Lights(lights.direction[:2], lights.intensity[:2], True), Progress())
