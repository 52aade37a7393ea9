"""Synthetic captures: the laws of rendering, the truth that goes with them, and the files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from references import is_closed, signed_volume

from mvps.command import run
from mvps.load import read_calibrated_lights, read_capture, read_truth
from mvps.measures import angles_deg, mesh_normal_errors
from mvps.mesh import largest_pieces, vertex_normals
from mvps.rendering import points_under
from mvps.scene import Camera, CaptureError, Lights, Surface
from mvps.synthetic.__main__ import main
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import Scene, make_scene, photograph_scene, render_capture
from mvps.synthetic.settings import SceneSettings
from mvps.synthetic.shape import Shape, mesh_of
from mvps.visibility import RayCaster

SMALL = SceneSettings(views=3, lights=4, size=64)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(SMALL)


def moved(scene: Scene, rotation: np.ndarray, translation: np.ndarray, scale: float) -> Scene:
    """The same scene after x -> scale * rotation @ x + translation of the whole world."""
    material = scene.material
    cameras = tuple(
        Camera(c.K, c.rotation @ rotation.T, scale * c.translation - c.rotation @ rotation.T @ translation, c.height, c.width)
        for c in scene.cameras
    )
    return Scene(
        Surface(scale * scene.surface.vertices @ rotation.T + translation, scene.surface.faces),
        type(material)(material.normal @ rotation.T, material.albedo, material.specular_weight, material.sharpness, material.confidence),
        cameras,
        Lights(tuple(d @ rotation.T for d in scene.lights.direction), scene.lights.intensity, scene.lights.one_rig),
    )


def some_rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


@pytest.mark.parametrize(
    ("rotation", "translation", "scale"),
    [
        (some_rotation(0), np.array([40.0, -300.0, 75.0]), 1.0),
        (np.eye(3), np.zeros(3), 1e-3),
        (np.eye(3), np.zeros(3), 1e3),
        (some_rotation(1), np.array([1e3, 2e3, -3e3]), 25.4),
    ],
)
def test_images_do_not_depend_on_the_world_frame_and_its_unit(
    scene: Scene, rotation: np.ndarray, translation: np.ndarray, scale: float
) -> None:
    masks, radiances, normals = photograph_scene(scene)
    moved_masks, moved_radiances, moved_normals = photograph_scene(moved(scene, rotation, translation, scale))
    for i in range(len(masks)):
        # Embree's single precision decides rays that graze an edge: a few pixels of the outline and of shadow borders.
        assert (masks[i] != moved_masks[i]).sum() <= 2
        both = masks[i] & moved_masks[i]
        a, b = radiances[i][both[masks[i]]], moved_radiances[i][both[moved_masks[i]]]
        assert (np.abs(a - b) > 1e-3 * radiances[i].max()).mean() < 2e-3
        turned = normals[i][both] @ rotation.T
        assert np.median(angles_deg(turned, moved_normals[i][both])) < 1e-3


def test_units_of_the_settings_leave_the_photographs_alone() -> None:
    reference, _ = render_capture(SMALL)
    metres, truth = render_capture(SceneSettings(views=3, lights=4, size=64, extent=0.15))
    assert np.ptp(truth.surface.vertices, axis=0).max() < 0.15
    for a, b in zip(reference.views, metres.views, strict=True):
        assert (a.mask != b.mask).sum() <= 2
    assert abs(np.mean(reference.views[0].samples) / np.mean(metres.views[0].samples) - 1) < 1e-3


def test_truth_normals_are_the_mesh_s(scene: Scene) -> None:
    capture, truth = render_capture(SMALL, scene)
    errors = mesh_normal_errors(truth.surface, truth.normals, capture)
    assert errors["normal_error_median_deg"] < 1
    assert errors["normal_error_deg"] < 2
    assert errors["normal_coverage"] == 1


@pytest.mark.parametrize("seed", [0, 1, 7])
def test_the_mesh_lies_on_the_zero_set(seed: int) -> None:
    shape = Shape(np.random.default_rng(seed))
    surface, normal = mesh_of(shape, 96)
    assert is_closed(surface)
    assert signed_volume(surface) > 0
    assert len(largest_pieces(surface).faces) == len(surface.faces)
    assert np.abs(shape(surface.vertices)).max() < 1e-6
    assert np.median(angles_deg(vertex_normals(surface), normal)) < 1


def test_skipping_blocks_changes_nothing() -> None:
    """Slow twin: the function on every node of the grid."""
    from skimage.measure import marching_cubes

    shape = Shape(np.random.default_rng(3))
    surface, _ = mesh_of(shape, 48)
    nodes = -1.1 + 2.2 / 48 * np.arange(48)
    values = shape(np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), -1))
    vertices, faces, _, _ = marching_cubes(values, 0.0, allow_degenerate=False)
    assert len(vertices) == len(surface.vertices) and len(faces) == len(surface.faces)


def test_the_gradient_stays_below_the_bound_that_skipping_blocks_relies_on() -> None:
    points = np.random.default_rng(0).uniform(-1.1, 1.1, (50_000, 3))
    for seed in range(3):
        gradient = Shape(np.random.default_rng(seed)).gradient(points)
        assert np.linalg.norm(gradient, axis=-1).max() < Shape.LIPSCHITZ


def test_without_gloss_the_lit_pixels_are_lambertian() -> None:
    settings = SceneSettings(views=2, lights=6, size=96, strength=0, noise=0, exposure=1.0)
    scene = make_scene(settings)
    capture, truth = render_capture(settings, scene)
    caster = RayCaster(scene.surface)
    ratios = []
    for view in capture.views:
        albedo = points_under(caster, scene.material, view.camera, view.pixels).albedo
        cosine = truth.normals[view.name][view.mask] @ truth.direction[view.name].T
        predicted = albedo[:, None] * cosine[..., None] * truth.intensity[view.name]
        lit = (cosine > 0.3) & (view.samples.min(-1) > 0)
        ratios.append((view.radiance() / predicted)[lit])
    ratio = np.concatenate(ratios).ravel()
    # One exposure for all: the spread is that of pixels on edges of patches, creases and shadows.
    assert np.subtract(*np.quantile(ratio, [0.9, 0.1])) < 0.05 * np.median(ratio)


def test_gloss_shadows_noise_and_clipping_are_there(scene: Scene) -> None:
    capture, truth = render_capture(SMALL, scene)
    samples = np.concatenate([view.samples.reshape(-1, 3) for view in capture.views])
    assert 0.0005 < (samples == 65535).mean() < 0.002, "the brightest thousandth is clipped"
    view = capture.views[0]
    cosine = truth.normals[view.name][view.mask] @ truth.direction[view.name].T
    dark = view.radiance().max(-1) < 4 * SMALL.noise
    assert (dark & (cosine < -0.1)).any(), "attached shadow"
    assert (dark & (cosine > 0.3)).mean() > 0.005, "cast shadow"
    matt, _ = render_capture(SceneSettings(views=3, lights=4, size=64, strength=0, noise=0))
    assert np.median(matt.views[0].samples) > 1.2 * np.median(view.samples), "highlights take up the range of the codes"
    quiet, _ = render_capture(SceneSettings(views=3, lights=4, size=64, noise=0), scene)
    difference = view.radiance() - quiet.views[0].radiance()
    middle = (quiet.views[0].samples > 2000) & (quiet.views[0].samples < 60000)
    assert difference[middle].std() == pytest.approx(SMALL.noise, rel=0.05)


def test_lights_of_a_rig_stand_still_in_the_camera_s_frame(scene: Scene) -> None:
    local = [d @ c.rotation.T for d, c in zip(scene.lights.direction, scene.cameras, strict=True)]
    assert scene.lights.one_rig
    assert np.allclose(local[0], local[1]) and np.allclose(local[0], local[2])
    angle = angles_deg(local[0], np.broadcast_to((0.0, 0.0, -1.0), local[0].shape))
    assert angle.max() <= SMALL.spread
    assert np.mean(scene.lights.intensity) == pytest.approx(1)


def test_free_lights_differ_from_view_to_view() -> None:
    scene = make_scene(SceneSettings(views=3, lights=40, size=32, free_lights=True))
    local = [d @ c.rotation.T for d, c in zip(scene.lights.direction, scene.cameras, strict=True)]
    assert not scene.lights.one_rig
    assert np.median(angles_deg(local[0], local[1])) > 10
    spread = np.log(np.concatenate(scene.lights.intensity)).std()
    assert spread == pytest.approx(0.35, rel=0.25)


def test_same_seed_same_bytes_other_seed_other_scene(tmp_path: Path) -> None:
    settings = SceneSettings(views=2, lights=2, size=32)
    for name in ("a", "b"):
        write_capture(*render_capture(settings), tmp_path / name)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) == 3 + 2 * (2 + 5)
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file
    other, _ = render_capture(SceneSettings(views=2, lights=2, size=32, seed=1))
    first, _ = render_capture(settings)
    assert not np.array_equal(other.views[0].mask, first.views[0].mask)


def test_what_is_written_is_what_is_read(tmp_path: Path, scene: Scene) -> None:
    capture, truth = render_capture(SMALL, scene)
    write_capture(capture, truth, tmp_path / "made")
    read, read_true = read_capture(tmp_path / "made"), read_truth(tmp_path / "made")
    for a, b in zip(capture.views, read.views, strict=True):
        assert (a.name, a.lights, a.saturation, a.scale) == (b.name, b.lights, b.saturation, b.scale)
        assert np.array_equal(a.mask, b.mask) and np.array_equal(a.samples, b.samples)
        for part in ("K", "rotation", "translation"):
            assert np.allclose(getattr(a.camera, part), getattr(b.camera, part), rtol=1e-12, atol=1e-12)
        assert np.allclose(truth.normals[a.name], read_true.normals[a.name], atol=1e-6, equal_nan=True)
        assert np.allclose(truth.direction[a.name], read_true.direction[a.name], atol=1e-8)
        assert np.allclose(truth.intensity[a.name], read_true.intensity[a.name], rtol=1e-8)
    assert np.array_equal(truth.surface.vertices, read_true.surface.vertices)
    assert np.array_equal(truth.surface.faces, read_true.surface.faces)
    assert read_calibrated_lights(tmp_path / "made", read).one_rig


@pytest.mark.parametrize(
    ("settings", "wanted"),
    [
        ({"views": 0}, "views: wanted at least 1, given 0"),
        ({"lights": 0}, "lights: wanted at least 1"),
        ({"size": -3}, "size: wanted at least 1"),
        ({"strength": -1.0}, "strength: wanted 0 or more"),
        ({"size": 10_001}, "size: wanted at most 10000"),
        ({"noise": float("nan")}, "noise: wanted 0 or more"),
        ({"noise": float("inf")}, "noise: wanted 0 or more, and finite"),
        ({"seed": -1}, "seed: wanted 0 or more"),
        ({"intensity_spread": -0.1}, "intensity_spread: wanted 0 or more"),
        ({"spread": 90.0}, "spread: wanted degrees in"),
        ({"extent": 0.0}, "extent: wanted a positive length"),
        ({"exposure": 0.0}, "exposure: wanted a share"),
    ],
)
def test_settings_that_make_no_scene(settings: dict[str, float], wanted: str) -> None:
    with pytest.raises(ValueError, match=wanted):
        SceneSettings(**settings)


def test_nothing_is_overwritten(tmp_path: Path, scene: Scene) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(CaptureError, match="wanted a new or empty folder"):
        write_capture(*render_capture(SMALL, scene), tmp_path)
    with pytest.raises(CaptureError, match="wanted a new or empty folder"):
        write_capture(*render_capture(SMALL, scene), tmp_path / "mine.txt")
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "made"
    arguments = ["--out", str(out), "--views", "2", "--lights", "3", "--size", "32", "--quiet"]
    assert run(main, arguments) == 0
    assert [len(view.lights) for view in read_capture(out).views] == [3, 3]
    assert run(main, arguments) == 2
    assert "wanted a new or empty folder" in capsys.readouterr().err
    assert run(main, ["--out", str(tmp_path / "none"), "--views", "0"]) == 2
    assert "views: wanted at least 1, given 0" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
