"""Every example runs and makes its picture; none is longer than a reader takes in at once."""

import runpy
import sys
from pathlib import Path

import cv2
import pytest

from mvps.export import write_reconstruction
from mvps.mesh import vertex_normals
from mvps.scene import Lights, Material, Reconstruction
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import make_scene, render_capture
from mvps.synthetic.settings import SceneSettings

EXAMPLES = sorted((Path(__file__).resolve().parent.parent / "examples").glob("*.py"))


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_short(example: Path) -> None:
    assert len(example.read_text(encoding="utf-8").splitlines()) <= 60


def test_relight_makes_a_picture_of_four_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = SceneSettings(views=3, lights=4, size=64)
    scene = make_scene(settings)
    capture, truth = render_capture(settings, scene)
    write_capture(capture, truth, tmp_path / "capture")
    names = tuple(view.name for view in capture.views)
    lights = Lights(tuple(truth.direction[n] for n in names), tuple(truth.intensity[n] for n in names), True)
    empty = tuple(truth.normals[n] for n in names)
    material = Material(
        vertex_normals(scene.surface), *(getattr(scene.material, k) for k in ("albedo", "specular_weight", "sharpness", "confidence"))
    )
    result = Reconstruction(scene.surface, material, lights, names, tuple(view.lights for view in capture.views), empty)
    write_reconstruction(result, tmp_path / "result")
    monkeypatch.setattr(sys, "argv", ["01_relight.py", str(tmp_path / "result"), str(tmp_path / "capture"), str(tmp_path / "picture.png")])
    runpy.run_path(str(EXAMPLES[0]), run_name="__main__")
    image = cv2.imread(str(tmp_path / "picture.png"))
    width = image.shape[1] // 4
    parts = [image[:, k * width : (k + 1) * width].astype(float) for k in range(4)]
    # Four different pictures of one silhouette: white around it in all, and no two alike.
    assert all((part[0, 0] == 255).all() for part in parts)
    assert min(abs(parts[a] - parts[b]).mean() for a in range(4) for b in range(a)) > 5
