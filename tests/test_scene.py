"""mvps.scene: values refuse what they cannot be, and cannot be changed afterwards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest

from mvps.scene import RELIABLE, Camera, Capture, Lights, Material, NormalMap, Reconstruction, Surface, Truth, View, expected_error_deg
from mvps.values import checked

K = np.array([[100.0, 0, 4], [0, 100, 3], [0, 0, 1]])
MASK = np.zeros((6, 8), bool)
MASK[1:4, 2:7] = True
UP = np.array([[0.0, 0, 1]])


def camera(**changes: Any) -> Camera:
    return Camera(**({"K": K, "rotation": np.eye(3), "translation": np.zeros(3), "height": 6, "width": 8} | changes))


def view(**changes: Any) -> View:
    samples = np.arange(MASK.sum() * 4 * 3, dtype=np.uint16).reshape(-1, 4, 3)
    values = {"name": "view_01", "camera": camera(), "mask": MASK, "samples": samples, "scale": 0.5, "saturation": 100}
    return View(**(values | {"lights": (1, 2, 5, 8)} | changes))


def surface(**changes: Any) -> Surface:
    return Surface(**({"vertices": np.eye(3), "faces": [[0, 1, 2]]} | changes))


def material(**changes: Any) -> Material:
    values = {"normal": np.eye(3), "albedo": np.ones((3, 3)), "specular_weight": np.ones((3, 2)), "sharpness": [5.0, 50.0]}
    return Material(**(values | {"confidence": np.ones(3)} | changes))


def reconstruction(**changes: Any) -> Reconstruction:
    values: dict[str, Any] = {"surface": surface(), "material": material(), "lights": Lights((UP,), (UP + 1,), True)}
    values |= {"views": ("view_01",), "light_names": ((1,),), "normal_maps": (np.zeros((2, 2, 3), np.float32),)}
    return Reconstruction(**(values | changes))


def truth(**changes: Any) -> Truth:
    values: dict[str, Any] = {"views": ("view_01",), "normals": {}, "direction": {}, "intensity": {}, "surface": None}
    return Truth(**(values | changes))


REFUSED: list[tuple[Callable[[], Any], str]] = [
    (lambda: checked("x", np.zeros((2, 3)), (None, 4)), r"x: wanted shape \(any, 4\), given \(2, 3\)"),
    (lambda: checked("x", [1, np.nan, np.inf], (3,)), "x: wanted finite numbers, given 2 NaN or infinite"),
    (lambda: camera(K=-K), "K: wanted positive focal lengths"),
    (lambda: camera(K=2 * K), "K: wanted .* a last row of 0 0 1"),
    (lambda: camera(rotation=np.eye(3) * 1.001), "rotation: wanted a right-handed orthonormal matrix, given one off by 0.002"),
    (lambda: camera(rotation=-np.eye(3)), "rotation: .* determinant -1"),
    (lambda: camera(height=0), "image size: wanted at least 1 x 1, given 0 x 8"),
    (lambda: view(mask=MASK[1:]), r"mask: wanted shape \(6, 8\), given \(5, 8\)"),
    (lambda: view(lights=(1, 2)), r"samples: wanted shape \(15, 2, 3\), given \(15, 4, 3\)"),
    (lambda: view(scale=0), "scale: wanted a positive number, given 0"),
    (lambda: Lights((UP,), (), True), "lights: wanted as many intensities as directions, given 0 and 1"),
    (lambda: Lights((2 * UP,), (UP + 1,), True), "light direction: wanted unit vectors, given one of length 2"),
    (lambda: Lights((UP,), (UP,), True), "light intensity: wanted positive numbers, given 0"),
    (lambda: Lights((UP,), (np.ones((2, 3)),), True), r"light intensity: wanted shape \(1, 3\)"),
    (lambda: Capture("x", ()), "views: wanted at least one"),
    (lambda: Capture("x", (view(), view())), "views: wanted distinct names"),
    (lambda: NormalMap(2 * UP, UP, np.ones(1)), "normal: wanted unit vectors"),
    (lambda: NormalMap(UP, UP, np.ones(2)), r"normal: wanted shape \(2, 3\)"),
    (lambda: surface(faces=np.zeros((0, 3))), "faces: wanted at least one"),
    (lambda: surface(faces=[[0, 1, 3]]), r"faces: wanted indices in 0..2, given 0..3"),
    (lambda: surface(vertices=np.eye(3) * np.nan), "vertices: wanted finite numbers"),
    (lambda: material(albedo=-np.ones((3, 3))), "material: wanted non-negative"),
    (lambda: material(specular_weight=np.ones((3, 1))), r"specular_weight: wanted shape \(3, 2\)"),
    (lambda: material(normal=np.zeros((3, 3))), "normal: wanted unit vectors"),
    (lambda: reconstruction(surface=Surface(np.eye(4)[:, :3], [[0, 1, 2]])), "material: wanted 4 vertices, given 3"),
    (lambda: reconstruction(light_names=()), r"light_names: wanted one per view \(1\), given 0"),
    (lambda: reconstruction(normal_maps=()), r"normal_maps: wanted one per view \(1\), given 0"),
    (lambda: reconstruction(lights=Lights((), (), True)), r"lights: wanted one set per view \(1\), given 0"),
    (lambda: truth(normals={"view_02": np.zeros((2, 2, 3))}), r"normals: wanted views among \['view_01'\], given \['view_02'\]"),
    (lambda: truth(normals={"view_01": np.ones((2, 2, 3))}), "normals of view_01: wanted unit vectors"),
    (lambda: truth(direction={"view_01": UP * 3}), "direction of view_01: wanted unit vectors"),
    (lambda: truth(direction={"view_01": UP * np.nan}), "direction of view_01: wanted finite numbers"),
    (lambda: truth(intensity={"view_01": UP}), "intensity: wanted positive numbers"),
]


@pytest.mark.parametrize(("make", "message"), REFUSED, ids=[message[:40] for _, message in REFUSED])
def test_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_values_cannot_be_changed() -> None:
    one = view()
    with pytest.raises(FrozenInstanceError):
        one.scale = 2.0  # type: ignore[misc]
    with pytest.raises(ValueError, match="read-only"):
        one.samples[0] = 1
    known = truth(direction={"view_01": UP})
    with pytest.raises(TypeError):
        known.direction["view_01"] = UP  # type: ignore[index]


def test_arrays_are_shared_and_the_callers_stay_writable() -> None:
    samples = np.zeros((MASK.sum(), 4, 3), np.uint16)
    assert np.shares_memory(view(samples=samples).samples, samples)
    assert samples.flags.writeable


def test_pixels_and_their_index_are_inverse() -> None:
    one = view()
    assert one.pixels.shape == (15, 2)
    np.testing.assert_array_equal(one.pixel_index[tuple(one.pixels.T)], np.arange(15))
    np.testing.assert_array_equal(one.pixel_index >= 0, MASK)
    # Samples are in the order in which numpy's boolean indexing takes foreground pixels.
    image = np.random.default_rng(0).random(MASK.shape)
    np.testing.assert_array_equal(image[MASK], image[tuple(one.pixels.T)])


def test_radiance_and_saturation() -> None:
    one = view()
    assert one.radiance().dtype == np.float32
    np.testing.assert_array_equal(one.radiance([0, 2]), one.samples[:, [0, 2]] * 0.5)
    np.testing.assert_array_equal(one.usable(), (one.samples < 100).all(-1))
    assert one.usable(slice(0, 1)).shape == (15, 1)


def test_select_keeps_views_and_lights_by_name_and_number() -> None:
    capture = Capture("x", (view(), view(name="view_02")))
    one = capture.select({"view_02": [8, 1]})
    assert [v.name for v in one.views] == ["view_02"] and one.views[0].lights == (8, 1)
    np.testing.assert_array_equal(one.views[0].samples, view().samples[:, [3, 0]])


def test_centre_is_where_camera_coordinates_vanish() -> None:
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    one = camera(rotation=rotation, translation=np.array([1.0, 2, 3]))
    np.testing.assert_allclose(rotation @ one.centre + one.translation, 0, atol=1e-15)
    assert replace(one, K=np.diag([50.0, 200, 1])).focal_length == pytest.approx(100)


def test_truth_keeps_nan_outside_the_mask() -> None:
    normals = np.full((2, 2, 3), np.nan)
    normals[0, 0] = (0, 0, 1)
    assert np.isnan(truth(normals={"view_01": normals}).normals["view_01"]).sum() == 9


def test_photographs_that_are_no_data() -> None:
    whole = Capture("a", (view(), view(name="view_02")))
    part = whole.without({"view_02": [5]})
    assert part.views[0] is whole.views[0]
    assert part.views[1].usable().any(0).tolist() == [True, True, False, True]
    assert np.array_equal(part.views[1].samples[:, [0, 1, 3]], whole.views[1].samples[:, [0, 1, 3]])


def test_expected_errors_are_between_none_and_a_right_angle() -> None:
    """Rayleigh's mean, sqrt(pi / 2) sigma, where that is an angle; what nothing is known of is at most 90 degrees off."""
    sigma = np.array([0.0, 0.01, 0.2])
    certain = 1 / (1 + (sigma / RELIABLE) ** 2)
    drawn = np.degrees(np.hypot(*np.random.default_rng(0).normal(size=(2, 200_000)))).mean()
    np.testing.assert_allclose(expected_error_deg(certain), drawn * sigma, rtol=0.01)
    assert expected_error_deg(np.array([1e-7, 0.0])).tolist() == [90, 90]
