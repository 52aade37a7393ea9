"""The command that compares a result folder with a capture's ground truth."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvps.command import run
from mvps.evaluate import PROTOCOLS, ROWS, evaluate_result, main, protocol_list, read_views, support_height, table, write_json
from mvps.export import read_reconstruction, write_reconstruction
from mvps.load import read_truth
from mvps.mesh import vertex_normals
from mvps.meshfile import ply_bytes, read_ply
from mvps.scene import Camera, Capture, Reconstruction, Surface, Truth, View
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import make_scene, render_capture
from mvps.synthetic.settings import SceneSettings

OFFSET_MM = 0.4


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A synthetic capture, and as its result the truth, grown by OFFSET_MM."""
    root = tmp_path_factory.mktemp("evaluate")
    settings = SceneSettings(views=3, lights=4, size=64, noise=0)
    scene = make_scene(settings)
    capture, truth = render_capture(settings, scene)
    write_capture(capture, truth, root / "capture")
    grown = Surface(scene.surface.vertices + OFFSET_MM * vertex_normals(scene.surface), scene.surface.faces)
    result = Reconstruction(
        grown,
        scene.material,
        scene.lights,
        truth.views,
        ((1, 2, 3, 4),) * 3,
        tuple(truth.normals[view] for view in truth.views),
        {"stages": [{"name": "kept", "seconds": 1.0, "peak_memory_mb": 100.0}]},
        {"hold_out_views": [2], "hold_out_lights": [3]},
    )
    write_reconstruction(result, root / "result")
    return root / "capture", root / "result"


@pytest.fixture
def result(folders: tuple[Path, Path], tmp_path: Path) -> Path:
    """A result folder that a test may change."""
    return Path(shutil.copytree(folders[1], tmp_path / "result"))


