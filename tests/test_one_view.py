"""One view: lights without calibration, normals, and the open surface that they integrate to."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from test_relief import ball, photographed

from mvps.evaluate import evaluate_result
from mvps.evaluate import main as evaluate
from mvps.joint.bas_relief import bas_relief, turned
from mvps.joint.one_view import Start, refine_view, with_rim, without_lobes
from mvps.joint.refine import RefineSettings
from mvps.load import read_capture, read_truth
from mvps.mesh import angles_deg
from mvps.oneview import distance_of, first_lights, lights_again, residuals, surface_of, without_misfits
from mvps.photometric import normal_map, normal_maps
from mvps.pixel_samples import lamp_colours
from mvps.progress import Progress
from mvps.reconstruct import Settings, reconstruct
from mvps.reconstruct import main as reconstruct_main
from mvps.relief.ambiguity import lights_under
from mvps.relief.silhouette import inflated_normals
from mvps.rendering import photograph
from mvps.scene import Capture, CaptureError, Law, Lights, Material, NormalMap, Surface, Truth, View, less_confident
from mvps.sound import sound
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import Scene, make_scene, render_capture
from mvps.synthetic.settings import SceneSettings
from mvps.visibility import ray_caster


@pytest.fixture(scope="module")
def made() -> tuple[Capture, Truth]:
    return render_capture(SceneSettings(views=1, lights=24, size=80, seed=4))


def photographed_as(scene: Scene, view: View) -> Material:
    """The scene's material in the photographs' unit, in which clipping has the value one."""
    material, sample = scene.material, view.radiance()
    drawn = photograph(
        ray_caster(scene.surface), material, view.camera, view.pixels, scene.lights.direction[0], scene.lights.intensity[0], side=2
    )
    unit = float(np.median(sample[view.usable()] / np.maximum(drawn[view.usable()], 1e-9)))
    return replace(material, albedo=material.albedo * unit, specular_weight=material.specular_weight * unit)


def test_the_bas_relief_is_found_by_the_lobes(made: tuple[Capture, Truth]) -> None:
    """A third flatter than true and leaning by 11 degrees, whose Lambertian images are the same."""
    capture, truth = made
    view = capture.views[0]
    normal = truth.normals[view.name][view.mask].astype(float)
    direction, intensity = truth.direction[view.name], truth.intensity[view.name]
    white = view.radiance().mean(2) / intensity.mean(1)
    albedo = np.median(white / np.maximum(normal @ direction.T, 0.2), axis=1)
    G = view.camera.rotation.T @ np.array([[1, 0, 0], [0, 1, 0], [0.2, -0.05, 0.67]]) @ view.camera.rotation
    bent, shade, light, strength = turned(G, normal, albedo, direction, intensity.mean(1))
    assert angles_deg(light, direction).mean() > 5 and angles_deg(bent, normal).mean() > 8
    lights = (light, strength[:, None] * intensity / intensity.mean(1, keepdims=True))
    back = bas_relief(view, bent, shade, lights, Law((8.0, 32.0, 128.0)), np.random.default_rng(0), torch.device("cpu"))
    straight, _, found, _ = turned(back, bent, shade, light, strength)
    assert angles_deg(found, direction).mean() < 1.5
    assert angles_deg(straight, normal).mean() < 3


def test_black_pixels_have_normals_after_a_bas_relief() -> None:
    normal, _, _, _ = turned(np.diag([1.0, 1, 0.5]), np.eye(3)[2:], np.zeros(1), np.eye(3), np.ones(3))
    assert np.allclose(normal, [0, 0, 1])


def test_confidence_takes_further_errors() -> None:
    """Standard deviations of 0.2 and 0.1 radians, and a further one of 0.2 radians."""
    assert np.allclose(less_confident(np.array([0.5, 0.8, 0.0]), np.full(3, 0.04)), [1 / 3, 1 / 2.25, 0])


def test_the_outline_takes_its_neighbours_errors() -> None:
    """Vertex 3 lies beside two that are known, 4 and 5 beside none."""
    surface = Surface(np.eye(6, 3), np.array([[0, 1, 2], [1, 3, 2], [3, 4, 5]]))
    found = with_rim(np.array([0.9, 0.5, 0.25, 0, 0, 0]), surface)
    assert np.allclose(found, [0.9, 0.5, 0.25, 1 / 3, 0, 0])


def test_a_capture_of_one_view_becomes_a_result_that_evaluate_reads(made: tuple[Capture, Truth], tmp_path: Path) -> None:
    capture, truth = made
    write_capture(capture, truth, tmp_path / "capture")
    reconstruct_main([str(tmp_path / "capture"), "--out", str(tmp_path / "result"), "--preset", "draft", "--quiet"])
    evaluate([str(tmp_path / "result"), "--truth", str(tmp_path / "capture"), "--quiet"])
    errors = evaluate_result(tmp_path / "result", tmp_path / "capture")
    assert errors["light_error_deg"] < 6 and errors["map_normal_error_deg"] < 8
    assert errors["mesh_coverage"] == 1
    for name in ("mesh.ply", "model.glb", "lights.json", "material.npz", "normals/view_01.npy", "report.html", "metrics.json"):
        assert (tmp_path / "result" / name).exists()
    metrics = (tmp_path / "result" / "metrics.json").read_text()
    assert "One view:" in metrics and "the world origin's" in metrics


def test_a_round_that_fits_much_worse_is_undone(made: tuple[Capture, Truth]) -> None:
    """Started anew under lights in the wrong order, the second of three rounds is the last and leaves no trace."""
    capture, truth = made
    view, device = capture.views[0], torch.device("cpu")
    true = Lights((truth.direction[view.name],), (truth.intensity[view.name],), True)
    wrong = Lights((true.direction[0][::-1].copy(),), true.intensity, True)
    tried = []

    def again(_: View, __: Lights, ___: NormalMap) -> Start[str]:
        tried.append(1)
        return Start(wrong, normal_maps(capture, wrong, device)[0], "wrong")

    def integrated(normal: np.ndarray, confidence: np.ndarray) -> Surface:
        return surface_of(view, normal, confidence, distance_of(view)[0])

    start = Start(true, normal_maps(capture, true, device)[0], "true")
    law, settings = Law((8.0, 32.0, 128.0)), RefineSettings((), free_lights=False)
    refined, kept = refine_view(capture, start, again, law, settings, 3, 0, device, integrated, lambda *_: None)
    assert tried == [1] and kept.resolved == "true"
    assert len(refined.rounds) == 1 and angles_deg(refined.lights.direction[0], true.direction[0]).max() < 0.01
    normal = refined.maps[0].normal
    assert angles_deg(normal, truth.normals[view.name][view.mask]).mean() < 5


@pytest.mark.parametrize(("name", "lights", "normals"), [("ball", 2.0, 3.5), ("bear", 3.0, 5.5)])
def test_photographs_without_calibration(captures: Path, tmp_path: Path, name: str, lights: float, normals: float) -> None:
    """Photographs of DiLiGenT (Shi et al. 2016). What is wrong with ball, slopes that are 3 % too steep, comes out under its true lights
    too, and nothing in its photographs tells of it: its stated errors are not held against anything."""
    reconstruct_main([str(captures / name), "--out", str(tmp_path / "result"), "--quiet"])
    errors = evaluate_result(tmp_path / "result", captures / name)
    assert errors["light_error_deg"] < lights
    assert errors["map_normal_error_deg"] < normals
    assert name == "ball" or errors["confidence_factor"] < 2.5


def test_without_lobes_lights_are_found_that_highlights_turn() -> None:
    """A glossy object's photographs less what its true lobes send, against photographs of the same object with none: the lobes are taken
    off, what is clipped stays, and lights that highlights turned come back."""
    settings = SceneSettings(views=1, lights=12, size=80, seed=3)
    scene = make_scene(settings)
    (glossy, truth), (matt, _) = render_capture(settings), render_capture(replace(settings, strength=0.0, noise=0.0))
    view, of_body = glossy.views[0], matt.views[0]
    true = truth.direction[view.name]
    body = without_lobes(view, scene.surface, photographed_as(scene, view), scene.lights)
    clipped = view.samples >= view.saturation
    assert clipped.any() and (body.samples[clipped] == view.samples[clipped]).all()
    known = view.usable() & of_body.usable()
    level = np.median(body.samples[known] / np.maximum(of_body.samples[known].astype(float), 1.0))
    with_lobes, without = (np.abs(v.samples[known] - level * of_body.samples[known]).mean() for v in (view, body))
    assert without < 0.2 * with_lobes

    rough = inflated_normals(view.mask)
    first = first_lights(glossy, rough, lights_under(view, rough), 0)[0]
    again = lights_again(body, first, rough, 0)[0]
    before, after = (angles_deg(found.direction[0], true).mean() for found in (first, again))
    assert before > 5 and after < 0.5 * before


@pytest.mark.parametrize(("name", "view", "told"), [("buddha", 1, False), ("buddha", 7, False), ("spot", 1, True), ("armadillo", 7, True)])
def test_where_photographs_do_not_tell_lights_the_silhouette_does(captures: Path, name: str, view: int, told: bool) -> None:
    """Of metal what resolves the factors puts lights 41 and 50 deg off."""
    capture = read_capture(captures / name, [view])
    of = capture.views[0]
    rough = inflated_normals(of.mask)
    lights, found = first_lights(capture, rough, lights_under(of, rough), 0)
    assert (found is not None) is told
    true = read_truth(captures / name).direction[of.name]
    assert angles_deg(lights.direction[0], true).mean() < (7 if told else 15)


def test_one_view_of_metal_has_the_lights_that_two_materials_tell(captures: Path, tmp_path: Path) -> None:
    """Rounds that resolve a bas-relief by lobes which are not understood put lights 60 deg off and more. Under the silhouette's lights,
    which are 12 deg off, its own normals are 36 deg off, and rounds from exemplars came to 17."""
    reconstruct_main([str(captures / "buddha"), "--views", "1", "--out", str(tmp_path / "result"), "--preset", "draft", "--quiet"])
    errors = evaluate_result(tmp_path / "result", captures / "buddha")
    assert errors["light_error_deg"] < 8 and errors["intensity_error"] < 0.2 and errors["map_normal_error_deg"] < 14
    metrics = json.loads((tmp_path / "result" / "metrics.json").read_text())
    assert "two materials" in metrics["status"]["text"] and metrics["status"]["name"] in ("poor fit", "doubtful")


def test_lights_that_rounds_turn_far_away_are_told_by_two_materials(made: tuple[Capture, Truth], monkeypatch: pytest.MonkeyPatch) -> None:
    """Near at first, far at the end: done again from what the silhouette tells, by two materials, and the status says so."""
    away = iter([0.0, 44.0])
    monkeypatch.setattr("mvps.relief.ambiguity.away_deg", lambda *_: next(away))
    capture, truth = made
    found = reconstruct(capture, Settings("made", preset="draft"), None, Progress())
    assert angles_deg(found.lights.direction[0], truth.direction[capture.views[0].name]).mean() < 10
    assert "two materials" in found.metrics["status"]["text"]


@pytest.mark.parametrize(
    ("name", "options", "normals"), [("ball", [], 2.5), ("bear", [], 5.5), ("buddha", ["--views", "7", "--preset", "draft"], 12)]
)
def test_photographs_under_given_lights(captures: Path, tmp_path: Path, name: str, options: list[str], normals: float) -> None:
    """buddha is of gold paint: 39 deg off without exemplars, for Lambert's law is 42 deg off."""
    reconstruct_main([str(captures / name), "--out", str(tmp_path / "result"), "--calibrated-lights", "--quiet", *options])
    errors = evaluate_result(tmp_path / "result", captures / name)
    assert errors["map_normal_error_deg"] < normals
    assert ("exemplars" in (tmp_path / "result" / "metrics.json").read_text()) is (name == "buddha")


