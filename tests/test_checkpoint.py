"""Runs that are interrupted and go on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvps.checkpoint import Checkpoints, program
from mvps.command import run
from mvps.load import read_capture
from mvps.progress import Progress
from mvps.reconstruct import Settings, checkpoints_of, main
from mvps.scene import CaptureError, Law, Surface
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings

CPU = torch.device("cpu")


def kept(folder: Path, resume: bool = True, of: str = "this") -> Checkpoints:
    return Checkpoints(folder, {"run": of}, (Surface, Law), CPU, resume)


def test_values_come_back_as_they_were(tmp_path: Path) -> None:
    surface = Surface(np.random.default_rng(0).random((4, 3)), np.array([[0, 1, 2], [0, 2, 3]]))
    value = (surface, [Law((8.0, 30.0), -0.1)], {"x": torch.tensor([0.1, torch.inf]), "y": None}, np.float64(0.1), "words", True)
    kept(tmp_path / "c").step("some stage", lambda: value, Progress())
    back = kept(tmp_path / "c").step("some stage", lambda: pytest.fail("made again"), Progress())
    assert (back[0].vertices == surface.vertices).all() and (back[0].faces == surface.faces).all() and not back[0].vertices.flags.writeable
    assert back[1] == [Law((8.0, 30.0), -0.1)] and torch.equal(back[2]["x"], value[2]["x"]) and back[2]["x"].dtype == torch.float32
    assert back[2]["y"] is None and back[3:] == (0.1, "words", True)


def test_another_run_a_damaged_file_and_no_resume(tmp_path: Path) -> None:
    kept(tmp_path / "c").step("a", lambda: 1, Progress())
    with pytest.raises(CaptureError, match="given those of another"):
        kept(tmp_path / "c", of="other")
    (tmp_path / "c" / "a.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(CaptureError, match="given a damaged one"):
        kept(tmp_path / "c").step("a", lambda: 2, Progress())
    assert kept(tmp_path / "c", resume=False).step("a", lambda: 3, Progress()) == 3


def test_two_runs_in_one_folder_stay_apart(tmp_path: Path) -> None:
    first, second = (kept(tmp_path / "c", resume=False, of=name) for name in ("first", "second"))
    assert first.step("a", lambda: 1, Progress()) == 1
    assert second.step("a", lambda: 2, Progress()) == 2
    assert first.step("a", lambda: 3, Progress()) == 3


def test_another_version_of_the_program_is_another_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "one.py").write_text(f"x = '{name}'\n")
    monkeypatch.setattr("mvps.checkpoint.solvers.__path__", [str(tmp_path / "a")])
    first = program()
    assert program() == first
    monkeypatch.setattr("mvps.checkpoint.solvers.__path__", [str(tmp_path / "b")])
    assert program() != first


def test_nothing_in_a_checkpoint_is_executed(tmp_path: Path) -> None:
    kept(tmp_path / "c").step("a", lambda: 1, Progress())
    np.savez(tmp_path / "c" / "a.npz", text=np.array([print], dtype=object))
    with pytest.raises(CaptureError, match="damaged"):
        kept(tmp_path / "c").step("a", lambda: 2, Progress())


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checkpoint") / "made"
    write_capture(*render_capture(SceneSettings(views=5, lights=8, size=64)), folder)
    return folder


def geometry(result: Path) -> dict[str, bytes]:
    """All files but those that hold times."""
    timed = {"metrics.json", "report.html"}
    return {str(p.relative_to(result)): p.read_bytes() for p in result.rglob("*") if p.is_file() and p.name not in timed}


def test_a_killed_run_goes_on_to_the_same_bytes(capture: Path, tmp_path: Path) -> None:
    options = [str(capture), "--quiet", "--out"]
    assert run(main, [*options, str(tmp_path / "whole")]) == 0
    out = tmp_path / "killed"
    process = subprocess.Popen([sys.executable, "-m", "mvps.reconstruct", *options, str(out)])
    while not (out / "checkpoint" / "first-refinement.npz").exists():
        assert process.poll() is None
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert [path.name for path in out.iterdir()] == ["checkpoint"]
    assert run(main, [*options, str(out), "--resume", "--seed", "1"]) == 2
    assert run(main, [*options, str(out), "--resume"]) == 0
    assert geometry(out) == geometry(tmp_path / "whole")
    stages = [stage["name"] for stage in json.loads((out / "metrics.json").read_text())["stages"]]
    assert stages == [stage["name"] for stage in json.loads((tmp_path / "whole" / "metrics.json").read_text())["stages"]]


def test_a_run_goes_on_from_another_folder(capture: Path, tmp_path: Path) -> None:
    photographs, whole, out = read_capture(capture), Settings(str(capture)), tmp_path / "out"
    checkpoints_of(out, photographs, whole, None, False).step("a", lambda: 1, Progress())
    relative = replace(whole, capture="made")
    assert checkpoints_of(out, photographs, relative, None, True).step("a", lambda: 2, Progress()) == 1
    part = photographs.select({view.name: view.lights for view in photographs.views[1:]})
    for other, settings in ((part, relative), (photographs, replace(relative, seed=1))):
        with pytest.raises(CaptureError, match="given those of another"):
            checkpoints_of(out, other, settings, None, True)


def test_a_place_with_other_files_is_refused_before_the_work(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    start = time.perf_counter()
    assert run(main, [str(capture), "--out", str(tmp_path)]) == 2
    assert "other files" in capsys.readouterr().err and time.perf_counter() - start < 3
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
