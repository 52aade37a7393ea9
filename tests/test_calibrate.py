"""Hull, lights and photometric stereo: known answers on analytic scenes, and the data that must be refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from sphere_scene import RADIUS, SphereScene, camera_at, make_sphere

from mvps import calibrate
from mvps.calibrate import solve_ambiguity, uncalibrated_lights
from mvps.camera import pixel_centres, rays
from mvps.hull import default_cells, hull_of_masks, masks_box, signed_distance, visual_hull
from mvps.mesh import normalise, piece_count, vertex_normals
from mvps.photometric import normal_map
from mvps.scene import Camera, Capture, CaptureError, Lights, Surface, View
from mvps.sharing import shared_frame
from mvps.silhouette import mask_distance
from mvps.synthetic.scene import Scene, make_cameras, make_lights, render_capture
from mvps.synthetic.settings import SceneSettings
from mvps.synthetic.shape import make_material
from mvps.visibility import RayCaster, camera_hits

CPU = torch.device("cpu")


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(4)


def discs(views: int, unit: float = 1.0, size: int = 160) -> Capture:
    """Analytic silhouettes of a sphere of radius RADIUS * unit from many sides."""
    rng = np.random.default_rng(0)
    made = []
    for k, direction in enumerate(normalise(rng.normal(size=(views, 3)))):
        near = camera_at(direction, size)
        camera = Camera(near.K, near.rotation, near.translation * unit, size, size)
        # The cone that touches the sphere: its half-angle is asin(radius / distance).
        half = near.K[0, 0] * np.tan(np.arcsin(RADIUS / 400.0))
        row, column = np.indices((size, size)) + 0.5
        mask = (column - size / 2) ** 2 + (row - size / 2) ** 2 < half**2
        samples = np.ones((int(mask.sum()), 1, 3), np.uint16)
        made.append(View(f"view_{k + 1:02d}", camera, mask, samples, 1.0, 65535, (1,)))
    return Capture("discs", tuple(made))


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_hull_of_a_sphere_from_many_sides_is_the_sphere_in_any_unit(unit: float) -> None:
    capture = discs(24, unit)
    low, high, _ = masks_box(capture)
    assert (low < -RADIUS * unit * 0.98).all() and (high > RADIUS * unit * 0.98).all() and (high - low < 3 * RADIUS * unit).all()
    hull = visual_hull(signed_distance(capture, default_cells(capture)))
    radius = np.linalg.norm(hull.vertices, axis=1) / unit
    pixel = 2 * RADIUS / (0.8 * 160)
    # Silhouettes touch the sphere; between them the hull bulges outwards.
    assert radius.min() > RADIUS - 0.5 * pixel and np.median(radius) < RADIUS + pixel


def test_distance_to_a_straight_mask_is_exact_and_half_a_pixel_from_the_centres() -> None:
    mask = np.zeros((40, 40), bool)
    mask[:, :20] = True
    distance = mask_distance(mask)
    assert np.allclose(distance[20, 10:30], np.arange(10, 30) + 0.5 - 20, atol=0.02)


def test_cameras_that_stand_beside_the_object_have_a_hull() -> None:
    """Corners of the grid lie behind them."""
    made = []
    for k, direction in enumerate(normalise(np.random.default_rng(1).normal(size=(8, 3)))):
        camera = camera_at(direction, 96, 1.3 * RADIUS)
        wide = replace(camera, K=np.array([[20.0, 0, 48], [0, 20.0, 48], [0, 0, 1]]))
        ball = Surface(make_sphere(4).reconstruction.surface.vertices, make_sphere(4).reconstruction.surface.faces)
        mask = (camera_hits(RayCaster(ball), wide, np.indices((96, 96)).reshape(2, -1).T).face >= 0).reshape(96, 96)
        made.append(View(f"view_{k + 1:02d}", wide, mask, np.zeros((int(mask.sum()), 1, 3), np.uint16), 1.0, 65535, (1,)))
    capture = Capture("near", tuple(made))
    grid = signed_distance(capture, 32)
    assert np.isfinite(grid.values).all()
    hull = hull_of_masks(capture, grid)
    assert np.linalg.norm(hull.vertices, axis=1).min() > 0.9 * RADIUS


def test_one_view_bounds_nothing() -> None:
    with pytest.raises(CaptureError, match="leave the object unbounded"):
        masks_box(discs(1))


@pytest.mark.parametrize(("radius", "count"), [(RADIUS / 4, 2), (RADIUS / 16, 1)])
def test_a_second_piece_stays_if_masks_ask_for_it(radius: float, count: int) -> None:
    balls = [trimesh.creation.icosphere(subdivisions=4, radius=r) for r in (20.0, radius)]
    balls[1].apply_translation((33.0, 0, 0))
    both = trimesh.util.concatenate(balls)
    caster, made = RayCaster(Surface(np.array(both.vertices), np.array(both.faces))), []
    for k, direction in enumerate(normalise(np.random.default_rng(0).normal(size=(10, 3)))):
        camera = camera_at(direction)
        mask = (camera_hits(caster, camera, np.indices((96, 96)).reshape(2, -1).T).face >= 0).reshape(96, 96)
        made.append(View(f"view_{k + 1:02d}", camera, mask, np.ones((int(mask.sum()), 1, 3), np.uint16), 1.0, 65535, (1,)))
    capture = Capture("two", tuple(made))
    grid = signed_distance(capture, 96)
    assert piece_count(hull_of_masks(capture, grid)) == count and piece_count(visual_hull(grid)) == 1


def test_a_ghost_larger_than_a_part_does_not_hide_it() -> None:
    """Three balls in four views: where cones of the two large ones meet, the hull has a piece that is larger than the small ball."""
    draw = np.random.default_rng(21)
    draw.integers(3, 7)
    balls: list[tuple[np.ndarray, float]] = []
    for radius in (0.8, 0.8, 0.25):
        while True:
            place = draw.uniform(-1.6, 1.6, 3) * [1, 0.4, 1]
            if all(np.linalg.norm(place - other) > radius + r + 0.3 for other, r in balls):
                balls.append((place, radius))
                break
    made, first = [], draw.uniform(0, 1)
    for k in range(4):
        angle = first + np.pi / 2 * k
        camera = camera_at(np.array([12 * np.sin(angle), 2.0, 12 * np.cos(angle)]), 96, 12.0)
        camera = replace(camera, K=np.array([[220.0, 0, 48], [0, 220, 48], [0, 0, 1]]))
        start, along = rays(camera, pixel_centres(np.indices((96, 96)).reshape(2, -1).T))
        mask = np.zeros(len(start), bool)
        for place, radius in balls:
            nearest = start + ((place - start) * along).sum(1, keepdims=True) * along
            mask |= ((nearest - place) ** 2).sum(1) < radius**2
        made.append(View(f"view_{k + 1:02d}", camera, mask.reshape(96, 96), np.zeros((int(mask.sum()), 1, 3), np.uint16), 1.0, 65535, (1,)))
    capture = Capture("three", tuple(made))
    hull = hull_of_masks(capture, signed_distance(capture, 96))
    assert all(np.linalg.norm(hull.vertices - place, axis=1).min() < 1.3 * radius for place, radius in balls)


def test_masks_of_different_places_have_no_common_part() -> None:
    capture = discs(6)
    moved = [
        replace(view, camera=Camera(view.camera.K, view.camera.rotation, view.camera.translation + np.array([150.0 * k, 0, 0]), 160, 160))
        for k, view in enumerate(capture.views)
    ]
    with pytest.raises(CaptureError, match="wanted masks"):
        signed_distance(Capture("apart", tuple(moved)), 32)


def light_error(lights: Lights, truth: Lights) -> float:
    return float(np.mean([degrees(a, b).mean() for a, b in zip(lights.direction, truth.direction, strict=True)]))


def lambertian(scene: SphereScene, seed: int | None = None, right: float = 0.4, lamps: bool = False) -> tuple[Capture, Lights, Surface]:
    """The sphere without lobes, albedo 0.7 and `right`; with a seed, other lights in every view; lamps: all around, fixed in the world."""
    reconstruction = scene.reconstruction
    lights = reconstruction.lights
    rng = np.random.default_rng(seed)
    if lamps:
        around, strength = normalise(rng.normal(size=(10, 3))), rng.uniform(0.6, 1.4, (10, 3))
        lights = Lights((around,) * len(scene.capture.views), (strength,) * len(scene.capture.views), True, True)
    elif seed is not None:
        directions = [
            normalise(np.concatenate([rng.normal(0, 0.5, (10, 2)), -np.ones((10, 1))], 1) @ view.camera.rotation)
            for view in scene.capture.views
        ]
        lights = Lights(tuple(directions), tuple(rng.uniform(0.6, 1.4, (10, 3)) for _ in directions), False)
    views = []
    for view, direction, intensity in zip(scene.capture.views, lights.direction, lights.intensity, strict=True):
        seen = normalise(np.nan_to_num(ball_normals(view)))
        shading = np.maximum(seen @ direction.T, 0)
        albedo = np.where(seen[:, :1] < 0, 0.7, right)
        radiance = albedo[:, None] * shading[..., None] * intensity
        views.append(replace(view, samples=np.rint(radiance / 2 * 65535).astype(np.uint16)))
    return Capture("lambertian", tuple(views)), lights, reconstruction.surface


def ball_normals(view: View) -> np.ndarray:
    """Exact normals (pixels, 3) of the sphere under a view's pixels."""
    origin, direction = rays(view.camera, pixel_centres(view.pixels))
    along = -(origin * direction).sum(1)
    miss = np.maximum(RADIUS**2 - ((origin + along[:, None] * direction) ** 2).sum(1), 0)
    return (origin + (along - np.sqrt(miss))[:, None] * direction) / RADIUS


