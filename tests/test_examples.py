"""Every example runs and makes its picture; none is longer than a reader takes in at once."""

from __future__ import annotations

import runpy
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
        runpy.run_path(str(path), run_name="__main__")
        image = cv2.imread(str(tmp_path / "picture.png"))
        assert image is not None
        return image.astype(float)

    return made_by


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
