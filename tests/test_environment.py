"""mvps.load.environment: the two formats, and files that are neither."""

from __future__ import annotations

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