@pytest.mark.parametrize("seed", [None, 3])
def test_lights_of_a_lambertian_sphere_and_whether_one_rig_made_them(scene: SphereScene, seed: int | None) -> None:
    capture, truth, surface = lambertian(scene, seed)
    found = uncalibrated_lights(capture, surface, 0)
    assert found.lights.one_rig == (seed is None)
    assert light_error(found.lights, truth) < 1.0 and found.fourth_singular_value < 0.1


def test_lamps_around_the_object_that_stand_still_while_the_camera_moves(scene: SphereScene) -> None:
    capture, truth, surface = lambertian(scene, 1, lamps=True)
    found = uncalibrated_lights(capture, surface, 0)
    # Half of them are behind the object in any view, which alone says nothing of their directions.
    assert found.lights.one_rig and found.lights.fixed and light_error(found.lights, truth) < 2.0
    assert "which stands still while the camera moves" in found.words()
    assert not uncalibrated_lights(capture, surface, 0, may_share=False).lights.one_rig


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize(("seed", "lamps"), [(None, False), (1, True), (1, False)])
def test_whose_few_lights_are(scene: SphereScene, count: int, seed: int | None, lamps: bool) -> None:
    capture, truth, surface = lambertian(scene, seed, lamps=lamps)
    numbers = tuple(range(1, count + 1))
    found = uncalibrated_lights(capture.select({view.name: numbers for view in capture.views}), surface, 0).lights
    assert found.one_rig == (seed is None or lamps) and found.fixed == lamps
    error = np.mean([degrees(a, b[:count]).mean() for a, b in zip(found.direction, truth.direction, strict=True)])
    # A lamp in the world lights no vertex twice from another side: that one half is darker may be the lamp's doing as well.
    assert error < (10 if lamps else 2) or not found.one_rig


