"""Files changed at random bytes, for as long as one likes: what comes of them besides a value or a CaptureError?

    python benchmarks/fuzz.py [--minutes 10] [--targets capture result checkpoint comparison]

Hypothesis changes one file of a tiny capture, result, checkpoint or comparison (tests/fuzzing.py; the suite runs a few seconds of the same)
and reads the folder. Prints how many were read, how many refused, the slowest, and every other exception with the smallest change that
raises it; exit code 1 where there is one.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from fuzzing import TARGETS, Edit, Target, edits

EXAMPLES = 500
"""Of one round; then the next target has its turn, with another seed."""


def fuzz_round(target: Target, number: int, counts: Counter[str], slowest: list[tuple[float, str]]) -> str:
    """A round on one target; the trace of what went wrong, empty where nothing did."""

    @seed(number)
    @settings(
        max_examples=EXAMPLES, deadline=None, database=None, suppress_health_check=list(HealthCheck), phases=(Phase.generate, Phase.shrink)
    )
    @given(st.sampled_from(target.files), edits, st.booleans())
    def example(name: str, by: list[Edit], seal: bool) -> None:
        start = time.perf_counter()
        outcome = target.tried(name, by, seal)
        counts["read" if outcome == "value" else "refused"] += 1
        slowest.append((time.perf_counter() - start, f"{name} {by}"))
        slowest.sort(reverse=True)
        del slowest[3:]

    try:
        example()
    except Exception as error:
        return "".join(traceback.format_exception(error)[-6:]) + "\n".join(getattr(error, "__notes__", []))
    return ""


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--targets", nargs="+", choices=TARGETS, default=list(TARGETS))
    parser.add_argument("--seed", type=int, default=0)
    given_ = parser.parse_args()
    end, number, found = time.monotonic() + 60 * given_.minutes, given_.seed, set()
    counts: dict[str, Counter[str]] = {name: Counter() for name in given_.targets}
    slowest: dict[str, list[tuple[float, str]]] = {name: [] for name in given_.targets}
    with tempfile.TemporaryDirectory() as folder:
        targets = {name: TARGETS[name](Path(folder)) for name in given_.targets}
        while time.monotonic() < end:
            for name, target in targets.items():
                trace = fuzz_round(target, number, counts[name], slowest[name])
                kind = trace.strip().splitlines()[-1] if trace else ""
                if trace and kind not in found:
                    print(f"--- {name}\n{trace}", flush=True)
                    found.add(kind)
            number += 1
    for name in given_.targets:
        print(f"{name}: {counts[name]['read']} read, {counts[name]['refused']} refused; slowest {slowest[name][0][0]:.2f} s")
    print(f"{len(found)} kinds of other exceptions")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
