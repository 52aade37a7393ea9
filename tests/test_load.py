"""mvps.load: what is written is read, every complaint can be made to fire, and the truth agrees with itself."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io
import trimesh

from mvps.camera import pixel_centres, rays
from mvps.load import read_calibrated_lights, read_capture, read_truth, with_mask
from mvps.load.images import clip_level
from mvps.mesh import normalise, vertex_normals
from mvps.scene import CaptureError, View
from mvps.visibility import RayCaster, interpolate

HEIGHT, WIDTH, VIEWS, LIGHTS = 12, 16, 2, 3
K = np.array([[50.0, 0, 8], [0, 50, 6], [0, 0, 1]])


def rotation(view: int) -> np.ndarray:
    return cv2.Rodrigues(np.array([0.1, 0.4 * view, 0.0]))[0]


def translation(view: int) -> np.ndarray:
    return np.array([[0.1], [0.2], [5.0 + view]])


def calibration(views: int = VIEWS) -> dict[str, np.ndarray]:
    """Calib_Results.mat of a tiny capture."""
    values = {"KK": K}
    for i in range(1, views + 1):
        values |= {f"Rc_{i}": rotation(i), f"Tc_{i}": translation(i)}
    return values


def photograph(view: int, light: int, dtype: Any = np.uint16) -> np.ndarray:
    """(height, width, 3) RGB, another value in every sample."""
    full = np.iinfo(dtype).max
    values = np.random.default_rng(100 * view + light).integers(0, full, (HEIGHT, WIDTH, 3))
    return values.astype(dtype)


def mask() -> np.ndarray:
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    image[2:9, 3:12] = 255
    image[5, 5] = 127
    return image


def write_rgb(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A tiny whole capture: two views, three lights, 16 bits, without ground truth."""
    root = tmp_path / "tiny"
    root.mkdir()
    scipy.io.savemat(root / "Calib_Results.mat", calibration())
    (root / "scene.json").write_text('{"pixel_center": 0.5}')
    for view in range(1, VIEWS + 1):
        folder = root / f"view_{view:02d}"
        folder.mkdir()
        write_rgb(folder / "mask.png", mask())
        for light in range(1, LIGHTS + 1):
            write_rgb(folder / f"{light:03d}.png", photograph(view, light))
    return root


# ------------------------------------------------------------------------------------------------ what is written is read


def test_code_values_cameras_and_order_come_back(capture: Path) -> None:
    read = read_capture(capture)
    assert read.name == "tiny" and [view.name for view in read.views] == ["view_01", "view_02"]
    foreground = mask() > 127
    for number, view in enumerate(read.views, 1):
        assert view.samples.dtype == np.uint16 and view.samples.max() > 255
        assert view.lights == (1, 2, 3)
        np.testing.assert_array_equal(view.mask, foreground)
        expected = np.stack([photograph(number, light)[foreground] for light in range(1, LIGHTS + 1)], 1)
        np.testing.assert_array_equal(view.samples, expected)
        np.testing.assert_array_equal(view.camera.K, K)
        np.testing.assert_allclose(view.camera.rotation, rotation(number))
        np.testing.assert_allclose(view.camera.translation, translation(number)[:, 0])
        assert view.scale == 1 / 65535 and view.saturation == 65535


def test_frames_are_the_mean_of_whole_photographs(capture: Path) -> None:
    for number, view in enumerate(read_capture(capture, lights=[1, 3]).views, 1):
        whole = np.stack([photograph(number, light) for light in (1, 3)]).astype(float)
        np.testing.assert_allclose(view.frame, whole.mean((0, 3)), rtol=1e-6)
        assert [file.name for file in view.files] == ["001.png", "003.png"]


def test_another_mask_reads_what_it_adds_and_keeps_the_rest(capture: Path) -> None:
    read = read_capture(capture).without({"view_01": [2]})
    other = mask() > 127
    other[0:3, 4:8], other[8] = True, False
    for number, view in enumerate(read.views, 1):
        changed = with_mask(view, other)
        expected = np.stack([photograph(number, light)[other] for light in range(1, LIGHTS + 1)], 1)
        if number == 1:
            expected[:, 1] = 65535
        np.testing.assert_array_equal(changed.samples, expected)
        np.testing.assert_array_equal(changed.mask, other)
        assert changed.lights == view.lights and changed.camera is view.camera


