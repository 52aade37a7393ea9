"""Stage II's blocks: derivatives by situation, steps that stay at the truth and come back to it, geometry that fuses."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from references import in_patches
from sphere_scene import RADIUS, SphereScene, make_sphere

from mvps.joint import vertices
from mvps.joint.agreement import Agreement, agreement
from mvps.joint.blocks import DirectionalLights, Vertices, evaluate, tangents, vertex_equations
from mvps.joint.choosing import TRIAL_VERTICES, errors_of
from mvps.joint.grey import grey_lights
from mvps.joint.lighting import LIGHT_VERTICES, of_one_normal
from mvps.joint.lights import light_step, with_mean_one
from mvps.joint.observe import SHADOW_MARGIN, ViewSamples, observe
from mvps.joint.patches import drawn_patches
from mvps.joint.pixels import _beside, all_pixel_normals, filled
from mvps.joint.reflectance import Observed
from mvps.joint.shown import OWN_SHARE
from mvps.joint.state import State
from mvps.joint.stated import scatter, stated_errors
from mvps.joint.steps import LEAST_NOISE, SCALE_FLOOR, _least_scale, free_reflectance, possible, vertex_step, with_population
from mvps.joint.thinned import ENOUGH_LIGHTS, ENOUGH_PHOTOGRAPHS, abundant, thinned
from mvps.joint.vertices import fuse
from mvps.material import Model
from mvps.mesh import face_normals, isotropic_remesh, normalise, vertex_normals
from mvps.scene import Capture, Law, Lights, Material, NormalMap, Surface

CPU = torch.device("cpu")


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def test_tangents_complete_a_frame_everywhere() -> None:
    normals = normalise(np.random.default_rng(0).normal(size=(500, 3)))
    normals[:3] = [(0, 0, 1), (0, 0, -1), (1, 0, 0)]
    n = torch.tensor(normals)
    first, second = tangents(n)
    assert torch.allclose(torch.linalg.cross(first, second), n, atol=1e-12)


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(subdivisions=4)


def problem(scene: SphereScene) -> tuple:
    """Samples, true vertices, true lights and law of the sphere."""
    reconstruction = scene.reconstruction
    views = observe(scene.capture, reconstruction.surface, reconstruction.lights, CPU)
    material = reconstruction.material
    values = np.column_stack([material.albedo.mean(1), material.specular_weight])
    normal, reflectance = (torch.tensor(a, dtype=torch.float32) for a in (material.normal, values))
    vertices = Vertices(normal, reflectance, torch.full((len(values),), 0.01))
    return views, vertices, grey_lights(reconstruction.lights, CPU), material.law


def test_vertices_find_normals_and_reflectance_from_the_meshs_normals(scene: SphereScene) -> None:
    views, truth, lights, law = problem(scene)
    mesh_normal = torch.tensor(vertex_normals(scene.reconstruction.surface), dtype=torch.float32)
    state = Vertices(mesh_normal, torch.tensor([[0.4, 0.0, 0.0]]).repeat(len(mesh_normal), 1), torch.full((len(mesh_normal),), 0.4))
    anchor = free_reflectance(mesh_normal, 0.3, 3)
    for _ in range(12):
        state = vertex_step(views, state, lights, law, anchor)
    before = degrees(mesh_normal.numpy(), truth.normal.numpy())
    after = degrees(state.normal.numpy(), truth.normal.numpy())
    assert np.median(after) < 0.5 < 0.2 * np.median(before) + 0.5 and np.median(after) < 0.2 * np.median(before)
    # The seam between the two colours is mixed by interpolation; away from it the albedo is what was rendered.
    away = np.abs(scene.reconstruction.surface.vertices[:, 0]) > 5
    assert np.median(np.abs(state.reflectance[:, 0] - truth.reflectance[:, 0]).numpy()[away]) < 0.02


@pytest.mark.parametrize("lobes", [0.0, 8.0])
def test_an_albedo_that_no_surface_has_is_taken_to_be_the_usual_one(lobes: float) -> None:
    """White on black may be ninety times as bright, a thousand times nothing is; what metals return by lobes counts as well."""
    albedo = torch.tensor([0.01] * 9 + [0.9, 10.0, 2e6])
    reflectance = torch.stack([albedo, torch.full_like(albedo, lobes)], 1)
    said = torch.ones_like(reflectance)
    said[8] = 0
    found = possible(Vertices(torch.zeros(12, 3), reflectance, albedo, said=said), Law((32.0,))).reflectance
    assert torch.equal(found[:10], reflectance[:10]) and torch.equal(found[:, 1], reflectance[:, 1])
    assert found[11, 0] == np.float32(0.01) and found[10, 0] == np.float32(10.0 if lobes else 0.01)


def test_normal_equations_do_not_depend_on_which_thread_was_faster(scene: SphereScene) -> None:
    views, truth, lights, law = problem(scene)
    first, second = (vertex_equations(views, truth, lights, law).hessian for _ in range(2))
    assert torch.equal(first, second)


def turned(lights: list[DirectionalLights], by: float) -> list[DirectionalLights]:
    """All lights turned by `by` degrees about random axes."""
    generator = torch.Generator().manual_seed(0)
    out = []
    for of_view in lights:
        aside = torch.linalg.cross(of_view.direction, torch.randn(of_view.direction.shape, generator=generator))
        aside = torch.nn.functional.normalize(aside, dim=1) * np.tan(np.radians(by))
        out.append(DirectionalLights(torch.nn.functional.normalize(of_view.direction + aside, dim=1), of_view.intensity))
    return out


def light_error(lights: list[DirectionalLights], truth: list[DirectionalLights]) -> float:
    return float(np.mean([degrees(a.direction.numpy(), b.direction.numpy()).mean() for a, b in zip(lights, truth, strict=True)]))


@pytest.mark.parametrize("one_rig", [True, False])
@pytest.mark.parametrize("start", [0.0, 5.0])
def test_lights_stay_at_the_truth_and_come_back_to_it(scene: SphereScene, start: float, one_rig: bool) -> None:
    views, vertices, truth, law = problem(scene)
    rotations_ = [torch.tensor(view.camera.rotation, dtype=torch.float32) for view in scene.capture.views]
    lights = turned(truth, start)
    if one_rig:
        lights = [
            DirectionalLights(lights[0].direction @ rotations_[0].T @ r, of_view.intensity)
            for r, of_view in zip(rotations_, truth, strict=True)
        ]
    # The anchor is the smooth sphere: true on average, some degrees off at every vertex.
    anchor = free_reflectance(torch.tensor(vertex_normals(scene.reconstruction.surface), dtype=torch.float32), 0.3, 3)
    views, vertices, anchor, patches = in_patches(scene.reconstruction.surface, views, vertices, anchor)
    for _ in range(8):
        lights, law = light_step(views, vertices, lights, law, anchor, patches, rotations_, one_rig)
        lights, vertices = with_mean_one(lights, vertices)
        for _ in range(2):
            vertices = vertex_step(views, vertices, lights, law, anchor, patches=patches)
    assert light_error(lights, truth) < 0.5


def test_light_step_is_finite_with_a_single_light(scene: SphereScene) -> None:
    views, vertices, truth, law = problem(scene)
    few = [replace(s, image=s.image[:, :1], data=s.data[:, :1]) for s in views]
    lights = [DirectionalLights(of_view.direction[:1], of_view.intensity[:1]) for of_view in truth]
    rotations_ = [torch.tensor(view.camera.rotation, dtype=torch.float32) for view in scene.capture.views]
    few, vertices, anchor, patches = in_patches(scene.reconstruction.surface, few, vertices, free_reflectance(vertices.normal, 0.05, 3))
    stepped, _ = light_step(few, vertices, lights, law, anchor, patches, rotations_, True)
    assert all(torch.isfinite(of_view.direction).all() and torch.isfinite(of_view.intensity).all() for of_view in stepped)
    state = vertex_step(few, vertices, lights, law, anchor)
    assert torch.isfinite(state.normal).all() and torch.isfinite(state.reflectance).all() and (state.reflectance >= 0).all()


def test_pixels_keep_the_normals_that_explain_them(scene: SphereScene) -> None:
    reconstruction = scene.reconstruction
    maps = all_pixel_normals(scene.capture, reconstruction.surface, reconstruction.material, reconstruction.lights, None, CPU)
    errors = [
        degrees(m.normal, truth[view.mask]) for m, truth, view in zip(maps, reconstruction.normal_maps, scene.capture.views, strict=True)
    ]
    assert np.median(np.concatenate(errors)) < 0.5
    smooth = Material(
        vertex_normals(reconstruction.surface),
        *(getattr(reconstruction.material, k) for k in ("albedo", "specular_weight", "sharpness", "confidence")),
    )
    again = all_pixel_normals(scene.capture, reconstruction.surface, smooth, reconstruction.lights, None, CPU)
    errors = [
        degrees(m.normal, truth[view.mask]) for m, truth, view in zip(again, reconstruction.normal_maps, scene.capture.views, strict=True)
    ]
    assert np.median(np.concatenate(errors)) < 1.0


def test_pixels_beside_a_shadow_are_those_within_two_of_one_in_it(scene: SphereScene) -> None:
    view = scene.capture.views[0]
    rng = np.random.default_rng(0)
    rows = np.sort(rng.permutation(len(view.pixels))[: len(view.pixels) // 2])
    shadow = rng.random((len(rows), 3)) < 0.01
    place = view.pixels[rows]
    apart = ((place[:, None] - place[None]) ** 2).sum(2)
    slow = np.stack([(apart[:, of_light] < (SHADOW_MARGIN + 0.5) ** 2).any(1) for of_light in shadow.T], 1)
    assert np.array_equal(_beside(view, rows, shadow), slow) and shadow.sum() < slow.sum() < slow.size


def test_pixels_between_solved_ones_take_what_these_differ_by_from_the_vertices(scene: SphereScene) -> None:
    reconstruction, view = scene.reconstruction, scene.capture.views[0]
    true = reconstruction.normal_maps[0][view.mask]
    known = np.isfinite(true).all(1)
    true = np.where(known[:, None], true, (0.0, 0.0, 1.0)).astype(np.float32)
    # Vertices are off by as much everywhere: the difference is known at once.
    rough = true + np.array([0.1, -0.05, 0.02])
    even = view.pixels.sum(1) % 2 == 0
    maps = NormalMap(np.where(even[:, None], true, (1.0, 0.0, 0.0)), np.ones((len(true), 3)), even.astype(np.float32))
    result = filled(view, maps, rough)
    rows, columns = np.indices(view.mask.shape)
    solved = np.pad(view.mask & ((rows + columns) % 2 == 0), 1)
    around = (solved[:-2, 1:-1] | solved[2:, 1:-1] | solved[1:-1, :-2] | solved[1:-1, 2:])[view.mask]
    assert np.array_equal(result[even], maps.normal[even])
    assert np.allclose(result[~even & around], true[~even & around], atol=1e-6)
    assert np.allclose(result[~even & ~around], normalise(rough)[~even & ~around])


def test_every_other_pixel_leaves_the_others_to_be_filled(scene: SphereScene) -> None:
    r, capture = scene.reconstruction, scene.capture
    halves = all_pixel_normals(capture, r.surface, r.material, r.lights, None, CPU, every_other=True)
    for view, maps, truth in zip(capture.views, halves, r.normal_maps, strict=True):
        solved = maps.confidence > 0
        assert not solved[view.pixels.sum(1) % 2 == 1].any() and solved.mean() > 0.4
        errors = degrees(filled(view, maps, truth[view.mask])[~solved], truth[view.mask][~solved])
        assert np.nanmedian(errors) < 0.5


def test_smallest_rotations_turn_source_to_target() -> None:
    rng = np.random.default_rng(1)
    source, target = (normalise(rng.normal(size=(100, 3))) for _ in range(2))
    target = np.where((source * target).sum(1, keepdims=True) < -0.9, -target, target)
    assert np.allclose(vertices.turned(source, target, source), target)
    columns = [vertices.turned(source, target, np.tile(axis, (100, 1))) for axis in np.eye(3)]
    assert np.allclose(np.linalg.det(np.stack(columns, -1)), 1)


def test_divergence_of_unturned_faces_is_that_of_the_positions() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    surface = Surface(np.array(ball.vertices) * (1, 2, 3), np.array(ball.faces))
    even = np.ones(len(surface.faces))
    divergence, laplacian = vertices._turned_divergence(surface, face_normals(surface), even), vertices._laplacian(surface, even)
    assert abs(laplacian + igl.cotmatrix(surface.vertices, surface.faces)).max() < 1e-12
    assert np.allclose(divergence, laplacian @ surface.vertices)
    uneven = np.random.default_rng(0).uniform(0.1, 10, len(surface.faces))
    divergence, laplacian = vertices._turned_divergence(surface, face_normals(surface), uneven), vertices._laplacian(surface, uneven)
    assert np.allclose(divergence, laplacian @ surface.vertices)


def test_views_agree_where_the_surface_is(scene: SphereScene) -> None:
    reconstruction = scene.reconstruction
    maps = all_pixel_normals(scene.capture, reconstruction.surface, reconstruction.material, reconstruction.lights, None, CPU)
    inside = isotropic_remesh(Surface(reconstruction.surface.vertices * 0.98, reconstruction.surface.faces), 1.0)
    from mvps.joint.observe import visible_in

    seen = [index for index, _ in visible_in(scene.capture, inside)]
    agreed = agreement(scene.capture, inside, maps, seen, np.arange(-2.0, 2.01, 0.25))
    told = np.isfinite(agreed.sigma) & (agreed.sigma < 0.5)
    assert told.sum() > 100 and abs(np.median(agreed.offset[told]) - 0.02 * RADIUS) < 0.15


def test_fusing_true_normals_and_positions_mends_a_dented_sphere() -> None:
    ball = make_sphere(4).reconstruction.surface
    outward = normalise(ball.vertices)
    dents = np.random.default_rng(2).normal(0, 0.2, len(outward))
    dented = Surface(ball.vertices + dents[:, None] * outward, ball.faces)
    offset = RADIUS - np.linalg.norm(dented.vertices, axis=1)
    sigma = np.full(len(outward), 0.1)
    # A tenth of the positions are wrong, a tenth unknown.
    offset[::10], sigma[5::10] = 3.0, np.inf
    mended = fuse(dented, normalise(outward[dented.faces].sum(1)), Agreement(offset, sigma), 0.02)[0]
    error = np.abs(np.linalg.norm(mended.vertices, axis=1) - RADIUS)
    assert error.mean() < 0.3 * np.abs(dents).mean()


def test_what_is_no_number_moves_nothing_and_the_rest_moves() -> None:
    ball = make_sphere(3).reconstruction.surface
    target = normalise(normalise(ball.vertices)[ball.faces].sum(1))
    target[7] = np.nan
    agreed = Agreement(np.ones(len(ball.vertices)), np.full(len(ball.vertices), 0.1))
    agreed.offset[3] = agreed.sigma[50] = np.nan
    grown = np.linalg.norm(fuse(ball, target, agreed, 0.02)[0].vertices, axis=1)
    assert np.abs(grown - RADIUS - 1).mean() < 0.1


def test_a_face_without_area_takes_no_part() -> None:
    """Its cotangents are no numbers, and one of them in the system would leave no surface at all."""
    ball = make_sphere(3).reconstruction.surface
    edge = ball.faces[0]
    middle = ball.vertices[edge[:2]].mean(0)
    with_sliver = Surface(np.vstack([ball.vertices, middle]), np.vstack([ball.faces, [edge[0], edge[1], len(ball.vertices)]]))
    outward = normalise(with_sliver.vertices)
    agreed = Agreement(np.full(len(outward), 0.1), np.full(len(outward), 0.01))
    target = normalise(outward[with_sliver.faces].sum(1))
    moved = fuse(with_sliver, target, agreed, 0.02)[0].vertices
    plain = fuse(ball, target[:-1], Agreement(agreed.offset[:-1], agreed.sigma[:-1]), 0.02)[0].vertices
    assert np.abs(moved[:-1] - plain).max() < 1e-2 and np.isfinite(moved).all()


def test_pixels_of_a_fold_show_more_than_one_normal() -> None:
    """In any unit: a sphere of 20 pixels radius bends by a twentieth of a radian in a pixel. What is within half a pixel is not seen."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=20.0)
    for unit in (1.0, 1e-3):
        surface = Surface(np.array(ball.vertices) * unit, np.array(ball.faces))
        normal = torch.tensor(vertex_normals(surface), dtype=torch.float32)
        found, coarse = (of_one_normal(surface, normal, pixel * unit, 128.0) for pixel in (1.0, 100.0))
        assert torch.allclose(found, torch.tensor(1 / (1 + 128 / 20**2)), rtol=0.01)
        assert coarse.mean() > 5 / (1 + 128 * 5**2)


