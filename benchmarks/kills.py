"""Does a run that was killed come to the same bytes? kill -9 at random moments, --resume after each.

    python benchmarks/kills.py [--kills 20] [--each 4] [--size 96] [--seed 0]

Makes a small capture in a temporary folder and reconstructs it once undisturbed. Then it is reconstructed again and again, each time
killed `each` times at moments drawn evenly from what is left of the undisturbed run's time, and resumed after every kill. All files of the
result have to be the same, metrics.json but for times and memory (and report.html, which shows them). Prints a line a kill, and writes
them to kills.md beside this file; exit code 1 where something differs.
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from accuracy import HERE, machine

TIMED = ("seconds", "peak_memory_mb")


def untimed(value: Any) -> Any:
    """JSON values without times and memory."""
    if isinstance(value, dict):
        return {key: untimed(part) for key, part in value.items() if key not in TIMED}
    return [untimed(part) for part in value] if isinstance(value, list) else value


def contents(result: Path) -> dict[str, Any]:
    """Every file of a result by its name: bytes, or what of it does not depend on time."""
    found: dict[str, Any] = {str(p.relative_to(result)): p.read_bytes() for p in result.rglob("*") if p.is_file()}
    found["metrics.json"] = untimed(json.loads(found["metrics.json"]))
    return found | {"report.html": None}


def killed(command: list[str], after: float) -> bool:
    """Run a command and kill it after so many seconds; whether it was killed before its end."""
    process = subprocess.Popen(command)
    try:
        return process.wait(timeout=after) != 0
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return True


def trial(command: list[str], out: Path, whole: float, kills: int, random_: random.Random) -> list[str]:
    """Run until it ends, killed `kills` times on the way; a line a kill."""
    lines, left = [], whole
    for _ in range(kills):
        after = random_.uniform(0, left)
        before = time.perf_counter()
        if not killed([*command, "--out", str(out), "--resume"], after):
            lines.append(f"not killed: it had ended before {after:.1f} s")
            break
        left = max(0.2 * whole, left - (time.perf_counter() - before))
        kept = sorted(path.name for path in (out / "checkpoint").glob("[!.]*.npz")) if out.exists() else []
        beside = [path.name for path in out.parent.iterdir() if path.name.startswith(f".{out.name}.")]
        lines.append(f"killed after {after:.1f} s; kept {', '.join(kept) or 'nothing'}{'; beside: ' + ', '.join(beside) if beside else ''}")
    subprocess.run([*command, "--out", str(out), "--resume"], check=True)
    return lines


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("kills", 20), ("each", 4), ("views", 6), ("lights", 8), ("size", 96), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    given = parser.parse_args()
    random_, wrong, done, number = random.Random(given.seed), 0, 0, 0
    said: list[str] = []

    def say(text: str) -> None:
        said.append(text)
        print(text, flush=True)

    with tempfile.TemporaryDirectory() as folder:
        capture, whole = Path(folder) / "capture", Path(folder) / "whole"
        sizes = [f"--{name}={getattr(given, name)}" for name in ("views", "lights", "size")]
        subprocess.run([sys.executable, "-m", "mvps.synthetic", "--quiet", "--out", str(capture), *sizes], check=True)
        command = [sys.executable, "-m", "mvps.reconstruct", str(capture), "--quiet"]
        start = time.perf_counter()
        subprocess.run([*command, "--out", str(whole)], check=True)
        seconds, wanted = time.perf_counter() - start, contents(whole)
        say(f"undisturbed: {seconds:.1f} s, {len(wanted)} files")
        while done < given.kills:
            number += 1
            out = Path(folder) / f"killed-{number}"
            lines = trial(command, out, seconds, min(given.each, given.kills - done), random_)
            done += sum(line.startswith("killed") for line in lines)
            found = contents(out)
            differ = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name) or name not in found)
            wrong += bool(differ)
            outcome = f"differs in {', '.join(differ)}" if differ else "the same bytes"
            say("\n".join(f"  {line}" for line in lines) + f"\nresult {number}: {outcome}")
        say(f"{done} kills, {number} results, {wrong} of them other than the undisturbed one")
    command_line = f"python benchmarks/kills.py --kills {given.kills} --each {given.each} --seed {given.seed}"
    page = f"`{command_line}` on {machine('cpu')}: kill -9 at random moments, --resume after each.\n\n```\n" + "\n".join(said) + "\n```\n"
    (HERE / "kills.md").write_text(page, encoding="utf-8")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
