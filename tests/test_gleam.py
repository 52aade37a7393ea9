"""Inter-reflection by way of lobes: what holds for any lobe, and a lobe as wide as the hemisphere, which is a diffuse surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from numpy.typing import NDArray
from sphere_scene import make_sphere

from mvps.bounce import PATCH_EDGES, gathered, lit_by
from mvps.export import read_reconstruction, write_reconstruction
from mvps.gleam import Senders, coarse_senders, shiny, terms, terms_of_points
from mvps.illumination import Illumination
from mvps.joint.blocks import LOBES_ERROR, DirectionalLights, Vertices, evaluate, robust
from mvps.joint.observe import ViewSamples
from mvps.joint.refine import refine
from mvps.joint.steps import free_reflectance, vertex_step
from mvps.layers import rendered
from mvps.material import LARGEST
from mvps.mesh import angles_deg, normalise, vertex_normals
from mvps.plan import Parts, last_pass
from mvps.rendering import light_arriving, photograph, points_under
from mvps.scene import Camera, Capture, CaptureError, Float, Int, Law, Lights, Material, NormalMap, Surface, Truth, View
from mvps.shading import STEEPEST, returned
from mvps.synthetic.scene import make_scene, render_capture
from mvps.synthetic.settings import SceneSettings
from mvps.texture import bake, pixel_albedo
from mvps.visibility import RayCaster, ray_caster
from solvers.low_rank import CAUCHY_95

WIDE = 1e-6
"""Sharpness of a lobe that is one everywhere."""

EYE = np.array([40.0, 30.0, 60.0])
LIGHTS = np.array([[0.3, 0.2, 0.93], [0.6, -0.5, 0.62]])
LIGHTS /= np.linalg.norm(LIGHTS, axis=1, keepdims=True)


def corner() -> Surface:
    """Two plates at a right angle, lit from above and from one side."""
    plates = []
    for turn in (0.0, np.pi / 2):
        plate = trimesh.creation.box((20, 20, 0.5))
        for _ in range(4):
            plate = plate.subdivide()
        plate.apply_translation([10.3, 0, 0])
        plate.apply_transform(trimesh.transformations.rotation_matrix(-turn, [0, 1, 0]))
        plates.append(plate)
    both = trimesh.util.concatenate(plates)
    return Surface(np.array(both.vertices), np.array(both.faces))


def made_of(surface: Surface, albedo: float, weights: tuple[float, ...], sharpness: tuple[float, ...], **law: float) -> Material:
    count = len(surface.vertices)
    grey = np.full((count, 3), albedo)
    of_lobes = np.tile(weights, (count, 1)), np.array(sharpness)
    return Material(vertex_normals(surface), grey, *of_lobes, np.ones(count), **law)  # type: ignore[arg-type]


def looking_at_origin() -> Camera:
    """A camera at EYE."""
    forward = -EYE / np.linalg.norm(EYE)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(np.array([[150.0, 0, 32], [0, 150, 32], [0, 0, 1]]), rotation, -rotation @ EYE, 64, 64)


def every_patch(sent: Senders) -> Int:
    return np.arange(len(sent.sources.of.normal))


def on_all(sent: Senders) -> NDArray[np.float32]:
    """G on all patches."""
    return terms(sent, LIGHTS, EYE).on(every_patch(sent))


@pytest.fixture
def ungained(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Lobes without what microfacets gain where light and view part."""
    with monkeypatch.context() as patch:
        patch.setattr("mvps.shading.STEEPEST", 1.0)
        returned.cache_clear()
        yield
    returned.cache_clear()


