"""Reading files of which nothing is known yet: they may be no files, endless, or say of themselves what is not so.

Nothing here waits for a pipe, asks for more memory than a file has bytes, or executes what it reads.
"""

from __future__ import annotations

import errno
import json
import math
import os
import stat
import struct
import tokenize
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

JSON_LIMIT = 1 << 26
"""Bytes of a JSON file: lights of a hundred thousand photographs take 20 MB."""

MOST_DIGITS = 1000
"""Of a whole number in JSON."""

DAMAGED = (
    OSError,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    EOFError,
    ArithmeticError,
    MemoryError,
    RuntimeError,
    struct.error,
    zipfile.BadZipFile,
)
"""What numpy, zipfile and conversions raise on damaged contents."""


def shown(path: Path) -> str:
    """A path as text that can be written: what is no UTF-8 in it is shown by its number."""
    return os.fsencode(path).decode("utf-8", "backslashreplace")


def file_size(path: Path) -> int:
    """Bytes of a file. OSError where it is none: opening a pipe would wait, reading a device would not end."""
    status = os.stat(path)
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "Is a pipe, a socket or a device", str(path))
    return status.st_size


def read_file(path: Path, most: int, first: int = -1) -> bytes:
    """The file's bytes, or only so many of its first. OSError where it cannot be read or all of it is more than `most` bytes."""
    size = file_size(path)
    if first < 0 and size > most:
        raise OSError(errno.EFBIG, f"Has {size} bytes, more than {most}", str(path))
    with path.open("rb") as file:
        return file.read(size if first < 0 else min(first, size))


def parsed_json(data: bytes | str) -> Any:
    """The value of a JSON text. ValueError where it is none, nests too deeply or holds a number that is not finite or too long."""

    def finite(text: str) -> float:
        number = float(text)
        if not math.isfinite(number):
            raise ValueError(f"the number {text[:20]}, which is not finite")
        return number

    def whole(text: str) -> int:
        # Python would refuse a few thousand digits more with an advice to programmers.
        if len(text) > MOST_DIGITS:
            raise ValueError(f"the number {text[:20]}..., of {len(text)} digits")
        return int(text)

    try:
        return json.loads(data, parse_float=finite, parse_constant=finite, parse_int=whole)
    except RecursionError:
        raise ValueError("lists within lists too deep to read") from None


def _check_array(file: BinaryIO, size: int) -> None:
    """ValueError unless `size` bytes of a file are one array of numbers, as its NPY header says (numpy.lib.format)."""
    headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(file)
    if version not in headers:
        raise ValueError(f"an array in format {version}")
    try:
        shape, _, dtype = headers[version](file)
    except (tokenize.TokenError, SyntaxError) as error:
        raise ValueError(f"an array whose header is no description of one ({error})") from None
    if dtype.hasobject or min(shape, default=0) < 0 or file.tell() + math.prod(shape) * dtype.itemsize != size:
        raise ValueError(f"an array of {size} bytes that says it is {dtype} of shape {shape}")


def check_npy(path: Path) -> None:
    """One of DAMAGED unless np.load of this NPY file takes no more memory than the file has bytes, and unpickles nothing."""
    size = file_size(path)
    with path.open("rb") as file:
        _check_array(file, size)


def check_npz(path: Path) -> None:
    """The same for an NPZ file. Its arrays are stored, as np.savez leaves them: what is compressed may take a thousand times as much."""
    size = file_size(path)
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if any(m.compress_type != zipfile.ZIP_STORED for m in members) or sum(m.file_size for m in members) > size:
            raise ValueError("arrays that are compressed")
        for member in members:
            with archive.open(member) as file:
                _check_array(file, member.file_size)  # type: ignore[arg-type]