DEGENERATE = {
    "one light": lambda s: replace(s, data=s.data & (torch.arange(s.image.shape[1]) == 0)),
    "lights in a row": lambda s: replace(s, data=s.data & (torch.arange(s.image.shape[1]) < 2)),
    "all saturated": lambda s: replace(s, data=torch.zeros_like(s.data)),
    "black": lambda s: replace(s, image=torch.zeros_like(s.image)),
}


@pytest.mark.parametrize("case", DEGENERATE)
def test_steps_of_rank_deficient_problems_are_finite(scene: SphereScene, case: str) -> None:
    """Also of vertices that a single view sees."""
    views, truth, lights, law = problem(scene)
    few = [DEGENERATE[case](s) for s in views[:1]]
    anchor = free_reflectance(truth.normal, 0.3, 3)
    state = Vertices(truth.normal, truth.reflectance, truth.scale)
    for _ in range(4):
        state = vertex_step(few, state, lights[:1], law, anchor)
        assert all(torch.isfinite(t).all() for t in (state.normal, state.reflectance, state.scale)) and (state.reflectance >= 0).all()
        assert torch.allclose(state.normal.norm(dim=1), torch.tensor(1.0), atol=1e-5)
    told = scatter(Observed(scene.capture, scene.reconstruction.surface, few, state, lights[:1], law), 0.01)
    certain = stated_errors(told, state.normal.double().numpy(), scene.reconstruction.surface, OWN_SHARE, 0.3)
    assert (certain >= 0).all() and (certain <= 1).all()
    few, state, anchor, patches = in_patches(scene.reconstruction.surface, few, state, anchor)
    state = vertex_step(few, state, lights[:1], law, anchor, patches=patches)
    assert all(torch.isfinite(t).all() for t in (state.normal, state.reflectance, state.scale))
    rotation = [torch.tensor(scene.capture.views[0].camera.rotation, dtype=torch.float32)]
    stepped, _ = light_step(few, state, lights[:1], law, anchor, patches, rotation, False)
    assert torch.isfinite(stepped[0].direction).all() and torch.isfinite(stepped[0].intensity).all()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 0.3), st.floats(0.0, 0.2))