@pytest.mark.parametrize(("scene", "shift"), [(None, 0.5), ("{}", 0.5), ('{"pixel_center": 0}', 0.5), ('{"pixel_center": 1}', -0.5)])
def test_principal_point_moves_to_our_pixel_centres(capture: Path, scene: str | None, shift: float) -> None:
    (capture / "scene.json").unlink()
    if scene is not None:
        (capture / "scene.json").write_text(scene)
    np.testing.assert_array_equal(read_capture(capture).views[0].camera.K, K + np.array([[0, 0, shift], [0, 0, shift], [0, 0, 0]]))


def test_views_and_lights_are_picked_by_number(capture: Path) -> None:
    everything = read_capture(capture)
    one = read_capture(capture, views=[2], lights=[3, 1])
    assert [view.name for view in one.views] == ["view_02"] and one.views[0].lights == (1, 3)
    np.testing.assert_array_equal(one.views[0].samples, everything.views[1].samples[:, [0, 2]])
    each = read_capture(capture, lights={"view_01": [2], "view_02": [1, 3]})
    assert [view.lights for view in each.views] == [(2,), (1, 3)]
    np.testing.assert_array_equal(each.views[0].samples, everything.views[0].samples[:, [1]])
    # A mapping may name views that are not read.
    assert len(read_capture(capture, views=[1], lights={"view_01": [2], "view_02": [1]}).views) == 1


def test_picking_views_needs_only_their_folders_and_calibration(capture: Path) -> None:
    shutil.rmtree(capture / "view_02")
    assert len(read_capture(capture, views=[1]).views) == 1


def test_filenames_give_the_order(capture: Path) -> None:
    everything = read_capture(capture)
    (capture / "view_01" / "filenames.txt").write_bytes(b"\xef\xbb\xbf003.png\r\n001.png\r\n\r\n002.png\r\n")
    np.testing.assert_array_equal(read_capture(capture).views[0].samples, everything.views[0].samples[:, [2, 0, 1]])


def test_eight_bits_grey_and_transparency(capture: Path) -> None:
    folder = capture / "view_01"
    images = [photograph(1, light, np.uint8) for light in (1, 2, 3)]
    write_rgb(folder / "001.png", images[0])
    write_rgb(folder / "002.png", images[1][..., 0])
    cv2.imwrite(str(folder / "003.png"), np.dstack([images[2][..., ::-1], np.zeros((HEIGHT, WIDTH), np.uint8)]))
    view = read_capture(capture).views[0]
    foreground = mask() > 127
    np.testing.assert_array_equal(view.samples[:, 0], images[0][foreground])
    np.testing.assert_array_equal(view.samples[:, 1], np.repeat(images[1][foreground][:, :1], 3, 1))
    np.testing.assert_array_equal(view.samples[:, 2], images[2][foreground])
    assert (view.scale, view.saturation) == (1 / 255, 255)


def test_a_matrix_per_view(capture: Path) -> None:
    values = calibration()
    values |= {"KK_1": values["KK"], "KK_2": values["KK"] * [[2], [2], [1]]}
    del values["KK"]
    scipy.io.savemat(capture / "Calib_Results.mat", values)
    # Where every view has its own matrix, sizes may differ between views.
    for path in (capture / "view_02").iterdir():
        write_rgb(path, cv2.resize(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), (2 * WIDTH, 2 * HEIGHT)))
    views = read_capture(capture).views
    assert views[1].camera.K[0, 0] == 100 and views[1].camera.width == 2 * WIDTH


def test_sixteen_bit_colour_mask(capture: Path) -> None:
    write_rgb(capture / "view_01" / "mask.png", np.dstack([mask().astype(np.uint16) * 257] * 3))
    np.testing.assert_array_equal(read_capture(capture).views[0].mask, mask() > 127)


