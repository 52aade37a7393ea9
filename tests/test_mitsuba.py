"""model.glb in another program: Mitsuba shows it as we render the reconstruction."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from sphere_scene import SphereScene, make_sphere

from mvps.command import run
from mvps.export import write_reconstruction
from mvps.texture import bake

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
BAR = 30.0
"""dB."""


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    """A sphere of two colours with coloured highlights; its refined normals are waves up to 20 degrees off the mesh."""
    return make_sphere(coloured_lobes=True, tint=(1.0, 0.7, 0.4), waves=0.2)


def gap(scene: SphereScene, folder: Path, change: Callable[[Any], Any] = lambda model: model) -> float:
    """PSNR, dB, of Mitsuba's pictures of the scene's model, changed after reading, against ours."""
    from glb import read_glb
    from mitsuba_check import pairs, psnr

    few = scene.capture.select({"view_01": [1, 4], "view_04": [2]})
    compared = pairs(scene.reconstruction, change(read_glb(folder / "model.glb")), few)
    return float(np.mean([psnr(pair.mitsuba, pair.ours, pair.inside) for pair in compared]))


MISTAKES: dict[str, Callable[[Any], Any]] = {
    "green of the normal map downwards": lambda m: m._replace(bump=np.stack([m.bump[..., 0], 1 - m.bump[..., 1], m.bump[..., 2]], -1)),
    "no normal map": lambda m: m._replace(bump=np.full_like(m.bump, (0.5, 0.5, 1))),
    "colours not decoded": lambda m: m._replace(base=m.base ** (1 / 2.2)),
    "no highlights": lambda m: m._replace(specular=0 * m.specular),
    "roughness squared once too often": lambda m: m._replace(roughness=m.roughness**2),
    "texture upside down": lambda m: m._replace(uv=1 - m.uv),
}


@pytest.mark.independent
def test_mitsuba_shows_the_file_as_we_render_it(scene: SphereScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    r = scene.reconstruction
    write_reconstruction(r, tmp_path / "result", bake(r.surface, r.material, r.lights, scene.capture, 2)[0])
    assert gap(scene, tmp_path / "result") > BAR + 5
    for name, mistake in MISTAKES.items():
        assert gap(scene, tmp_path / "result", mistake) < BAR, name


@pytest.mark.independent
def test_the_files_tangents_are_those_of_its_texture_coordinates(
    scene: SphereScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that readers that make their own, of model.obj all of them, see the same relief."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from glb import read_glb, tangent_gap_deg

    r = scene.reconstruction
    write_reconstruction(r, tmp_path / "result", bake(r.surface, r.material, r.lights, scene.capture, 2)[0])
    found = tangent_gap_deg(read_glb(tmp_path / "result" / "model.glb"))
    assert found.mean() < 1.5 and np.percentile(found, 99) < 5


@pytest.mark.independent
@pytest.mark.parametrize("name", ["mitsuba_check", "levels", "blender_check"])
def test_what_is_no_result_is_refused_with_a_sentence(
    scene: SphereScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    # It is asked for nothing before the result is read.
    monkeypatch.setitem(sys.modules, "bpy", ModuleType("bpy"))
    main = import_module(name).main
    assert run(main, [str(tmp_path / "nowhere"), str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(f"mvps: {tmp_path}/nowhere: wanted a result folder, given one without mesh.ply")
    write_reconstruction(scene.reconstruction, tmp_path / "bare")
    assert run(main, [str(tmp_path / "bare"), str(tmp_path)]) == 2
    assert "model.glb" in capsys.readouterr().err