def test_photographs_that_fit_no_surface_are_left_out(made: tuple[Capture, Truth]) -> None:
    capture, truth = made
    name = capture.views[0].name
    direction = truth.direction[name].copy()
    direction[[2, 7, 11]] = direction[[11, 2, 7]]
    device = torch.device("cpu")
    right, wrong = (Lights((d,), (truth.intensity[name],), True) for d in (truth.direction[name], direction))
    assert without_misfits(capture, right, device)[1] == []
    after, findings = without_misfits(capture, wrong, device)
    assert [one.where for one in findings] == [f"{name}/003", f"{name}/008", f"{name}/012"]
    assert np.flatnonzero(~after.views[0].shown).tolist() == [2, 7, 11]
    few = capture.select({name: capture.views[0].lights[:8]})
    assert without_misfits(few, Lights((direction[:8],), (truth.intensity[name][:8],), True), device) == (few, [])


def one_view(mask: np.ndarray, made: tuple[Capture, Truth]) -> Capture:
    """The made capture, of this mask's pixels alone."""
    view = made[0].views[0]
    stay = mask & view.mask
    return replace(made[0], views=(replace(view, mask=stay, samples=view.samples[stay[view.mask]]),))


def test_an_object_of_two_pixels_width_is_refused(made: tuple[Capture, Truth]) -> None:
    """All pixels lie beside the mask's border."""
    mask = made[0].views[0].mask
    ring = mask & ~cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=2).astype(bool)
    with pytest.raises(CaptureError, match="a pixel inside of its mask"):
        reconstruct(one_view(ring, made), Settings("made", preset="draft"), None, Progress())


