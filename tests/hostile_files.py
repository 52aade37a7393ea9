"""A tiny capture with its truth, and ways to make one of its files hostile: bombs, lying headers, what is no file, names that lead away."""

from __future__ import annotations

import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.io
import trimesh

HEIGHT, WIDTH, VIEWS, LIGHTS = 12, 16, 3, 3
K = np.array([[50.0, 0, 8], [0, 50, 6], [0, 0, 1]])

Damage = Callable[[Path], object]


def calibration(**changes: Any) -> dict[str, Any]:
    """Variables of Calib_Results.mat, some of them changed; None leaves one out."""
    values: dict[str, Any] = {"KK": K}
    for i in range(1, VIEWS + 1):
        values |= {f"Rc_{i}": cv2.Rodrigues(np.array([0.1, 0.9 * i, 0.0]))[0], f"Tc_{i}": np.array([[0.0], [0.0], [5.0]])}
    return {name: value for name, value in (values | changes).items() if value is not None}


def make_capture(root: Path) -> Path:
    """Three views of three photographs of 16 bits, with all files that a capture may have."""
    root.mkdir(parents=True)
    scipy.io.savemat(root / "Calib_Results.mat", calibration())
    (root / "scene.json").write_text('{"pixel_center": 0.5}')
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], process=False).export(
        root / "mesh_Gt.ply"
    )
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[3:9, 4:12] = 255
    random = np.random.default_rng(0)
    for view in range(1, VIEWS + 1):
        folder = root / f"view_{view:02d}"
        folder.mkdir()
        (folder / "mask.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
        for light in range(1, LIGHTS + 1):
            photograph = random.integers(0, 65536, (HEIGHT, WIDTH, 3)).astype(np.uint16)
            (folder / f"{light:03d}.png").write_bytes(cv2.imencode(".png", photograph)[1].tobytes())
        (folder / "filenames.txt").write_text("001.png\n002.png\n003.png\n")
        np.savetxt(folder / "light_directions.txt", [[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]])
        np.savetxt(folder / "light_intensities.txt", [[1, 2, 3], [2, 2, 2], [4, 4, 4]])
        scipy.io.savemat(folder / "Normal_gt.mat", {"Normal_gt": np.where(mask[..., None] > 0, [0.6, 0, 0.8], 0.0)})
    return root


def chunk(kind: bytes, data: bytes) -> bytes:
    """A block of a PNG."""
    return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")


def png(width: int, height: int, *blocks: bytes, bits: int = 16, colour: int = 2) -> bytes:
    """A PNG with this header and these blocks."""
    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([bits, colour, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + b"".join(blocks) + chunk(b"IEND", b"")


def zeros(length: int) -> bytes:
    """A zlib stream of so many zeros, a thousandth as long."""
    packer, block = zlib.compressobj(9), bytes(1 << 20)
    parts = [packer.compress(block) for _ in range(length >> 20)] + [packer.compress(bytes(length & 0xFFFFF)), packer.flush()]
    return b"".join(parts)


def png_bomb(width: int, height: int, bits: int = 16, colour: int = 2) -> bytes:
    """A PNG that is what it says, black."""
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    return png(width, height, chunk(b"IDAT", zeros(height * (1 + width * channels * bits // 8))), bits=bits, colour=colour)


def part(kind: int, data: bytes) -> bytes:
    """A data element of a MAT file (MathWorks, MAT-File Format, level 5)."""
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def matrix(name: bytes, dims: tuple[int, ...], body: bytes, kind: int = 6) -> bytes:
    """A miMATRIX element of class `kind` (6: double, 1: cell) with these dimensions and this body."""
    return part(14, part(6, struct.pack("<II", kind, 0)) + part(5, struct.pack(f"<{len(dims)}i", *dims)) + part(1, name) + body)


def mat(*elements: bytes) -> bytes:
    """A MAT file of these elements."""
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b"".join(elements)


def packed(element: bytes, more: int = 0) -> bytes:
    """A compressed element, followed inside by so many zeros."""
    packer = zlib.compressobj(9)
    data = packer.compress(element) + b"".join(packer.compress(bytes(1 << 20)) for _ in range(more >> 20)) + packer.flush()
    return struct.pack("<II", 15, len(data)) + data


def write(name: str, content: bytes) -> Damage:
    return lambda root: ((root / name).unlink(missing_ok=True), (root / name).write_bytes(content))


def made(name: str, content: Callable[[], bytes]) -> Damage:
    """As `write`, for contents that take a while to make."""
    return lambda root: ((root / name).unlink(missing_ok=True), (root / name).write_bytes(content()))


def with_calibration(**changes: Any) -> Damage:
    return lambda root: scipy.io.savemat(root / "Calib_Results.mat", calibration(**changes))


def sparse(name: str, size: int, head: bytes = b"") -> Damage:
    """A file of that size that takes no room."""

    def make(root: Path) -> None:
        (root / name).write_bytes(head)
        os.truncate(root / name, size)

    return make


def fifo(name: str) -> Damage:
    return lambda root: ((root / name).unlink(missing_ok=True), os.mkfifo(root / name))


def linked(name: str, target: str | Path) -> Damage:
    return lambda root: ((root / name).unlink(missing_ok=True), (root / name).symlink_to(target))


def folder(name: str) -> Damage:
    return lambda root: ((root / name).unlink(missing_ok=True), (root / name).mkdir())


def cut(name: str, keep: float) -> Damage:
    return lambda root: (root / name).write_bytes((root / name).read_bytes()[: int((root / name).stat().st_size * keep)])


def all_masks_and_photographs(content: Callable[[], bytes], of_mask: Callable[[], bytes]) -> Damage:
    def make(root: Path) -> None:
        data, mask = content(), of_mask()
        for view in root.glob("view_*"):
            (view / "mask.png").write_bytes(mask)
            for path in view.glob("0*.png"):
                path.write_bytes(data)

    return make


def spotted_mask(width: int, height: int) -> bytes:
    """A mask with one white row."""
    packer = zlib.compressobj(9)
    data = (
        packer.compress(b"\0" + b"\xff" * width) + b"".join(packer.compress(bytes(1 + width)) for _ in range(height - 1)) + packer.flush()
    )
    return png(width, height, chunk(b"IDAT", data), bits=8, colour=0)


def ply(counts: str, body: bytes = b"", form: str = "binary_little_endian") -> bytes:
    """A PLY file with these element lines and this body."""
    return f"ply\nformat {form} 1.0\n{counts}end_header\n".encode() + body


VERTEX = "element vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
FACE = "element face {}\nproperty list uchar int vertex_indices\n"


def odd_view(root: Path) -> None:
    """A folder whose number is a digit that is no decimal."""
    shutil.copytree(root / "view_01", root / "view_\u00b2")


def odd_names(root: Path) -> None:
    """Names that are not UTF-8, where nothing asks for them."""
    for name in (b"\xff.png", b"\xff\xfe.txt"):
        with open(os.path.join(os.fsencode(root / "view_01"), name), "wb") as file:
            file.write(b"x")
    os.mkdir(os.path.join(os.fsencode(root), b"view_\xff"))


FILES = (
    "Calib_Results.mat",
    "scene.json",
    "view_01/mask.png",
    "view_01/002.png",
    "view_01/filenames.txt",
    "view_01/light_directions.txt",
    "view_01/light_intensities.txt",
    "view_01/Normal_gt.mat",
    "mesh_Gt.ply",
)

IN_PLACE_OF_A_FILE: dict[str, Callable[[str], Damage]] = {
    "fifo": fifo,
    "device": lambda name: linked(name, "/dev/zero"),
    "folder": folder,
    "empty": lambda name: write(name, b""),
    "endless": lambda name: sparse(name, 20 << 30),
    "loop": lambda name: linked(name, Path(name).name),
    "dangling": lambda name: linked(name, "nowhere"),
    "half": lambda name: cut(name, 0.5),
}
