"""mvps.load.environment: the two formats, and files that are neither."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from mvps.load import read_environment
from mvps.scene import CaptureError

PICTURE = np.random.default_rng(0).uniform(0.1, 2, (6, 12, 3)).astype(np.float32)


def write_exr(path: Path, picture: np.ndarray, names: str = "RGB") -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {n: np.ascontiguousarray(picture[..., k]) for k, n in enumerate(names)}).write(str(path))


def test_both_formats_are_read(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.hdr"), PICTURE[..., ::-1])
    write_exr(tmp_path / "a.exr", PICTURE)
    # Radiance files share an exponent of eight bits between the channels.
    np.testing.assert_allclose(read_environment(tmp_path / "a.hdr"), PICTURE, atol=0.01)
    np.testing.assert_array_equal(read_environment(tmp_path / "a.exr"), PICTURE)


def test_the_maps_at_hand(captures: Path) -> None:
    for path in sorted((captures.parent / "hdri").glob("*.hdr")):
        assert read_environment(path).shape == (128, 256, 3)


def test_other_files_are_refused(tmp_path: Path) -> None:
    good = tmp_path / "a.exr"
    write_exr(good, PICTURE)
    cv2.imwrite(str(tmp_path / "b.hdr"), PICTURE)
    whole = (tmp_path / "b.hdr").read_bytes()
    spoiled = PICTURE.copy()
    spoiled[0, 0, 0] = np.nan
    write_exr(tmp_path / "nan.exr", spoiled)
    write_exr(tmp_path / "grey.exr", PICTURE[..., :1], "Y")
    cases = {
        "missing.hdr": None,
        "text.hdr": b"hello",
        "empty.hdr": b"",
        "cut.exr": good.read_bytes()[:200],
        "huge.hdr": whole.replace(b"-Y 6 +X 12", b"-Y 999999 +X 999999"),
    }
    for name, data in cases.items():
        if data is not None:
            (tmp_path / name).write_bytes(data)
    for name in (*cases, "nan.exr", "grey.exr"):
        with pytest.raises(CaptureError, match=rf"{name}: wanted"):
            read_environment(tmp_path / name)


@pytest.mark.parametrize("name", ["cut.hdr", "form.hdr", "cut.exr", "spoiled.exr"])
def test_libraries_say_nothing_of_damaged_files(tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]) -> None:
    picture = np.random.default_rng(0).uniform(0.1, 2, (64, 128, 3)).astype(np.float32)
    cv2.imwrite(str(tmp_path / "a.hdr"), picture)
    write_exr(tmp_path / "a.exr", picture)
    hdr, exr = ((tmp_path / whole).read_bytes() for whole in ("a.hdr", "a.exr"))
    damaged = {
        "cut.hdr": hdr[: len(hdr) // 2],
        "form.hdr": hdr.replace(b"32-bit_rle_rgbe", b"32-bit_rle_abcd"),
        "cut.exr": exr[: len(exr) // 2],
        "spoiled.exr": exr[: len(exr) // 2] + bytes(50) + exr[len(exr) // 2 + 50 :],
    }
    (tmp_path / name).write_bytes(damaged[name])
    with pytest.raises(CaptureError, match="a damaged one"):
        read_environment(tmp_path / name)
    os.write(2, b"heard again")
    assert capfd.readouterr() == ("", "heard again")


def test_a_map_without_colours_is_refused_with_its_channels(tmp_path: Path) -> None:
    write_exr(tmp_path / "grey.exr", PICTURE[..., :1], "Y")
    with pytest.raises(CaptureError, match="with channels R, G and B, given only Y; export it again"):
        read_environment(tmp_path / "grey.exr")
