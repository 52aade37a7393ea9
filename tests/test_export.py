"""A result folder: every file read back, the same bytes twice, whole or not at all, and what other programs make of it."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from references import linear_from_srgb
from sphere_scene import SphereScene, make_sphere

import mvps.export
from mvps.export import read_reconstruction, write_reconstruction
from mvps.folders import appearing_whole
from mvps.mesh import decimated
from mvps.meshfile import read_ply
from mvps.pbr import reflectance_scale
from mvps.scene import CaptureError, Material, Reconstruction, Surface, Truth
from mvps.texture import Textures, bake
from mvps.visibility import camera_hits, interpolate, ray_caster

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(3, coloured_lobes=True)


@pytest.fixture(scope="module")
def textures(scene: SphereScene) -> Textures:
    r = scene.reconstruction
    return bake(r.surface, r.material, r.lights, scene.capture, 2)[0]


@pytest.fixture
def folder(scene: SphereScene, textures: Textures, tmp_path: Path) -> Path:
    write_reconstruction(scene.reconstruction, tmp_path / "result", textures, "<p>report</p>")
    return tmp_path / "result"


@pytest.fixture
def levels(scene: SphereScene, tmp_path: Path) -> Path:
    """A result with a second model of 100 faces."""
    r = scene.reconstruction
    full, level = bake(r.surface, r.material, r.lights, scene.capture, 2, [decimated(r.surface, 100)])
    write_reconstruction(r, tmp_path / "levels", full, "", {100: level})
    return tmp_path / "levels"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def assert_same(a: Reconstruction, b: Reconstruction) -> None:
    for name in ("vertices", "faces"):
        np.testing.assert_array_equal(getattr(a.surface, name), getattr(b.surface, name))
    for name in ("normal", "albedo", "specular_weight", "sharpness", "confidence"):
        np.testing.assert_array_equal(getattr(a.material, name), getattr(b.material, name))
    for name in ("direction", "intensity"):
        for x, y in zip(getattr(a.lights, name), getattr(b.lights, name), strict=True):
            np.testing.assert_array_equal(x, y)
    for x, y in zip(a.normal_maps, b.normal_maps, strict=True):
        np.testing.assert_array_equal(x, y)
    for name in ("views", "light_names", "metrics", "settings"):
        assert getattr(a, name) == getattr(b, name)
    assert (a.lights.one_rig, a.lights.fixed) == (b.lights.one_rig, b.lights.fixed)


def test_what_is_read_is_what_was_written(scene: SphereScene, folder: Path) -> None:
    assert_same(read_reconstruction(folder), scene.reconstruction)


def test_a_rig_that_stands_still_in_the_world(scene: SphereScene, tmp_path: Path) -> None:
    r = scene.reconstruction
    fixed = replace(r, lights=replace(r.lights, fixed=True))
    write_reconstruction(fixed, tmp_path / "result")
    record = json.loads((tmp_path / "result" / "lights.json").read_text())
    assert record["fixed"] is True and record["one_rig"] is False
    assert_same(read_reconstruction(tmp_path / "result"), fixed)
    # Results of before such rigs were told have no word of it.
    del record["fixed"]
    (tmp_path / "result" / "lights.json").write_text(json.dumps(record))
    old = read_reconstruction(tmp_path / "result").lights
    assert not old.one_rig and not old.fixed


def test_views_keep_their_order_and_may_have_no_light_and_no_lobe(scene: SphereScene, tmp_path: Path) -> None:
    r = scene.reconstruction
    empty = np.zeros((0, 3))
    lights = replace(r.lights, direction=(*r.lights.direction[:5], empty), intensity=(*r.lights.intensity[:5], empty), one_rig=False)
    n = len(r.material.albedo)
    material = Material(r.material.normal, r.material.albedo, np.zeros((n, 0)), np.zeros(0), np.zeros(n))
    changed = replace(r, lights=lights, material=material, views=tuple("fedcba"), light_names=(*r.light_names[:5], ()))
    write_reconstruction(changed, tmp_path / "result")
    assert_same(read_reconstruction(tmp_path / "result"), changed)


def test_the_contract_names_exactly_these_files(scene: SphereScene, folder: Path) -> None:
    views = {f"normals/{view}.{end}" for view in scene.reconstruction.views for end in ("npy", "png")}
    pictures = {f"model_{name}.png" for name in ("base_color", "normal", "roughness", "specular")}
    files = {
        "mesh.ply",
        "model.glb",
        "model.obj",
        "model.mtl",
        "lights.json",
        "material.npz",
        "report.html",
        "metrics.json",
        "settings.json",
    }
    assert set(contents(folder)) == files | views | pictures


def test_a_smaller_model_stands_beside_the_full_one(folder: Path, levels: Path) -> None:
    full, files = contents(folder), contents(levels)
    small = {name for name in files if "_100" in name}
    ends = [".glb", ".mtl", ".obj", *(f"_{name}.png" for name in ("base_color", "normal", "roughness", "specular"))]
    assert small == {"mesh_100.ply", *(f"model_100{end}" for end in ends)} and set(files) - small == set(full) - {"report.html"}
    assert all(files[name] == full[name] for name in set(files) - small)
    for name in ("model_100.glb", "model_100.obj", "mesh_100.ply"):
        assert len(trimesh.load(levels / name, force="mesh", process=False).faces) == 100
    named = {word for line in (levels / "model_100.mtl").read_text().splitlines() for word in line.split() if word.endswith(".png")}
    assert named == {name for name in small if name.endswith(".png")}


def test_a_smaller_ply_has_the_full_one_s_normals_and_colours(scene: SphereScene, levels: Path) -> None:
    full, small = (read_ply(levels / name) for name in ("mesh.ply", "mesh_100.ply"))
    np.testing.assert_allclose(np.linalg.norm(small.normals, axis=1), 1)
    # Decimation keeps vertices near those of the full mesh: of a sphere's, the closest is nearly the nearest point.
    closest = np.linalg.norm(small.vertices[:, None] - full.vertices[None], axis=2).argmin(1)
    assert np.degrees(np.arccos((small.normals * full.normals[closest]).sum(1).clip(-1, 1))).max() < 15
    assert np.abs(small.colours.astype(int) - full.colours[closest]).mean() < 5


def test_same_reconstruction_same_bytes(scene: SphereScene, folder: Path, tmp_path: Path) -> None:
    r = scene.reconstruction
    write_reconstruction(
        read_reconstruction(folder), tmp_path / "again", bake(r.surface, r.material, r.lights, scene.capture, 2)[0], "<p>report</p>"
    )
    assert contents(tmp_path / "again") == contents(folder)


def test_lights_file_is_the_contract(scene: SphereScene, folder: Path) -> None:
    record = json.loads((folder / "lights.json").read_text())
    assert record["one_rig"] is True and list(record["views"]) == list(scene.reconstruction.views)
    view = record["views"]["view_02"]
    np.testing.assert_array_equal(view["direction"], scene.reconstruction.lights.direction[1])
    np.testing.assert_array_equal(view["intensity"], scene.reconstruction.lights.intensity[1])
    assert view["lights"] == list(range(1, 11))


def test_other_programs_read_the_ply(scene: SphereScene, folder: Path) -> None:
    mesh = trimesh.load(folder / "mesh.ply", process=False)
    np.testing.assert_array_equal(mesh.vertices, scene.reconstruction.surface.vertices)
    np.testing.assert_array_equal(mesh.faces, scene.reconstruction.surface.faces)
    np.testing.assert_allclose(mesh.vertex_normals, scene.reconstruction.material.normal, atol=1e-12)
    albedo = linear_from_srgb(mesh.visual.vertex_colors[:, :3]) * reflectance_scale(scene.reconstruction.material)
    # Half a step of 8-bit sRGB is at most 0.45 % of full scale.
    np.testing.assert_allclose(albedo, scene.reconstruction.material.albedo, atol=0.0045 * reflectance_scale(scene.reconstruction.material))


def test_normal_pictures_show_the_normals_where_there_are_any(scene: SphereScene, folder: Path) -> None:
    normals = scene.reconstruction.normal_maps[3]
    picture = cv2.imread(str(folder / "normals" / "view_04.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    inside = np.isfinite(normals).all(-1)
    assert (picture[~inside] == 0).all() and inside.any()
    np.testing.assert_allclose(picture[inside] / 127.5 - 1, normals[inside], atol=1 / 250)


def test_glb_read_back_by_trimesh(scene: SphereScene, textures: Textures, folder: Path) -> None:
    mesh = next(iter(trimesh.load(folder / "model.glb", process=False).geometry.values()))
    atlas = textures.atlas
    assert len(mesh.vertices) == len(atlas.uv) and len(mesh.faces) == len(scene.reconstruction.surface.faces)
    np.testing.assert_allclose(mesh.vertices, scene.reconstruction.surface.vertices[atlas.vertex], rtol=1e-6, atol=1e-5)
    # trimesh counts v from the bottom.
    np.testing.assert_allclose(mesh.visual.uv, np.stack([atlas.uv[:, 0], 1 - atlas.uv[:, 1]], -1), atol=1e-6)
    material = mesh.visual.material
    np.testing.assert_array_equal(np.asarray(material.baseColorTexture)[..., :3], textures.base_color)
    np.testing.assert_array_equal(np.asarray(material.normalTexture)[..., :3], textures.normal_map)
    np.testing.assert_array_equal(np.asarray(material.metallicRoughnessTexture)[..., 1], textures.roughness)
    assert material.metallicFactor == 0 and (np.asarray(material.metallicRoughnessTexture)[..., 2] == 0).all()


def test_the_benchmark_reads_the_normals_that_the_model_holds(
    scene: SphereScene, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At pixels, the file's normal map gives the refined normals, which are waves of six degrees, and the mesh alone does not."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from model_normals import model_normal_errors

    r, capture = scene.reconstruction, tmp_path / "capture"
    pictures = []
    for view in scene.capture.views:
        hits = camera_hits(ray_caster(r.surface), view.camera, view.pixels)
        normal = interpolate(r.surface, hits, r.material.normal)
        picture = np.full((*view.mask.shape, 3), np.nan, np.float32)
        picture[view.mask] = np.where(
            hits.face[:, None] >= 0, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9), np.nan
        )
        pictures.append(picture)
    names = [view.name for view in scene.capture.views]
    truth = Truth(tuple(names), dict(zip(names, pictures, strict=True)), {}, {}, None)
    monkeypatch.setattr("model_normals.read_truth", lambda _: truth)
    monkeypatch.setattr("model_normals.read_capture", lambda *_, **__: scene.capture)
    errors = model_normal_errors(folder / "model.glb", capture)
    assert errors["model_normal_error_deg"] < 1 < 3 < errors["model_normal_error_without_map_deg"]


def test_a_model_far_from_the_world_s_origin_keeps_its_shape(
    scene: SphereScene, textures: Textures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Single precision has steps of half a metre there, a hundredth of the object."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from glb import read_glb

    vertices = scene.reconstruction.surface.vertices + np.array([4e6, 5e6, 300])
    surface = Surface(vertices, scene.reconstruction.surface.faces)
    away = replace(scene.reconstruction, surface=surface)
    write_reconstruction(away, tmp_path / "out", replace(textures, surface=surface), "")
    for mesh in (
        trimesh.load_scene(tmp_path / "out" / "model.glb", process=False).to_mesh(),
        trimesh.load(tmp_path / "out" / "model.obj", process=False),
    ):
        assert np.abs(mesh.triangles - vertices[surface.faces]).max() < 1e-5
    assert np.abs(read_glb(tmp_path / "out" / "model.glb").position - vertices[textures.atlas.vertex]).max() < 1e-5


def test_obj_read_back_by_trimesh(scene: SphereScene, textures: Textures, folder: Path) -> None:
    mesh = trimesh.load(folder / "model.obj", process=False)
    corners = scene.reconstruction.surface.vertices[scene.reconstruction.surface.faces]
    np.testing.assert_allclose(mesh.triangles, corners, rtol=1e-8, atol=1e-8)
    uv = textures.atlas.uv[textures.atlas.faces]
    np.testing.assert_allclose(mesh.visual.uv[mesh.faces], np.stack([uv[..., 0], 1 - uv[..., 1]], -1), atol=1e-8)
    np.testing.assert_array_equal(np.asarray(mesh.visual.material.image)[..., :3], textures.base_color)
    named = {word for line in (folder / "model.mtl").read_text().splitlines() for word in line.split() if word.endswith(".png")}
    assert named == {p.name for p in folder.glob("model_*.png")}


VALIDATOR = """
const validator = require('gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2]))).then(r => console.log(JSON.stringify(r.issues)));
"""


@pytest.mark.node
def test_glb_is_valid_to_khronos(folder: Path, levels: Path, tmp_path: Path) -> None:
    if not shutil.which("npm"):
        pytest.skip("no npm: install Node.js")
    subprocess.run(["npm", "install", "--silent", "--prefix", ".", "gltf-validator@2.0.0-dev.3.10"], cwd=tmp_path, check=True)
    (tmp_path / "validate.js").write_text(VALIDATOR)

    def issues(file: Path) -> dict[str, int]:
        ran = subprocess.run(["node", "validate.js", str(file)], cwd=tmp_path, check=True, capture_output=True, text=True)
        counts: dict[str, int] = json.loads(ran.stdout)
        return counts

    for file in (folder / "model.glb", levels / "model_100.glb"):
        found = issues(file)
        assert found["numErrors"] == 0 and found["numWarnings"] == 0, found
    damaged = tmp_path / "damaged.glb"
    damaged.write_bytes((folder / "model.glb").read_bytes().replace(b'"VEC4"', b'"VEC2"'))
    assert issues(damaged)["numErrors"] > 0


# ------------------------------------------------------------------------------------------------ whole or not at all


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
def test_an_interrupted_write_leaves_nothing(
    scene: SphereScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    def fails(*_: object) -> None:
        raise error

    monkeypatch.setattr(mvps.export.np, "save", fails)
    with pytest.raises(error):
        write_reconstruction(scene.reconstruction, tmp_path / "result")
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_write_leaves_the_earlier_result(folder: Path, scene: SphereScene, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(folder)

    def fails(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(mvps.export.np, "save", fails)
    with pytest.raises(KeyboardInterrupt):
        write_reconstruction(replace(scene.reconstruction, settings={"seed": 1}), folder)
    assert contents(folder) == before and list(folder.parent.iterdir()) == [folder]


def test_a_request_to_end_while_results_change_places_waits_for_the_new_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "result").mkdir()
    (tmp_path / "result" / "mark").write_text("old")
    rename = Path.rename

    def interrupted(path: Path, to: Path) -> Path:
        moved = rename(path, to)
        if str(to).endswith("replaced"):
            signal.raise_signal(signal.SIGINT)
        return moved

    monkeypatch.setattr(Path, "rename", interrupted)
    # Whoever runs the tests in the background may have let them ignore this signal.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), appearing_whole(tmp_path / "result", ("mark",)) as folder:
            (folder / "mark").write_text("new")
    finally:
        signal.signal(signal.SIGINT, before)
    assert [p.name for p in tmp_path.iterdir()] == ["result"] and (tmp_path / "result" / "mark").read_text() == "new"


def test_a_failing_rename_puts_the_earlier_result_back(folder: Path, scene: SphereScene, monkeypatch: pytest.MonkeyPatch) -> None:
    before, rename = contents(folder), Path.rename

    def fails(self: Path, target: Path) -> Path:
        if self.name.endswith(".writing"):
            raise OSError("disk")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fails)
    with pytest.raises(OSError, match="disk"):
        write_reconstruction(scene.reconstruction, folder)
    assert contents(folder) == before and list(folder.parent.iterdir()) == [folder]


def test_an_earlier_result_is_replaced_whole(folder: Path, scene: SphereScene) -> None:
    write_reconstruction(replace(scene.reconstruction, settings={"seed": 1}), folder)
    assert read_reconstruction(folder).settings == {"seed": 1}
    assert not (folder / "model.glb").exists() and list(folder.parent.iterdir()) == [folder]


def test_an_empty_folder_and_missing_parents_are_no_obstacle(scene: SphereScene, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for place in (tmp_path / "empty", tmp_path / "deep" / "er" / "result"):
        write_reconstruction(scene.reconstruction, place)
        assert_same(read_reconstruction(place), scene.reconstruction)


def test_other_peoples_files_are_left_alone(scene: SphereScene, tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "settings.json").write_text("{}")
    with pytest.raises(CaptureError, match=r"thesis: wanted a new or empty folder or an earlier result, given a folder with other files"):
        write_reconstruction(scene.reconstruction, tmp_path / "thesis")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(CaptureError, match="file: wanted a folder to write to, given a file"):
        write_reconstruction(scene.reconstruction, tmp_path / "file")
    with pytest.raises(CaptureError, match="wanted a new or empty folder, given a folder with other files"), appearing_whole(tmp_path):
        pass
    assert (tmp_path / "file").read_text() == "mine" and (tmp_path / "thesis" / "settings.json").read_text() == "{}"


def test_what_appears_in_the_meantime_is_left_alone(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="given a folder with other files"), appearing_whole(tmp_path / "out") as writing:
        (writing / "ours").write_text("1")
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "theirs").write_text("2")
    assert contents(tmp_path) == {"out/theirs": b"2"}


# ------------------------------------------------------------------------------------------------ messages


@pytest.mark.parametrize("value", [float("nan"), np.float32(1), {1, 2}])
def test_values_that_are_no_json_are_named(scene: SphereScene, tmp_path: Path, value: object) -> None:
    with pytest.raises(ValueError, match="metrics: wanted plain JSON values"):
        write_reconstruction(replace(scene.reconstruction, metrics={"residual": value}), tmp_path / "result")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_no_result_is_named(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"wanted a result folder, given one without mesh.ply, material.npz, lights.json"):
        read_reconstruction(tmp_path)


def damage_normals(folder: Path) -> None:
    (folder / "normals" / "view_03.npy").unlink()


def cut(name: str) -> object:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-7])


def edit_lights(folder: Path, **changes: object) -> None:
    record = json.loads((folder / "lights.json").read_text())
    record["views"]["view_01"] |= changes
    (folder / "lights.json").write_text(json.dumps(record))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (damage_normals, "wanted a whole result, given a damaged one .*view_03.npy"),
        (cut("material.npz"), "wanted a whole result"),
        (cut("mesh.ply"), r"mesh.ply: wanted \d+ bytes after the header, given \d+"),
        (lambda f: (f / "mesh.ply").write_bytes(b"ply\nformat ascii 1.0\nend_header\n"), "wanted a PLY file with the properties that mvps"),
        (lambda f: (f / "mesh.ply").write_bytes(b""), "wanted a PLY file"),
        (cut("metrics.json"), "metrics.json: wanted JSON, given something else"),
        (lambda f: (f / "settings.json").write_text("[]"), "settings.json: wanted a JSON object"),
        (lambda f: (f / "lights.json").write_text("{}"), "lights.json: wanted a JSON object"),
        (lambda f: edit_lights(f, direction=[[0, 0, 1]]), "wanted 10 rows of direction for view_01, given 1"),
        (lambda f: edit_lights(f, direction=[[0, 0, 2]] * 10), "wanted unit vectors"),
        (lambda f: edit_lights(f, direction="up"), "wanted a whole result"),
        (lambda f: edit_lights(f, lights=None), "wanted a whole result"),
    ],
)
def test_damaged_results_are_named(folder: Path, damage: object, message: str) -> None:
    damage(folder)  # type: ignore[operator]
    with pytest.raises(CaptureError, match=message):
        read_reconstruction(folder)
