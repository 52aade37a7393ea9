"""Checks that frozen values make of the arrays that they are given."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def checked(
    name: str,
    value: Any,
    shape: tuple[int | None, ...],
    dtype: Any = np.float64,
    finite: bool = True,
) -> NDArray[Any]:
    """`value` as a read-only array of `dtype` and `shape` (None matches any length); ValueError with wanted and given if not."""
    array = np.asarray(value, dtype=dtype)
    if array.ndim != len(shape) or any(w is not None and w != g for w, g in zip(shape, array.shape, strict=True)):
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise ValueError(f"{name}: wanted shape {wanted}, given {array.shape}")
    if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name}: wanted finite numbers, given {int((~np.isfinite(array)).sum())} NaN or infinite")
    if array.flags.writeable:
        array = array.view()
        array.flags.writeable = False
    return array


def channel_mean(values: NDArray[Any], dtype: Any = np.float64) -> NDArray[Any]:
    """(...) mean of three channels (..., 3): numpy's own, whose loops are slow along an axis of three, takes several times as long."""
    total: NDArray[Any] = values[..., 0].astype(dtype)
    total += values[..., 1]
    total += values[..., 2]
    total /= 3
    return total


def unit(name: str, vectors: NDArray[Any]) -> None:
    """ValueError unless vectors (..., 3) have length 1."""
    # Too long for a number is infinitely long, without a warning beside the sentence.
    with np.errstate(over="ignore"):
        length = np.linalg.norm(vectors, axis=-1)
    if length.size and np.abs(length - 1).max() > 1e-3:
        worst = float(length.flat[int(np.abs(length - 1).argmax())])
        raise ValueError(f"{name}: wanted unit vectors, given one of length {worst:.4g}")
