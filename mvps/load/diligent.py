"""The layout of DiLiGenT-MV (Li et al. 2020): a folder -> Capture.

    CAPTURE/Calib_Results.mat, scene.json   the cameras (see calibration.py)
    CAPTURE/view_01/001.png ...             linear photographs of 16 or 8 bits, one per light
    CAPTURE/view_01/mask.png                white where the object is
    CAPTURE/view_01/filenames.txt           optional: names of the photographs in the order of the lights

No ground truth is read here (see truth.py).
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.inputs import shown
from mvps.load.calibration import Calibration, read_calibration
from mvps.load.images import TEXT_LIMIT, Header, check_packing, clip_level, complaint, decode, histogram, read_bytes, read_header, read_mask
from mvps.scene import Bool, Camera, Capture, Int, View

LONGEST_NAME = 255
"""Bytes of a file's name (NAME_MAX of Linux)."""


def read_capture(
    path: str | Path,
    views: Sequence[int] | None = None,
    lights: Sequence[int] | Mapping[str, Sequence[int]] | None = None,
    before_decoding: Callable[[list[tuple[int, int]]], None] | None = None,
) -> Capture:
    """A capture in the layout of DiLiGenT-MV, foreground pixels only, views and lights in ascending order of their numbers.

    views   numbers of the views to read, counted from 1 as in the folders' names; None: all
    lights  numbers of the photographs to read, counted from 1 in the order of filenames.txt or of the files' names, for all
            views or by view name (every view read must then be named); None: all
    before_decoding is called with every view's numbers of foreground pixels and lights, while nothing large is held yet

    Samples are the file's code values: scale is 1 / 255 or 1 / 65535; for saturation see `clip_level`.
    Raises CaptureError, with the file, what was wanted, what was given and what to try, about everything that is wrong.
    """
    root = Path(path)
    calibration = read_calibration(root)
    folders = view_folders(root, calibration, views)
    chosen = _lights_per_view(root, {n: f.name for n, f in folders.items()}, calibration, lights)
    plans = [_plan(root, folders[number], calibration, number, chosen.get(folders[number].name)) for number in sorted(folders)]
    if calibration.shared_K:
        for plan in plans[1:]:
            if plan.header[:2] != plans[0].header[:2]:
                first = plans[0]
                wanted = f"{first.header.width} x {first.header.height} pixels as in {first.folder.name}, because one KK serves all views"
                given = f"{plan.header.width} x {plan.header.height}"
                raise complaint(plan.folder, wanted, given, "restore the original size or store one KK_i per view")
    if before_decoding is not None:
        before_decoding([(int(plan.mask.sum()), len(plan.lights)) for plan in plans])
    samples, frames = _decode_all(plans)
    deep = [s for s, plan in zip(samples, plans, strict=True) if plan.header.bits == 16]
    saturation = {8: 255, 16: clip_level(histogram(deep))}
    return Capture(
        shown(Path(root.resolve().name)),
        tuple(
            View(
                name=plan.folder.name,
                camera=plan.camera,
                mask=plan.mask,
                samples=values,
                scale=1 / (2**plan.header.bits - 1),
                saturation=saturation[plan.header.bits],
                lights=plan.lights,
                frame=frame,
                files=plan.files,
            )
            for plan, values, frame in zip(plans, samples, frames, strict=True)
        ),
    )


def view_folders(root: Path, calibration: Calibration, views: Sequence[int] | None) -> dict[int, Path]:
    """Folders by view number, in ascending order; each has a calibration, and the other way round unless `views` picks."""
    matches = [(m, entry) for entry in sorted(root.iterdir()) if entry.is_dir() and (m := re.fullmatch(r"view_(\d+)", entry.name))]
    found: dict[int, Path] = {}
    for match, entry in matches:
        if int(match[1]) in found:
            raise complaint(entry, "one folder per view", f"the same number as {found[int(match[1])].name}", "rename one of them")
        found[int(match[1])] = entry
    if not found:
        raise complaint(root, "folders view_01, view_02 and so on", "none", "check the path and the capture layout in the README")
    chosen = sorted(set(found) | set(calibration.rotation)) if views is None else _checked_numbers(root, "views", views)
    for number in chosen:
        if number not in found and number not in calibration.rotation:
            raise complaint(root, f"numbers of views among {_span(sorted(found))}", str(number), "choose other views")
        if number not in found:
            wanted = f"a folder view_{number:02d}, because {calibration.path.name} has Rc_{number}"
            raise complaint(root, wanted, "none", "restore it, or pick the views that are there with --views")
        if number not in calibration.rotation:
            wanted = f"Rc_{number} and Tc_{number}, because there is a folder {found[number].name}"
            raise complaint(calibration.path, wanted, "neither", "calibrate the view, or pick others with --views")
    return {number: found[number] for number in chosen}


