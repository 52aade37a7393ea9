"""Values that are made once."""

from __future__ import annotations

import gc
import threading
import time
from weakref import ref

import numpy as np
import pytest

from mvps.once import computed_once, once_for


class Thing:
    """Something that values are made for."""


def test_what_is_computed_once_is_so_for_threads_that_ask_together() -> None:
    calls = []

    class Slow:
        @computed_once
        def value(self) -> int:
            calls.append(1)
            time.sleep(0.02)
            return 7

    slow = Slow()
    asked = [threading.Thread(target=lambda: slow.value) for _ in range(8)]
    for thread in asked:
        thread.start()
    for thread in asked:
        thread.join()
    assert slow.value == 7 and calls == [1]


def test_a_value_is_made_once_for_a_thing_and_the_rest() -> None:
    calls = []

    @once_for
    def values(thing: Thing, count: int, step: float = 1.0) -> np.ndarray:
        """Doc."""
        calls.append((thing, count, step))
        return step * np.arange(count)

    one, other = Thing(), Thing()
    assert values(one, 3) is values(one, 3) and values(one, 3) is not values(other, 3)
    assert values(one, 4).tolist() == [0, 1, 2, 3] and values(one, 4, step=2.0).tolist() == [0, 2, 4, 6]
    assert calls == [(one, 3, 1.0), (other, 3, 1.0), (one, 4, 1.0), (one, 4, 2.0)]
    assert values.__doc__ == "Doc."


def test_arrays_that_all_share_cannot_be_written_to() -> None:
    shared = once_for(lambda thing: np.zeros(3))(Thing())
    with pytest.raises(ValueError, match="read-only"):
        shared[0] = 1


def test_values_are_gone_with_their_thing() -> None:
    made = []

    class Value:
        """Something that can be watched."""

    @once_for
    def value(thing: Thing) -> Value:
        made.append(ref(of := Value()))
        return of

    thing = Thing()
    assert value(thing) is made[0]()
    del thing
    gc.collect()
    assert made[0]() is None


def test_what_fails_is_asked_again() -> None:
    @once_for
    def value(thing: Thing) -> int:
        calls.append(1)
        if len(calls) == 1:
            raise ZeroDivisionError
        return len(calls)

    calls: list[int] = []
    thing = Thing()
    with pytest.raises(ZeroDivisionError):
        value(thing)
    assert value(thing) == 2 and value(thing) == 2


def test_threads_that_ask_together_get_the_same() -> None:
    @once_for
    def value(thing: Thing) -> object:
        time.sleep(0.02)
        return object()

    thing, found = Thing(), []
    asked = [threading.Thread(target=lambda: found.append(value(thing))) for _ in range(8)]
    for thread in asked:
        thread.start()
    for thread in asked:
        thread.join()
    assert len(set(map(id, found))) == 1