# ------------------------------------------------------------------------------------------------ clipping


def exposure(seed: int = 0, gain: float = 9000.0) -> np.ndarray:
    return np.random.default_rng(seed).exponential(gain, 200_000)


def counts(codes: np.ndarray) -> np.ndarray:
    return np.bincount(codes.ravel().astype(np.int64), minlength=65536)


def test_clip_level_is_full_scale_without_clipping() -> None:
    assert clip_level(counts(np.minimum(exposure(gain=3000), 65535).round())) == 65535
    assert clip_level(counts(np.zeros(10))) == 65535
    assert clip_level(np.zeros(65536, np.int64)) == 65535


@pytest.mark.parametrize("step", [1, 4, 16, 257])
def test_clip_level_of_stretched_sensors(step: int) -> None:
    full = 65535 // step
    codes = np.minimum((exposure() / step).round(), full) * step
    assert clip_level(counts(codes)) == full * step


@pytest.mark.parametrize("clip", [4095, 16383, 40000])
def test_clip_level_below_full_scale_is_found_from_its_crowd(clip: int) -> None:
    assert clip_level(counts(np.minimum(exposure(gain=clip / 5).round(), clip))) == clip


def test_smooth_maxima_are_no_clip_level() -> None:
    y, x = np.mgrid[-1:1:600j, -1:1:600j]
    sphere = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    cylinder = np.sqrt(1 - x**2)
    for shading in (sphere, cylinder, np.exp(20 * (sphere - 1))):
        for peak in (3000.0, 30000.0):
            assert clip_level(counts((shading * peak).round())) == 65535
    # A plane under three lights has no tail that could tell.
    assert clip_level(counts(np.repeat([40000, 30000, 20000], 5000))) == 65535


def test_saturated_samples_are_marked(capture: Path) -> None:
    image = np.minimum(photograph(1, 1), 4095) * 16
    write_rgb(capture / "view_01" / "001.png", image)
    for light in (2, 3):
        write_rgb(capture / "view_01" / f"{light:03d}.png", photograph(1, light) // 16 // 16 * 16)
    view = read_capture(capture, views=[1]).views[0]
    assert view.saturation == 4095 * 16
    np.testing.assert_array_equal(view.usable()[:, 0], (image[mask() > 127] < 65520).all(-1))
    assert view.usable()[:, 1:].all()


# ------------------------------------------------------------------------------------------------ complaints


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


# ------------------------------------------------------------------------------------------------ ground truth


@pytest.fixture
def with_truth(capture: Path) -> Path:
    """The tiny capture with normals, lights that stand still in the camera's frame, and a mesh."""
    for view in range(1, VIEWS + 1):
        folder = capture / f"view_{view:02d}"
        normals = np.zeros((HEIGHT, WIDTH, 3))
        normals[mask() > 127] = (0.6, 0, 0.8)
        normals[3, 4] = 0
        scipy.io.savemat(folder / "Normal_gt.mat", {"Normal_gt": normals})
        np.savetxt(folder / "light_directions.txt", [[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]])
        np.savetxt(folder / "light_intensities.txt", [[1, 2, 3], [2, 2, 2], [4, 4, 4]])
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False).export(capture / "mesh_Gt.ply")
    return capture


def test_truth_is_in_the_world_frame(with_truth: Path) -> None:
    truth = read_truth(with_truth)
    assert truth.views == ("view_01", "view_02") and truth.surface is not None
    for number, name in enumerate(truth.views, 1):
        # DiLiGenT's z towards the camera is minus the optical axis, its y up is minus the image's y.
        axes = rotation(number).T @ np.diag([1, -1, -1])
        np.testing.assert_allclose(truth.direction[name], np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]]) @ axes.T, atol=1e-12)
        normals = truth.normals[name]
        known = (mask() > 127) & ~((np.arange(HEIGHT)[:, None] == 3) & (np.arange(WIDTH) == 4))
        np.testing.assert_array_equal(np.isfinite(normals).all(-1), known)
        np.testing.assert_allclose(normals[known], np.broadcast_to(axes @ [0.6, 0, 0.8], (known.sum(), 3)), atol=1e-6)
        np.testing.assert_array_equal(truth.intensity[name], [[1, 2, 3], [2, 2, 2], [4, 4, 4]])