def test_black_photographs_tell_of_no_rig(scene: SphereScene) -> None:
    capture, _, surface = lambertian(scene)
    black = replace(capture, views=tuple(replace(view, samples=0 * view.samples) for view in capture.views))
    assert shared_frame(black, RayCaster(surface), np.random.default_rng(0)) is None


def test_lights_survive_a_rough_shape_that_is_wrong_on_one_side(scene: SphereScene) -> None:
    capture, truth, surface = lambertian(scene)
    # A hull's bulge: one flank of the sphere is pushed flat, its normals wrong by up to 40 degrees.
    squeezed = surface.vertices * np.where(surface.vertices[:, 1:2] > 0.5 * RADIUS, (1, 0.6, 1), (1, 1, 1))
    assert light_error(uncalibrated_lights(capture, Surface(squeezed, surface.faces), 0).lights, truth) < 3.0


def test_few_lights_on_one_albedo_are_solved_from_the_rough_normals(scene: SphereScene) -> None:
    capture, truth, surface = lambertian(scene, right=0.7)
    few = capture.select({view.name: (1, 2) for view in capture.views})
    found = uncalibrated_lights(few, surface, 0).lights
    assert np.mean([degrees(a, b[:2]).mean() for a, b in zip(found.direction, truth.direction, strict=True)]) < 2


def box() -> tuple[Capture, Lights]:
    """Three flat, glossy sides in every view, under one rig."""
    settings = SceneSettings(views=8, lights=10, size=64, seed=2)
    made = trimesh.creation.box((1.0, 0.8, 0.6)).subdivide_to_size(0.05)
    vertices = np.array(made.vertices) / np.linalg.norm(made.vertices, axis=1).max()
    surface = Surface(vertices * settings.extent / 2, np.array(made.faces))
    cameras = make_cameras(settings, surface.vertices)
    material = make_material(vertices, vertex_normals(surface), settings.strength, np.random.default_rng(1))
    lights = make_lights(settings, cameras, np.random.default_rng(2))
    return render_capture(settings, Scene(surface, material, cameras, lights))[0], lights


