"""Values that are made once, also where threads ask for them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cached_property, wraps
from typing import Any, Concatenate, ParamSpec, Self, TypeVar, overload
from weakref import finalize

import numpy as np

Thing = TypeVar("Thing")
Rest = ParamSpec("Rest")
Result = TypeVar("Result")


class computed_once(cached_property[Result]):
    """A cached property that is computed once even where threads ask for it at the same time (functools' own, from Python 3.12 on, by
    each of them)."""

    def __init__(self, function: Callable[[Any], Result]) -> None:
        super().__init__(function)
        self._lock = threading.RLock()

    @overload
    def __get__(self, instance: None, owner: type[Any] | None = None) -> Self: ...
    @overload
    def __get__(self, instance: object, owner: type[Any] | None = None) -> Result: ...
    def __get__(self, instance: object, owner: type[Any] | None = None) -> Any:
        with self._lock:
            return super().__get__(instance, owner)


def once_for(function: Callable[Concatenate[Thing, Rest], Result]) -> Callable[Concatenate[Thing, Rest], Result]:
    """function(thing, rest), made once for a thing and each rest, and kept as long as the thing lives; things and rests are told apart by
    what they are, not by what they hold. Arrays are read-only, for all who ask get the same. Threads that ask for the same at the same time
    may each make it, and get what was made first."""
    kept: dict[int, dict[Any, Result]] = {}
    lock = threading.Lock()

    @wraps(function)
    def once(thing: Thing, /, *rest: Rest.args, **named: Rest.kwargs) -> Result:
        with lock:
            if id(thing) not in kept:
                kept[id(thing)] = {}
                finalize(thing, kept.pop, id(thing)).atexit = False
            of_thing = kept[id(thing)]
        key = (rest, *sorted(named.items()))
        if key not in of_thing:
            made = function(thing, *rest, **named)
            if isinstance(made, np.ndarray):
                made.flags.writeable = False
            of_thing.setdefault(key, made)
        return of_thing[key]

    return once
