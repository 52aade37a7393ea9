"""mvps.layers: pictures whose values are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sphere_scene import RADIUS, SphereScene, camera_at, make_sphere

import mvps.layers
from mvps.illumination import Illumination, environment_lights
from mvps.layers import rendered
from mvps.render import LAYERS
from mvps.rendering import photograph
from mvps.scene import Camera, Material, Surface
from mvps.visibility import RayCaster

CAMERA = camera_at(np.array([1.0, 0.5, 0.3]), 48)
SUN = Illumination(np.array([[0.0, 0.6, 0.8]]), np.array([[1.0, 0.8, 0.5]]))


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(4)


@pytest.fixture(scope="module")
def caster(scene: SphereScene) -> RayCaster:
    return RayCaster(scene.reconstruction.surface)


def white(scene: SphereScene) -> Material:
    """Lambert's white on the sphere's own normals."""
    outward = scene.reconstruction.surface.vertices / RADIUS
    return replace(scene.reconstruction.material, normal=outward, albedo=np.ones_like(outward), specular_weight=np.zeros((len(outward), 2)))


def inner(coverage: np.ndarray) -> np.ndarray:
    return coverage == 1


def test_a_uniform_environment_shows_white_as_its_radiance(scene: SphereScene, caster: RayCaster) -> None:
    light = environment_lights(np.full((32, 64, 3), 0.7, np.float32), 256, np.array([0.0, 0.0, 1.0]))
    found, coverage = rendered(caster, white(scene), CAMERA, light, ("image", "shadow"))
    np.testing.assert_allclose(found["image"][inner(coverage)], 0.7, rtol=0.04)
    assert found["shadow"][inner(coverage)].max() < 0.05 and (found["image"][coverage == 0] == 0).all()


@pytest.mark.parametrize("microfacet", [False, True])
def test_a_polished_body_shows_an_environment_and_not_its_lights(scene: SphereScene, caster: RayCaster, microfacet: bool) -> None:
    """256 lights, each as wide as its region, are nearer to sixteen times as many than 256 without a width, which are dots."""
    outward = scene.reconstruction.surface.vertices / RADIUS
    weight = np.full((len(outward), 1), 1.0)
    polished = replace(
        scene.reconstruction.material,
        normal=outward,
        albedo=np.zeros_like(outward),
        specular_weight=weight,
        sharpness=np.array([1000.0]),
        microfacet=microfacet,
    )
    bright = np.linspace(2, 0.5, 64)[:, None, None] * np.ones((64, 128, 3))
    few, many = (environment_lights(bright.astype(np.float32), count, np.array([0.0, 0.0, 1.0])) for count in (256, 4096))
    dots = replace(few, spread=np.zeros(len(few.direction)))
    wanted, wide, narrow = (rendered(caster, polished, CAMERA, light, ("specular",))[0]["specular"][..., 0] for light in (many, few, dots))
    middle = np.s_[16:32, 16:32]
    assert few.spread.min() > 0
    off, off_dots = (np.abs(found - wanted)[middle].mean() / wanted[middle].mean() for found in (wide, narrow))
    assert off < 0.5 * off_dots


def test_pixels_of_the_outline_see_all_of_an_environment(scene: SphereScene, caster: RayCaster, monkeypatch: pytest.MonkeyPatch) -> None:
    sky = np.random.default_rng(1).uniform(0, 2, (16, 32, 3)).astype(np.float32) ** 4
    light = environment_lights(sky, 70, np.array([0.0, 0.0, 1.0]))
    shared, coverage = rendered(caster, scene.reconstruction.material, CAMERA, light, ("image", "specular", "shadow"))
    monkeypatch.setattr(mvps.layers, "MANY_LIGHTS", 1000)
    whole, _ = rendered(caster, scene.reconstruction.material, CAMERA, light, ("image", "specular", "shadow"))
    outline = (coverage > 0) & (coverage < 1)
    for name, values in shared.items():
        np.testing.assert_allclose(values[outline], whole[name][outline], atol=1e-6)
    assert not np.array_equal(shared["image"], whole["image"])
    np.testing.assert_allclose(shared["image"][inner(coverage)].mean(), whole["image"][inner(coverage)].mean(), rtol=0.01)


def test_parts_of_a_picture_join(scene: SphereScene, caster: RayCaster, monkeypatch: pytest.MonkeyPatch) -> None:
    sky = environment_lights(np.random.default_rng(1).uniform(0, 2, (16, 32, 3)).astype(np.float32), 70, np.array([0.0, 0.0, 1.0]))
    point = Illumination(position=np.array([[3 * RADIUS, 0, 0]]), strength=np.full((1, 3), RADIUS**2))
    whole, coverage = rendered(caster, scene.reconstruction.material, CAMERA, sky.with_also(point), LAYERS)
    largest = []
    monkeypatch.setattr(mvps.layers, "PIXELS_AT_A_TIME", 1000)
    monkeypatch.setattr(mvps.layers, "SAMPLES_PER_CHUNK", 5000)
    under = mvps.layers.points_under
    monkeypatch.setattr(mvps.layers, "points_under", lambda *given: largest.append(len(given[-1])) or under(*given))
    parts, also = rendered(caster, scene.reconstruction.material, CAMERA, sky.with_also(point), LAYERS)
    np.testing.assert_array_equal(also, coverage)
    for name, values in whole.items():
        # A processor's wide registers add the rest of an array in another order.
        np.testing.assert_allclose(parts[name], values, rtol=1e-6)
    # Rays on their way at a time: what memory grows with.
    assert len(largest) == 3 and max(largest) == 4000


def test_pixels_are_the_mean_of_their_rays(scene: SphereScene, caster: RayCaster) -> None:
    material = scene.reconstruction.material
    found, coverage = rendered(caster, material, CAMERA, SUN, ("image",))
    fine = Camera(np.diag([2.0, 2, 1]) @ CAMERA.K, CAMERA.rotation, CAMERA.translation, 96, 96)
    every = np.indices((96, 96)).reshape(2, -1).T
    rays = photograph(caster, material, fine, every, SUN.direction, SUN.intensity)[:, 0].reshape(48, 2, 48, 2, 3)
    np.testing.assert_allclose(found["image"] * coverage[..., None], rays.mean((1, 3)), atol=1e-6)
    assert set(np.unique(coverage)) == {0.0, 0.25, 0.5, 0.75, 1.0}


def test_a_far_point_of_light_is_a_directional_one(scene: SphereScene, caster: RayCaster) -> None:
    far = 1e5 * RADIUS
    point = Illumination(position=far * SUN.direction, strength=far**2 * SUN.intensity)
    one, other = (
        rendered(caster, scene.reconstruction.material, CAMERA, light, ("image", "specular", "shadow"))[0] for light in (SUN, point)
    )
    for name in one:
        np.testing.assert_allclose(one[name], other[name], atol=2e-3)


def test_a_point_of_light_falls_off_with_the_square(scene: SphereScene, caster: RayCaster) -> None:
    material = white(scene)
    camera = camera_at(np.array([1.0, 0.0, 0.0]), 49)
    point = Illumination(position=np.array([[3 * RADIUS, 0, 0]]), strength=np.full((1, 3), RADIUS**2))
    middle = rendered(caster, material, camera, point, ("image",))[0]["image"][24, 24]
    np.testing.assert_allclose(middle, 1 / 4, rtol=0.01)


def lidded() -> tuple[RayCaster, Material, Camera]:
    """A ground with a lid above its middle, and a camera above both."""
    ground, lid = [[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], [[-3.0, -3, 4], [3, -3, 4], [3, 3, 4], [-3, 3, 4]]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    surface = Surface(np.array(ground + lid), np.concatenate([faces, faces + 4]))
    plain = Material(np.tile([0.0, 0, 1], (8, 1)), np.ones((8, 3)), np.zeros((8, 0)), np.zeros(0), np.ones(8))
    camera = Camera(np.array([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]), np.diag([1.0, -1, -1]), np.array([0.0, 0, 20]), 40, 40)
    caster = RayCaster(surface)
    caster.__dict__["offset"] = 1e-3
    return caster, plain, camera


def test_what_stands_between_throws_a_shadow_and_what_stands_behind_does_not() -> None:
    caster, plain, camera = lidded()
    shown = []
    for height in (20.0, 2.0):
        light = Illumination(position=np.array([[8.0, 0, height]]), strength=np.full((1, 3), 100.0))
        shown.append(rendered(caster, plain, camera, light, ("shadow",))[0]["shadow"])
    assert shown[0][20, 11] == 1 and shown[1][20, 11] == 0


def test_shadow_is_of_all_light_whichever_ray_takes_the_strong_one() -> None:
    """A sun that the lid hides, which a quarter of the rays take, in a dim sky that nothing hides: of all light the sun's share."""
    caster, plain, camera = lidded()
    sky = np.column_stack([np.full(63, -1.0), np.linspace(-0.1, 0.1, 63), np.full(63, 1.0)])
    direction = np.concatenate([[[8.0, 0, 4]], sky])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    light = Illumination(direction, np.full((64, 3), 0.02) + 5 * np.eye(64, 1))
    shadow = rendered(caster, plain, camera, light, ("shadow",))[0]["shadow"]
    arriving = direction[:, 2] * light.intensity[:, 0]
    assert shadow[20, 8] == pytest.approx(arriving[0] / arriving.sum(), abs=1e-3)


def test_layers_are_what_they_say(scene: SphereScene, caster: RayCaster) -> None:
    found, coverage = rendered(caster, scene.reconstruction.material, CAMERA, SUN, LAYERS)
    on = inner(coverage)
    np.testing.assert_allclose(np.linalg.norm(found["normals"][on], axis=-1), 1, atol=1e-5)
    middle = found["depth"][24, 24]
    assert abs(middle - 360) < 0.5 and found["confidence"][on].min() == 1
    assert (found["specular"] <= found["image"] + 1e-6).all() and found["specular"].max() > 0.01
    lambertian = replace(scene.reconstruction.material, specular_weight=0 * scene.reconstruction.material.specular_weight)
    without = rendered(caster, lambertian, CAMERA, SUN, ("image",))[0]["image"]
    np.testing.assert_allclose(found["image"] - found["specular"], without, atol=1e-6)
    assert set(rendered(caster, lambertian, CAMERA, SUN, ("albedo", "normals"))[0]) == {"albedo", "normals"}


def test_no_light_shows_black(scene: SphereScene, caster: RayCaster) -> None:
    found, _ = rendered(caster, scene.reconstruction.material, CAMERA, Illumination(), ("image", "shadow"))
    assert not found["image"].any() and not found["shadow"].any()
