"""Every example runs and makes its picture; none is longer than a reader takes in at once."""

from __future__ import annotations

import os
import re
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mvps.export import write_reconstruction
from mvps.mesh import vertex_normals
from mvps.scene import Lights, Material, Reconstruction
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import make_scene, render_capture
from mvps.synthetic.settings import SceneSettings

EXAMPLES = sorted((Path(__file__).resolve().parent.parent / "examples").glob("*.py"))
ENVIRONMENT = os.environ | {"PYTHONPATH": str(EXAMPLES[0].parents[1])}
Picture = Callable[..., np.ndarray]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small capture and a result that is its truth."""
    folder, settings = tmp_path_factory.mktemp("examples"), SceneSettings(views=4, lights=8, size=64)
    scene = make_scene(settings)
    capture, truth = render_capture(settings, scene)
    write_capture(capture, truth, folder / "capture")
    names = tuple(view.name for view in capture.views)
    lights = Lights(tuple(truth.direction[n] for n in names), tuple(truth.intensity[n] for n in names), True)
    material = Material(
        vertex_normals(scene.surface), *(getattr(scene.material, k) for k in ("albedo", "specular_weight", "sharpness", "confidence"))
    )
    maps = tuple(truth.normals[n] for n in names)
    result = Reconstruction(scene.surface, material, lights, names, tuple(view.lights for view in capture.views), maps)
    write_reconstruction(result, folder / "result")
    cv2.imwrite(str(folder / "sky.hdr"), np.random.default_rng(0).uniform(0, 1, (8, 16, 3)).astype(np.float32) ** 4)
    return folder


@pytest.fixture
def picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Picture:
    """The picture that an example makes, by its number and the arguments before the picture's path."""

    def made_by(number: int, *arguments: Path) -> np.ndarray:
        (path,) = [example for example in EXAMPLES if example.name.startswith(f"{number:02d}_")]
        monkeypatch.setattr(sys, "argv", [path.name, *map(str, arguments), str(tmp_path / "picture.png")])
        with pytest.raises(SystemExit, match=r"^0$"):
            runpy.run_path(str(path), run_name="__main__")
        image = cv2.imread(str(tmp_path / "picture.png"))
        assert image is not None
        return image.astype(float)

    return made_by


def complaint(number: int, *arguments: object) -> str:
    """The one sentence with which an example ends."""
    (path,) = [example for example in EXAMPLES if example.name.startswith(f"{number:02d}_")]
    ended = subprocess.run(
        [sys.executable, path, *map(str, arguments)], cwd=path.parents[1], env=ENVIRONMENT, capture_output=True, text=True
    )
    said = ended.stderr.strip().splitlines()
    assert ended.returncode == 2 and len(said) == 1 and said[0].startswith("mvps: "), ended.stderr
    return said[0]


def parts_of(image: np.ndarray, count: int) -> list[np.ndarray]:
    return np.split(image[:, : image.shape[1] // count * count], count, axis=1)


def differ(parts: list[np.ndarray], by: float) -> bool:
    return min(abs(parts[a] - parts[b]).mean() for a in range(len(parts)) for b in range(a)) > by


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_short(example: Path) -> None:
    assert len(example.read_text(encoding="utf-8").splitlines()) <= 60


def test_relight_makes_a_picture_of_four_parts(made: Path, picture: Picture) -> None:
    parts = parts_of(picture(1, made / "result", made / "capture"), 4)
    # Four different pictures of one silhouette: white around it in all, and no two alike.
    assert all((part[0, 0] == 255).all() for part in parts) and differ(parts, 5)


def test_one_view_s_normals(made: Path, picture: Picture) -> None:
    photograph, normals = parts_of(picture(2, made / "capture"), 2)
    # Normals face the camera: blue, the first channel here, is above one half.
    assert photograph.max() == 255 and normals[32, 32, 0] > 128


def test_reconstruct_from_python_predicts_a_photograph(made: Path, picture: Picture, tmp_path: Path) -> None:
    seen, predicted = parts_of(picture(3, made / "capture", tmp_path / "out"), 2)
    assert (tmp_path / "out" / "model.glb").is_file() and abs(seen - predicted).mean() < 0.05 * seen.max()


def test_an_environment_in_four_turns(made: Path, picture: Picture) -> None:
    assert differ(parts_of(picture(4, made / "result", made / "sky.hdr"), 4), 0.5)


def test_four_materials(made: Path, picture: Picture) -> None:
    assert differ(parts_of(picture(5, made / "result"), 4), 1)


def test_methods_side_by_side(made: Path, picture: Picture, tmp_path: Path) -> None:
    truth, hull, ours = parts_of(picture(6, made / "capture", tmp_path / "compared"), 3)
    below = slice(hull.shape[0] // 2 + 12, None)
    assert hull[below].mean() > ours[below].mean() > truth[below].mean()


def test_an_own_solver_block_finds_its_unknowns(picture: Picture, capsys: pytest.CaptureFixture[str]) -> None:
    assert (picture(7) < 255).any()
    words = capsys.readouterr().out.split()
    assert float(words[4].rstrip(",")) < 0.01 and float(words[7].rstrip(",")) < 0.02


def test_capture_without_truth_is_not_compared(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / "capture", tmp_path / "bare", ignore=shutil.ignore_patterns("*_gt.mat", "mesh_Gt.ply", "light_*.txt"))
    assert "wanted a capture with true normals" in complaint(6, tmp_path / "bare", tmp_path / "compared", tmp_path / "picture.png")
    assert not (tmp_path / "compared").exists()


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_without_arguments_says_what_it_wants(example: Path) -> None:
    wanted = re.search(r"^python examples/\S+ (.*)$", example.read_text(encoding="utf-8"), re.MULTILINE)
    assert wanted is not None and f"wanted {wanted[1]}, given 0 arguments" in complaint(int(example.name[:2]))


def test_examples_given_no_result_and_no_place_for_the_picture(made: Path, tmp_path: Path) -> None:
    picture, nowhere = tmp_path / "picture.png", tmp_path / "nowhere" / "picture.png"
    for number, second in ((1, made / "capture"), (4, made / "sky.hdr")):
        assert "wanted a result folder" in complaint(number, made / "capture", second, picture)
    assert f"{nowhere}: No such file" in complaint(5, made / "result", nowhere)
    assert not list(tmp_path.iterdir())
