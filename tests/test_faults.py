"""A machine that refuses: no memory, no room, no place to write, an interruption. One sentence, an exit code, nothing half-written."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from mvps import checkpoint, evaluate, reconstruct
from mvps.addresses import NEEDED, loading, refused
from mvps.checkpoint import Checkpoints
from mvps.command import run
from mvps.folders import check_place
from mvps.progress import Progress
from mvps.scene import CaptureError
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("faults") / "made"
    write_capture(*render_capture(SceneSettings(views=5, lights=6, size=48)), folder)
    return folder


def said_by(error: BaseException, capsys: pytest.CaptureFixture[str]) -> str:
    """The one sentence that a command ends with when this is raised in it."""

    def main(argv: object) -> None:
        raise error

    assert run(main, []) == 2
    said = capsys.readouterr().err
    assert said.startswith("mvps: ") and said.count("\n") == 1
    return said


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        np._core._exceptions._ArrayMemoryError((1 << 40,), np.dtype(float)),
        RuntimeError(
            "[enforce fail at alloc_cpu.cpp:121] err == 0. DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes."
        ),
        RuntimeError("can't start new thread"),
        ImportError("libopenblas.so: failed to map segment from shared object"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_no_memory(error: Exception, capsys: pytest.CaptureFixture[str]) -> None:
    said = said_by(error, capsys)
    assert said.startswith("mvps: memory: wanted more than there is (")
    # Not every command has --views.
    assert "ask for fewer or smaller images" in said and "--" not in said


def test_allocators_say_what_is_looked_for(capsys: pytest.CaptureFixture[str]) -> None:
    """Asked for an exabyte, numpy and torch raise what is known as no memory."""
    for ask in (lambda: np.zeros(1 << 57), lambda: torch.zeros(1 << 57)):
        with pytest.raises((MemoryError, RuntimeError)) as caught:
            ask()
        assert "memory" in said_by(caught.value, capsys)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EFBIG, errno.EROFS])
def test_no_room(code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"writing a file: {os.strerror(code)}; make room" in said_by(OSError(code, os.strerror(code)), capsys)


def test_no_room_for_an_array(capsys: pytest.CaptureFixture[str]) -> None:
    """numpy writes arrays itself: a file that may not grow makes it raise an error without a number."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    with tempfile.TemporaryFile() as file:
        before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limit[1]))
        try:
            with pytest.raises(OSError) as caught:
                np.save(file, np.zeros(10_000))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limit)
            signal.signal(signal.SIGXFSZ, before)
    assert "writing a file: " in (said := said_by(caught.value, capsys)) and "make room" in said


def test_names_do_not_move_the_cursor(capsys: pytest.CaptureFixture[str]) -> None:
    assert "\\x1b[2J" in said_by(CaptureError("x\x1b[2J: wanted a, given b"), capsys)


# ------------------------------------------------------------------------------------------------ limits


