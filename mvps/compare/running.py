"""Every method in a process of its own, so that its time and its largest memory are its own. What has run with the same options on
the same files stays.

Seconds are of the whole process, imports and reading included; processor seconds, of all cores, say less of what else the machine does.
Memory is the largest resident set.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from mvps.checkpoint import program
from mvps.command import not_ended
from mvps.evaluate import evaluate_result, has_truth, write_json
from mvps.inputs import DAMAGED, JSON_LIMIT, parsed_json, read_file, shown
from mvps.load import read_truth
from mvps.progress import Progress
from mvps.scene import CaptureError

RUNS = "runs.json"


@dataclass(frozen=True)
class Run:
    """What came of a method. capture (its folder) and options (of mvps.methods): by which a run is known; failed: why there is no result,
    else empty; status: of the result; protocols: of mvps.evaluate that were measured; errors: by their names, where the capture has
    truth; made_of: the program and the capture's files, as they were."""

    method: str
    options: tuple[str, ...]
    seconds: float = 0.0
    processor_seconds: float = 0.0
    peak_memory_mb: float = 0.0
    failed: str = ""
    status: str = ""
    protocols: tuple[str, ...] = ()
    errors: dict[str, float] = field(default_factory=dict)
    capture: str = ""
    made_of: str = ""


def known_runs(out: Path) -> dict[str, Run]:
    """The runs in an earlier comparison's folder by method; none where it is new. CaptureError where its record is damaged."""
    path = out / RUNS
    if not path.exists():
        return {}
    try:
        return {name: _known_run(record) for name, record in parsed_json(read_file(path, JSON_LIMIT)).items()}
    except DAMAGED as error:
        raise CaptureError(f"{path}: wanted the record of a comparison, given something else ({error}); give another --out") from error


def _known_run(record: dict[str, Any]) -> Run:
    run = Run(**{**record, **{key: tuple(record[key]) for key in ("options", "protocols")}})
    numbers = [run.seconds, run.processor_seconds, run.peak_memory_mb, *run.errors.values()]
    if not all(isinstance(number, int | float) for number in numbers) or not isinstance(run.failed, str) or not isinstance(run.status, str):
        raise ValueError(f"{run.method}: wanted numbers and texts, given other values")
    return run


def run_all(
    capture: Path, methods: Sequence[str], options: Sequence[str], out: Path, progress: Progress, protocols: Sequence[str] = ("ours",)
) -> dict[str, Run]:
    """Runs the methods that have not run with these options yet, measures them by these protocols, and keeps the record in `out`."""
    if out.exists() and any(out.iterdir()) and not (out / RUNS).exists():
        raise CaptureError(f"{out}: wanted a new or empty folder or an earlier comparison, given a folder with other files")
    out.mkdir(parents=True, exist_ok=True)
    runs, place, made_of = known_runs(out), shown(capture.resolve()), state(capture, options)
    # What is interrupted in its first run is an earlier comparison too.
    write_json(out / RUNS, {method: asdict(run) for method, run in runs.items()})
    for name in methods:
        known = runs.get(name)
        same = known is not None and (known.options, known.capture, known.made_of) == (tuple(options), place, made_of) and not known.failed
        if not same or not (out / name / "settings.json").exists():
            with progress.stage(name) as stage:
                runs[name] = replace(_run(capture, name, options, out / name), capture=place, made_of=made_of)
                stage.status(runs[name].failed or runs[name].status)
        runs[name] = _measured(runs[name], capture, out / name, protocols)
        write_json(out / RUNS, {method: asdict(run) for method, run in runs.items()})
    return runs


def state(capture: Path, options: Sequence[str] = ()) -> str:
    """Hash of the program, of the capture's files by name, size and time, and of what a file among the options (--lights) holds: of another
    state a run is another. The comparison itself may lie in the capture's folder; what views link to counts."""
    digest = hashlib.blake2b(program().encode(), digest_size=16)
    for path in sorted(path for files in ("*", "view_*/*") for path in capture.glob(files) if path.is_file()):
        about = path.stat()
        digest.update(repr((str(path.relative_to(capture)), about.st_size, about.st_mtime_ns)).encode("utf-8", "surrogateescape"))
    for value in (option.partition("=")[2] for option in options):
        if os.path.isfile(value):
            digest.update(read_file(Path(value), JSON_LIMIT))
    return digest.hexdigest()


def _run(capture: Path, name: str, options: Sequence[str], folder: Path) -> Run:
    """One method, not measured yet. KeyboardInterrupt where the user interrupts it."""
    # Names of folders may begin as options do.
    command = [sys.executable, "-m", "mvps.methods", f"--method={name}", f"--out={folder}", *options, "--", str(capture)]
    start = time.perf_counter()
    with tempfile.TemporaryFile("w+", encoding="utf-8") as complaints:
        process = None
        try:
            with not_ended():
                process = subprocess.Popen(command, stderr=complaints)
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            # Whoever ends the comparison wants nothing of it to go on.
            if process is not None:
                process.terminate()
                process.wait()
            raise
        seconds, code = time.perf_counter() - start, os.waitstatus_to_exitcode(status)
        busy = usage.ru_utime + usage.ru_stime
        process.returncode = code
        complaints.seek(0)
        said = complaints.read().strip()
    if code == 130:
        raise KeyboardInterrupt
    if code == 2:
        return Run(name, tuple(options), seconds, busy, failed=said.splitlines()[-1].removeprefix("mvps: "))
    if code < 0:
        why = f"ended by signal {-code}" + (", as a system without memory sends it" if code == -signal.SIGKILL else "")
        return Run(name, tuple(options), seconds, busy, failed=why)
    if code:
        raise RuntimeError(f"{' '.join(command)}: exit code {code}\n{said}")
    metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    # Not the system's figure: a process starts with the peak of the one that started it.
    peak = max(stage["peak_memory_mb"] for stage in metrics["stages"])
    return Run(name, tuple(options), seconds, busy, peak, "", metrics["status"]["name"])


def _measured(run: Run, capture: Path, folder: Path, protocols: Sequence[str]) -> Run:
    """The run with errors by these protocols too; as it is where it failed or there is no truth."""
    new = tuple(name for name in protocols if name not in run.protocols)
    if run.failed or not new:
        return run
    if not has_truth(read_truth(capture)):
        return run
    return replace(run, protocols=(*run.protocols, *new), errors=run.errors | evaluate_result(folder, capture, new))
