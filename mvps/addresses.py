"""A limit on the process's addresses (ulimit -v), looked at before numpy is loaded.

Where a library finds too few while it is loaded, no exception comes of it: OpenBLAS prints a page about its threads, and the C library may
end the process. So the limit is compared with what the libraries are known to take. Later failures are exceptions (command.py).
"""

from __future__ import annotations

import resource
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

NEEDED = 1.6e9
"""Bytes. All libraries map 1.0e9 (PyTorch for the CPU, two cores), and their buffers come on top: 1.11e9 and 1.18e9 ended in OpenBLAS,
1.30e9 to 1.45e9 in the ray tracer, which does not ask whether it got its memory."""


def refused(limit: int) -> str:
    """Why a limit (bytes; resource.RLIM_INFINITY for none) is too low, as a sentence; empty where it is not."""
    if limit == resource.RLIM_INFINITY or limit >= NEEDED:
        return ""
    return f"memory: wanted at least {NEEDED / 1e9:.1f} GB of addresses, given {limit / 1e9:.2g}; raise the limit with ulimit -v"


@contextmanager
def loading() -> Iterator[None]:
    """While libraries are loaded: ends the process with exit code 2 and a sentence where its limit is too low; an interruption ends it
    without the trace of an import."""
    sentence = refused(resource.getrlimit(resource.RLIMIT_AS)[0])
    if sentence:
        print(f"mvps: {sentence}", file=sys.stderr)
        raise SystemExit(2)
    handled = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if handled:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        if handled:
            signal.signal(signal.SIGINT, signal.default_int_handler)
