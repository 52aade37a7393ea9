"""Re-rendering views: the photographs of a scene made by the same image model come out again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from sphere_scene import SphereScene, make_sphere

import mvps.render
from mvps.command import run
from mvps.export import write_reconstruction
from mvps.load import read_environment
from mvps.new_pictures import Range, write_layer
from mvps.pbr import reflectance_scale, srgb_bytes
from mvps.render import main, render_view
from mvps.rendering import RAYS_ACROSS
from mvps.scene import Camera, CaptureError, Lights, Truth, View
from mvps.synthetic.files import write_capture
from mvps.viewpoints import cameras_record, look_at
from mvps.visibility import RayCaster

SPAN = 2.0
"""Radiance of the scene's white; a capture that is read from files has white at 1."""


def as_read(view: View) -> View:
    return replace(view, scale=1 / 65535)


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    """Two views, intensities in units in which white is 1, as after reading the photographs from files."""
    made = make_sphere(3, side=RAYS_ACROSS)
    r = made.reconstruction
    views = made.capture.views[:2]
    lights = Lights(r.lights.direction[:2], tuple(e / SPAN for e in r.lights.intensity[:2]), True)
    few = replace(r, views=r.views[:2], light_names=r.light_names[:2], normal_maps=r.normal_maps[:2], lights=lights)
    return SphereScene(few, replace(made.capture, views=tuple(map(as_read, views))))


