"""mvps.load: every complaint about a capture can be made to fire, in one sentence."""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io
from tiny_capture import HEIGHT, WIDTH, K, calibration, mask, photograph, tiny_capture, write_rgb

from mvps.load import read_capture
from mvps.scene import CaptureError


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return tiny_capture(tmp_path / "tiny")


def change_calibration(**values: Any) -> Callable[[Path], None]:
    def change(root: Path) -> None:
        merged = calibration() | values
        scipy.io.savemat(root / "Calib_Results.mat", {k: v for k, v in merged.items() if v is not None})

    return change


def write(name: str, content: bytes) -> Callable[[Path], None]:
    def put(root: Path) -> None:
        (root / name).write_bytes(content)

    return put


def image(name: str, value: np.ndarray) -> Callable[[Path], None]:
    return lambda root: write_rgb(root / name, value)


def remove(*names: str) -> Callable[[Path], None]:
    def drop(root: Path) -> None:
        for name in names:
            shutil.rmtree(root / name) if (root / name).is_dir() else (root / name).unlink()

    return drop


def file_instead(root: Path) -> None:
    shutil.rmtree(root)
    root.write_text("x")


def truncate(name: str, keep: float) -> Callable[[Path], None]:
    def cut(root: Path) -> None:
        data = (root / name).read_bytes()
        (root / name).write_bytes(data[: int(len(data) * keep)])

    return cut


