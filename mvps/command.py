"""What every command line of the program shares: options, exit codes and the one sentence for bad input.

exit code   0 done,  2 bad input (one sentence on standard error),  129, 130, 143 ended by a signal (the terminal closed, Ctrl-C, kill),
            141 the reader of a pipe went away
"""

from __future__ import annotations

import _thread
import argparse
import errno
import gc
import io
import logging
import math
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

from mvps.addresses import loading

# These load numpy.
with loading():
    from mvps.inputs import JSON_LIMIT, parsed_json, read_file
    from mvps.memory import keep_freed
    from mvps.progress import ConsoleHandler
    from mvps.scene import CaptureError

NO_MEMORY = ("allocate memory", "out of memory", "start new thread", "insufficient memory", "bad_alloc", "failed to map segment")
"""In what libraries say when they find none, small letters: torch's allocators, Python's threads, OpenCV, C++, the loader."""

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
"""Faults of writing to an open file, which name none."""

BELOW_ZERO = re.compile(r"-\.?\d[\d\s.,eE+-]*")
"""A value of an option, one number or several, that argparse would take for an option."""


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose complaints are a CaptureError, so that bad options read like all other bad input."""

    def error(self, message: str) -> NoReturn:
        raise CaptureError(f"{message}; see {self.prog} --help")


class _Help(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Defaults after every option, the description's lines as written."""


def parser(module: str, description: str) -> Parser:
    """A parser for `python -m MODULE` with --quiet and --verbose; parse with `parse`."""
    made = Parser(prog=f"python -m {module}", description=description, formatter_class=_Help)
    shown = made.add_mutually_exclusive_group()
    shown.add_argument("--quiet", action="store_true", help="show no progress, only warnings and errors")
    shown.add_argument("--verbose", action="store_true", help="show every step")
    return made


def parse(made: Parser, argv: Sequence[str]) -> argparse.Namespace:
    """The arguments; --quiet and --verbose take effect on the logger "mvps"."""
    arguments = made.parse_args(_joined(argv))
    logger = logging.getLogger("mvps")
    logger.setLevel(logging.WARNING if arguments.quiet else logging.DEBUG if arguments.verbose else logging.INFO)
    if not any(isinstance(handler, ConsoleHandler) for handler in logger.handlers):
        logger.addHandler(ConsoleHandler())
    return arguments


