"""How work is dealt to threads, and threads that libraries bring along."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time

import pytest

from mvps.cores import at_a_time, on_cores, one_by_one

ASK = """
import numpy, json
from threadpoolctl import threadpool_info, threadpool_limits
threadpool_limits(3, "blas")
from mvps.cores import blas_as_asked
blas_as_asked()
print(json.dumps([pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]))
"""


@pytest.mark.parametrize(("given", "wanted"), [(None, 1), ("2", 2), ("", 3), ("many", 3)])
def test_blas_has_the_threads_that_were_asked_for_whoever_loads_numpy_first(given: str | None, wanted: int) -> None:
    rest = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    said = subprocess.run(
        [sys.executable, "-c", ASK], env=rest | ({} if given is None else {"OPENBLAS_NUM_THREADS": given}), capture_output=True, check=True
    ).stdout
    threads = json.loads(said)
    assert threads and set(threads) == {wanted}


@pytest.mark.parametrize(("cores", "things", "share"), [(2, 20, 1), (16, 20, 1), (16, 3, 5), (16, 1, 16), (1, 4, 1)])
def test_what_is_dealt_out_within_a_thing_goes_to_the_cores_that_are_its_share(
    monkeypatch: pytest.MonkeyPatch, cores: int, things: int, share: int
) -> None:
    monkeypatch.setattr("mvps.cores._most", [cores])
    working, most = [0], [0]
    lock = threading.Lock()

    def inner(_: int) -> None:
        with lock:
            working[0] += 1
            most[0] = max(most[0], working[0])
        time.sleep(0.002)
        with lock:
            working[0] -= 1

    def outer(_: int) -> int:
        on_cores(inner, range(8))
        return at_a_time()

    assert on_cores(outer, range(things)) == [share] * things == list(one_by_one(outer, things))
    assert most[0] <= cores and (most[0] > 1) == (cores > 1)
    assert at_a_time() == cores


def test_results_come_in_order_and_the_first_failure_is_told() -> None:
    assert on_cores(lambda a, b: a * b, range(5), range(5)) == [0, 1, 4, 9, 16]
    assert on_cores(lambda a: a, []) == []
    with pytest.raises(ZeroDivisionError):
        on_cores(lambda a: 1 / a, [1, 0, 2])
