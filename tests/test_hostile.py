"""Files made to crash, hang or fill the memory of what reads them: one sentence, soon, in little memory."""

from __future__ import annotations

import os
import resource
import struct
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import hostile_files as h
import numpy as np
import pytest
import scipy.io
from fuzzing import TARGETS, Edit, Target, cleared, edits, read_whole_capture, result_target
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mvps.calibrate import uncalibrated_lights
from mvps.export import read_reconstruction
from mvps.hull import signed_distance, visual_hull
from mvps.inputs import check_npz, parsed_json
from mvps.load import read_capture, read_truth
from mvps.scene import Capture, CaptureError, View
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings

ROOT = Path(__file__).resolve().parents[1]


def refusal(root: Path) -> str:
    """The sentence by which reading the capture is refused; without a warning, which would be another line."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(CaptureError) as caught:
            read_whole_capture(root)
    message = str(caught.value)
    assert "\n" not in message and "wanted" in message and "given" in message and ";" in message and len(message) < 700
    return message


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return h.make_capture(tmp_path / "capture")


def test_the_tiny_capture_is_good(capture: Path) -> None:
    read_whole_capture(capture)


@pytest.mark.parametrize("name", h.FILES)
@pytest.mark.parametrize("kind", h.IN_PLACE_OF_A_FILE)
def test_what_is_no_whole_file_is_refused_by_name(kind: str, name: str, capture: Path) -> None:
    h.IN_PLACE_OF_A_FILE[kind](name)(capture)
    assert Path(name).name in refusal(capture)


POINT = struct.pack("<II", 9, 2**31 - 8)
"""The tag of two gigabytes of doubles."""


def camera_variables() -> list[bytes]:
    """Elements of a good calibration."""
    values = h.calibration()
    return [h.matrix(n.encode(), v.shape, h.part(9, np.asarray(v, "<f8").tobytes("F"))) for n, v in values.items()]


def long_normals(root: Path) -> None:
    scipy.io.savemat(root / "view_01" / "Normal_gt.mat", {"Normal_gt": np.full((h.HEIGHT, h.WIDTH, 3), 1e300)})


LIES: dict[str, tuple[h.Damage, str]] = {
    "png of a billion": (h.write("view_01/002.png", h.png(10**9, 10**9)), "megapixels"),
    "png of a colour that is none": (h.write("view_01/002.png", h.png(16, 12, colour=7)), "colour type 7"),
    "mat of a billion": (h.write("Calib_Results.mat", h.mat(h.matrix(b"KK", (10**9, 10**9), b""))), "wanted Rc_1"),
    "mat with lying bytes": (
        h.write("Calib_Results.mat", h.mat(h.matrix(b"KK", (3, 3), POINT), *camera_variables()[1:])),
        "cannot be read",
    ),
    "mat cut inside": (h.write("Calib_Results.mat", h.mat(*camera_variables())[:-30]), "no whole variable"),
    "mat of endless variables": (h.write("Calib_Results.mat", h.mat(*[struct.pack("<II", 14, 0)] * 10001)), "cannot be read"),
    "mat of objects": (h.with_calibration(KK=np.array([[{"a": 1}] * 3] * 3, dtype=object)), "the class cell"),
    "cell of a billion": (h.write("view_01/Normal_gt.mat", h.mat(h.matrix(b"Normal_gt", (10**4, 10**5), b"", 1))), "cell of shape"),
    "ply of a billion": (h.write("mesh_Gt.ply", h.ply(h.VERTEX.format(10**9) + h.FACE.format(10**9), bytes(100))), "triangle mesh"),
    "ply text of a billion": (
        h.write("mesh_Gt.ply", h.ply(h.VERTEX.format(10**9) + h.FACE.format(9), b"0 0 0\n", "ascii")),
        "triangle mesh",
    ),
    "ply of less than none": (h.write("mesh_Gt.ply", h.ply(h.VERTEX.format(-1) + h.FACE.format(1), b"", "ascii")), "triangle mesh"),
    "ply without faces": (h.write("mesh_Gt.ply", h.ply(h.VERTEX.format(2), bytes(24))), "triangle mesh"),
    "ply of long numbers": (h.write("mesh_Gt.ply", h.ply("element vertex " + "9" * 5000 + "\n")), "triangle mesh"),
    "deep lists": (h.write("scene.json", b"[" * 100_000), "too deep"),
    "deep objects": (h.write("scene.json", b'{"a":' * 100_000), "too deep"),
    "a large number": (h.write("scene.json", b'{"pixel_center": 1' + b"0" * 400 + b"}"), "from 0 to 1"),
    "a larger number": (h.write("scene.json", b'{"pixel_center": 1' + b"0" * 8500 + b"}"), "JSON"),
    "an infinite number": (h.write("scene.json", b'{"pixel_center": 1e999}'), "not finite"),
    "a name that is no text": (h.write("view_01/filenames.txt", b"\xff.png\n"), "UTF-8"),
    "a name too long": (h.write("view_01/filenames.txt", b"a" * 5000 + b".png\n002.png\n001.png\n003.png\n"), "bare name"),
    "bright lights": (h.write("view_01/light_intensities.txt", b"1e308 1e308 1e308\n" * 3), "light_intensities"),
    "long lights": (h.write("view_01/light_directions.txt", b"1e308 1e308 1e308\n" * 3), "light_directions"),
    "long normals": (
        lambda root: scipy.io.savemat(root / "view_01/Normal_gt.mat", {"Normal_gt": np.full((12, 16, 3), 1e300)}),
        "Normal_gt",
    ),
    "lines of two": (h.write("view_01/light_intensities.txt", b"1 1 1\n1 1\n1\n"), "light_intensities"),
    "focal lengths of 1e300": (h.with_calibration(KK=h.K * [[1e300], [1e300], [1]]), "in KK"),
    "no focal length": (h.with_calibration(KK=np.zeros((3, 3))), "positive focal lengths"),
    "a camera at 1e300": (h.with_calibration(Tc_1=np.full((3, 1), 1e300)), "in Tc_1"),
    "a rotation of zeros": (h.with_calibration(Rc_1=np.zeros((3, 3))), "orthonormal"),
    "a mirror": (h.with_calibration(Rc_1=np.diag([1.0, 1, -1])), "determinant -1"),
    "a rotation of 1e300": (h.with_calibration(Rc_1=np.full((3, 3), 1e300)), "in Rc_1"),
}


@pytest.mark.parametrize("name", LIES)
def test_lies_are_refused(name: str, capture: Path) -> None:
    damage, words = LIES[name]
    damage(capture)
    assert words in refusal(capture)


def test_odd_names_beside_are_no_obstacle(capture: Path) -> None:
    h.odd_names(capture)
    h.odd_view(capture)
    assert len(read_truth(capture).views) == 3


def test_a_mesh_opens_no_other_file(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    texture = "comment TextureFile 002.png\n"
    good = np.zeros(3, [("p", "<f4", 3)])
    good["p"] = np.eye(3)
    face = b"\x03" + np.arange(3, dtype="<i4").tobytes()
    (capture / "mesh_Gt.ply").write_bytes(h.ply(texture + h.VERTEX.format(3) + h.FACE.format(1), good.tobytes() + face))
    monkeypatch.setattr("trimesh.resolvers.FilePathResolver.get", lambda *_: pytest.fail("opened"))
    assert read_truth(capture).surface is not None


def test_capture_in_a_folder_whose_name_is_no_text(tmp_path: Path) -> None:
    root = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    h.make_capture(root)
    assert len(read_capture(root).views) == 3


# ------------------------------------------------------------------------------------------------ cameras that are none


def moved(capture: Capture, **translations: float) -> Capture:
    """The capture with translations of these views (all: every view) times a factor."""

    def of(view: View) -> View:
        camera = view.camera
        return replace(
            view, camera=replace(camera, translation=camera.translation * translations.get(view.name, translations.get("all", 1)))
        )

    return replace(capture, views=tuple(map(of, capture.views)))


def test_cameras_that_see_no_object_are_named() -> None:
    capture, _ = render_capture(SceneSettings(views=5, lights=4, size=48))
    for factor in (0.0, 1e-300):
        with pytest.raises(CaptureError, match=r"box without volume|do not meet|unbounded"):
            signed_distance(moved(capture, all=factor), 32)
    away = moved(capture, view_01=1000.0)
    surface = visual_hull(signed_distance(away, 32))
    with pytest.raises(CaptureError, match="view_01: wanted a camera that sees what all masks enclose"):
        uncalibrated_lights(away, surface, 0)


# ------------------------------------------------------------------------------------------------ bombs

READ = """
import sys
from pathlib import Path
from mvps.command import run
from mvps.load import read_capture, read_truth
code = run(lambda argv: (read_capture(argv[0]), read_truth(argv[0])) and None, sys.argv[1:])
status = Path("/proc/self/status").read_text()
print(code, int(status.split("VmHWM:")[1].split()[0]) // 1024)
"""


def lying_matrix() -> bytes:
    """A compressed camera of 3 x 3 that goes on for a quarter of a gigabyte."""
    return h.mat(h.packed(h.matrix(b"KK", (3, 3), POINT), 1 << 28), *camera_variables()[1:])


BOMBS: dict[str, h.Damage] = {
    "photographs of 72 megapixels": h.all_masks_and_photographs(lambda: h.png_bomb(8500, 8500), lambda: h.spotted_mask(8500, 8500)),
    "a mask with 16 bits and transparency": h.made("view_01/mask.png", lambda: h.png_bomb(6000, 6000, 16, 6)),
    "a camera that goes on": h.made("Calib_Results.mat", lying_matrix),
    "normals that go on": h.made("view_01/Normal_gt.mat", lambda: h.mat(h.packed(h.matrix(b"Normal_gt", (12, 16, 3), POINT), 1 << 28))),
    "names without end": h.sparse("view_01/filenames.txt", 1 << 40, b"001.png\n"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_refused_in_little_memory(name: str, capture: Path) -> None:
    BOMBS[name](capture)
    result = subprocess.run([sys.executable, "-c", READ, str(capture)], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert result.stderr.startswith("mvps: ") and result.stderr.count("\n") == 1
    code, megabytes = map(int, result.stdout.split())
    # numpy, scipy and OpenCV alone take 120.
    assert code == 2 and megabytes < 400


def test_a_sharp_photograph_is_no_bomb(tmp_path: Path) -> None:
    from mvps.load.images import MOST_PACKED, UNCHECKED_BYTES, check_packing, read_header

    path = tmp_path / "001.png"
    path.write_bytes(h.png(4000, 4000, h.chunk(b"IDAT", bytes(4000 * 4000 * 6 // MOST_PACKED))))
    header = read_header(path)
    assert header.decoded > UNCHECKED_BYTES
    check_packing(path, header)
    path.write_bytes(h.png(4000, 4000, h.chunk(b"IDAT", bytes(4000 * 4000 * 6 // MOST_PACKED - 1000))))
    with pytest.raises(CaptureError, match="a 100th at least"):
        check_packing(path, header)


# ------------------------------------------------------------------------------------------------ results


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Target:
    return result_target(tmp_path_factory.mktemp("result"))


def compressed(path: Path) -> None:
    with np.load(path) as arrays:
        kept = dict(arrays)
    np.savez_compressed(path, **kept)


def pickled(path: Path) -> None:
    with np.load(path) as arrays:
        kept = dict(arrays)
    np.savez(path, **kept | {"albedo": np.array([print], dtype=object)})


def npy(path: Path, shape: tuple[int, ...]) -> None:
    """A header that says so and nothing after it."""
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("material.npz", compressed),
        ("material.npz", pickled),
        ("normals/view_01.npy", lambda path: npy(path, (10**6, 10**6, 3))),
        ("normals/view_01.npy", lambda path: np.save(path, np.array([print], dtype=object))),
        ("normals/view_01.npy", lambda path: np.save(path, np.zeros((2, 2)))),
        ("normals/view_01.npy", lambda path: (path.unlink(), os.mkfifo(path))),
        ("normals/view_01.npy", lambda path: path.write_bytes(path.read_bytes().replace(b"'descr'", b"\xff\xff(((\xff\xff"))),
        ("mesh.ply", lambda path: os.truncate(path, 1 << 40)),
        ("mesh.ply", lambda path: path.write_bytes(path.read_bytes().replace(b"vertex 4", b"vertex " + b"9" * 5000))),
        ("lights.json", lambda path: path.write_text("[" * 100_000)),
        ("lights.json", lambda path: path.write_text(path.read_text().replace("view_01", "../view_01"))),
        ("lights.json", lambda path: path.write_text(path.read_text().replace("1.0", "1" + "0" * 400))),
        ("metrics.json", lambda path: path.write_text('{"stages": 3}')),
        ("metrics.json", lambda path: path.write_text('{"truth": {"a": NaN}}')),
        ("settings.json", lambda path: path.write_text('{"hold_out_views": "all"}')),
    ],
)
def test_hostile_results_are_refused(name: str, damage: h.Damage, result: Target) -> None:
    path = result.root / name
    good = path.read_bytes()
    try:
        damage(path)
        with pytest.raises(CaptureError) as caught:
            read_reconstruction(result.root)
        assert "\n" not in str(caught.value)[:200]
    finally:
        path.unlink()
        path.write_bytes(good)
    read_reconstruction(result.root)


def test_what_is_read_takes_no_more_than_the_file(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.zeros((3, 0)), y=np.float64(2), z=np.arange(5))
    check_npz(tmp_path / "a.npz")
    assert parsed_json('{"a": [1.5, -2e3, true, null]}') == {"a": [1.5, -2000.0, True, None]}


# ------------------------------------------------------------------------------------------------ fuzz


@pytest.mark.parametrize("name", TARGETS)
def test_changed_bytes_give_a_value_or_a_refusal(name: str, tmp_path: Path) -> None:
    target = TARGETS[name](cleared(tmp_path / "fuzz"))
    target.read(target.root)
    outcomes: set[bool] = set()

    @settings(max_examples=60, deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(st.sampled_from(target.files), edits, st.booleans())
    def example(file: str, by: list[Edit], seal: bool) -> None:
        outcomes.add(target.tried(file, by, seal) == "value")

    example()
    assert False in outcomes


def test_no_file_was_left_open() -> None:
    """A thousand refusals would not use up the process's files."""
    assert len(os.listdir("/proc/self/fd")) < min(200, resource.getrlimit(resource.RLIMIT_NOFILE)[0])