def _checked_numbers(where: Path, what: str, numbers: Sequence[int]) -> list[int]:
    """Ascending distinct numbers, at least one of them."""
    bad = [n for n in numbers if isinstance(n, bool) or not isinstance(n, int | np.integer)]
    if bad:
        raise complaint(where, f"whole numbers as {what}", repr(bad[0]), "count from 1, as in the file names")
    if not numbers:
        raise complaint(where, f"at least one number in {what}", "none", f"leave {what} out to read all")
    if len(set(numbers)) != len(numbers):
        raise complaint(where, f"each number of {what} once", str(list(numbers)), "remove the repeated one")
    return sorted(int(n) for n in numbers)


def _span(numbers: Sequence[int]) -> str:
    """1..20, or the list where numbers are missing."""
    whole = len(numbers) > 2 and list(numbers) == list(range(numbers[0], numbers[-1] + 1))
    return f"{numbers[0]}..{numbers[-1]}" if whole else ", ".join(map(str, numbers))


def _lights_per_view(
    root: Path, names: Mapping[int, str], calibration: Calibration, lights: Sequence[int] | Mapping[str, Sequence[int]] | None
) -> dict[str, list[int]]:
    """Numbers of the lights asked for by view name; a view that is not in it keeps all."""
    if lights is None:
        return {}
    if not isinstance(lights, Mapping):
        return dict.fromkeys(names.values(), _checked_numbers(root, "lights", lights))
    for name in lights:
        if name not in names.values() and not (root / name).is_dir():
            raise complaint(root, f"names of views such as {next(iter(names.values()))} in lights", repr(name), "correct the name")
    for name in names.values():
        if name not in lights:
            raise complaint(
                root, f"numbers of lights for {name}", f"lights only for {', '.join(lights)}", "add it, or pick views with --views"
            )
    return {name: _checked_numbers(root / name, f"lights of {name}", lights[name]) for name in names.values()}


@dataclass(frozen=True, eq=False)
class _Plan:
    """A view before its photographs are decoded."""

    folder: Path
    camera: Camera
    mask: Bool
    header: Header
    files: tuple[Path, ...]
    lights: tuple[int, ...]


def _plan(root: Path, folder: Path, calibration: Calibration, number: int, lights: list[int] | None) -> _Plan:
    mask = read_mask(folder / "mask.png")
    files = _photographs(root, folder)
    chosen = list(range(1, len(files) + 1)) if lights is None else lights
    for light in chosen:
        if not 1 <= light <= len(files):
            raise complaint(folder, f"numbers of lights in 1..{len(files)}", str(light), "choose other lights")
    picked = tuple(files[light - 1] for light in chosen)
    headers = [read_header(file) for file in picked]
    for file, header in zip(picked, headers, strict=True):
        check_packing(file, header)
        if header[:2] != mask.shape:
            wanted = f"{mask.shape[1]} x {mask.shape[0]} pixels as in mask.png"
            raise complaint(file, wanted, f"{header.width} x {header.height}", "use photographs and a mask of one size")
        if header.bits != headers[0].bits:
            wanted = f"{headers[0].bits} bits as in {picked[0].name}"
            raise complaint(file, wanted, f"{header.bits} bits", "export all photographs of a view with the same depth")
    return _Plan(folder, calibration.camera(number, *mask.shape), mask, headers[0], picked, tuple(chosen))


def _photographs(root: Path, folder: Path) -> list[Path]:
    """The photographs in the order of their lights: filenames.txt, or 001.png, 002.png and so on without a gap."""
    numbered = sorted((int(p.stem), p.name) for p in folder.iterdir() if re.fullmatch(r"\d+\.png", p.name, re.IGNORECASE))
    listing = folder / "filenames.txt"
    if os.path.lexists(listing):
        names = _listed_names(root, listing)
        unlisted = [name for _, name in numbered if name not in names]
        if unlisted:
            given = f"{len(names)} names while {len(unlisted)} more photographs lie beside it, such as {unlisted[0]}"
            raise complaint(listing, "the names of all photographs", given, "add the names or move the photographs away")
        return [folder / name for name in names]
    if not numbered:
        raise complaint(folder, "at least one photograph 001.png", "none", "check the capture layout in the README")
    for position, (number, name) in enumerate(numbered, 1):
        if number != position:
            wanted = f"photographs 001.png to {len(numbered):03d}.png without a gap, one per light"
            raise complaint(folder, wanted, f"{name} at position {position}", "restore or renumber them, or list them in filenames.txt")
    return [folder / name for _, name in numbered]


