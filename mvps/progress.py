"""How far a computation is: a bar on a terminal, plain lines in a pipe, and the account of time and memory that stays.

    progress = Progress()
    with progress.stage("visual hull", total=20) as stage:
        for view in views:
            ...
            stage.advance(1, residual=0.012)
        stage.status("converged")

Everything shown goes through the logger "mvps": INFO shows a line at the end of a stage (and at its start where there is no
bar), DEBUG every step, WARNING and above nothing of this. A program that never set up logging sees nothing.
"""

from __future__ import annotations

import logging
import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, SupportsFloat

logger = logging.getLogger("mvps")

BAR_WIDTH = 24
SECONDS_BETWEEN_DRAWINGS = 0.1
"""A bar redrawn ten times a second looks smooth and costs nothing."""

CLEAR_LINE = "\r\x1b[K"


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, megabytes (10^6 bytes).

    Linux: VmHWM of /proc/self/status, in units of 1024 bytes. Its ru_maxrss would not do: a process starts with the value of
    the one that started it. Elsewhere ru_maxrss, which macOS counts in bytes.
    """
    if sys.platform == "linux":
        with open("/proc/self/status", encoding="ascii", errors="replace") as status:
            return next(int(line.split()[1]) for line in status if line.startswith("VmHWM")) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


class ConsoleHandler(logging.Handler):
    """Log records as lines on standard error; on a terminal they take the place of the bar, which is drawn anew below them."""

    def emit(self, record: logging.LogRecord) -> None:
        clear = CLEAR_LINE if sys.stderr.isatty() else ""
        sys.stderr.write(f"{clear}{self.format(record)}\n")
        sys.stderr.flush()


class Stage:
    """One step of the way, while it runs. Made by `Progress.stage`."""

    def __init__(self, name: str, total: int | None) -> None:
        self.name, self.total = name, total
        self.done = 0
        self.values: dict[str, SupportsFloat] = {}
        self.words = ""
        self._start = time.perf_counter()
        self._drawn = -SECONDS_BETWEEN_DRAWINGS
        self._bar = sys.stderr.isatty() and logger.isEnabledFor(logging.INFO)

    @property
    def seconds(self) -> float:
        """Time since the stage began."""
        return time.perf_counter() - self._start

    def advance(self, steps: int = 1, **values: SupportsFloat) -> None:
        """`steps` more of the total are done; values, such as a residual, replace the ones shown before. They become floats when they are
        shown: a GPU works on until then."""
        self.done += steps
        self.values.update(values)
        if logger.isEnabledFor(logging.DEBUG):
            logger.debug("%s", self._text())
        now = self.seconds
        if self._bar and now - self._drawn >= SECONDS_BETWEEN_DRAWINGS:
            self._drawn = now
            sys.stderr.write(f"{CLEAR_LINE}{self._text()}")
            sys.stderr.flush()

    def status(self, text: str) -> None:
        """How the stage ended, in words."""
        self.words = text

    def record(self) -> dict[str, Any]:
        """name, seconds, peak_memory_mb of the process so far; status and the last values where there are any."""
        record: dict[str, Any] = {"name": self.name, "seconds": round(self.seconds, 3), "peak_memory_mb": round(peak_memory_mb(), 1)}
        if self.words:
            record["status"] = self.words
        if self.values:
            record["values"] = {name: float(value) for name, value in self.values.items()}
        return record

    def open(self) -> None:
        if not self._bar:
            logger.info("%s ...", self.name)

    def close(self, outcome: str) -> None:
        if self._bar:
            sys.stderr.write(CLEAR_LINE)
            sys.stderr.flush()
        words = [f"{self.seconds:.1f} s", *self._values(), *([outcome] if outcome else [])]
        logger.info("%s: %s", self.name, ", ".join(words))

    def _values(self) -> list[str]:
        return [f"{name.replace('_', ' ')} {float(value):.4g}" for name, value in self.values.items()]

    def _text(self) -> str:
        if self.total:
            filled = min(BAR_WIDTH, BAR_WIDTH * self.done // self.total)
            count = f"[{'#' * filled}{'-' * (BAR_WIDTH - filled)}] {self.done}/{self.total}"
        else:
            count = str(self.done)
        return "  ".join([self.name, count, *self._values(), f"{self.seconds:.0f} s"])


class Progress:
    """The stages of a computation. `stages` holds, for every one that ended well, what `Stage.record` says."""

    def __init__(self) -> None:
        self.stages: list[dict[str, Any]] = []

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[Stage]:
        """A stage that lasts as long as the with block; `total` steps, where known, make the bar's full length."""
        stage = Stage(name, total)
        stage.open()
        finished = False
        try:
            yield stage
            finished = True
        finally:
            stage.close(stage.words if finished else "stopped before its end")
        self.stages.append(stage.record())