def test_an_object_of_a_few_pixels_has_a_result_that_is_doubted(made: tuple[Capture, Truth]) -> None:
    """Narrower than photographs are moved by in their check."""
    view = made[0].views[0]
    middle = view.pixels.mean(0)
    near = np.abs(np.indices(view.mask.shape) - middle[:, None, None]).max(0) < 5
    found = reconstruct(sound(one_view(near, made), Progress())[0], Settings("made", preset="draft"), None, Progress())
    assert np.isfinite(found.surface.vertices).all() and found.metrics["status"]["name"] != "one view"


@pytest.mark.parametrize("colour", [(1.0, 1.0, 1.0), (1.6, 0.7, 0.7)])
def test_lamps_may_differ_in_colour_on_an_object_that_has_one(colour: tuple[float, float, float]) -> None:
    """Three of sixteen; the plain mean of the channels of a red ball makes the reddish ones a quarter stronger, lights 3 degrees off, and
    would tell such photographs from the others under true lights."""
    mask, _, normal = ball()
    view, scaled = photographed(mask, normal, np.where(np.argwhere(mask)[:, 1] < 32, 0.8, 0.4), 16, 0)
    tint = np.ones((16, 3))
    tint[[2, 7, 11]] = colour
    values = view.samples * np.array([0.9, 0.25, 0.15]) * tint / 1.6
    tinted = replace(view, samples=np.rint(values).astype(np.uint16))
    found = lamp_colours(tinted)
    np.testing.assert_allclose(found, tint / tint.mean(1, keepdims=True), atol=0.01)
    strength = np.linalg.norm(scaled, axis=1, keepdims=True)
    lights = Lights((scaled / strength,), (strength * tint / 1.6 * 60000 / 65535,), True)
    capture = Capture("ball", (tinted,))
    maps = normal_map(tinted, lights.direction[0], lights.intensity[0], torch.device("cpu"))
    assert np.nanmax(residuals(tinted, maps, lights)) < 0.02
    rough = inflated_normals(mask)
    solved = first_lights(capture, rough, lights_under(tinted, rough), 0)[0]
    ratio = solved.intensity[0].mean(1) / strength[:, 0]
    assert ratio[[2, 7, 11]].mean() / np.delete(ratio, [2, 7, 11]).mean() == pytest.approx(1, abs=0.05)