def test_vertex_steps_never_worsen_random_problems(seed: int, turn: float, noise: float) -> None:
    """Two dozen vertices of random reflectance under random lights: after a few steps they explain the samples no worse than before."""
    g = torch.Generator().manual_seed(seed)

    def units(n: int, centre: tuple[float, float, float]) -> torch.Tensor:
        return torch.nn.functional.normalize(torch.tensor(centre) + 0.6 * torch.randn(n, 3, generator=g), dim=1)

    n, count = 24, 10
    lights = [DirectionalLights(units(count, (0, 0, 1)), 0.5 + torch.rand(count, generator=g))]
    normal, towards = units(n, (0, 0, 1.5)), units(n, (0, 0, 3))
    reflectance = torch.rand(n, 2, generator=g) * torch.tensor([1.0, 0.5])
    law = Law((20.0,), 0.1, 0.0)
    image = evaluate(normal, reflectance, towards, lights[0], law).predicted
    image = (image + noise * image.mean() * torch.randn(n, count, generator=g)).clamp_min(0)
    samples = [ViewSamples(torch.arange(n), towards, torch.ones(n), image, torch.ones(n, count, dtype=torch.bool))]
    start = torch.nn.functional.normalize(normal + turn * torch.randn(n, 3, generator=g), dim=1)
    state = Vertices(start, torch.full((n, 2), 0.3), torch.full((n,), 1.0))
    anchor = free_reflectance(start, 0.3, 2)

    def error(at: Vertices) -> float:
        return float((evaluate(at.normal, at.reflectance, towards, lights[0], law).predicted - image).abs().mean())

    before = error(state)
    for _ in range(8):
        state = vertex_step(samples, state, lights, law, anchor)
        assert torch.isfinite(state.normal).all() and torch.isfinite(state.reflectance).all()
    assert error(state) <= before * 1.01