@pytest.fixture
def patches_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Patches of lobed surfaces as large as those of diffuse ones."""
    monkeypatch.setattr("mvps.gleam.LOBES_PATCH_EDGES", PATCH_EDGES)
    monkeypatch.setattr("mvps.gleam.SHELTERED_EDGES", PATCH_EDGES)


@pytest.mark.usefixtures("ungained", "patches_alike")
def test_a_lobe_as_wide_as_the_hemisphere_sends_and_takes_what_a_diffuse_surface_does() -> None:
    surface = corner()
    diffuse = coarse_senders(surface, made_of(surface, 0.5, (), (), bounce=0.8), grey=True)
    lobed = coarse_senders(surface, made_of(surface, 0.0, (0.5,), (WIDE,), gleam=0.8), grey=True)
    assert diffuse is not None and lobed is not None
    G, by_lobes = on_all(diffuse), on_all(lobed)
    assert G.shape[2] == 1 and by_lobes.shape[2] == 3 and G.max() > 0.05
    assert np.abs(by_lobes[:, :, 0]).max() == 0
    for k in (1, 2):
        assert np.allclose(by_lobes[:, :, k], G[:, :, 0], atol=1e-5)


@pytest.mark.usefixtures("ungained", "patches_alike")
def test_albedo_and_lobes_share_what_is_sent() -> None:
    """Half of the reflectance as albedo, half as a lobe: all together is what it was; the part of albedo alone has only its own bounces."""
    surface = corner()
    whole = coarse_senders(surface, made_of(surface, 0.5, (), (), bounce=0.8), grey=True)
    halves = coarse_senders(surface, made_of(surface, 0.25, (0.25,), (WIDE,), bounce=0.8, gleam=0.8), grey=True)
    assert whole is not None and halves is not None
    G, parts = on_all(whole)[:, :, 0], on_all(halves)
    assert np.allclose(parts[:, :, 0] + parts[:, :, 1], G, atol=1e-5) and np.allclose(parts[:, :, 2], G, atol=1e-5)
    assert np.allclose(parts[:, :, 0], gathered(halves.sources, lit_by(halves.sources.of, LIGHTS), 0.8))


@pytest.mark.usefixtures("ungained", "patches_alike")
def test_photographs_and_textures_of_a_wide_lobe_are_those_of_a_diffuse_surface() -> None:
    surface = corner()
    matt, lobed = made_of(surface, 0.5, (), (), bounce=0.8), made_of(surface, 0.0, (0.5,), (WIDE,), gleam=0.8)
    camera = looking_at_origin()
    caster, pixels = ray_caster(surface), np.argwhere(np.ones((64, 64), bool))
    both = []
    for material in (matt, lobed):
        arriving = light_arriving(coarse_senders(surface, material), LIGHTS, camera.centre)
        both.append(photograph(caster, material, camera, pixels, LIGHTS, np.ones((2, 3)), arriving))
        plain = photograph(caster, material, camera, pixels, LIGHTS, np.ones((2, 3)))
        assert (both[-1] - plain).max() > 0.02
    assert np.allclose(*both, atol=1e-5) and both[0].max() > 0.1


def test_a_body_without_hollows_sends_itself_nothing() -> None:
    made = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    surface = Surface(np.array(made.vertices), np.array(made.faces))
    sent = coarse_senders(surface, made_of(surface, 0.1, (0.5, 0.3), (10.0, 90.0), bounce=1.0, gleam=1.0))
    assert sent is not None
    assert np.abs(on_all(sent)).max() == 0


@pytest.mark.parametrize("channels", [1, 3])
def test_patches_that_are_asked_for_one_after_the_other_get_what_they_do_together(channels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    surface = corner()
    sent = coarse_senders(surface, made_of(surface, 0.3, (0.5, 0.2), (10.0, 60.0), bounce=0.7, gleam=0.9), grey=channels == 1)
    assert sent is not None
    together, generator = on_all(sent), np.random.default_rng(0)
    assert together.shape[3:] == ((3,) if channels == 3 else ()) and together[:, :, 2:].max() > 0
    monkeypatch.setattr("mvps.gleam.SAMPLES_PER_CHUNK", 500)
    one_by_one = terms(sent, LIGHTS, EYE)
    for some in np.array_split(generator.permutation(every_patch(sent)), 5):
        assert np.array_equal(one_by_one.on(some), together[some])
    assert np.array_equal(one_by_one.on(every_patch(sent)), together)


def test_sharp_lobes_send_to_the_mirror_direction() -> None:
    """Light that comes down on the floor at 45 degrees, away from the wall or towards it: mirrors send to the wall only the latter."""
    surface = corner()
    sent = coarse_senders(surface, made_of(surface, 0.0, (1.0,), (60.0,), gleam=1.0), grey=True)
    assert sent is not None
    of = sent.sources.of
    wall = (of.normal[:, 0] > 0.9) & (of.caster.surface.vertices[of.vertex, 2] > 2)
    # Along the wall's own plane and away from the wall: neither lights the wall itself.
    lights = np.array([[1.0, 0, 1], [-1e-3, 0, 1]]) / np.sqrt([[2.0], [1.0]])
    G = terms(sent, lights, EYE).on(np.flatnonzero(wall))[:, :, 1]
    assert G[:, 0].mean() > 3 * G[:, 1].mean() > 0


@pytest.mark.usefixtures("patches_alike")
def test_the_gain_at_grazing_angles_is_bounded() -> None:
    surface = corner()
    material = made_of(surface, 0.0, (1.0,), (WIDE,), gleam=1e-9)
    sent = coarse_senders(surface, material, grey=True)
    plain = coarse_senders(surface, made_of(surface, 1.0, (), (), bounce=1e-9), grey=True)
    assert sent is not None and plain is not None
    once, twice = on_all(sent)[:, :, 1], on_all(plain)[:, :, 0]
    once, twice = once[twice > 0.01], twice[twice > 0.01]
    assert (once >= 0.999 * twice).all() and (once <= 1.001 * STEEPEST * twice).all() and once.mean() > 1.2 * twice.mean()


@pytest.mark.parametrize("gleam", [0.0, 0.9])
def test_far_points_of_light_send_on_what_lights_do_and_near_ones_fall_off(gleam: float) -> None:
    surface = corner()
    sent = coarse_senders(surface, made_of(surface, 0.4, (0.5,), (20.0,), bounce=0.9, gleam=gleam), grey=True)
    assert sent is not None
    far = 1e5
    G, every = on_all(sent), every_patch(sent)
    by_points = terms_of_points(sent, far * LIGHTS, EYE).on(every)
    assert G.max() > 0.02 and np.allclose(far**2 * by_points, G, atol=2e-3 * G.max())
    # From the corner's own edge on, light reaches both plates alike, and a point twice as far a quarter of it.
    near, twice = (terms_of_points(sent, np.array([[d, 0.0, d]]), EYE).on(every)[:, 0, 0].max() for d in (400.0, 800.0))
    assert 3.6 < near / twice < 4.4


def test_pictures_by_a_far_point_hold_what_surfaces_send_as_those_by_a_light_do() -> None:
    surface, camera, far = corner(), looking_at_origin(), 1e5
    caster, material = ray_caster(surface), made_of(surface, 0.4, (0.5,), (20.0,), bounce=0.9, gleam=0.9)
    sent, strength = coarse_senders(surface, material), np.ones((2, 3))
    lamps, points = Illumination(LIGHTS, strength), Illumination(position=far * LIGHTS, strength=far**2 * strength)

    def shown(light: Illumination, senders: Senders | None) -> NDArray[np.float32]:
        return rendered(caster, material, camera, light, ["image"], senders)[0]["image"]

    by_points = shown(points, sent)
    assert np.abs(by_points - shown(lamps, sent)).mean() < 1e-3 * by_points.mean()
    assert (by_points - shown(points, None)).max() > 0.02


def test_lobes_count_where_they_return_a_quarter() -> None:
    law, albedo = Law((WIDE,)), np.full(5, 0.75)
    quarter = np.full((5, 1), 0.25 / returned(law.sharpness, False)[1])
    assert shiny(law, albedo, 1.01 * quarter) and not shiny(law, albedo, 0.99 * quarter)
    assert not shiny(Law(()), albedo, np.zeros((5, 0)))
    assert not shiny(law, np.zeros(5), np.zeros((5, 1)))
    # What no view shows does not count.
    unseen = np.zeros(7)
    assert shiny(law, np.append(albedo, unseen), np.append(1.01 * quarter, unseen[:, None], 0))


def test_colours_of_lobes_are_sent_channel_by_channel() -> None:
    surface = corner()
    material = made_of(surface, 0.0, (0.4,), (20.0,), gleam=1e-9)
    tinted = replace(material, specular_weight=material.specular_weight[..., None] * (1.0, 0.5, 0.25))
    sent = coarse_senders(surface, tinted)
    assert sent is not None
    G = on_all(sent)
    assert G.shape[-1] == 3 and np.allclose(G[..., 1], G[..., 0] / 2, atol=1e-6) and np.allclose(G[..., 2], G[..., 0] / 4, atol=1e-6)


def test_albedo_of_texels_is_what_lobes_leave() -> None:
    """A photograph with light by way of lobes: the albedo comes back only where that light is taken off."""
    surface = corner()
    material = made_of(surface, 0.3, (0.4,), (20.0,), bounce=0.5, gleam=0.8)
    camera = looking_at_origin()
    caster = ray_caster(surface)
    arriving = light_arriving(coarse_senders(surface, material), LIGHTS, camera.centre)
    every = np.argwhere(np.ones((64, 64), bool))
    mask = points_under(caster, material, camera, every).hit.reshape(64, 64)
    image = photograph(caster, material, camera, np.argwhere(mask), LIGHTS, np.ones((2, 3)), arriving)
    scale = float(image.max()) / 60000
    view = View("view_01", camera, mask, np.rint(image / scale).astype(np.uint16), scale, 65535, (1, 2))
    for given, near in ((arriving, True), (None, False)):
        _, albedo, known = pixel_albedo(caster, material, view, LIGHTS, np.ones((2, 3)), given)
        error = np.abs(albedo[known] - 0.3).max()
        assert (error < 1e-3) == near


def metal(settings: SceneSettings) -> tuple[Capture, Truth, float]:
    """A made object of lobes alone, in the light that these send each other; and how strong that is."""
    scene = make_scene(settings)
    count, sharpness = len(scene.surface.vertices), np.array([10.0, 40.0])
    weight = np.tile([0.5, 0.8], (count, 1))
    # So that every point returns nine tenths of what it receives.
    strength = 0.9 / float(weight[0] @ returned(tuple(sharpness), False)[1:])
    material = replace(scene.material, albedo=np.zeros((count, 3)), specular_weight=weight, sharpness=sharpness, gleam=strength)
    sent = coarse_senders(scene.surface, material)

    def take(caster: RayCaster, _: Material, camera: Camera, pixels: Int, direction: Float, intensity: Float) -> NDArray[np.float32]:
        return photograph(caster, material, camera, pixels, direction, intensity, light_arriving(sent, direction, camera.centre))

    return *render_capture(settings, replace(scene, material=material), take), material.gleam


def test_light_between_metals_is_found_and_normals_are_better_with_it() -> None:
    """On the true surface, from true lights and normals."""
    capture, truth, strength = metal(SceneSettings(views=6, lights=10, size=80))
    lights = Lights(tuple(truth.direction.values()), tuple(truth.intensity.values()), True)
    normals = [truth.normals[view.name][view.mask].astype(float) for view in capture.views]
    maps = tuple(NormalMap(normalise(n), np.full((len(n), 3), 0.1), np.ones(len(n))) for n in normals)  # type: ignore[arg-type]
    errors = []
    for model in (LARGEST, replace(LARGEST, gleam=False)):
        parts = Parts(model, moves=False)
        plan = parts.of(last_pass("standard", True, False, [{"goes_on": 0.0}]))
        assert truth.surface is not None
        refined = refine(capture, truth.surface, lights, maps, parts.law(), plan, 0, torch.device("cpu"), lambda *_: None)
        errors.append(np.mean([angles_deg(true, found.normal).mean() for true, found in zip(normals, refined.maps, strict=True)]))
        kept = [trial.kept for trial in refined.trials if trial.name == "inter-reflection of lobes"]
        assert kept == [True] * model.gleam
        if model.gleam:
            assert strength / 2 < refined.law.gleam < 1.2 * strength
        else:
            assert refined.law.gleam == 0
    assert errors[0] < 0.97 * errors[1]


def test_a_result_without_gleam_is_one_whose_lobes_send_each_other_nothing(tmp_path: Path) -> None:
    """The other values of the whole object must be there."""
    scene = make_sphere(subdivisions=2)
    r = scene.reconstruction
    write_reconstruction(r, tmp_path / "result", bake(r.surface, r.material, r.lights, scene.capture, 1)[0])
    path = tmp_path / "result" / "material.npz"
    with np.load(path) as arrays:
        kept = dict(arrays)
    del kept["gleam"]
    np.savez(path, **kept)
    assert read_reconstruction(tmp_path / "result").material.gleam == 0
    del kept["bounce"]
    np.savez(path, **kept)
    with pytest.raises(CaptureError, match="bounce"):
        read_reconstruction(tmp_path / "result")


def test_what_lobes_send_is_as_unsure_as_it_is_strong() -> None:
    """A sample that holds as much of it as its vertex's residuals are large counts half; diffuse light changes no weight."""
    residual, scale = torch.tensor([[0.0, 0.02]]), torch.tensor([0.01])
    plain = robust(residual, scale, None)
    assert torch.allclose(plain, 1 / (1 + (residual / (CAUCHY_95 * 0.01)) ** 2))
    assert torch.allclose(robust(residual, scale, torch.full((1, 2), 0.01)), 1 / (1 / plain + 1))
    normal, lights = torch.tensor([[0.0, 0.0, 1.0]]), DirectionalLights(torch.tensor([[0.0, 0.6, 0.8]]), torch.tensor([2.0]))
    law, reflectance = Law((20.0,), 0.0, 0.7, gleam=0.5), torch.tensor([[0.4, 0.3]])
    diffuse = evaluate(normal, reflectance, normal, lights, law, torch.tensor([[[0.1]]]))
    lobed = evaluate(normal, reflectance, normal, lights, law, torch.tensor([[[0.1, 0.2, 0.3]]]))
    assert diffuse.unsure is None and lobed.unsure is not None
    assert torch.allclose(lobed.unsure, LOBES_ERROR * 0.5 * 2.0 * torch.tensor([[0.4 * 0.2 + 0.3 * 0.3]]))