def test_too_few_photographs_are_refused(captures: Path) -> None:
    capture = read_capture(captures / "ball", lights={"view_01": [1, 20, 60]})
    with pytest.raises(CaptureError, match="wanted at least 4 photographs of the one view"):
        reconstruct(capture, Settings("ball"), None, Progress())


def test_the_distance_is_the_origins_where_that_is_seen(made: tuple[Capture, Truth], captures: Path) -> None:
    view = made[0].views[0]
    assert distance_of(view)[0] == pytest.approx(view.camera.translation[2])
    ball = read_capture(captures / "ball", lights={"view_01": [1]}).views[0]
    assert distance_of(ball)[0] == pytest.approx(ball.camera.focal_length)


def test_pixels_that_are_wider_than_high() -> None:
    """Slopes are over rays, not over pixels: lights were 5.1 deg off."""
    settings = SceneSettings(views=1, lights=12, size=96)
    scene = make_scene(settings)
    camera = scene.cameras[0]
    wide = replace(camera, K=camera.K * np.array([[1.35], [0.9], [1.0]]), width=130)
    capture, truth = render_capture(settings, replace(scene, cameras=(wide,)))
    found = reconstruct(capture, Settings("made", preset="draft"), None, Progress())
    assert angles_deg(found.lights.direction[0], truth.direction["view_01"]).mean() < 2.0