def _listed_names(root: Path, listing: Path) -> list[str]:
    """The lines of filenames.txt. It comes from whoever made the capture: it may name no file outside of it. Where the view's folder is a
    link, it may name those beside it."""
    try:
        text = read_bytes(listing, "names of photographs", "remove the file to use the order of the names", most=TEXT_LIMIT).decode(
            "utf-8-sig"
        )
    except UnicodeDecodeError as error:
        raise complaint(listing, "UTF-8 text", f"a byte that is none at position {error.start}", "save it as UTF-8") from None
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    if not lines:
        raise complaint(listing, "at least one name", "none", "remove the file to use the order of the names")
    seen: set[str] = set()
    places = root.resolve(), os.path.realpath(listing.parent)
    for number, name in lines:
        where = Path(f"{listing}, line {number}")
        if name in (".", "..") or "/" in name or "\\" in name or "\0" in name or ":" in name or len(os.fsencode(name)) > LONGEST_NAME:
            raise complaint(where, "the bare name of a file in this folder", repr(name[:80]), "list names without folders")
        if name in seen:
            raise complaint(where, "every name once", f"{name} again", "remove the line")
        # Unlike Path.resolve this ends at a link to itself, which reading refuses.
        real = Path(os.path.realpath(listing.parent / name))
        if not any(real.is_relative_to(place) for place in places):
            raise complaint(where, "a file of this capture", f"{name}, a link that leads out of it", "copy the photograph into the capture")
        seen.add(name)
    return [name for _, name in lines]


def _decode_all(plans: Sequence[_Plan]) -> tuple[list[NDArray[np.uint16]], list[NDArray[np.float32]]]:
    """(pixels, lights, 3) code values and (height, width) mean code value of every view, decoded on all cores straight into their place."""
    samples = [np.empty((int(plan.mask.sum()), len(plan.files), 3), np.uint16) for plan in plans]
    foreground: list[Int] = [np.flatnonzero(plan.mask) for plan in plans]
    sums, locks = [np.zeros(plan.mask.shape, np.uint32) for plan in plans], [Lock() for _ in plans]

    def fill(task: tuple[int, int]) -> None:
        view, light = task
        image = decode(plans[view].files[light], plans[view].header)
        # Turned back to the decoder's order, channels need no copy before few pixels are left of them.
        samples[view][:, light, ::-1] = np.take(image[..., ::-1].reshape(-1, 3), foreground[view], axis=0)
        # Integers, the same sum in whatever order photographs come; 32 bits hold 20 000 photographs.
        with locks[view]:
            for channel in range(3):
                sums[view] += image[..., channel]

    _each(fill, [(view, light) for view, plan in enumerate(plans) for light in range(len(plan.files))])
    return samples, [(total / (3 * len(plan.files))).astype(np.float32) for plan, total in zip(plans, sums, strict=True)]


def _each(task: Callable[[Any], None], arguments: Sequence[Any]) -> None:
    """The task with each argument, on all cores; the first error ends it."""
    pool = ThreadPoolExecutor(len(os.sched_getaffinity(0)))
    try:
        for _ in pool.map(task, arguments):
            pass
    finally:
        pool.shutdown(cancel_futures=True)


def with_mask(view: View, mask: Bool) -> View:
    """The view with another mask (height, width). Samples of pixels that were not foreground before are read from the photographs, whose
    files must be known; a photograph that counts as saturated in all of the old mask is no data in the new pixels either."""
    kept = mask & view.mask
    samples = np.empty((int(mask.sum()), len(view.lights), 3), np.uint16)
    samples[kept[mask]] = view.samples[kept[view.mask]]
    added, black = mask & ~view.mask, np.array(view.black, np.uint16)
    if added.any():
        new = np.empty((int(added.sum()), len(view.lights), 3), np.uint16)

        def fill(light: int) -> None:
            file = view.files[light]
            read = decode(file, read_header(file))[added]
            new[:, light] = np.where((read < view.saturation).all(-1, keepdims=True), np.maximum(read, black) - black, read)
            if not view.usable([light]).any():
                new[:, light] = np.iinfo(np.uint16).max

        _each(fill, range(len(view.files)))
        samples[added[mask]] = new
    return replace(view, mask=mask, samples=samples)
