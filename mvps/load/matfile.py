"""Variables of MATLAB files, one at a time and never more of one than was asked for.

A MAT file of level 5 (MathWorks, MAT-File Format) is 128 bytes of header and a chain of elements (type, length, data), one a variable;
an element of type 15 holds another one, compressed. A kilobyte may unfold to a megabyte, and the lengths within an element need not
be those of the array that it says it is. So every element is unfolded here as far as a limit, and scipy reads it as a file of its own.
Level 4 knows no compression. Version 7.3 is HDF5 and is refused.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.io
from numpy.typing import NDArray
from scipy.io.matlab import MatReadError

from mvps.inputs import DAMAGED, file_size, read_file
from mvps.load.images import complaint
from mvps.scene import CaptureError

MAT_ERRORS = (*DAMAGED, MatReadError, zlib.error)
"""What scipy raises on damaged MAT files and on HDF5-based ones (version 7.3)."""

HEADER_BYTES = 128

MATRIX, COMPRESSED = 14, 15
"""Types of elements."""

ROOM = 4096
"""Bytes of an element beside its numbers: flags, dimensions, name."""

MOST_VARIABLES = 10_000
"""A calibration of a hundred views with all its by-products has a third of them."""

LEVEL_4_LIMIT = 1 << 26
"""Bytes of a file of level 4, which is read whole."""

NUMERIC = ("double", "single", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64")


class Variable(NamedTuple):
    """A variable as a MAT file of its own: shape and class that its header says, and the file's bytes, cut at the limit."""

    shape: tuple[int, ...]
    kind: str
    file: bytes


def read_variables(path: Path, most: int, only: str = "") -> dict[str, Variable]:
    """Variables by name, up to `most` bytes of each (as doubles); `only`: the others without their bytes. CaptureError where the file is
    damaged."""
    found: dict[str, Variable] = {}
    try:
        for data in _files(path, most + ROOM):
            for name, shape, kind in scipy.io.whosmat(io.BytesIO(data)):
                found[name] = Variable(tuple(shape), kind, data if name == only or not only else b"")
    except MAT_ERRORS as error:
        raise _unreadable(path, error) from None
    return found


def numbers_of(path: Path, name: str, variable: Variable) -> NDArray[Any]:
    """The array of a variable whose shape has been checked. CaptureError where it holds no real numbers or is damaged."""
    if variable.kind not in NUMERIC:
        raise complaint(path, f"finite real numbers in {name}", f"the class {variable.kind}", "export it again")
    try:
        return np.asarray(scipy.io.loadmat(io.BytesIO(variable.file), variable_names=[name])[name])
    except MAT_ERRORS as error:
        raise _unreadable(path, error) from None


def _files(path: Path, limit: int) -> Iterator[bytes]:
    """A file for every element, each no longer than header and limit."""
    size = file_size(path)
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES)
        if 0 in head[:4]:
            yield read_file(path, LEVEL_4_LIMIT)
            return
        # Refuses what is no MAT file and version 7.3.
        scipy.io.whosmat(io.BytesIO(head))
        order = "<" if head[126:128] == b"IM" else ">"
        for _ in range(MOST_VARIABLES):
            tag = file.read(8)
            if not tag:
                return
            kind, length = struct.unpack(f"{order}II", tag)
            start = file.tell()
            if kind not in (MATRIX, COMPRESSED) or start + length > size:
                raise ValueError(f"no whole variable at byte {start - 8}")
            # What does not compress grows by a thousandth.
            data = file.read(min(length, 2 * limit))
            file.seek(start + length)
            yield head + (zlib.decompressobj().decompress(data, limit) if kind == COMPRESSED else (tag + data)[:limit])
    raise ValueError(f"more than {MOST_VARIABLES} variables")


def _unreadable(path: Path, error: Exception) -> CaptureError:
    given = f"one that cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:120]})"
    return complaint(path, "a MATLAB file", given, "copy it again, or save it in MATLAB with save(..., '-v7')")