def flip_a_byte(root: Path) -> None:
    data = bytearray((root / "view_01/002.png").read_bytes())
    data[len(data) // 2] ^= 1
    (root / "view_01/002.png").write_bytes(data)


def png(width: int, height: int, *chunks: tuple[bytes, bytes]) -> bytes:
    """A PNG with this header (16-bit RGB) and these further chunks."""
    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([16, 2, 0, 0, 0])
    blocks = [len(d).to_bytes(4, "big") + k + d + zlib.crc32(k + d).to_bytes(4, "big") for k, d in ((b"IHDR", header), *chunks)]
    return b"\x89PNG\r\n\x1a\n" + b"".join(blocks)


def link_out(root: Path) -> None:
    outside = root.parent / "secret.png"
    shutil.copy(root / "view_01/001.png", outside)
    (root / "view_01/001.png").unlink()
    (root / "view_01/001.png").symlink_to(outside)
    (root / "view_01/filenames.txt").write_text("001.png\n002.png\n003.png\n")


def directory_instead(root: Path) -> None:
    (root / "view_01/002.png").unlink()
    (root / "view_01/002.png").mkdir()


NAN_TRANSLATION = np.array([[np.nan], [0], [1]])

COMPLAINTS: list[tuple[Callable[[Path], None], dict[str, Any], list[str]]] = [
    (lambda root: shutil.rmtree(root), {}, ["tiny: wanted a capture's folder, given no such folder; check the path"]),
    (file_instead, {}, ["given a file; check the path"]),
    (remove("Calib_Results.mat"), {}, ["Calib_Results.mat", "no such file", "README"]),
    (write("Calib_Results.mat", b""), {}, ["Calib_Results.mat", "empty file of 0 bytes"]),
    (write("Calib_Results.mat", b"not a MATLAB file at all" * 20), {}, ["Calib_Results.mat", "wanted a MATLAB file", "-v7"]),
    (truncate("Calib_Results.mat", 0.5), {}, ["Calib_Results.mat", "wanted"]),
    (truncate("Calib_Results.mat", 0.97), {}, ["Calib_Results.mat", "wanted a MATLAB file"]),
    (write("Calib_Results.mat", b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(100)), {}, ["cannot be read", "-v7"]),
    (lambda root: scipy.io.savemat(root / "Calib_Results.mat", {"x": 1}), {}, ["wanted Rc_1", "only ['x']"]),
    (change_calibration(KK=None), {}, ["wanted KK,", "a file without it"]),
    (change_calibration(KK=np.eye(4)), {}, ["wanted KK of shape (3, 3), given shape (4, 4)"]),
    (change_calibration(KK=K * np.nan), {}, ["finite real numbers in KK"]),
    (change_calibration(KK=-K), {}, ["view 1", "wanted positive focal lengths", "export the calibration again"]),
    (change_calibration(KK=K.astype(complex)), {}, ["finite real numbers in KK"]),
    (change_calibration(KK=np.array([["abc"] * 3] * 3, dtype=object)), {}, ["finite real numbers in KK"]),
    (change_calibration(KK=None, KK_1=K), {}, ["wanted KK_2"]),
    (change_calibration(Rc_2=2 * np.eye(3)), {}, ["view 2: rotation: wanted a right-handed orthonormal matrix"]),
    (change_calibration(Rc_2=np.diag([1.0, 1, -1])), {}, ["view 2: rotation", "determinant -1"]),
    (change_calibration(Rc_2=np.eye(2)), {}, ["wanted Rc_2 of shape (3, 3)"]),
    (change_calibration(Tc_1=NAN_TRANSLATION), {}, ["finite real numbers in Tc_1"]),
    (change_calibration(Tc_1=None), {}, ["wanted Tc_1"]),
    (
        change_calibration(kc=np.zeros((8, 1))),
        {},
        ["wanted kc of shape (5, 1), given shape (8, 1)", "remove it if photographs are undistorted"],
    ),
    (change_calibration(kc_2=np.full((5, 1), np.nan)), {}, ["finite real numbers in kc_2"]),
    (change_calibration(kc=np.full((5, 1), 1e5)), {}, ["finite real numbers in kc"]),
    (change_calibration(Tc_1=np.zeros((4, 1))), {}, ["wanted Tc_1 of shape (3, 1), given shape (4, 1)"]),
    (change_calibration(Rc_2=None, Tc_2=None), {}, ["Rc_2 and Tc_2, because there is a folder view_02"]),
    (remove("view_02"), {}, ["a folder view_02, because Calib_Results.mat has Rc_2", "--views"]),
    (remove("view_01", "view_02"), {}, ["folders view_01, view_02", "given none"]),
    (lambda root: (root / "view_1").mkdir(), {}, ["one folder per view", "the same number as view_01"]),
    (write("scene.json", b"{"), {}, ["scene.json: wanted a JSON object"]),
    (write("scene.json", b"\xff\xfe\xff"), {}, ["scene.json: wanted a JSON object"]),
    (write("scene.json", b""), {}, ["scene.json", "0 bytes"]),
    (write("scene.json", b"[]"), {}, ["scene.json: wanted a JSON object, given list"]),
    (write("scene.json", b'{"pixel_center": "half"}'), {}, ["wanted a number as pixel_center, from 0 to 1, given 'half'"]),
    (write("scene.json", b'{"pixel_center": true}'), {}, ["given True"]),
    (write("scene.json", b'{"pixel_center": NaN}'), {}, ["the number NaN, which is not finite"]),
    (remove("view_01/mask.png"), {}, ["view_01/mask.png: wanted a mask", "no such file"]),
    (image("view_01/mask.png", np.zeros((HEIGHT, WIDTH), np.uint8) + 127), {}, ["some foreground", "largest value 127"]),
    (image("view_01/mask.png", np.full((HEIGHT, WIDTH), 255, np.uint8)), {}, ["some background"]),
    (image("view_01/mask.png", mask()[:-1]), {}, ["001.png: wanted 16 x 11 pixels as in mask.png, given 16 x 12"]),
    (remove("view_01/003.png"), {"lights": [3]}, ["numbers of lights in 1..2, given 3"]),
    (remove("view_01/002.png"), {}, ["without a gap", "003.png at position 2"]),
    (remove("view_01/001.png", "view_01/002.png", "view_01/003.png"), {}, ["at least one photograph"]),
    (image("view_01/002.png", photograph(1, 2)[1:]), {}, ["002.png: wanted 16 x 12 pixels", "given 16 x 11"]),
    (image("view_01/002.png", photograph(1, 2, np.uint8)), {}, ["002.png: wanted 16 bits as in 001.png, given 8 bits"]),
    (write("view_01/002.png", b""), {}, ["002.png", "empty file of 0 bytes"]),
    (write("view_01/002.png", b"\x89PN"), {}, ["002.png", "without its header, 3 bytes"]),
    (write("view_01/002.png", b"\xff\xd8\xff\xe0 a JPEG"), {}, ["002.png", "starts with", "save it as PNG"]),
    (truncate("view_01/002.png", 0.6), {}, ["002.png", "truncated PNG"]),
    (truncate("view_01/002.png", 0.999), {}, ["002.png", "truncated PNG"]),
    (truncate("view_01/mask.png", 0.8), {}, ["mask.png", "truncated PNG"]),
    (flip_a_byte, {}, ["002.png", "damaged PNG (wrong checksum"]),
    (directory_instead, {}, ["002.png", "cannot be read"]),
    (write("view_01/002.png", png(100_000, 100_000)), {}, ["1 to 100 megapixels, given 100000 x 100000"]),
    (write("view_01/002.png", png(0, 5)), {}, ["given 0 x 5 pixels"]),
    (write("view_01/002.png", png(WIDTH, HEIGHT, (b"IDAT", b"nonsense"), (b"IEND", b""))), {}, ["002.png", "cannot be decoded"]),
    (write("view_01/filenames.txt", b""), {}, ["filenames.txt", "0 bytes"]),
    (write("view_01/filenames.txt", b"\n\n"), {}, ["filenames.txt: wanted at least one name"]),
    (write("view_01/filenames.txt", b"001.png\n\xff\xfe"), {}, ["filenames.txt: wanted UTF-8 text", "position 8"]),
    (write("view_01/filenames.txt", b"001.png\n/etc/passwd\n"), {}, ["filenames.txt, line 2: wanted the bare name", "/etc/passwd"]),
    (write("view_01/filenames.txt", b"../view_02/001.png\n"), {}, ["line 1: wanted the bare name"]),
    (write("view_01/filenames.txt", b"..\n"), {}, ["line 1: wanted the bare name"]),
    (write("view_01/filenames.txt", b"C:\\001.png\n"), {}, ["line 1: wanted the bare name"]),
    (write("view_01/filenames.txt", b"001\x00.png\n"), {}, ["line 1: wanted the bare name"]),
    (write("view_01/filenames.txt", b"001.png\n001.png\n"), {}, ["line 2: wanted every name once"]),
    (write("view_01/filenames.txt", b"001.png\n003.png\n"), {}, ["2 names while 1 more photographs lie beside it, such as 002.png"]),
    (write("view_01/filenames.txt", b"001.png\n002.png\n003.png\n004.png\n"), {}, ["004.png: wanted a photograph", "no such file"]),
    (link_out, {}, ["filenames.txt, line 1: wanted a file of this capture, given 001.png, a link that leads out of it"]),
    (lambda root: None, {"views": [3]}, ["numbers of views among 1, 2, given 3"]),
    (lambda root: None, {"views": [0]}, ["numbers of views among 1, 2, given 0"]),
    (lambda root: None, {"views": []}, ["at least one number in views"]),
    (lambda root: None, {"views": [1, 1]}, ["each number of views once"]),
    (lambda root: None, {"views": [1.5]}, ["whole numbers as views, given 1.5"]),
    (lambda root: None, {"lights": []}, ["at least one number in lights"]),
    (lambda root: None, {"lights": [0]}, ["numbers of lights in 1..3, given 0"]),
    (lambda root: None, {"lights": {"view_01": [1]}}, ["numbers of lights for view_02, given lights only for view_01"]),
    (lambda root: None, {"lights": {"view_01": [1], "view_02": []}}, ["view_02: wanted at least one number in lights of view_02"]),
    (lambda root: None, {"lights": {"view_1": [1]}}, ["names of views such as view_01 in lights, given 'view_1'"]),
]


@pytest.mark.parametrize(("damage", "options", "words"), COMPLAINTS, ids=[f"{i}-{c[2][0][:40]}" for i, c in enumerate(COMPLAINTS)])
def test_complaint(capture: Path, damage: Callable[[Path], None], options: dict[str, Any], words: list[str]) -> None:
    damage(capture)
    with pytest.raises(CaptureError) as caught:
        read_capture(capture, **options)
    message = str(caught.value)
    assert all(word in message for word in words), message
    assert "wanted" in message and ("given" in message) and ";" in message and "\n" not in message
    assert str(capture) in message


def test_one_matrix_for_views_of_different_sizes(capture: Path) -> None:
    for path in (capture / "view_02").iterdir():
        write_rgb(path, cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:-1])
    with pytest.raises(CaptureError, match="view_02: wanted 16 x 12 pixels as in view_01, because one KK serves all views"):
        read_capture(capture)


def test_a_huge_array_in_the_calibration_is_refused_before_it_is_unpacked(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scipy.io.savemat(capture / "Calib_Results.mat", calibration() | {"Rc_1": np.zeros((1000, 1000))}, do_compression=True)
    monkeypatch.setattr(scipy.io, "loadmat", lambda *_, **__: pytest.fail("unpacked"))
    with pytest.raises(CaptureError, match=r"wanted Rc_1 of shape \(3, 3\), given shape \(1000, 1000\)"):
        read_capture(capture)


def test_unreadable_file(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target, whole = capture / "view_01" / "002.png", Path.open

    def refuse(self: Path, *arguments: Any) -> Any:
        if self == target:
            raise PermissionError(13, "Permission denied", str(self))
        return whole(self, *arguments)

    # The tests may run as root, whom no permission stops.
    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(CaptureError, match=r"002.png: wanted a photograph as PNG, given a file that cannot be read \(Permission denied\)"):
        read_capture(capture)
