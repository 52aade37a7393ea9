"""mvps.progress: what a terminal, a pipe, --quiet and --verbose show, and what is recorded."""

from __future__ import annotations

import io
import logging
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mvps.progress import CLEAR_LINE, ConsoleHandler, Progress, peak_memory_mb


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def level() -> Iterator[logging.Logger]:
    """The program's logger with its console, at INFO; put back as it was afterwards."""
    logger = logging.getLogger("mvps")
    before, handlers = logger.level, logger.handlers[:]
    logger.handlers = [ConsoleHandler()]
    logger.setLevel(logging.INFO)
    yield logger
    logger.setLevel(before)
    logger.handlers = handlers


def steps() -> Progress:
    progress = Progress()
    with progress.stage("visual hull", total=3) as stage:
        for k in range(3):
            stage.advance(1, residual=0.5**k)
        stage.status("converged after 3 steps")
    return progress


def test_record() -> None:
    progress = Progress()
    with progress.stage("first") as stage:
        time.sleep(0.02)
        stage.advance(2, residual=1, other_error=2)
        stage.advance(residual=0.25)
        assert stage.done == 3
    with progress.stage("second") as stage:
        stage.status("skipped: the capture has one view")
    first, second = progress.stages
    assert first["name"] == "first" and 0.02 <= first["seconds"] < 1
    assert first["values"] == {"residual": 0.25, "other_error": 2.0} and "status" not in first
    assert second["status"] == "skipped: the capture has one view" and "values" not in second
    assert 10 < first["peak_memory_mb"] <= second["peak_memory_mb"] <= peak_memory_mb() + 0.1


def test_peak_memory_counts_megabytes() -> None:
    # In a process of its own, started by one that is larger: the peak must not be inherited.
    block = bytes(range(250)) * 1_600_000
    script = "from mvps.progress import peak_memory_mb as peak; a = peak(); b = bytes(range(250)) * 800_000; print(peak() - a)"
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1])
    assert 180 < float(out.stdout) < 220 < len(block) / 1e6


def test_pipe_gets_one_line_at_start_and_end(level: logging.Logger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    steps()
    first, second = sys.stderr.getvalue().splitlines()
    assert first == "visual hull ..." and second == "visual hull: 0.0 s, residual 0.25, converged after 3 steps"


def test_terminal_gets_a_bar_that_goes_away(level: logging.Logger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Terminal())
    progress = Progress()
    with progress.stage("lights", total=4) as stage:
        stage.advance(1, residual=0.5)
        drawn = sys.stderr.getvalue()
        assert drawn.startswith(CLEAR_LINE) and "lights  [######------------------] 1/4  residual 0.5" in drawn
        stage.advance(1)
        assert sys.stderr.getvalue() == drawn, "drawn again within a tenth of a second"
    assert sys.stderr.getvalue().endswith(f"{CLEAR_LINE}{CLEAR_LINE}lights: 0.0 s, residual 0.5\n")


def test_unknown_total_and_overrun(level: logging.Logger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Terminal())
    with Progress().stage("search") as stage:
        stage.advance(5)
        assert "search  5  0 s" in sys.stderr.getvalue()
    with Progress().stage("more", total=2) as stage:
        stage.advance(5)
        assert f"[{'#' * 24}] 5/2" in sys.stderr.getvalue()


def test_quiet_shows_nothing_and_verbose_every_step(level: logging.Logger, monkeypatch: pytest.MonkeyPatch) -> None:
    for stream in (io.StringIO(), Terminal()):
        monkeypatch.setattr(sys, "stderr", stream)
        level.setLevel(logging.WARNING)
        assert len(steps().stages) == 1
        assert stream.getvalue() == ""
    level.setLevel(logging.DEBUG)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    steps()
    assert [f"{k}/3" in sys.stderr.getvalue() for k in (1, 2, 3)] == [True] * 3


def test_a_stage_that_fails_is_not_recorded_and_says_so(level: logging.Logger, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    progress = Progress()
    with pytest.raises(RuntimeError, match="inside"), progress.stage("hull"):
        raise RuntimeError("inside")
    assert progress.stages == []
    assert sys.stderr.getvalue().splitlines()[-1] == "hull: 0.0 s, stopped before its end"


def test_without_logging_set_up_nothing_is_shown(level: logging.Logger, capsys: pytest.CaptureFixture[str]) -> None:
    # As in a program that never did: other tests have.
    level.handlers = []
    level.setLevel(logging.NOTSET)
    steps()
    assert capsys.readouterr().err == ""
