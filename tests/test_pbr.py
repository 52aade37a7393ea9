"""mvps.pbr: the metallic-roughness model that comes closest to the lobes, and its colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from references import linear_from_srgb

from mvps.mesh import normalise
from mvps.pbr import fit_error, glossy, reflectance_scale, specular_energy, srgb_bytes
from mvps.scene import Law, Material


@pytest.mark.parametrize("weight", [0.01, 3.0])
@pytest.mark.parametrize("sharpness", [8.0, 32.0, 128.0, 1000.0, 1e4])
def test_roughness_and_strength_of_one_lobe(sharpness: float, weight: float) -> None:
    """A narrow lobe of microfacets is GGX of its alpha; a Gaussian one has about that of one peak and one integral."""
    rough, reflected = glossy(np.array([[weight]]), Law((sharpness,)))
    assert rough[0] ** 2 == pytest.approx(np.sqrt(2 / sharpness), rel=0.2)
    assert reflected[0] == pytest.approx(specular_energy(np.array([[weight]]), np.array([sharpness]))[0], rel=0.3)
    if sharpness > 100:
        rough, _ = glossy(np.array([[weight]]), Law((sharpness,), microfacet=True))
        assert rough[0] ** 2 == pytest.approx(np.sqrt(4 / (4 + sharpness)), rel=0.05)


def gltf_times_pi(light: np.ndarray, view: np.ndarray, normal: np.ndarray, rough: float, f0: float) -> np.ndarray:
    """pi F0 D V of glTF 2.0, appendix B.3, word by word, times n . l, for lights (n, 3)."""
    half = normalise(light + view)
    alpha = rough**2
    n_dot_h, n_dot_l, n_dot_v = half @ normal, light @ normal, view @ normal
    D = alpha**2 / (np.pi * (n_dot_h**2 * (alpha**2 - 1) + 1) ** 2)
    V = 1 / (n_dot_l + np.sqrt(alpha**2 + (1 - alpha**2) * n_dot_l**2)) / (n_dot_v + np.sqrt(alpha**2 + (1 - alpha**2) * n_dot_v**2))
    product: np.ndarray = np.pi * f0 * D * V * n_dot_l
    return product


def test_no_other_roughness_comes_nearer_to_the_lobes() -> None:
    """Pictures of a ball under lights around its camera: an independent sampling of what the fit is made for."""
    rng = np.random.default_rng(0)
    weight, law = np.array([[0.4, 0.7]]), Law((20.0, 120.0))
    rough, reflected = glossy(weight, law)
    disk = rng.uniform(-1, 1, (4000, 2))
    disk = disk[(disk**2).sum(1) < 0.97]
    normals = np.column_stack([disk, np.sqrt(1 - (disk**2).sum(1))])
    view = np.array([0.0, 0, 1])
    tilt, turn = np.arccos(rng.uniform(np.cos(np.radians(50)), 1, len(normals))), rng.uniform(0, 2 * np.pi, len(normals))
    lights = np.column_stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    lit = (lights * normals).sum(1) > 0
    lights, normals = lights[lit], normals[lit]
    h_dot_n = (normalise(lights + view) * normals).sum(1)
    lobes = np.exp(np.array(law.sharpness) * (h_dot_n[:, None] - 1)) @ weight[0] * (lights * normals).sum(1)
    lobes /= (normalise(lights + view) @ view) ** 2

    def error(roughness: float, f0: float) -> float:
        theirs = np.array([gltf_times_pi(light[None], view, n, roughness, f0)[0] for light, n in zip(lights, normals, strict=True)])
        return float(np.sqrt(((theirs - lobes) ** 2).mean() / (lobes**2).mean()))

    best = error(rough[0], reflected[0, 0])
    assert best < 0.15
    for change in (0.9, 1.1):
        assert error(change * rough[0], reflected[0, 0]) > best and error(rough[0], change * reflected[0, 0]) > best


def test_no_gloss_is_rough_and_broad_lobes_stay_in_range() -> None:
    assert glossy(np.zeros((1, 2)), Law((3.0, 30.0)))[0] == 1
    rough, reflected = glossy(np.zeros((1, 0)), Law(()))
    assert rough == 1 and not reflected.any()
    assert 0.8 < glossy(np.ones((1, 1)), Law((0.1,)))[0][0] <= 1
    assert 0.1 <= glossy(np.ones((1, 1)), Law((1e9,)))[0][0] < 0.2


def test_colour_weights_tint_the_reflection() -> None:
    law = Law((16.0, 64.0))
    weight = np.array([[[1.0, 0.5, 0.25], [2.0, 1.0, 0.5]], [[0.0, 0, 0], [0.0, 0, 0]]])
    rough, reflected = glossy(weight, law)
    np.testing.assert_allclose(reflected / reflected[0, 0], [[1, 0.5, 0.25], [0, 0, 0]])
    plain, grey = glossy(weight[:, :, 0] * 7 / 12, law)
    np.testing.assert_allclose(plain, rough)
    np.testing.assert_allclose(grey.mean(1), reflected.mean(1))


@given(st.floats(1e-6, 1e6))
def test_exposure_does_not_change_the_colours(factor: float) -> None:
    rng = np.random.default_rng(0)
    n = 50
    normal = np.tile([0.0, 0, 1], (n, 1))
    a = Material(normal, rng.uniform(0, 1, (n, 3)), rng.uniform(0, 1, (n, 1)), np.array([20.0]), np.ones(n))
    b = replace(a, albedo=a.albedo * factor, specular_weight=a.specular_weight * factor)
    assert reflectance_scale(b) == pytest.approx(factor * reflectance_scale(a))
    black = replace(a, albedo=np.zeros((n, 3)), specular_weight=np.zeros((n, 1)))
    assert reflectance_scale(black) == 1


def test_srgb_round_trip_and_known_values() -> None:
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(srgb_bytes(linear_from_srgb(codes)), codes)
    # IEC 61966-2-1: middle grey of 18 % and 21.4 %; out of range is clipped.
    np.testing.assert_array_equal(srgb_bytes(np.array([-1, 0, 0.18, 0.214041, 1, 7])), [0, 0, 118, 127, 255, 255])


def test_the_fit_says_how_far_it_is_off() -> None:
    """Of one lobe of microfacets next to nothing, of a wide and a narrow one together much; no colour and no scale changes it."""
    one, two = Law((200.0,), microfacet=True), Law((8.0, 500.0))
    assert fit_error(np.zeros((4, 1)), one) == 0
    assert fit_error(np.ones((4, 1)), one) < 0.1
    mixed = np.array([[0.2, 1.0]])
    off = fit_error(mixed, two)
    assert 0.1 < off < 0.9
    assert fit_error(7 * mixed, two) == pytest.approx(off, rel=1e-4)
    coloured = mixed[..., None] * np.array([1.0, 0.5, 0.1])
    assert fit_error(coloured, two) == pytest.approx(off, rel=1e-3)