def test_flat_sides_are_taken_to_be_under_one_rig(monkeypatch: pytest.MonkeyPatch) -> None:
    capture, truth = box()
    surface = visual_hull(signed_distance(capture, default_cells(capture)))
    calibration = uncalibrated_lights(capture, surface, 0)
    found = calibration.lights
    assert found.one_rig and not found.fixed and light_error(found, truth) < 10 and calibration.under_normals
    # Three factors explain three sides whatever reflects: by the variances alone every view has lights of its own, and wrong ones.
    alone = uncalibrated_lights(capture, surface, 0, may_share=False).lights
    assert not alone.one_rig and light_error(alone, truth) > 2 * light_error(found, truth)
    # Where the shape's normals do not tell of a rig either, one is believed: single views say nothing.
    monkeypatch.setattr(calibrate, "shared_frame", lambda *_: None)
    assumed = uncalibrated_lights(capture, surface, 0)
    assert assumed.assumed and "one rig for all views, which do not tell them one by one" in assumed.words()
    assert assumed.lights.one_rig and not assumed.lights.fixed and light_error(assumed.lights, truth) < 10


def test_a_rough_shape_that_faces_one_way_tells_no_lights(scene: SphereScene) -> None:
    capture, _, _ = lambertian(scene)
    view = capture.views[0]
    corners = 3 * RADIUS * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) @ view.camera.rotation
    with pytest.raises(CaptureError, match="normals point many ways, given one where they all lie in one plane"):
        uncalibrated_lights(capture.select({view.name: view.lights}), Surface(corners, np.array([[0, 2, 1], [0, 3, 2]])), 0)


def test_ambiguity_is_undone_among_wrong_normals() -> None:
    rng = np.random.default_rng(1)
    normal = normalise(rng.normal(size=(800, 3)))
    A = rng.normal(size=(3, 3)) + 2 * np.eye(3)
    pseudo = normal * rng.uniform(0.3, 1, (800, 1)) @ np.linalg.inv(A).T
    wrong = normal.copy()
    wrong[::6] = normalise(rng.normal(size=wrong[::6].shape))
    solved = solve_ambiguity(pseudo, wrong, np.ones(800))
    assert degrees(normalise(pseudo @ solved.T), normal).max() < 0.1


def test_normals_in_one_plane_fix_no_ambiguity() -> None:
    angle = np.linspace(0, np.pi, 50)
    normal = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    with pytest.raises(np.linalg.LinAlgError, match="span no volume"):
        solve_ambiguity(normal, normal, np.ones(50))


def test_photometric_stereo_of_a_lambertian_sphere(scene: SphereScene) -> None:
    capture, lights, _ = lambertian(scene)
    view = capture.views[0]
    maps = normal_map(view, lights.direction[0], lights.intensity[0], CPU)
    error = degrees(maps.normal, ball_normals(view))
    assert np.median(error) < 0.1 and np.quantile(error, 0.9) < 2
    expected = np.where(ball_normals(view)[:, :1] < 0, 0.7, 0.4)
    sure = maps.confidence > 0.9
    assert sure.mean() > 0.7 and np.abs(maps.albedo - expected)[sure].max() < 0.02


def test_shadows_highlights_and_saturation_are_outvoted(scene: SphereScene) -> None:
    capture, lights, _ = lambertian(scene)
    view = capture.views[0]
    spoiled = view.samples.copy()
    spoiled[:, 0] = 0  # one light blocked everywhere
    spoiled[:, 1] = np.minimum(spoiled[:, 1].astype(int) * 2 + 8000, 65534)  # one with a highlight everywhere
    spoiled[:, 2] = 65535  # one saturated
    maps = normal_map(replace(view, samples=spoiled), lights.direction[0], lights.intensity[0], CPU)
    assert np.median(degrees(maps.normal, ball_normals(view))) < 0.5


def test_a_dark_pixel_faces_the_camera_without_confidence(scene: SphereScene) -> None:
    capture, lights, _ = lambertian(scene)
    view = capture.views[0]
    black = view.samples.copy()
    black[:5] = 0
    maps = normal_map(replace(view, samples=black), lights.direction[0], lights.intensity[0], CPU)
    assert (maps.confidence[:5] == 0).all() and (degrees(maps.normal[:5], -view.camera.rotation[2]) < 15).all()
    assert np.isfinite(maps.albedo).all()


