"""mvps.load: what is written is read, and whole captures are."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
from tiny_capture import HEIGHT, LIGHTS, WIDTH, K, calibration, mask, photograph, rotation, tiny_capture, translation, write_rgb

from mvps.camera import pixel_centres, rays
from mvps.load import read_calibrated_lights, read_capture, read_truth, with_mask
from mvps.load.images import clip_level
from mvps.mesh import normalise, vertex_normals
from mvps.scene import View
from mvps.visibility import RayCaster, interpolate


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return tiny_capture(tmp_path / "tiny")


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


def test_distortion_is_read_of_all_views_or_of_each(capture: Path) -> None:
    assert [view.camera.distortion for view in read_capture(capture).views] == [(), ()]
    of_all, of_second = [0.1, -0.2, 0.01, 0.02, 0.3], [0.4, 0.5, 0, 0]
    scipy.io.savemat(capture / "Calib_Results.mat", calibration() | {"kc": np.array(of_all)[:, None], "kc_error": np.ones((5, 1))})
    assert [view.camera.distortion for view in read_capture(capture).views] == [tuple(of_all)] * 2
    scipy.io.savemat(capture / "Calib_Results.mat", calibration() | {"kc": np.array([of_all]), "kc_2": np.array([of_second])})
    assert [view.camera.distortion for view in read_capture(capture).views] == [tuple(of_all), tuple(of_second)]


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


def test_a_view_may_be_a_link_to_its_folder(capture: Path, tmp_path: Path) -> None:
    (capture / "view_01" / "filenames.txt").write_text("003.png\n001.png\n002.png\n")
    before = read_capture(capture)
    (capture / "view_01").rename(tmp_path / "elsewhere")
    (capture / "view_01").symlink_to(tmp_path / "elsewhere")
    np.testing.assert_array_equal(read_capture(capture).views[0].samples, before.views[0].samples)


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


@pytest.mark.parametrize("beyond", [1, 5])
def test_a_few_samples_beyond_the_crowd_are_no_clip_level(beyond: int) -> None:
    codes = np.minimum(exposure(gain=16383 / 5).round(), 16383)
    assert (codes == 16383).sum() >= 100 * beyond
    codes[np.flatnonzero(codes < 16383)[:beyond]] = 65535
    assert clip_level(counts(codes)) == 16383


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
