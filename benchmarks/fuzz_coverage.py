"""Files changed where that reaches new code: what random bytes do not come upon, and then the same question as in fuzz.py.

    pip install atheris
    python benchmarks/fuzz_coverage.py capture [--minutes 10]

libFuzzer, by atheris, changes one file at a time of a tiny capture, result, checkpoint or comparison and keeps what runs lines of mvps that
nothing before it ran. Ends at the first exception other than a CaptureError, with its trace, the bytes in a file, and an exit code that is
not 0.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
with atheris.instrument_imports(include=["mvps"]):
    from fuzzing import TARGETS

LONGEST = 1 << 16
"""Bytes of a file: thirteen times the largest of the targets'."""


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--minutes", type=float, default=10)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        target, corpus = TARGETS[given.target](Path(folder)), Path(folder) / "corpus"
        corpus.mkdir()
        for number, name in enumerate(target.files):
            (corpus / str(number)).write_bytes(bytes([number]) + (target.root / name).read_bytes())

        def one(data: bytes) -> None:
            """The first byte says which file, the rest is what it holds."""
            if data:
                target.holding(target.files[data[0] % len(target.files)], data[1:], seal=True)

        atheris.Setup([sys.argv[0], f"-max_total_time={round(60 * given.minutes)}", f"-max_len={LONGEST}", str(corpus)], one)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
