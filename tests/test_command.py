"""mvps.command: exit codes, the one sentence, the shared options."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from mvps.command import lights_argument, not_ended, number_list, parse, parser, run
from mvps.scene import CaptureError

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(autouse=True)
def logger() -> Iterator[logging.Logger]:
    logger = logging.getLogger("mvps")
    before, handlers = logger.level, logger.handlers[:]
    yield logger
    logger.setLevel(before)
    logger.handlers = handlers


def raising(error: BaseException) -> int:
    def main(argv: Sequence[str]) -> None:
        raise error

    return run(main, [])


def test_success() -> None:
    seen: list[Sequence[str]] = []
    assert run(seen.append, ["a", "b"]) == 0
    assert seen == [["a", "b"]]


@pytest.mark.parametrize(
    ("error", "code", "sentence"),
    [
        (CaptureError("x/mask.png: wanted a mask,\n  given nothing"), 2, "mvps: x/mask.png: wanted a mask, given nothing\n"),
        (ValueError("scale: wanted a positive number, given 0"), 2, "mvps: scale: wanted a positive number, given 0\n"),
        (PermissionError(13, "Permission denied", "/out"), 2, "mvps: /out: Permission denied; check the path, its permissions and"),
        (KeyboardInterrupt(), 130, "mvps: interrupted before the end\n"),
    ],
)
def test_failures_end_with_a_code_and_a_sentence(
    error: BaseException, code: int, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert raising(error) == code
    err = capsys.readouterr().err
    assert err.startswith(sentence) and err.count("\n") == 1


@pytest.mark.parametrize("error", [ValueError("operands could not be broadcast"), OSError("no file name"), RuntimeError("wanted")])
def test_faults_of_the_program_keep_their_trace(error: Exception) -> None:
    with pytest.raises(type(error)):
        raising(error)


def test_a_closed_pipe_is_quiet() -> None:
    script = "import sys; from mvps.command import run\ndef main(argv):\n    for k in range(100000): print(k)\nsys.exit(run(main, []))"
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(timeout=30) == 141


def test_a_request_to_end_waits_for_what_is_being_started() -> None:
    made = []
    # Whoever runs the tests in the background may have let them ignore this signal.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), not_ended():
            signal.raise_signal(signal.SIGINT)
            made.append("owned")
        assert made and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_bad_options_read_like_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    made = parser("mvps.reconstruct", "Reconstruct.")
    made.add_argument("--views", type=number_list, help="numbers of views")
    for argv, words in (
        (["--views", "1,x"], "argument --views: wanted numbers from 1, separated by commas, such as 1,5,9, given '1,x'"),
        (["--nonsense"], "unrecognized arguments: --nonsense"),
        (["--quiet", "--verbose"], "not allowed with argument"),
    ):
        assert run(lambda argv: parse(made, argv) and None, argv) == 2
        err = capsys.readouterr().err
        assert err.startswith("mvps: ") and words in err and err.endswith("; see python -m mvps.reconstruct --help\n")
        assert err.count("\n") == 1


@pytest.mark.parametrize("vector", ["-1,0,1", "-.5, -1e-3,2", "-400", "1,-1,0"])
def test_values_below_zero_follow_their_option(vector: str) -> None:
    made = parser("mvps.x", "")
    made.add_argument("place", nargs="+")
    made.add_argument("--light", action="append")
    given = parse(made, ["here", "--light", vector, f"--light={vector}", "--quiet", "--lig", vector])
    assert given.light == [vector] * 3 and given.quiet and given.place == ["here"]
    assert parse(made, ["--", "--light", "-1,0"]).place == ["--light", "-1,0"]


def test_what_is_no_number_is_no_value(capsys: pytest.CaptureFixture[str]) -> None:
    made = parser("mvps.x", "")
    made.add_argument("--light")
    assert run(lambda argv: parse(made, argv) and None, ["--light", "-x,0,1"]) == 2
    assert "expected one argument" in capsys.readouterr().err


def test_help_shows_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    made = parser("mvps.x", "What it does.\nAnd how.")
    made.add_argument("--seed", type=int, default=7, help="seed of all randomness")
    with pytest.raises(SystemExit) as stop:
        run(lambda argv: parse(made, argv) and None, ["--help"])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    assert "seed of all randomness (default: 7)" in out and "What it does.\nAnd how." in out


@pytest.mark.parametrize(("argv", "level"), [([], logging.INFO), (["--quiet"], logging.WARNING), (["--verbose"], logging.DEBUG)])
def test_how_much_is_shown(argv: list[str], level: int, logger: logging.Logger) -> None:
    logger.handlers = []
    for _ in range(2):
        parse(parser("mvps.x", ""), argv)
    assert logger.level == level and len(logger.handlers) == 1


def test_number_list() -> None:
    assert number_list("1,5,9") == (1, 5, 9)
    assert number_list(" 12 , 3") == (12, 3)


@pytest.mark.parametrize("text", ["", ",", "1,", "0", "-1", "1.5", "a", "1;2", "1,,2", "²"])
def test_number_list_refuses(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="wanted numbers from 1, separated by commas"):
        number_list(text)


def test_lights_argument(tmp_path: Path) -> None:
    assert lights_argument("1,8,16") == (1, 8, 16)
    path = tmp_path / "lights.json"
    path.write_text('{"view_01": [1], "view_02": [8, 2]}')
    assert lights_argument(str(path)) == {"view_01": (1,), "view_02": (8, 2)}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "wanted a JSON file, or numbers such as 1,5,9, given No such file"),
        ("{", "wanted JSON, given text that is none"),
        ("[1, 2]", "wanted a list of numbers from 1 per view"),
        ("{}", "wanted a list of numbers from 1 per view"),
        ('{"view_01": []}', "wanted a list of numbers from 1 per view"),
        ('{"view_01": [0]}', "wanted a list of numbers from 1 per view"),
        ('{"view_01": [true]}', "wanted a list of numbers from 1 per view"),
        ('{"view_01": ["1"]}', "wanted a list of numbers from 1 per view"),
        ('{"view_01": 1}', "wanted a list of numbers from 1 per view"),
    ],
)
def test_lights_argument_refuses(tmp_path: Path, content: str | None, words: str) -> None:
    path = tmp_path / "lights.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(argparse.ArgumentTypeError, match=words) as caught:
        lights_argument(str(path))
    assert "lights.json" in str(caught.value)


def test_lights_argument_of_numbers_only_is_no_path() -> None:
    for text in ("0", "-3", "1,,2", " "):
        with pytest.raises(argparse.ArgumentTypeError, match="separated by commas"):
            lights_argument(text)


def test_a_pipe_of_lights_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(argparse.ArgumentTypeError, match="Is a pipe"):
        lights_argument(str(tmp_path / "pipe"))
