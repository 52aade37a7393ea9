"""How much is worked on at a time: one thing to a core, and fewer where memory is short. What is dealt out within such a thing goes to the
cores that are its share: twice as many threads as cores would only wait for each other.

Every view (or half of them) that is worked on holds arrays of its own, so their number at a time decides how much memory is held beyond
what the photographs and the mesh need. No value depends on it: results come in order.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Result = TypeVar("Result")

MANY_POINTS = 1 << 14
"""Below, starting threads takes longer than looking for points' neighbours (about 2 microseconds each)."""

_most = [len(os.sched_getaffinity(0))]
_thread = threading.local()


def at_a_time() -> int:
    """Things that are worked on at a time: the number of cores, unless `work_on` set less; within a thing, its share of them."""
    share: int = getattr(_thread, "share", _most[0])
    return share


def work_on(most: int) -> None:
    """No more than `most` things at a time from now on, in this process; at least one, no more than cores."""
    _most[0] = max(1, min(most, len(os.sched_getaffinity(0))))


def blas_as_asked() -> None:
    """As many threads of BLAS as the environment says (mvps/__init__.py), also where numpy was imported before this package: other numbers
    give other last bits, and threads on top of ours only wait for each other."""
    asked = os.environ["OPENBLAS_NUM_THREADS"]
    if asked.isdecimal() and int(asked) > 0:
        threadpool_limits(int(asked), "blas")


def _pool(things: int) -> ThreadPoolExecutor:
    """Threads for so many things."""
    threads = max(1, min(things, at_a_time()))
    share = at_a_time() // threads
    return ThreadPoolExecutor(threads, initializer=lambda: setattr(_thread, "share", share))


def on_cores(task: Callable[..., Result], *arguments: Iterable[Any]) -> list[Result]:
    """[task(first arguments), task(second ones) ...] on all cores: numpy, torch and Embree release the interpreter's lock."""
    things = list(zip(*arguments, strict=True))
    if min(len(things), at_a_time()) < 2:
        return [task(*thing) for thing in things]
    with _pool(len(things)) as pool:
        return list(pool.map(lambda thing: task(*thing), things))


def one_by_one(task: Callable[[int], Result], total: int) -> Iterator[Result]:
    """task(0), task(1) ... of `total` on all cores, in this order, for results too large to hold all: while one is used, the next are
    being made, and no more than one waits."""
    with _pool(total) as pool:
        waiting: deque[Future[Result]] = deque()
        for number in range(total):
            if len(waiting) > at_a_time():
                yield waiting.popleft().result()
            waiting.append(pool.submit(task, number))
        while waiting:
            yield waiting.popleft().result()


def neighbours(tree: cKDTree, points: NDArray[Any], k: int = 1, p: float = 2) -> tuple[NDArray[Any], NDArray[Any]]:
    """Distance and index (n,), or (n, k), of the tree's points nearest to points (n, 3), in the p-norm, on all cores where there are many
    points. (The tree's own threads are abandoned by an interruption, and abort the process when it ends.)"""
    if len(points) < MANY_POINTS:
        few: tuple[NDArray[Any], NDArray[Any]] = tree.query(points, k=k, p=p)
        return few
    parts = on_cores(lambda some: tree.query(some, k=k, p=p), np.array_split(points, at_a_time()))
    distance, index = (np.concatenate(values) for values in zip(*parts, strict=True))
    return distance, index