def test_too_few_addresses_are_refused_before_numpy_is_there() -> None:
    assert not refused(resource.RLIM_INFINITY) and not refused(int(NEEDED)) and "wanted at least" in refused(int(NEEDED) - 1)
    for gigabytes in (0.1, 0.5, 1.2):
        limit = int(1e9 * gigabytes)
        result = subprocess.run(
            [sys.executable, "-m", "mvps.reconstruct", "nowhere", "--out", "nothing"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            preexec_fn=lambda limit=limit: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
        )
        assert result.returncode == 2 and result.stderr.count("\n") == 1
        assert result.stderr.startswith("mvps: memory: wanted at least")


@pytest.mark.usefixtures("interruptible")
def test_an_interruption_while_loading_leaves_no_trace() -> None:
    with loading():
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_that_a_library_makes_an_exception_of_its_own_is_one_still(
    number: signal.Signals, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(_: Sequence[str]) -> None:
        try:
            signal.raise_signal(number)
        except BaseException:
            raise ImportError("no such library")  # noqa: B904

    before = signal.getsignal(number)
    assert run(work, []) == 128 + number and signal.getsignal(number) is before
    assert capsys.readouterr().err == "mvps: interrupted before the end\n"


def with_small_files(most: int, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Python in a process of its own, whose files hold no more than so many bytes, as on a full disk."""
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (most, most)),
    )


def test_a_full_disk_while_checkpoints_are_written(capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    ended = with_small_files(10_000, "-m", "mvps.reconstruct", capture, "--out", out, "--preset", "draft", "--quiet")
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1 and "File too large; make room" in ended.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert [path.name for path in (out / "checkpoint").iterdir()] == ["run.json"]
    # With room again it goes on.
    assert run(reconstruct.main, [str(capture), "--out", str(out), "--preset", "draft", "--quiet", "--resume"]) == 0
    before = (out / "metrics.json").read_bytes()
    ended = with_small_files(1000, "-m", "mvps.evaluate", out, "--truth", capture)
    assert ended.returncode == 2 and (out / "metrics.json").read_bytes() == before
    assert not [path.name for path in out.iterdir() if path.name.startswith(".")]


WRITING_A_FOLDER = """
import sys
from pathlib import Path
from mvps.folders import appearing_whole
with appearing_whole(Path(sys.argv[1])) as writing:
    (writing / "a").write_bytes(bytes(500))
    (writing / "b").write_bytes(bytes(5000))
"""


def test_a_full_disk_while_a_folder_is_written(tmp_path: Path) -> None:
    ended = with_small_files(1000, "-c", WRITING_A_FOLDER, tmp_path / "out")
    assert ended.returncode == 1 and "too large" in ended.stderr and list(tmp_path.iterdir()) == []


def test_a_full_disk_while_a_capture_is_made(tmp_path: Path) -> None:
    ended = with_small_files(2000, "-m", "mvps.synthetic", "--out", tmp_path / "made", "--views=2", "--lights=2", "--size=32")
    assert ended.returncode == 2 and "too large" in ended.stderr and list(tmp_path.iterdir()) == []


def test_a_checkpoint_that_is_interrupted_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def kept() -> Checkpoints:
        return Checkpoints(tmp_path / "c", {}, (), torch.device("cpu"), True)

    kept().step("a", lambda: 1, Progress())

    def cut(file: object, **_: object) -> None:
        file.write(b"PK half")  # type: ignore[attr-defined]
        raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint.np, "savez", cut)
    with pytest.raises(KeyboardInterrupt):
        kept().step("b", lambda: 2, Progress())
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == ["a.npz", "run.json"]


# ------------------------------------------------------------------------------------------------ places


def test_places_that_cannot_be_written_are_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(CaptureError, match="given file, a file"):
        check_place(tmp_path / "file" / "deep" / "out")
    # Root may write anywhere but on a read-only system, so the answer is made up.
    monkeypatch.setattr(os, "access", lambda path, _: Path(path) != tmp_path)
    for place in (tmp_path / "out", tmp_path / "deep" / "out"):
        with pytest.raises(CaptureError, match="given one that cannot be written; give another --out"):
            check_place(place)


def test_the_root_is_no_place() -> None:
    with pytest.raises(CaptureError, match=r"^/: wanted a new or empty folder"):
        check_place(Path("/"))


def test_a_place_is_no_view_of_a_capture(tmp_path: Path) -> None:
    """Beside its views it holds what it likes."""
    (tmp_path / "cap" / "view_01").mkdir(parents=True)
    (tmp_path / "cap" / "Calib_Results.mat").write_text("")
    for inside in ("cap/view_07", "cap/view_01/out"):
        with pytest.raises(CaptureError, match=f"{inside}: wanted a place that is no view of a capture"):
            check_place(tmp_path / inside)
    for beside in ("cap/out", "cap/deep/out", "view_01", "new/out"):
        check_place(tmp_path / beside)


def test_capture_and_result_whose_names_are_no_text(capture: Path, tmp_path: Path) -> None:
    odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    os.mkdir(odd)
    made, out = odd / "made", odd / "out"
    subprocess.run([sys.executable, "-m", "mvps.synthetic", "--out", made, "--views=5", "--lights=6", "--size=48"], cwd=ROOT, check=True)
    assert run(reconstruct.main, [str(made), "--out", str(out), "--preset", "draft", "--quiet"]) == 0
    assert run(evaluate.main, [str(out), "--truth", str(made)]) == 0
    assert "caf\\xe9" in (out / "settings.json").read_text().replace("\\\\", "\\")


# ------------------------------------------------------------------------------------------------ interruptions


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("leaving", [False, True])
def test_an_interruption_leaves_no_lock_taken(leaving: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """Raised while a pool's condition was being entered, it left the condition locked, and threads and the program waited for ever."""

    class Lock:
        """Interrupted as soon as it is taken, or just before it is let go."""

        def __init__(self) -> None:
            self.inner = threading.Lock()
            self.acquire, self.release = self.inner.acquire, self.inner.release

        def __enter__(self) -> None:
            self.inner.acquire()
            if not leaving:
                signal.raise_signal(signal.SIGINT)

        def __exit__(self, *_: object) -> None:
            if leaving:
                signal.raise_signal(signal.SIGINT)
            self.inner.release()

    lock, went_on = Lock(), []

    def work(_: Sequence[str]) -> None:
        with threading.Condition(lock):  # type: ignore[arg-type]
            went_on.append(True)
        time.sleep(10)
        went_on.append(False)

    assert run(work, []) == 130 and went_on == [True]
    assert lock.inner.acquire(blocking=False), "it is still taken"
    assert "interrupted before the end" in capsys.readouterr().err


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize(
    ("stage", "number"),
    [
        ("load", signal.SIGINT),
        ("joint refinement", signal.SIGINT),
        ("joint refinement", signal.SIGTERM),
        ("joint refinement", signal.SIGHUP),
    ],
)
def test_an_interrupted_run(capture: Path, tmp_path: Path, stage: str, number: signal.Signals) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "mvps.reconstruct", str(capture), "--out", str(out), "--preset", "draft"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith(f"{stage} ..."):
                break
        time.sleep(0.1)
        process.send_signal(number)
        rest = process.stderr.read().splitlines()
        assert process.wait(timeout=60) == 128 + number, rest
    assert rest[-1] == "mvps: interrupted before the end" and not any("Traceback" in line for line in rest)
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]
    assert not out.exists() or [path.name for path in out.iterdir()] == ["checkpoint"]
