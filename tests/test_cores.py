"""Threads that libraries bring along."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

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
