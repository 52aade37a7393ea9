"""mvps.exemplars: normals of metals and the like, whose photographs are not Lambert's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mvps.camera import pixel_centres, rays
from mvps.exemplars import FEWEST, is_shiny, matched, misfit, with_exemplars
from mvps.material import POOR_FIT
from mvps.mesh import angles_deg, normalise
from mvps.oneview import beginning, without_misfits
from mvps.photometric import normal_map
from mvps.scene import Camera, Capture, Lights, NormalMap, View, expected_error_deg
from mvps.two_materials import materials_under

SIZE, LIGHTS, CPU = 40, 16, torch.device("cpu")
RNG = np.random.default_rng(0)
# A camera whose rays are up to 40 degrees apart, turned against the world.
CAMERA = Camera(
    np.array([[60.0, 0, SIZE / 2], [0, 60, SIZE / 2], [0, 0, 1]]),
    np.linalg.qr(RNG.normal(size=(3, 3)))[0],
    np.array([0.0, 0, 10]),
    SIZE,
    SIZE,
)
if np.linalg.det(CAMERA.rotation) < 0:
    CAMERA = replace(CAMERA, rotation=-CAMERA.rotation)
MASK = np.ones((SIZE, SIZE), bool)
TOWARDS = -rays(CAMERA, pixel_centres(np.argwhere(MASK)))[1]
NORMAL = normalise(TOWARDS + RNG.normal(0, 0.25, TOWARDS.shape))
DIRECTION = normalise(np.concatenate([RNG.normal(0, 0.5, (LIGHTS, 2)), -np.ones((LIGHTS, 1))], 1)) @ CAMERA.rotation
INTENSITY = np.repeat(RNG.uniform(0.6, 1.4, (LIGHTS, 1)), 3, 1)


def photographed(metal: np.ndarray, exposure: float = 1.0, error: float = 0.01) -> View:
    """A view of patches, each alone: of metal (pixels,), a lobe between the exemplars' and no body, or of chalk; noise in parts of a
    value."""
    half = normalise(TOWARDS[:, None] + DIRECTION)
    lobe = np.exp(np.where(metal, 16.0, 0.0)[:, None] * ((half * NORMAL[:, None]).sum(2) - 1))
    gain = np.where(metal[:, None], 1 / np.maximum((half * TOWARDS[:, None]).sum(2), 0.5) ** 2, 1)
    value = np.maximum(NORMAL @ DIRECTION.T, 0) * lobe * gain * INTENSITY.mean(1)
    value *= 1 + error * np.random.default_rng(1).normal(size=value.shape)
    scale = value.max() / 60000
    samples = np.repeat(np.rint(value / scale)[..., None], 3, 2).astype(np.uint16)
    return View("view_01", CAMERA, MASK, samples, exposure * scale, 65535, tuple(range(1, LIGHTS + 1)))


def errors_of(maps: NormalMap, where: np.ndarray) -> np.ndarray:
    found: np.ndarray = angles_deg(maps.normal[where].astype(float), NORMAL[where])
    return found


METAL, CHALK = np.ones(SIZE**2, bool), np.zeros(SIZE**2, bool)


def test_normals_of_metal() -> None:
    view = photographed(METAL)
    assert is_shiny(view, DIRECTION, INTENSITY, CPU)
    by_lambert = normal_map(view, DIRECTION, INTENSITY, CPU)
    found = with_exemplars(view, DIRECTION, INTENSITY, materials_under(view, DIRECTION, INTENSITY, CPU), by_lambert, CPU, all_over=False)
    assert np.median(errors_of(by_lambert, METAL)) > 15
    off = errors_of(found, METAL)
    assert np.median(off) < 5 and off.mean() < 0.3 * errors_of(by_lambert, METAL).mean()
    stated = expected_error_deg(found.confidence)
    assert 0.5 < stated.mean() / off.mean() < 2


def test_where_lambert_fits_its_normals_stay() -> None:
    """Those of the chalk on an object that is mostly of metal, unless they are asked for all over."""
    mostly = np.arange(SIZE**2) % 4 > 0
    view = photographed(mostly)
    by_lambert = normal_map(view, DIRECTION, INTENSITY, CPU)
    found = with_exemplars(view, DIRECTION, INTENSITY, materials_under(view, DIRECTION, INTENSITY, CPU), by_lambert, CPU, all_over=False)
    assert (found.normal[~mostly] == by_lambert.normal[~mostly]).all() and (found.albedo[~mostly] == by_lambert.albedo[~mostly]).all()
    assert errors_of(found, mostly).mean() < 0.4 * errors_of(by_lambert, mostly).mean()
    everywhere = with_exemplars(
        view, DIRECTION, INTENSITY, materials_under(view, DIRECTION, INTENSITY, CPU), by_lambert, CPU, all_over=True
    )
    assert (everywhere.normal[~mostly] != by_lambert.normal[~mostly]).any(1).all() and errors_of(everywhere, ~mostly).mean() < 5


def test_chalk_is_not_shiny_nor_with_a_few_pixels_of_metal() -> None:
    assert not is_shiny(photographed(CHALK), DIRECTION, INTENSITY, CPU)
    few = np.arange(SIZE**2) % 5 == 0
    view = photographed(few)
    by_lambert = normal_map(view, DIRECTION, INTENSITY, CPU)
    off = misfit(view, DIRECTION, INTENSITY, by_lambert, np.arange(SIZE**2))
    assert (off[few] > POOR_FIT).mean() > 0.8 and (off[~few] > POOR_FIT).mean() < 0.1
    assert not is_shiny(view, DIRECTION, INTENSITY, CPU)


@pytest.mark.parametrize("exposure", [1e-6, 1e6])
def test_exposure_is_of_no_account(exposure: float) -> None:
    rows = np.arange(200)
    seen, exposed = photographed(METAL), photographed(METAL, exposure)
    weights, of_exposed = (materials_under(*of, CPU) for of in ((seen, DIRECTION, INTENSITY), (exposed, DIRECTION, exposure * INTENSITY)))
    normal, sigma, body = matched(seen, DIRECTION, INTENSITY, weights, rows, CPU)
    again, sigma_again, _ = matched(exposed, DIRECTION, exposure * INTENSITY, of_exposed, rows, CPU)
    assert angles_deg(normal, again).max() < 0.1 and np.allclose(sigma, sigma_again, rtol=1e-2)
    assert np.isfinite(body).all() and (body >= 0).all()


def test_black_clipped_and_unlit_pixels_are_finite() -> None:
    """Pixels without values enough keep what Lambert's law made of them."""
    view = photographed(METAL)
    samples = view.samples.copy()
    samples[0], samples[1], samples[2, FEWEST - 1 :] = 0, 65535, 65535
    view = replace(view, samples=samples)
    by_lambert = normal_map(view, DIRECTION, INTENSITY, CPU)
    found = with_exemplars(view, DIRECTION, INTENSITY, materials_under(view, DIRECTION, INTENSITY, CPU), by_lambert, CPU, all_over=False)
    for values in (found.normal, found.albedo, found.confidence):
        assert np.isfinite(values).all()
    assert (found.normal[:3] == by_lambert.normal[:3]).all() and (found.confidence[:3] == by_lambert.confidence[:3]).all()


def test_no_photograph_of_metal_is_left_out_for_not_being_lamberts() -> None:
    """Under given lights that law would leave some out; and chalk keeps its normals."""
    rough = np.tile([0.0, 0.0, -1.0], (SIZE**2, 1))
    lights = Lights((DIRECTION,), (INTENSITY,), False)
    metal, chalk = (Capture("patches", (photographed(kind),)) for kind in (METAL, CHALK))
    assert without_misfits(metal, lights, CPU)[1]
    begun = beginning(metal, lights, False, True, rough, CPU, 0)
    assert begun.shiny and not begun.misfits and len(begun.used.views[0].lights) == LIGHTS
    begun = beginning(chalk, lights, False, True, rough, CPU, 0)
    assert not begun.shiny and (begun.maps.normal == normal_map(chalk.views[0], DIRECTION, INTENSITY, CPU).normal).all()
