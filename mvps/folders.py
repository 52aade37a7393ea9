"""Folders and files that appear whole: written beside their place, on the same file system, and renamed."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from mvps.command import not_ended
from mvps.scene import CaptureError

RESULT_MARKS = ("settings.json", "mesh.ply")
"""Files by which a folder is known as an earlier result, which may be replaced."""

CHECKPOINT = "checkpoint"
"""Folder in a result's place from which an interrupted run goes on (checkpoint.py)."""


@contextmanager
def appearing_whole(folder: Path, marks: tuple[str, ...] = (), unfinished: str = "") -> Iterator[Path]:
    """A folder to write into, which takes its place at `folder` when the block ends well and vanishes when it does not.

    CaptureError as `check_place`.
    """
    place = Path(folder).resolve()
    check_place(place, marks, unfinished)
    place.parent.mkdir(parents=True, exist_ok=True)
    writing, aside = (place.with_name(f".{place.name}.{os.getpid()}.{use}") for use in ("writing", "replaced"))
    writing.mkdir()
    try:
        yield writing
        # Someone may have put something there in the meantime.
        check_place(place, marks, unfinished)
        with not_ended():
            _put(writing, place, aside)
    finally:
        if writing.exists():
            shutil.rmtree(writing)


def _put(writing: Path, place: Path, aside: Path) -> None:
    """A finished folder in its place; what was there goes aside until it is."""
    if not place.exists():
        writing.rename(place)
        return
    place.rename(aside)
    try:
        writing.rename(place)
    except OSError:
        aside.rename(place)
        raise
    shutil.rmtree(aside)


def replaced(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """The file with what `write` writes, whole or as it was."""
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with beside.open("wb") as file:
            write(file)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes) -> None:
    """The file with this content (text as UTF-8), whole or as it was."""
    data = content.encode("utf-8") if isinstance(content, str) else content
    replaced(path, lambda file: file.write(data))


def check_file(path: Path) -> None:
    """CaptureError unless a file can be written at this place, new or over another one."""
    given = "a folder" if path.is_dir() else "no such folder" if not path.parent.is_dir() else ""
    if not given and not os.access(path.parent, os.W_OK | os.X_OK):
        given = "one that cannot be written"
    if given:
        raise CaptureError(f"{path}: wanted a file in a folder that is there and can be written, given {given}; give another place")


def check_place(place: Path, marks: tuple[str, ...] = (), unfinished: str = "") -> None:
    """CaptureError unless the place can be written and is free, an empty folder, or one that may be replaced: with all the files named in
    `marks`, by which an earlier output of the same kind is known, or with nothing but what is called `unfinished`, the rest of an
    interrupted one; and CaptureError where it would be a view of a capture, which could not be read any more."""
    # The root has none above it.
    above = next((folder for folder in place.parents if folder.exists()), place)
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        given = "one that cannot be written" if above.is_dir() else f"{above.name}, a file"
        raise CaptureError(f"{place}: wanted a place in a folder that can be written, given {given}; give another --out")
    for folder in (place, *place.parents):
        if re.fullmatch("view_[0-9]+", folder.name) and (folder.parent / "Calib_Results.mat").exists():
            raise CaptureError(f"{place}: wanted a place that is no view of a capture, given one of {folder.parent}; give another --out")
    if not place.exists():
        return
    if not place.is_dir():
        raise CaptureError(f"{place}: wanted a folder to write to, given a file; give another --out")
    earlier = bool(marks) and all((place / name).is_file() for name in marks)
    if not earlier and any(path.name != unfinished for path in place.iterdir()):
        wanted = "a new or empty folder or an earlier result" if marks else "a new or empty folder"
        raise CaptureError(f"{place}: wanted {wanted}, given a folder with other files; give another --out or empty this one")