@pytest.fixture(scope="module")
def folders(scene: SphereScene, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    base = tmp_path_factory.mktemp("render")
    r = scene.reconstruction
    named = [dict(zip(r.views, values, strict=True)) for values in (r.normal_maps, r.lights.direction, r.lights.intensity)]
    write_capture(scene.capture, Truth(r.views, *named, r.surface), base / "capture")
    write_reconstruction(r, base / "result")
    return base / "result", base / "capture"


def image(path: Path) -> np.ndarray:
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert stored is not None, path
    return stored[..., ::-1] if stored.ndim == 3 else stored


def test_the_photographs_come_out_again(scene: SphereScene, folders: tuple[Path, Path], tmp_path: Path) -> None:
    result, capture = folders
    assert run(main, [str(result), "--capture", str(capture), "--views", "2", "--out", str(tmp_path / "out")]) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["view_02"]
    view = scene.capture.views[1]
    for k, number in enumerate(view.lights):
        rendered = image(tmp_path / "out" / "view_02" / f"{number:03d}.png")
        assert rendered.dtype == np.uint16 and rendered.max() > 255
        # Single precision and the rounding of the photograph.
        assert np.abs(rendered[view.mask].astype(int) - view.samples[:, k]).max() <= 2
        assert (rendered[~view.mask] == 0).all()
    np.testing.assert_array_equal(image(tmp_path / "out" / "view_02" / "mask.png") == 255, view.mask)


def test_all_views_of_the_result_without_views(folders: tuple[Path, Path], tmp_path: Path) -> None:
    result, capture = folders
    assert run(main, [str(result), "--capture", str(capture), "--out", str(tmp_path / "out")]) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["view_01", "view_02"]
    assert len(list((tmp_path / "out").rglob("0*.png"))) == 20


def test_lights_keep_their_numbers(scene: SphereScene, folders: tuple[Path, Path], tmp_path: Path) -> None:
    """A result of two of the lights: their images carry their numbers."""
    r = scene.reconstruction
    lights = Lights(tuple(d[[6, 8]] for d in r.lights.direction), tuple(e[[6, 8]] for e in r.lights.intensity), True)
    write_reconstruction(replace(r, lights=lights, light_names=((7, 9), (7, 9))), tmp_path / "result")
    assert run(main, [str(tmp_path / "result"), "--capture", str(folders[1]), "--views", "1", "--out", str(tmp_path / "out")]) == 0
    names = sorted(p.name for p in (tmp_path / "out" / "view_01").iterdir())
    assert names == ["007.png", "009.png", "mask.png"]
    rendered = image(tmp_path / "out" / "view_01" / "009.png")
    view = scene.capture.views[0]
    assert np.abs(rendered[view.mask].astype(int) - view.samples[:, 8]).max() <= 2


def test_bright_pixels_are_clipped_and_chunks_join(scene: SphereScene, monkeypatch: pytest.MonkeyPatch) -> None:
    r, camera = scene.reconstruction, scene.capture.views[0].camera
    caster = RayCaster(r.surface)
    whole, mask = render_view(caster, r, "view_01", camera)
    monkeypatch.setattr(mvps.render, "SAMPLES_PER_CHUNK", 1000)
    np.testing.assert_array_equal(render_view(caster, r, "view_01", camera)[0], whole)
    bright = replace(r, material=replace(r.material, albedo=r.material.albedo * 100))
    image, _ = render_view(caster, bright, "view_01", camera)
    assert image.max() == 65535 and (image[~mask] == 0).all() and (image >= whole).all()


def test_messages(folders: tuple[Path, Path], scene: SphereScene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result, capture = folders

    def complaint(*arguments: object) -> str:
        assert run(main, [str(a) for a in arguments]) == 2
        return capsys.readouterr().err

    out = tmp_path / "out"
    assert "wanted a result folder" in complaint(capture, "--capture", capture, "--out", out)
    assert "wanted" in (missing := complaint(result, "--capture", capture, "--views", 3, "--out", out)) and "3" in missing
    assert "wanted numbers from 1" in complaint(result, "--capture", capture, "--views", "x", "--out", out)
    assert "--capture" in complaint(result, "--out", out)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("1")
    assert "wanted a new or empty folder" in complaint(result, "--capture", capture, "--out", tmp_path / "mine")
    renamed = replace(scene.reconstruction, views=("view_08", "view_09"))
    write_reconstruction(renamed, tmp_path / "other")
    assert "wanted the capture of the result's view_08, view_09" in complaint(tmp_path / "other", "--capture", capture, "--out", out)
    given = complaint(tmp_path / "other", "--capture", capture, "--views", 1, "--out", out)
    assert "views: wanted one of the result's view_08, view_09, given view_01" in given
    assert not out.exists()
    with pytest.raises(CaptureError, match="given view_05"):
        render_view(RayCaster(scene.reconstruction.surface), scene.reconstruction, "view_05", scene.capture.views[0].camera)


def rendered_files(folders: tuple[Path, Path], out: Path, *options: str) -> list[str]:
    assert run(main, [str(folders[0]), "--out", str(out), "--quiet", *options]) == 0
    return sorted(path.name for path in out.iterdir())


def test_a_turntable_under_an_environment(folders: tuple[Path, Path], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "sky.hdr"), np.ones((8, 16, 3), np.float32))
    options = ["--turntable", "2", "--envmap", str(tmp_path / "sky.hdr"), "--envmap-lights", "32", "--size", "40x30", "--video"]
    names = rendered_files(folders, tmp_path / "out", *options, "--layers", "image,depth")
    wanted = ["depth.mp4", "image.mp4", *(f"turn_000{k}_{layer}.png" for k in (1, 2) for layer in ("depth", "image"))]
    assert names == wanted
    shown = cv2.imread(str(tmp_path / "out" / "turn_0001_image.png"), cv2.IMREAD_UNCHANGED)
    assert shown is not None and shown.shape == (30, 40, 4)
    assert shown[15, 20, 3] == 255 and shown[0, 0, 3] == 0 and 30 < shown[15, 20, :3].mean() < 255
    video = cv2.VideoCapture(str(tmp_path / "out" / "image.mp4"))
    assert video.read()[1][0, 0].min() > 240


def write_cameras(path: Path, cameras: list[Camera]) -> None:
    matrices = ("K", "rotation", "translation")
    records = [
        {"name": f"c{k}", "width": camera.width, "height": camera.height} | {name: getattr(camera, name).tolist() for name in matrices}
        for k, camera in enumerate(cameras)
    ]
    path.write_text(json.dumps({"cameras": records}))


@pytest.mark.parametrize("form", ["png16", "exr"])
def test_videos_look_alike_whatever_the_format(folders: tuple[Path, Path], tmp_path: Path, form: str) -> None:
    options = ["--turntable", "2", "--size", "40x30", "--video", "--layers", "image,normals"]
    rendered_files(folders, tmp_path / "png", *options)
    names = rendered_files(folders, tmp_path / form, *options, "--format", form)
    suffix = form.removesuffix("16")
    assert names == ["image.mp4", "normals.mp4", *(f"turn_000{k}_{layer}.{suffix}" for k in (1, 2) for layer in ("image", "normals"))]
    for layer in ("image", "normals"):
        assert (tmp_path / form / f"{layer}.mp4").read_bytes() == (tmp_path / "png" / f"{layer}.mp4").read_bytes()


@pytest.mark.parametrize("name", ["top view", "a+b", "Ansicht_ü", "x.1", "-a"])
def test_a_video_of_cameras_of_any_name(folders: tuple[Path, Path], tmp_path: Path, name: str) -> None:
    camera = look_at(np.array([400.0, 0, 0]), np.zeros(3), np.array([0.0, 0, 1]), 40, 30)
    cameras_file = tmp_path / "cameras.json"
    cameras_file.write_text(json.dumps(cameras_record({name: camera, f"{name}2": camera})))
    names = rendered_files(folders, tmp_path / "out", "--cameras", str(cameras_file), "--video")
    assert names == sorted([f"{name}_image.png", f"{name}2_image.png", "image.mp4"])
    video = cv2.VideoCapture(str(tmp_path / "out" / "image.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 2 and video.read()[1].shape == (30, 40, 3)


FAILING = '#!/bin/sh\nfor last; do :; done\necho part > "$last"\necho no room for it >&2\nexit 1\n'
"""An encoder that leaves a part of the video behind."""


@pytest.mark.parametrize(
    ("script", "said"),
    [(FAILING, "no room for it"), ("#!/bin/sh\nexit 3\n", "exit status 3"), ("", "Permission denied")],
    ids=["part", "silent", "no program"],
)
@pytest.mark.parametrize("form", ["png", "exr"])
def test_pictures_stay_where_the_encoder_fails(
    folders: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    script: str,
    said: str,
    form: str,
) -> None:
    program = tmp_path / "encoder"
    program.write_text(script)
    program.chmod(0o755 if script else 0o644)
    monkeypatch.setattr("mvps.new_pictures.ffmpeg", lambda: str(program))
    options = ["--turntable", "2", "--size", "40x30", "--video", "--format", form, "--quiet"]
    assert run(main, [str(folders[0]), "--out", str(tmp_path / "out"), *options]) == 2
    told = capsys.readouterr().err
    assert f"--video: wanted a video of 2 pictures, given an encoder that fails ({said}" in told
    assert f"the pictures are in {tmp_path / 'out'}" in told
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [f"turn_000{k}_image.{form}" for k in (1, 2)]


def test_the_first_picture_that_shows_the_object_gives_the_exposure(folders: tuple[Path, Path], tmp_path: Path) -> None:
    up = np.array([0.0, 0, 1])
    away, dim, near = (
        look_at(np.array(eye), np.array(target), up, 40, 40)
        for eye, target in (((400.0, 0, 0), (800.0, 0, 0)), ((-400.0, 0, 0), (0.0, 0, 0)), ((400.0, 0, 0), (0.0, 0, 0)))
    )
    for name, cameras in {"first": [near], "later": [away, dim, near]}.items():
        write_cameras(tmp_path / f"{name}.json", cameras)
        for layers in ("image,specular", "specular"):
            options = ["--cameras", str(tmp_path / f"{name}.json"), "--light", "1,0,0", "--layers", layers]
            rendered_files(folders, tmp_path / name / layers, *options)
    shown = {k: image(tmp_path / k / "image,specular" / f"c{c}_image.png") for k, c in (("first", 0), ("later", 2))}
    assert shown["first"][..., :3].max() == 255
    np.testing.assert_array_equal(shown["first"], shown["later"])
    alone, beside, later = (
        image(tmp_path / path)
        for path in ("first/specular/c0_specular.png", "first/image,specular/c0_specular.png", "later/specular/c2_specular.png")
    )
    assert alone[..., :3].max() > 0
    np.testing.assert_array_equal(alone, beside)
    np.testing.assert_array_equal(alone, later)


def test_depths_of_all_pictures_have_one_scale(folders: tuple[Path, Path], tmp_path: Path) -> None:
    eyes = ((400.0, 0, 0), (300.0, 0, 0))
    write_cameras(tmp_path / "c.json", [look_at(np.array(eye), np.zeros(3), np.array([0.0, 0, 1]), 40, 40) for eye in eyes])
    cameras = ["--cameras", str(tmp_path / "c.json"), "--layers", "depth"]
    rendered_files(folders, tmp_path / "exr", *cameras, "--format", "exr")
    rendered_files(folders, tmp_path / "png16", *cameras, "--format", "png16")
    depth, coverage = (
        np.stack([OpenEXR.File(str(tmp_path / "exr" / f"c{k}_depth.exr")).channels()[name].pixels for k in (0, 1)]) for name in "YA"
    )
    grey = np.stack([image(tmp_path / "png16" / f"c{k}_depth.png") for k in (0, 1)])
    seen = coverage > 0
    near, far = depth[seen].min(), depth[seen].max()
    assert far - near > 100
    np.testing.assert_allclose(grey[seen] / 65535, 1 - (depth[seen] - near) / (far - near), atol=1e-4)
    assert not grey[~seen].any()


@pytest.mark.parametrize("form", ["png16", "exr"])
def test_values_as_they_are(folders: tuple[Path, Path], scene: SphereScene, tmp_path: Path, form: str) -> None:
    view = scene.capture.views[0]
    light = ",".join(f"{x:.9g}" for x in (*scene.reconstruction.lights.direction[0][0], *scene.reconstruction.lights.intensity[0][0]))
    options = ["--capture", str(folders[1]), "--views", "1", "--light", light, "--format", form]
    rendered_files(folders, tmp_path / "out", *options, *(["--exposure", "1"] if form == "png16" else []))
    if form == "exr":
        found = read_environment(tmp_path / "out" / "view_01_image.exr")
    else:
        found = image(tmp_path / "out" / "view_01_image.png") / 65535
    photographed = np.zeros_like(found)
    photographed[view.mask] = view.radiance()[:, 0]
    inner = cv2.erode(view.mask.astype(np.uint8), np.ones((5, 5))) > 0
    np.testing.assert_allclose(found[inner].clip(0, 1), photographed[inner].clip(0, 1), atol=0.02)


def test_light_of_pixels_that_are_covered_in_part(tmp_path: Path) -> None:
    """Of the whole pixel, but where PNG has its coverage beside it; values are those of what is covered."""
    values, coverage = np.full((1, 3, 3), 0.5, np.float32), np.array([[0.0, 0.25, 1.0]], np.float32)
    for layer, wanted in (("image", 0.5 * coverage[0]), ("albedo", np.full(3, 0.5))):
        for form in ("exr", "png16", "png"):
            write_layer(tmp_path, form, layer, values, coverage, Range(1.0, 0.0, 1.0, 1.0), form)
        channels = OpenEXR.File(str(tmp_path / "exr.exr")).channels()
        found = channels["RGB"].pixels if "RGB" in channels else channels["RGBA"].pixels
        np.testing.assert_allclose(found[0, :, 1], wanted)
        np.testing.assert_allclose(image(tmp_path / "png16.png")[0, :, 1] / 65535, wanted, atol=1e-4)
        stored = cv2.imread(str(tmp_path / "png.png"), cv2.IMREAD_UNCHANGED)
        assert stored is not None and set(stored[0, :, 1].tolist()) == {188}


@pytest.mark.parametrize("stops", [0, 6])
def test_albedo_in_png_is_over_the_object_s_white(scene: SphereScene, tmp_path: Path, stops: int) -> None:
    """However dark the capture: a colour that an edit gives comes out as it was given, and EXR has the material's own values."""
    material = scene.reconstruction.material
    darker = replace(material, albedo=material.albedo / 2**stops, specular_weight=material.specular_weight / 2**stops)
    write_reconstruction(replace(scene.reconstruction, material=darker), tmp_path / "result")
    (tmp_path / "edits.json").write_text('{"edits": [{"preset": "matte"}, {"albedo": {"colour": [0.5, 0.25, 0.125]}}]}')
    camera = ["--camera", "400,0,0", "--size", "40x40", "--layers", "albedo", "--exposure", "16"]
    folders = (tmp_path / "result", tmp_path)
    for form in ("png", "png16", "exr"):
        rendered_files(folders, tmp_path / form, *camera, "--format", form)
        rendered_files(folders, tmp_path / "edited" / form, *camera, "--format", form, "--edit", str(tmp_path / "edits.json"))
    white = reflectance_scale(darker)
    for folder, wanted in ((tmp_path / "edited", np.array([0.5, 0.25, 0.125])), (tmp_path, None)):
        found = read_environment(folder / "exr" / "camera_albedo.exr")[15:25, 15:25] / white
        if wanted is not None:
            np.testing.assert_allclose(found, np.broadcast_to(wanted, found.shape), rtol=1e-5)
        np.testing.assert_allclose(image(folder / "png16" / "camera_albedo.png")[15:25, 15:25] / 65535, found, atol=1e-5)
        coloured = cv2.imread(str(folder / "png" / "camera_albedo.png"))[15:25, 15:25, ::-1]
        np.testing.assert_allclose(coloured, srgb_bytes(found), atol=1)


def test_a_light_fixed_to_the_camera_and_an_edit(folders: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "edits.json").write_text('{"edits": [{"albedo": {"colour": [0, 1, 0]}}]}')
    options = ["--camera", "400,0,0", "--light", "-1,0,0.1", "--frame", "camera", "--size", "40x40", "--edit", str(tmp_path / "edits.json")]
    assert rendered_files(folders, tmp_path / "out", *options) == ["camera_image.png"]
    shown = image(tmp_path / "out" / "camera_image.png").astype(int)
    left, right = shown[20, 15], shown[20, 25]
    assert left.sum() > right.sum()


def test_views_under_their_own_lights_with_an_edit(folders: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "edits.json").write_text('{"edits": [{"albedo": {"factor": [0, 1, 1]}}, {"specular": {"factor": 0}}]}')
    views = ["--capture", str(folders[1]), "--views", "1"]
    assert rendered_files(folders, tmp_path / "plain", *views) == ["view_01"]
    assert rendered_files(folders, tmp_path / "edited", *views, "--edit", str(tmp_path / "edits.json")) == ["view_01"]
    plain, edited = (image(tmp_path / name / "view_01" / "001.png") for name in ("plain", "edited"))
    assert plain[..., 0].any() and not edited[..., 0].any() and edited[..., 1].any()
    assert (edited[..., 1] <= plain[..., 1]).all()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--fov", "180"], "wanted degrees below 180"),
        (["--envmap-turn", "nan"], "wanted a finite number"),
        (["--envmap-lights", "0"], "wanted 1 to 65536"),
        (["--light", "1e200,0,1"], "wanted three numbers"),
        (["--turntable", "1", "--up", "0,0,0"], "up: wanted a direction"),
        (["--camera", "400,0,0", "--up", "0,0,0"], "up: wanted a direction"),
        (["--camera", "1e99,0,0"], "wanted three numbers, separated by commas, up to 1e+12"),
        (["--turntable", "1", "--light", "1,0,0,1e99,1e99,1e99"], "wanted three numbers"),
        (["--turntable", "1", "--exposure", "1e308"], "wanted 1e-12 to 1e+12"),
        (["--turntable", "2", "--fov", "1e-30"], "wanted degrees below 180, 0.01 at least"),
        (["--cameras", "SIZES", "--video"], "--video: wanted cameras of one size, given 9 x 9 and 9 x 8"),
        (["--turntable", "1", "--envmap", "BRIGHT", "--edit", "EDIT"], "image: wanted values that are finite"),
        (["--capture", "CAPTURE", "--size", "9x9"], "--size: wanted together with"),
        (["--layers", "image,colour"], "wanted some of image"),
        (["--light", "1,2"], "wanted three numbers"),
        (["--light", "0,0,0"], "wanted a direction"),
        (["--light", "0,0,1,1,-1,1"], "wanted intensities"),
        (["--turntable", "0"], "wanted 1 to 9999 frames"),
        (["--size", "10"], "wanted width and height"),
        (["--envmap", "nowhere.hdr"], "nowhere.hdr: wanted an environment map"),
        (["--cameras", "nowhere.json"], "nowhere.json"),
        (["--camera", "0,0,0", "--target", "0,0,0"], "wanted an eye away"),
        (["--camera", "0,0,9", "--turntable", "8"], "wanted one of --cameras, --camera and --turntable, given --camera and --turntable"),
        (["--turntable", "8", "--target", "0,0,0"], "--target: wanted together with --camera"),
        (["--turntable", "8", "--views", "1"], "--views: wanted together with --capture"),
        (["--capture", "CAPTURE", "--turntable", "8", "--views", "1", "--edit", "x"], "--views: wanted together with --capture"),
        (["--capture", "CAPTURE", "--envmap-turn", "90"], "--envmap-turn: wanted together with --envmap"),
        (["--turntable", "8", "--envmap-turn", "90"], "--envmap-turn: wanted together with --envmap"),
        (["--turntable", "8", "--envmap-lights", "9"], "--envmap-lights: wanted together with --envmap"),
        (["--turntable", "8", "--frame", "camera"], "--frame: wanted together with --light or --point"),
        (["--camera", "0,0,9", "--elevation", "9"], "--elevation: wanted together with --turntable"),
        (["--cameras", "x", "--fov", "9"], "--fov: wanted together with --camera or --turntable"),
        (["--capture", "CAPTURE", "--light", "0,0,1", "--up", "1,0,0"], "--up: wanted together with --camera, --turntable or --envmap"),
        ([], "wanted --capture"),
    ],
)
def test_bad_options_write_nothing(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    looking = look_at(np.array([400.0, 0, 0]), np.zeros(3), np.array([0.0, 0, 1]), 9, 9)
    cameras = [looking, replace(looking, height=8)]
    write_cameras(tmp_path / "sizes.json", cameras)
    (tmp_path / "edit.json").write_text('{"edits": [{"albedo": {"factor": 1e6}}]}')
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, dict.fromkeys("RGB", np.full((4, 8), 1e37, np.float32))).write(str(tmp_path / "bright.exr"))
    files = {"CAPTURE": folders[1], "SIZES": tmp_path / "sizes.json", "BRIGHT": tmp_path / "bright.exr", "EDIT": tmp_path / "edit.json"}
    named = [str(files.get(option, option)) for option in options]
    assert run(main, [str(folders[0]), "--out", str(tmp_path / "out"), *named]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out").exists()
