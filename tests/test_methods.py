"""What was found in a capture, by whichever command it is reconstructed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mvps.nearness
import mvps.sound
from mvps.finding import Finding
from mvps.load import read_capture
from mvps.methods import run_method
from mvps.reconstruct import Settings, main
from mvps.scene import Capture, CaptureError
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings
from mvps.viewpoints import read_cameras

WRONG = Finding("mask", "all views", "masks are too small", False)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("capture") / "made"
    write_capture(*render_capture(SceneSettings(views=5, lights=8, size=64)), path)
    return path


@pytest.fixture
def doubted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A check that finds what it cannot mend, and brightness that falls off as under near lights, which is seen in the result alone."""

    def found(capture: Capture, *_: object) -> tuple[Capture, list[Finding]]:
        return capture, [WRONG]

    monkeypatch.setattr(mvps.sound, "sound", found)
    monkeypatch.setattr(mvps.nearness, "nearness", lambda *_: mvps.nearness.Nearness(1.0, 0.0))


def account(out: Path) -> dict[str, Any]:
    metrics: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    return metrics


def test_ours_is_as_doubtful_by_either_command(path: Path, tmp_path: Path, doubted: None, capsys: pytest.CaptureFixture[str]) -> None:
    run_method(path, "ours-draft", Settings(str(path)), tmp_path / "method")
    main([str(path), "--out", str(tmp_path / "command"), "--preset", "draft", "--quiet"])
    one, other = (account(tmp_path / name) for name in ("method", "command"))
    assert one["status"] == other["status"] and one["status"]["name"] == "doubtful"
    assert one["findings"] == other["findings"] and [of["about"] for of in one["findings"]] == ["mask", "lights"]
    cameras = {view.name: view.camera for view in read_capture(path).views}
    for name in ("method", "command"):
        written = read_cameras(tmp_path / name / "cameras.json")
        assert list(written) == list(cameras)
        for of in cameras:
            for part in ("K", "rotation", "translation"):
                np.testing.assert_array_equal(getattr(written[of], part), getattr(cameras[of], part))
            assert (written[of].width, written[of].height) == (64, 64)
    said = capsys.readouterr().out
    assert "all views: masks are too small\n" in said and "all views: brightness falls off" in said


def test_a_place_that_is_taken_is_refused_before_the_work(path: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(CaptureError, match="given a folder with other files"):
        run_method(path / "no capture at all", "hull", Settings(str(path)), tmp_path)


def test_what_was_found_is_told_with_other_methods_too(path: Path, tmp_path: Path, doubted: None) -> None:
    run_method(path, "hull", Settings(str(path)), tmp_path / "hull")
    assert [of["text"] for of in account(tmp_path / "hull")["findings"]] == [WRONG.text]
