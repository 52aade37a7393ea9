"""What all tests share: where the captures are, and the rule that nothing may be skipped where it counts."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

IN_CI = os.environ.get("CI", "").lower() in ("1", "true")


@pytest.fixture(scope="session")
def captures() -> Path:
    """The folder of the test captures: $MVPS_CAPTURES, or shared/captures beside the checkout."""
    given = os.environ.get("MVPS_CAPTURES")
    path = Path(given) if given else Path(__file__).resolve().parents[2] / "shared" / "captures"
    if not path.is_dir():
        pytest.skip(f"no captures at {path}: set MVPS_CAPTURES to the folder that holds bunny, ball and the others")
    return path


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """In CI a skipped test is a failure: it would be a check that nobody misses."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if IN_CI and reporter is not None and reporter.stats.get("skipped") and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    skipped = terminalreporter.stats.get("skipped", [])
    if IN_CI and skipped:
        terminalreporter.write_line(f"CI: {len(skipped)} skipped, which counts as failed", red=True)


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Signals as at a terminal: what a shell starts in the background ignores Ctrl-C, under nohup a hang-up, and what tests start would."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
