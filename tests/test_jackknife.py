"""By how much one view's normals are wrong together: stated without the truth, and held against it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvps.jackknife import ACROSS, at_corners, either, shared_variance, without_parts
from mvps.joint.bas_relief import bas_relief, turned
from mvps.oneview import first_lights
from mvps.photometric import normal_maps
from mvps.relief.ambiguity import lights_under
from mvps.relief.integrate import integrate
from mvps.relief.silhouette import inflated_normals
from mvps.relief.surface import pixel_surface
from mvps.scene import Camera, Law
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings

CPU = torch.device("cpu")
LAW = Law((8.0, 32.0, 128.0))


def test_every_pixel_is_left_out_once() -> None:
    pixels = np.argwhere(np.hypot(*(np.indices((31, 40)) - [[[15]], [[20]]])) < 14)
    stay = np.stack(without_parts(pixels))
    assert (stay.sum(0) == ACROSS**2 - 1).all()
    # A disc's corners hold less than its middle.
    assert (stay.mean(1) < 0.97).all() and (stay.mean(1) > 0.8).all()


@pytest.mark.parametrize("thin", [1, 2])
def test_a_mask_of_a_row_or_two_has_parts(thin: int) -> None:
    stay = without_parts(np.argwhere(np.ones((thin, 7), bool)))
    assert (np.stack(stay).sum(0) == ACROSS**2 - 1).all()


def test_corners_take_the_mean_of_the_pixels_around() -> None:
    size, flat = 3, np.tile([0.0, 0.0, -1.0], (9, 1))
    camera = Camera(np.diag([600.0, 600.0, 1.0]), np.eye(3), np.zeros(3), size, size)
    mask, pixels = np.ones((size, size), bool), np.argwhere(np.ones((size, size), bool))
    surface = pixel_surface(camera, pixels, flat, integrate(camera, mask, flat, np.ones(9)), 1.0)
    values = np.zeros(9)
    values[4] = 1.0
    found = np.sort(at_corners(values, surface))
    # Four corners of the middle pixel, which they share with three others; faces around count, of which a pixel has one or two.
    assert (found[:-4] == 0).all() and (found[-4:] > 0.1).all() and found[-4:].max() < 0.5
    assert np.allclose(at_corners(np.full(9, 0.3), surface), 0.3)


def test_what_two_guesses_disagree_by_is_half_eithers() -> None:
    """Of two pixels one is a tenth of a radian apart: 0.1^2 / 2 / 2 along a tangent."""
    turned = np.array([[np.sin(0.1), 0.0, -np.cos(0.1)], [0.0, 0.0, -1.0]])
    assert np.allclose(either(turned, np.tile([0.0, 0.0, -1.0], (2, 1))), [0.0025, 0], rtol=1e-2)


def shared_part(normal: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(n, 3) what a turn and a bas-relief of all normals (n, 3), camera frame, make of their difference to the true ones: least squares."""
    turns = np.stack([np.cross(axis, normal) for axis in np.eye(3)], 2)
    reliefs = normal[:, 2, None, None] * (np.eye(3) - normal[:, :, None] * normal[:, None, :])
    motions = np.concatenate([turns, reliefs], 2).reshape(-1, 6)
    return np.asarray(motions @ np.linalg.lstsq(motions, (true - normal).ravel(), rcond=None)[0]).reshape(-1, 3)


def test_stated_shared_errors_are_those_that_normals_have() -> None:
    """Over three made objects, root mean squares of all pixels, as far as all normals are wrong together. A few numbers an object: what is
    stated is within a factor of two."""
    stated, measured = [], []
    for seed in (0, 1, 3):
        capture, truth = render_capture(SceneSettings(views=1, lights=12, size=72, seed=seed))
        view = capture.views[0]
        rough = inflated_normals(view.mask)
        lights, found = first_lights(capture, rough, lights_under(view, rough), 0)
        assert found is not None
        maps = normal_maps(capture, lights, CPU)[0]
        variance = shared_variance(view, lights, maps, found, LAW, 0, CPU)
        assert variance.shape == (len(view.pixels),) and (variance > 0).all()
        normal, grey = maps.normal.astype(float), maps.albedo.mean(1).astype(float)
        own = lights.direction[0], lights.intensity[0]
        G = bas_relief(view, normal, grey, own, LAW, np.random.default_rng(0), CPU)
        after, true = turned(G, normal, grey, own[0], own[1].mean(1))[0], truth.normals[view.name][view.mask]
        known = np.isfinite(true).all(1) & (maps.confidence > 0.5)
        wrong = shared_part(after[known] @ view.camera.rotation.T, true[known] @ view.camera.rotation.T)
        measured.append((wrong**2).sum(1).mean() / 2)
        stated.append(variance[known].mean())
    assert 0.5 < np.sqrt(np.mean(stated) / np.mean(measured)) < 2