def test_what_is_absent_is_absent(capture: Path) -> None:
    truth = read_truth(capture)
    assert (dict(truth.normals), dict(truth.direction), dict(truth.intensity), truth.surface) == ({}, {}, {}, None)
    shutil.rmtree(capture / "view_02")
    assert read_truth(capture).views == ("view_01",)


def test_calibrated_lights_are_matched_by_number(with_truth: Path) -> None:
    lights = read_calibrated_lights(with_truth, read_capture(with_truth, lights={"view_01": [3], "view_02": [1, 2]}))
    everything = read_truth(with_truth)
    np.testing.assert_allclose(lights.direction[0], everything.direction["view_01"][[2]])
    np.testing.assert_allclose(lights.direction[1], everything.direction["view_02"][[0, 1]])
    mean = (12 + 6 + 6) / 9
    np.testing.assert_allclose(lights.intensity[1], np.array([[1, 2, 3], [2, 2, 2]]) / mean)
    assert np.concatenate(lights.intensity).mean() == pytest.approx(1)
    assert not lights.one_rig


@pytest.mark.parametrize(("angle", "one_rig"), [(0.0, True), (5e-4, True), (2e-3, False)])
def test_one_rig_within_a_milliradian(with_truth: Path, angle: float, one_rig: bool) -> None:
    turned = [[np.sin(angle), 0, np.cos(angle)], [0.6, 0, 0.8], [0, 0.6, 0.8]]
    np.savetxt(with_truth / "view_02" / "light_directions.txt", turned)
    assert read_calibrated_lights(with_truth, read_capture(with_truth)).one_rig is one_rig


TRUTH_COMPLAINTS: list[tuple[str, bytes | None, str]] = [
    ("light_directions.txt", b"", "0 bytes"),
    ("light_directions.txt", b"1 2 x\n", "three numbers per line"),
    ("light_directions.txt", b"\xff\xfe", "three numbers per line"),
    ("light_directions.txt", b"1 0\n0 1\n", "three finite numbers per line"),
    ("light_directions.txt", b"0 0 1\n0 nan 1\n", "three finite numbers per line"),
    ("light_directions.txt", b"0 0 1\n0 0 2\n", "wanted unit vectors, given one of length 2 in line 2"),
    ("light_intensities.txt", b"1 1 1\n1 0 1\n", "three finite positive numbers"),
    ("Normal_gt.mat", b"garbage" * 50, "wanted a MATLAB file"),
    ("../mesh_Gt.ply", b"garbage", "wanted a triangle mesh as PLY"),
]


@pytest.mark.parametrize(("name", "content", "words"), TRUTH_COMPLAINTS)
def test_complaint_about_the_truth(with_truth: Path, name: str, content: bytes, words: str) -> None:
    (with_truth / "view_02" / name).write_bytes(content)
    with pytest.raises(CaptureError, match=words) as caught:
        read_truth(with_truth)
    assert Path(name).name in str(caught.value)


def test_complaints_about_the_shape_of_the_truth(with_truth: Path) -> None:
    scipy.io.savemat(with_truth / "view_01" / "Normal_gt.mat", {"Normal_gt": np.zeros((2, 2, 3))})
    with pytest.raises(CaptureError, match=r"Normal_gt of shape \(12, 16, 3\) as in mask.png, given double of shape \(2, 2, 3\)"):
        read_truth(with_truth)
    scipy.io.savemat(with_truth / "view_01" / "Normal_gt.mat", {"other": 1})
    with pytest.raises(CaptureError, match="a variable Normal_gt"):
        read_truth(with_truth)


def test_complaints_about_calibrated_lights(with_truth: Path) -> None:
    capture = read_capture(with_truth)
    (with_truth / "view_02" / "light_intensities.txt").write_text("1 1 1\n1 1 1\n")
    with pytest.raises(CaptureError, match=r"light_intensities.txt: wanted a line for each of 3 lights, given 2 lines"):
        read_calibrated_lights(with_truth, capture)
    (with_truth / "view_02" / "light_directions.txt").unlink()
    with pytest.raises(CaptureError, match=r"light_directions.txt: wanted three numbers per light, given no such file"):
        read_calibrated_lights(with_truth, capture)


