"""mvps.joint.shown: vertices' normals without the blur of pixels, and with their surface's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from sphere_scene import SphereScene, make_sphere

from mvps.joint.blocks import Vertices
from mvps.joint.grey import grey_lights
from mvps.joint.observe import observe
from mvps.joint.reflectance import Observed
from mvps.joint.shown import SURFACE_SHARE, own_normals, shaded_as
from mvps.mesh import angles_deg, edges, neighbour_sums, normalise, vertex_normals
from mvps.scene import Float, Law

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    """Waves as long as some eight edges, which are of three pixels."""
    return make_sphere(subdivisions=4, waves=0.2)


@pytest.fixture(scope="module")
def observed(scene: SphereScene) -> Observed:
    of, n = scene.reconstruction, len(scene.reconstruction.surface.vertices)
    vertices = Vertices(torch.tensor(of.material.normal, dtype=torch.float32), torch.full((n, 1), 0.5), torch.full((n,), 0.01))
    views, lights = observe(scene.capture, of.surface, of.lights, CPU), grey_lights(of.lights, CPU)
    return Observed(scene.capture, of.surface, views, vertices, lights, Law(()))


def blurred(normal: Float, scene: SphereScene, part: float) -> Float:
    """A part of the way to the mean over neighbours."""
    ends = edges(scene.reconstruction.surface)
    count = np.bincount(ends.ravel(), minlength=len(normal))[:, None]
    return normalise((1 - part) * normal + part * neighbour_sums(normal, ends) / count)


def test_normals_that_pixels_blurred_are_sharpened(scene: SphereScene, observed: Observed) -> None:
    true = scene.reconstruction.material.normal
    given = blurred(true, scene, 0.1)
    found = own_normals(given, np.zeros(len(true)), observed)
    assert angles_deg(found, true).mean() < 0.6 * angles_deg(given, true).mean()


def test_what_is_noise_or_not_seen_stays(scene: SphereScene, observed: Observed) -> None:
    given = blurred(scene.reconstruction.material.normal, scene, 0.1)
    assert np.allclose(own_normals(given, np.full(len(given), 0.3**2), observed), given)
    unseen = np.arange(len(given)) % 2 == 0
    found = own_normals(given, np.where(unseen, np.nan, 0), observed)
    assert np.allclose(found[unseen], given[unseen]) and (angles_deg(found, given)[~unseen] > 0.01).mean() > 0.9


def test_errors_that_are_not_shared_with_the_surface_count_less(scene: SphereScene) -> None:
    """A vertex's own by a third; where it is opposite, the surface's stays."""
    surface, material = scene.reconstruction.surface, scene.reconstruction.material
    true = vertex_normals(surface)
    wrong = normalise(true + np.random.default_rng(2).normal(0, 0.02, true.shape))
    found = shaded_as(replace(material, normal=wrong), surface).normal
    share = angles_deg(found, true).mean() / angles_deg(wrong, true).mean()
    assert share == pytest.approx(1 / (1 + SURFACE_SHARE), rel=0.01)
    assert np.allclose(shaded_as(replace(material, normal=-true), surface).normal, true)