def _joined(argv: Sequence[str]) -> list[str]:
    """The arguments with each option and a value below zero that follows it as one: "--light", "-1,0,1" -> "--light=-1,0,1"."""
    joined: list[str] = []
    for word in argv:
        before = joined[-1] if joined else ""
        option = before.startswith("--") and before != "--" and "=" not in before and "--" not in joined
        joined[-1:] = [f"{before}={word}"] if option and BELOW_ZERO.fullmatch(word) else [*joined[-1:], word]
    return joined


ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Requests to end."""


class _Ended(KeyboardInterrupt):
    """By a signal whose number is its first argument: nothing half-written stays."""


TAKING = (threading.Condition.__enter__.__code__, threading.Condition.__exit__.__code__)
"""Code in which a lock of Python's own is held by no `with` yet, or no more: what leaves it there by an exception leaves it locked, and
threads that want it, and what waits for these, wait for ever."""

A_MOMENT = 1e-3
"""Seconds after which a request is made again that came in TAKING."""


def _taking(frame: FrameType | None) -> bool:
    """Whether one of the frames, from the innermost outwards, is in TAKING."""
    while frame is not None and frame.f_code not in TAKING:
        frame = frame.f_back
    return frame is not None


def _ask_again(number: int) -> None:
    """Makes the request once more."""
    time.sleep(A_MOMENT)
    os.kill(os.getpid(), number)


@contextmanager
def _signals() -> Iterator[None]:
    """While a command runs, a request to end is an exception. Where a caller has his own way with a signal, that stays."""
    mine = threading.current_thread() is threading.main_thread()
    before = {number: signal.getsignal(number) for number in ENDING}
    asked = [number for number, way in before.items() if mine and way in (signal.SIG_DFL, signal.default_int_handler)]
    came: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        if _taking(frame):
            _thread.start_new_thread(_ask_again, (number,))
            return
        came.append(number)
        raise _Ended(number)

    for number in asked:
        signal.signal(number, end)
    try:
        yield
    except Exception as error:
        if came:
            # On its way out a library has made another exception of it (some take whatever ends an import for a missing file).
            raise _Ended(came[0]) from error
        raise
    finally:
        for number in asked:
            signal.signal(number, before[number])


@contextmanager
def not_ended() -> Iterator[None]:
    """Requests to end wait for the end of the block, where they are answered as they would have been: what it starts has an owner then, who
    can end it too."""
    mine = threading.current_thread() is threading.main_thread()
    before = {number: way for number in ENDING if mine and callable(way := signal.getsignal(number))}
    came: list[int] = []
    for number in before:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, way in before.items():
            signal.signal(number, way)
    if came:
        signal.raise_signal(came[0])


def run(main: Callable[[Sequence[str]], None], argv: Sequence[str] | None = None) -> int:
    """Run a command with these arguments (None: those of the process) and return its exit code."""
    keep_freed()
    # A path need not be text: what has no letter is shown by its number.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with _signals():
            main(sys.argv[1:] if argv is None else argv)
            sys.stdout.flush()
    except CaptureError as error:
        return _complain(str(error))
    except ValueError as error:
        # Checks on what the user gave say wanted and given; any other ValueError is a fault of the program and keeps its trace.
        if "wanted" not in str(error):
            raise
        return _complain(str(error))
    except BrokenPipeError:
        # What is still buffered would raise once more when the interpreter closes standard output.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except Exception as error:
        sentence = _of_the_machine(error)
        if not sentence:
            raise
        return _complain(sentence)
    except KeyboardInterrupt as error:
        print("mvps: interrupted before the end", file=sys.stderr)
        return 128 + (error.args[0] if isinstance(error, _Ended) else signal.SIGINT)
    finally:
        # The process ends and takes its memory along: no search for garbage among the libraries' half a million objects.
        gc.freeze()
    return 0


def _of_the_machine(error: Exception) -> str:
    """A sentence where not the program failed but the machine refused: memory, threads, a file; else empty."""
    if isinstance(error, MemoryError) or any(words in str(error).lower() for words in NO_MEMORY):
        said = str(error).strip().splitlines()[:1] or ["none was left"]
        return (
            f"memory: wanted more than there is ({said[0][:120]}); ask for fewer or smaller images, end other programs, or raise the"
            " limit (ulimit -v)"
        )
    if isinstance(error, OSError) and error.filename is not None:
        name = error.filename if isinstance(error.filename, str) else os.fsdecode(error.filename)
        return f"{name}: {error.strerror}; check the path, its permissions and the free space"
    # numpy writes arrays itself, and says "6912 requested and 5088 written" without a number.
    if isinstance(error, OSError) and (error.errno in NO_ROOM or "requested and" in str(error)):
        return f"writing a file: {error.strerror or 'no space left'}; make room, or give another --out"
    return ""


def _complain(message: str) -> int:
    # Names of files come from whoever made them: what would move a terminal's cursor is shown by its number.
    words = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(message.split()))
    print(f"mvps: {words}", file=sys.stderr)
    return 2


def number_list(text: str) -> tuple[int, ...]:
    """Numbers counted from 1, separated by commas: "1,5,9" -> (1, 5, 9)."""
    numbers = tuple(int(word) for word in text.split(",") if word.strip().isdecimal())
    if not numbers or len(numbers) != text.count(",") + 1 or min(numbers) < 1:
        raise argparse.ArgumentTypeError(f"wanted numbers from 1, separated by commas, such as 1,5,9, given {text!r}")
    return numbers


def positive(text: str) -> float:
    """A finite number above zero."""
    number = _number(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"wanted a number above 0, given {text!r}")
    return number


def finite(text: str) -> float:
    """A finite number."""
    number = _number(text)
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"wanted a finite number, given {text!r}")
    return number


def whole(text: str) -> int:
    """A whole number from 0."""
    if not text.isdecimal() or len(text) > 18:
        raise argparse.ArgumentTypeError(f"wanted a whole number of 0 and more, given {text!r}")
    return int(text)


DEVICES = ("auto", "cpu", "cuda")
"""Where torch may be asked to compute."""


def device_name(text: str) -> str:
    """One of DEVICES."""
    if text not in DEVICES:
        raise argparse.ArgumentTypeError(f"wanted one of {', '.join(DEVICES)}, given {text!r}")
    return text


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def lights_argument(text: str) -> tuple[int, ...] | Mapping[str, tuple[int, ...]]:
    """Numbers of lights for all views, "1,8,16", or the path of a JSON file with a list per view, {"view_01": [1, 8]}."""
    if not text.strip() or set(text) <= set("0123456789, -+"):
        return number_list(text)
    try:
        lights = parsed_json(read_file(Path(text), JSON_LIMIT))
    except OSError as error:
        raise argparse.ArgumentTypeError(f"{text}: wanted a JSON file, or numbers such as 1,5,9, given {error.strerror}") from None
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text}: wanted JSON, given text that is none ({error})") from None
    good = isinstance(lights, dict) and bool(lights)
    if not good or not all(isinstance(v, list) and v and all(type(n) is int and n >= 1 for n in v) for v in lights.values()):
        raise argparse.ArgumentTypeError(f'{text}: wanted a list of numbers from 1 per view, such as {{"view_01": [1, 8]}}')
    return {str(view): tuple(numbers) for view, numbers in lights.items()}