def test_figures_go_to_the_table_the_metrics_and_the_file(
    folders: tuple[Path, Path], result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(main, [str(result), "--truth", str(folders[0]), "--json", str(tmp_path / "figures.json")]) == 0
    metrics = json.loads((result / "metrics.json").read_text())
    errors = metrics["truth"]
    assert [stage["name"] for stage in metrics["stages"]] == ["kept"]
    assert json.loads((tmp_path / "figures.json").read_text()) == errors
    # In creases the grown surface is nearer than it was moved.
    assert 0.9 * OFFSET_MM < errors["chamfer_mm"] < 1.02 * OFFSET_MM
    assert errors["offset_px"] > 0
    assert errors["light_error_deg"] < 1e-5 and errors["intensity_error"] < 1e-6
    assert errors["map_held_out_normal_error_deg"] < 0.01
    assert errors["held_out_views_psnr_db"] > 20 and errors["held_out_lights_psnr_db"] > 20
    assert read_reconstruction(result).metrics["truth"] == errors
    assert capsys.readouterr().out == table(errors) + "\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["figures.json", "result"]


def test_every_figure_of_the_table_exists(folders: tuple[Path, Path], result: Path) -> None:
    run(main, [str(result), "--truth", str(folders[0])])
    errors = json.loads((result / "metrics.json").read_text())["truth"]
    keys = [key for row in ROWS["ours"] for key in row.keys if key]
    assert set(keys) <= set(errors)
    assert " - " not in table(errors) + " "


def test_what_is_absent_is_a_dash() -> None:
    lines = table({"chamfer_mm": 0.25, "mesh_normal_error_deg": 3.0}).splitlines()
    by_title = {line[:46].strip(): line[46:].split() for line in lines[2:]}
    assert by_title["Chamfer distance, mm"] == ["0.250"]
    assert by_title["mesh normals, mean error, degrees"] == ["3.00", "-", "-"]
    assert by_title["PSNR of held-out views, dB"] == ["-"]


def test_other_protocols_have_their_own_blocks(
    folders: tuple[Path, Path], result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [str(result), "--truth", str(folders[0])]
    assert run(main, command) == 0 and run(main, [*command, "--protocols", "rnbneus,psnerf", "--json", str(tmp_path / "figures.json")]) == 0
    ours, theirs = (text.strip() for text in capsys.readouterr().out.split("rnbneus: "))
    assert ours.startswith("ours: first hits") and theirs.startswith("RNb-NeuS (CVPR 2024)") and "\n\npsnerf: PS-NeRF" in theirs
    assert "100 LPIPS" in theirs and theirs.count("needs --lpips-weights") == 2
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert {name.partition("_")[0] for name in figures} == {"rnbneus", "psnerf"}
    # Vertex to the same vertex, OFFSET_MM apart, or to one that is nearer.
    assert 0.9 * OFFSET_MM < figures["rnbneus_chamfer_mm"] <= OFFSET_MM * (1 + 1e-6)
    assert figures["psnerf_normal_error_deg"] < 0.01 and figures["psnerf_light_error_deg"] < 1e-5
    kept = json.loads((result / "metrics.json").read_text())["truth"]
    assert figures.items() <= kept.items() and "chamfer_mm" in kept, "the others stay"


def test_protocols_are_all_or_some_of_those_that_there_are(
    folders: tuple[Path, Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert protocol_list("all") == tuple(PROTOCOLS) == tuple(ROWS)
    assert protocol_list("psnerf,ours,psnerf") == ("psnerf", "ours")
    command = [str(folders[1]), "--truth", str(folders[0])]
    assert "wanted all, or names among ours, supernormal, mvscps" in complaint([*command, "--protocols", "ours,dtu"], capsys)
    assert "wanted psnerf among --protocols, given ours" in complaint([*command, "--lpips-weights", "alex.pth"], capsys)
    monkeypatch.setitem(sys.modules, "lpips", None)
    assert "run pip install mvps[lpips]" in complaint([*command, "--protocols", "psnerf", "--lpips-weights", "alex.pth"], capsys)


@pytest.mark.parametrize(("name", "lights", "support"), [("bearPNG", 96, 0.0), ("bear", 96, 0.0), ("bear", 95, None), ("bunny", 96, None)])
def test_what_diligent_mv_stands_on_is_known(name: str, lights: int, support: float | None) -> None:
    views = tuple(f"view_{k:02d}" for k in range(1, 21))
    truth = Truth(views, {}, {view: np.tile([0.0, 0, 1], (lights, 1)) for view in views}, {}, None)
    camera = Camera(np.diag([10.0, 10, 1]), np.eye(3), np.zeros(3), 1, 1)
    view = View("view_01", camera, np.zeros((1, 1), bool), np.zeros((0, 0, 3), np.uint16), 1.0, 1, ())
    assert support_height(Capture(name, (view,)), truth) == support


def test_only_held_out_photographs_are_decoded(folders: tuple[Path, Path]) -> None:
    reconstruction, truth = read_reconstruction(folders[1]), read_truth(folders[0])
    lights = [view.lights for view in read_views(folders[0], reconstruction, truth).views]
    assert lights == [(3,), (1, 2, 3, 4), (3,)]
    nothing = replace(reconstruction, settings={})
    assert [view.lights for view in read_views(folders[0], nothing, truth).views] == [(1,), (1,), (1,)]


def complaint(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert run(main, arguments) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    return said.err


def test_bad_input_is_one_sentence(folders: tuple[Path, Path], result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = folders[0]
    before = (result / "metrics.json").read_bytes()
    assert "wanted a result folder" in complaint([str(capture), "--truth", str(capture)], capsys)
    assert "required" in complaint([str(result)], capsys)

    bare = tmp_path / "bare"
    shutil.copytree(capture, bare, ignore=shutil.ignore_patterns("mesh_Gt.ply", "Normal_gt.mat", "light_*.txt"))
    assert "wanted ground truth" in complaint([str(result), "--truth", str(bare)], capsys)

    other = tmp_path / "other"
    write_capture(*render_capture(SceneSettings(views=1, lights=1, size=32)), other)
    lights = json.loads((result / "lights.json").read_text())
    lights["views"] = {f"view_{int(name[5:]) + 10}": value for name, value in lights["views"].items()}
    (result / "lights.json").write_text(json.dumps(lights))
    for path in (result / "normals").iterdir():
        path.rename(path.with_name(f"view_{int(path.stem[5:]) + 10}{path.suffix}"))
    assert "wanted the capture of the result's views view_11, view_12, view_13" in complaint([str(result), "--truth", str(other)], capsys)
    assert (result / "metrics.json").read_bytes() == before

    untouched = shutil.copytree(folders[1], tmp_path / "untouched")
    places = {
        tmp_path / "missing" / "figures.json": "no such folder",
        tmp_path: "a folder",
        untouched / "metrics.json": "one of the result's own",
    }
    for place, given in places.items():
        said = complaint([str(untouched), "--truth", str(capture), "--json", str(place)], capsys)
        assert said.startswith(f"mvps: {place}: wanted a file ") and f"given {given};" in said
        assert "truth" not in json.loads((untouched / "metrics.json").read_text()) and not (untouched / "report.html").exists()


def test_a_truth_of_nothing_but_intensities_is_measured(folders: tuple[Path, Path], result: Path, tmp_path: Path) -> None:
    ignored = shutil.ignore_patterns("mesh_Gt.ply", "Normal_gt.mat", "light_directions.txt")
    lamps = shutil.copytree(folders[0], tmp_path / "lamps", ignore=ignored)
    assert run(main, [str(result), "--truth", str(folders[0]), "--protocols", "ours,psnerf"]) == 0
    assert run(main, [str(result), "--truth", str(lamps), "--json", str(tmp_path / "figures.json")]) == 0
    errors = json.loads((tmp_path / "figures.json").read_text())
    assert errors["intensity_error"] < 1e-6 and "light_error_deg" not in errors
    kept = json.loads((result / "metrics.json").read_text())["truth"]
    assert {key for key in kept if not key.startswith("psnerf_")} == set(errors), "figures of another truth are gone"
    assert "psnerf_chamfer" in kept, "another protocol's stay"


def test_a_true_mesh_whose_faces_look_inwards(folders: tuple[Path, Path], result: Path, tmp_path: Path) -> None:
    turned = shutil.copytree(folders[0], tmp_path / "turned")
    mesh = read_ply(turned / "mesh_Gt.ply")
    (turned / "mesh_Gt.ply").write_bytes(ply_bytes(mesh._replace(faces=mesh.faces[:, ::-1]), "ground truth"))
    right, other = (evaluate_result(result, truth, ("ours", "rnbneus")) for truth in (folders[0], turned))
    assert other["offset_px"] == pytest.approx(right["offset_px"]) and right["offset_px"] > 0
    key = "rnbneus_low_visibility_chamfer_mm"
    assert other[key] == pytest.approx(right[key])


def test_a_file_that_cannot_be_written_whole_stays_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    path.write_text("{}")
    with pytest.raises(ValueError):
        write_json(path, {"value": float("nan")})
    assert path.read_text() == "{}"
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.json"]


@pytest.mark.parametrize("module", ["mvps.evaluate", "mvps.synthetic"])
def test_help_loads_nothing_heavy(module: str) -> None:
    done = subprocess.run([sys.executable, "-X", "importtime", "-m", module, "--help"], capture_output=True, text=True, check=True)
    loaded = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "mvps.command" in loaded
    assert not loaded & {"torch", "skimage", "cv2", "matplotlib", "igl", "embreex", "scipy"}


@pytest.mark.parametrize("name", ["bunny", "spot", "bear", "ball"])
def test_the_truth_of_the_test_captures_agrees_with_itself(captures: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from mvps import same_object
    from mvps.measures import evaluate
    from mvps.scene import Lights, Material

    truth = read_truth(captures / name)
    if truth.surface is None:
        # Any triangle stands for the surface, and covers next to nothing of the mask.
        monkeypatch.setattr(same_object, "LEAST_OVERLAP", 0.0)
    surface = truth.surface or Surface(np.eye(3), np.array([[0, 1, 2]]))
    vertices = len(surface.vertices)
    material = Material(vertex_normals(surface), np.ones((vertices, 3)), np.zeros((vertices, 0)), np.zeros(0), np.ones(vertices))
    lights = Lights(tuple(truth.direction.values()), tuple(truth.intensity.values()), False)
    numbers = tuple(tuple(range(1, len(d) + 1)) for d in lights.direction)
    perfect = Reconstruction(surface, material, lights, truth.views, numbers, tuple(truth.normals.values()), {}, {})
    capture: Capture = read_views(captures / name, perfect, truth)
    errors = evaluate(perfect, capture, truth)
    assert errors["light_error_deg"] < 1e-5
    assert errors["map_normal_error_deg"] < 1e-3
    if truth.surface is not None:
        assert errors["chamfer_mm"] < 1e-5
        assert errors["mesh_normal_error_median_deg"] < 1