def test_normals_hold_where_lobes_send_other_light_than_is_thought(monkeypatch: pytest.MonkeyPatch) -> None:
    """Walls whose shape is not yet right send half of what they will: samples that they hardly reach say what the normals are."""
    g = torch.Generator().manual_seed(5)
    n, count, law = 200, 16, Law((10.0,), 0.0, 0.0, gleam=1.0)

    def units(many: int, centre: tuple[float, float, float], spread: float) -> torch.Tensor:
        return torch.nn.functional.normalize(torch.tensor(centre) + spread * torch.randn(many, 3, generator=g), dim=1)

    lights = [DirectionalLights(units(count, (0, 0, 1), 0.5), torch.ones(count))]
    normal, towards = units(n, (0, 0, 1), 0.3), units(n, (0, 0, 1), 0.1)
    reflectance = torch.tensor([[0.05, 0.5]]).repeat(n, 1)
    # Of every second light nothing arrives by way of others.
    sent = torch.rand(n, count, 3, generator=g) * torch.tensor([0.0, 1.0])[torch.arange(count) % 2][:, None] * 0.3
    image = evaluate(normal, reflectance, towards, lights[0], law, sent).predicted
    every = torch.ones(n, count, dtype=torch.bool)
    samples = [ViewSamples(torch.arange(n), towards, torch.ones(n), image, every, sent / 2)]

    def off(error: float) -> float:
        monkeypatch.setattr("mvps.joint.blocks.LOBES_ERROR", error)
        state = Vertices(normal, reflectance, torch.full((n,), 0.05))
        for _ in range(10):
            state = vertex_step(samples, state, lights, law, free_reflectance(normal, 1.0, 2))
        return float(angles_deg(state.normal.numpy(), normal.numpy()).mean())

    assert off(1.0) < 0.5 * off(0.0) and off(0.0) > 1