# ------------------------------------------------------------------------------------------------ whole captures


def test_bunny(captures: Path) -> None:
    capture = read_capture(captures / "bunny")
    assert len(capture.views) == 20
    for view in capture.views:
        assert view.samples.dtype == np.uint16 and view.samples.shape == (view.mask.sum(), 32, 3)
        assert view.samples.max() > 255
        # The renders are quantised to 12 bits and stored times 16.
        assert view.saturation == 65520
        assert 0 < (~view.usable()).mean() < 0.01


@pytest.mark.parametrize("name", ["bunny", "spot"])
def test_true_normals_are_those_of_the_true_mesh(captures: Path, name: str) -> None:
    capture, truth = read_capture(captures / name, lights=[1]), read_truth(captures / name)
    assert truth.surface is not None
    caster, normals = RayCaster(truth.surface), vertex_normals(truth.surface)
    for view in capture.views:

        def error(shift: float, view: View = view) -> float:
            """Median angle in degrees between normals of the file and of the mesh, looked up `shift` pixels away."""
            hits = caster.first_hits(*rays(view.camera, pixel_centres(view.pixels) + shift))
            seen = hits.face >= 0
            assert seen.mean() > 0.97
            found = normalise(interpolate(truth.surface, hits, normals)[seen])
            return float(np.degrees(np.median(np.arccos(np.minimum((found * truth.normals[view.name][view.mask][seen]).sum(-1), 1)))))

        # Camera, frame and pixel centres agree: half a pixel off in any of them is several times worse.
        assert error(0) < 0.5 < error(0.5) and error(0) < 0.5 < error(-0.5)


def test_rigs(captures: Path) -> None:
    for name, one_rig in (("bunny", True), ("spot", False)):
        assert read_calibrated_lights(captures / name, read_capture(captures / name)).one_rig is one_rig


def test_true_lights_explain_the_photographs(captures: Path) -> None:
    # Where normal . light grows, a nearly Lambertian object gets brighter: a wrong frame would break it.
    capture, truth = read_capture(captures / "spot"), read_truth(captures / "spot")
    for view in capture.views:
        shading = np.maximum(truth.normals[view.name][view.mask] @ truth.direction[view.name].T, 0)
        assert np.corrcoef(shading.ravel(), view.radiance().mean(-1).ravel())[0, 1] > 0.5


def test_memory_stays_near_the_samples(tmp_path: Path) -> None:
    # 4 views x 24 photographs of 306 x 256: 45 MB decoded, 0.9 MB of it foreground.
    height, width, lights = 256, 306, 24
    scipy.io.savemat(tmp_path / "Calib_Results.mat", calibration(4))
    image = np.random.default_rng(0).integers(0, 65535, (height, width, 3)).astype(np.uint16)
    square = np.zeros((height, width), np.uint8)
    square[20:60, 20:60] = 255
    for view in range(1, 5):
        folder = tmp_path / f"view_{view:02d}"
        folder.mkdir()
        write_rgb(folder / "mask.png", square)
        write_rgb(folder / "001.png", image)
        for light in range(2, lights + 1):
            (folder / f"{light:03d}.png").hardlink_to(folder / "001.png")
    script = (
        "import sys; from mvps.load import read_capture; from mvps.progress import peak_memory_mb\n"
        "before = peak_memory_mb(); capture = read_capture(sys.argv[1])\n"
        "print(peak_memory_mb() - before, sum(v.samples.nbytes for v in capture.views) / 1e6)"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    out = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1])
    grown, samples = map(float, out.stdout.split())
    # A decoder on every core holds a file, its image and a copy in RGB, 0.5 MB each; a histogram and its sum take 1 MB.
    assert 0 < grown < samples + 25, f"{grown:.1f} MB for {samples:.1f} MB of samples"