def test_thinned_views_keep_other_lights_and_their_own_light(scene: SphereScene) -> None:
    """A few views keep all of their lights; many views, or very many lights, do with fewer, and all together still use every light."""
    capture, lights = scene.capture, scene.reconstruction.lights
    assert thinned(capture, lights) == (capture, lights)
    view, count = capture.views[0], len(capture.views[0].lights)
    times = -(-4 * ENOUGH_LIGHTS // count)
    many = replace(view, samples=np.tile(view.samples, (1, times, 1)), lights=tuple(range(1, times * count + 1)))
    crowd = Capture("crowd", tuple(replace(many, name=f"view_{k:02d}") for k in range(1, 22)))
    direction, intensity = (np.tile(values[0], (times, 1)) for values in (lights.direction, lights.intensity))
    numbered = intensity * np.arange(1, len(intensity) + 1)[:, None]
    part, kept = thinned(crowd, Lights((direction,) * 21, (numbered,) * 21, True))
    assert thinned(crowd, Lights((direction,) * 21, (2 * numbered,) * 21, True))[0] is part, "its samples are copied once"
    sizes = [len(v.lights) for v in part.views]
    assert min(sizes) >= ENOUGH_LIGHTS and max(sizes) < len(many.lights) and sum(sizes) >= ENOUGH_PHOTOGRAPHS
    assert {number for v in part.views for number in v.lights} == set(many.lights)
    for v, d, e in zip(part.views, kept.direction, kept.intensity, strict=True):
        rows = np.array(v.lights) - 1
        assert np.array_equal(d, direction[rows]) and np.array_equal(e, numbered[rows])
        assert np.array_equal(v.samples, many.samples[:, rows])
    half = thinned(crowd, Lights((direction,) * 21, (numbered,) * 21, True), fewer=2)[0]
    assert ENOUGH_LIGHTS / 2 <= min(len(v.lights) for v in half.views) <= min(sizes) / 2
    assert {number for v in half.views for number in v.lights} == set(many.lights)


@pytest.mark.parametrize(
    ("views", "lights", "abound"), [(20, 12, True), (20, 96, True), (40, 6, True), (12, 20, False), (5, 96, False), (20, 11, False)]
)
def test_photographs_abound_where_many_views_have_as_many_lights_as_tell_a_pixel(views: int, lights: int, abound: bool) -> None:
    """However many a few views have: they do not show a place from more sides."""
    view = make_sphere(1).capture.views[0]
    samples = np.zeros((len(view.pixels), lights, 3), view.samples.dtype)
    view = replace(view, samples=samples, lights=tuple(range(1, lights + 1)))
    assert abundant(Capture("many", tuple(replace(view, name=f"view_{k:02d}") for k in range(1, views + 1)))) == abound


@pytest.mark.parametrize("fewer", [1.0, 2.0, 100.0])
def test_of_few_photographs_more_vertices_try_the_models_components(
    scene: SphereScene, fewer: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    views, start, _, law = problem(scene)
    photographs, surface = sum(samples.image.shape[1] for samples in views), scene.reconstruction.surface
    monkeypatch.setattr("mvps.joint.choosing.ENOUGH_PHOTOGRAPHS", fewer * photographs)
    seen = torch.cat([samples.vertex for samples in views]).unique().numpy()
    patches = drawn_patches(seen, surface, start.normal.numpy(), LIGHT_VERTICES, np.random.default_rng(0), CPU)
    state = State(surface, scene.reconstruction.lights, (), law, Model(), 0.0)
    lit, _ = errors_of(state, scene.capture, views, start, free_reflectance(start.normal, 1.0, 2), patches)(Model())
    assert len(lit) == pytest.approx(min(fewer * TRIAL_VERTICES, len(patches.vertex)), rel=0.1)


def test_where_nothing_reflects_lobes_are_tied_to_nothing() -> None:
    """A tie to none with no spread would be infinitely firm, and its equations no numbers."""
    normal, none = torch.eye(3), torch.zeros(3, 3)
    black = Vertices(normal, none, torch.ones(3), said=torch.ones(3, 3))
    assert with_population(black, free_reflectance(normal, 0.3, 3)).reflectance_sigma.isinf().all()


@pytest.mark.parametrize("albedo", [[0.0, 0.0, 0.4], [0.0, 0.0, 0.0]])
def test_exact_fits_on_a_mesh_that_is_mostly_out_of_sight_have_a_scale(albedo: list[float]) -> None:
    """One light a view: every sample fits, and the median vertex is not seen. One over the scale's square is a float32."""
    least = _least_scale(torch.zeros(1), torch.tensor(albedo))
    assert least == pytest.approx(LEAST_NOISE * 0.4 if max(albedo) else SCALE_FLOOR)
    assert np.isfinite(np.float32(1) / np.float32(least) ** 2)
