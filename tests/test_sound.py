"""mvps.sound: checks in their order, each on what those before it made of the capture."""

from __future__ import annotations

import pytest
from sphere_scene import make_sphere

import mvps.sound
from mvps.finding import Finding
from mvps.progress import Progress
from mvps.scene import Capture
from mvps.sound import sound


def test_each_check_gets_what_those_before_it_made(monkeypatch: pytest.MonkeyPatch) -> None:
    def renamed(capture: Capture) -> tuple[Capture, list[Finding]]:
        return Capture(f"{capture.name}+", capture.views), [Finding("view", capture.name, "seen", True)]

    monkeypatch.setattr(mvps.sound, "CHECKS", (renamed, renamed))
    capture, progress = make_sphere().capture, Progress()
    after, findings = sound(capture, progress)
    assert after.name == f"{capture.name}++"
    assert [one.where for one in findings] == [capture.name, f"{capture.name}+"]
    assert f"{capture.name}+: seen" in progress.stages[0]["status"]