@pytest.mark.parametrize("nothing", [0.0, np.nan])
def test_lights_of_which_nothing_is_known_stand_at_the_camera(nothing: float) -> None:
    """Of a view without a usable sample all are such; no number comes of the others."""
    toward = [0.0, 0.0, -1.0]
    none = calibrate.without_gaps(np.full((3, 3), nothing))
    np.testing.assert_array_equal(none, [toward] * 3)
    some = calibrate.without_gaps(np.array([[0.0, 2.0, 0.0], [nothing] * 3]))
    np.testing.assert_array_equal(some, [[0, 2, 0], [0, 0, -2]])


@pytest.mark.parametrize("seed", [None, 3])
def test_a_view_of_few_lights_leaves_the_others_theirs(scene: SphereScene, seed: int | None) -> None:
    capture, truth, surface = lambertian(scene, seed)
    keep = {view.name: view.lights for view in capture.views}
    first = capture.views[0].name
    found = uncalibrated_lights(capture.select(keep | {first: (1, 2, 3)}), surface, 0).lights
    others = uncalibrated_lights(capture.select({name: of for name, of in keep.items() if name != first}), surface, 0).lights
    for a, b, e, f in zip(found.direction[1:], others.direction, found.intensity[1:], others.intensity, strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.ptp(e / f) < 1e-9
    assert not found.one_rig and light_error(replace(found, direction=found.direction[1:], intensity=found.intensity[1:]), others) < 1e-6
    assert degrees(found.direction[0], truth.direction[0][:3]).mean() < 10
    stronger = [e.mean(1) / f.mean(1)[: len(e)] for e, f in zip(found.intensity, truth.intensity, strict=True)]
    # One albedo stands for both, 0.7 and 0.4.
    assert 4 / 7 < np.median(stronger[0]) / np.median(np.concatenate(stronger[1:])) < 7 / 4


@pytest.mark.parametrize("exposure", [1.0, 1 / 16])
def test_photographs_that_were_left_out_count_as_none(scene: SphereScene, exposure: float) -> None:
    capture, lights, _ = lambertian(scene)
    view = capture.views[0]
    dark = replace(view, samples=np.rint(exposure * view.samples).astype(np.uint16))
    kept = Capture("dark", (dark,)).without({view.name: (2, 5, 7)}).views[0]
    others = [n - 1 for n in view.lights if n not in (2, 5, 7)]
    alone = replace(dark, samples=dark.samples[:, others], lights=tuple(n + 1 for n in others))
    given = lights.direction[0], lights.intensity[0]
    found, wanted = normal_map(kept, *given, CPU), normal_map(alone, *(of[others] for of in given), CPU)
    assert (found.confidence > 0.5).mean() > 0.8 and np.median(degrees(found.normal, ball_normals(view))) < 0.5
    assert np.median(degrees(found.normal, wanted.normal)) < 0.05


def test_colours_of_a_rig_are_those_of_views_that_show_a_light(scene: SphereScene) -> None:
    capture, truth, _ = lambertian(scene)
    ratio = truth.intensity[0] / truth.intensity[0].mean(1, keepdims=True)
    gone = capture.without({view.name: (1,) for view in capture.views[:-1]})
    for given in (capture, gone):
        found = calibrate._assemble(given, [truth.direction[0] @ given.views[0].camera.rotation.T] * len(given.views), True).intensity[0]
        assert np.abs(found[0] / found[0].mean() / ratio[0] - 1).max() < 0.2
    nowhere = capture.without({view.name: (1,) for view in capture.views})
    found = calibrate._assemble(nowhere, [truth.direction[0]] * len(nowhere.views), True).intensity[0]
    assert np.ptp(found[0]) == 0


@pytest.mark.parametrize(("count", "said"), [(3, "3 of 3 pixels of its mask meet"), (12, "point many ways")])
def test_a_view_that_hardly_shows_the_object_is_named(scene: SphereScene, count: int, said: str) -> None:
    """Fewer rows than factors start from ended in a traceback."""
    capture, _, surface = lambertian(scene, 3)
    first = capture.views[0]
    mask = np.zeros_like(first.mask)
    mask[tuple(first.pixels[len(first.pixels) // 2 :][:count].T)] = True
    small = replace(first, mask=mask, samples=first.samples[mask[first.mask]])
    with pytest.raises(CaptureError, match=said):
        uncalibrated_lights(Capture("small", (small, *capture.views[1:])), surface, 0)
