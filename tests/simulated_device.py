"""A device that is not the CPU, on any machine: tensors whose values lie in the processor's memory, behind a wall.

They say that they are on the device "meta", and keep values all the same, so that whole reconstructions run on it and can be compared with
the CPU's. Like tensors of a GPU they cannot be mixed with others (but for numbers: tensors without axes), and numpy does not get at them;
unlike there, not even with indices from the CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

SIMULATED = torch.device("meta")

aten = torch.ops.aten


class Remote(torch.Tensor):
    """A tensor on the simulated device."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> Remote:
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        made = torch.Tensor._make_wrapper_subclass(cls, inner.shape, device=SIMULATED, **layout)  # type: ignore[attr-defined]
        made.inner = inner
        return made

    def tolist(self) -> Any:
        """The values as Python's, which torch has not for classes like this one."""
        return self.inner.tolist()

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(function, args, kwargs or {})


def _here(value: Any) -> Any:
    return value.inner if isinstance(value, Remote) else value


def _there(value: Any) -> Any:
    return Remote(value) if isinstance(value, torch.Tensor) and not isinstance(value, Remote) else value


def _run(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """One operation of torch: on the values, and its result where it belongs."""
    tensors = [t for t in tree_flatten((args, kwargs))[0] if isinstance(t, torch.Tensor)]
    remote = any(isinstance(t, Remote) for t in tensors)
    wanted = kwargs.get("device")
    kwargs = kwargs | ({} if wanted is None else {"device": torch.device("cpu")})
    here = tree_map(_here, (args, kwargs))
    to_remote = remote if wanted is None else torch.device(wanted).type == SIMULATED.type
    if function is aten._to_copy.default:
        moved = function(*here[0], **here[1])
        return Remote(moved) if to_remote else moved
    if remote and function is not aten.copy_.default and not all(isinstance(t, Remote) or t.ndim == 0 for t in tensors):
        raise RuntimeError(f"{function}: wanted all tensors on one device, given some on the simulated one and some on the CPU")
    result = function(*here[0], **here[1])
    if function._schema.is_mutable:
        return args[0]
    return tree_map(_there, result) if to_remote else result


class _Operations(TorchDispatchMode):
    """Tensors that are made on the simulated device."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(function, args, kwargs or {})


class _Constants(TorchFunctionMode):
    """torch.tensor fills in its values where no dispatch mode sees them."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if function is torch.tensor and "device" in kwargs:
            return torch.tensor(*args, **{**kwargs, "device": "cpu"}).to(kwargs["device"])
        return function(*args, **kwargs)


class _Generator(torch.Generator):
    """Random numbers of any device, drawn on the CPU."""

    def __new__(cls, device: Any = None) -> _Generator:
        return super().__new__(cls)


class _InTurn:
    """In the place of threads, which know nothing of the modes."""

    def __init__(self, _: int, initializer: object = None) -> None: ...

    def __enter__(self) -> _InTurn:
        return self

    def __exit__(self, *_: object) -> None: ...

    def map(self, task: Callable[..., Any], *arguments: Iterable[Any]) -> Iterator[Any]:
        return map(task, *arguments)


@contextmanager
def simulated_device(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """The simulated device, while this lasts; random numbers on it are the CPU's."""
    for module in ("mvps.cores", "mvps.fieldtraining", "mvps.joint.neural"):
        monkeypatch.setattr(f"{module}.ThreadPoolExecutor", _InTurn)
    monkeypatch.setattr("torch.Generator", _Generator)
    with _Constants(), _Operations():
        yield SIMULATED
