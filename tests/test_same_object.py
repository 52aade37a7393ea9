"""A result with the capture of another object is refused; with its own, and with views that it has not seen, it is taken."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sphere_scene import RADIUS, SphereScene, camera_at, make_sphere

import mvps.sound
from mvps import evaluate, render, view
from mvps.command import run
from mvps.export import read_reconstruction, write_reconstruction
from mvps.finding import Finding
from mvps.load import read_capture, read_truth
from mvps.same_object import LEAST_OVERLAP, capture_of, overlap_of
from mvps.scene import Capture, Surface, Truth
from mvps.synthetic.files import write_capture
from mvps.visibility import camera_hits, ray_caster


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(3)


@pytest.fixture(scope="module")
def folders(scene: SphereScene, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """The capture, its result, and a result whose sphere stands beside, by one and a half of its radii."""
    base = tmp_path_factory.mktemp("same_object")
    r = scene.reconstruction
    named = [dict(zip(r.views, values, strict=True)) for values in (r.normal_maps, r.lights.direction, r.lights.intensity)]
    write_capture(scene.capture, Truth(r.views, *named, r.surface), base / "capture")
    write_reconstruction(r, base / "own")
    beside = Surface(r.surface.vertices + np.array([0, 0, 1.5 * RADIUS]), r.surface.faces)
    write_reconstruction(replace(r, surface=beside), base / "other")
    return base / "capture", base / "own", base / "other"


def test_a_result_covers_the_masks_of_its_own_capture(scene: SphereScene) -> None:
    caster = ray_caster(scene.reconstruction.surface)
    assert min(overlap_of(caster, view.camera, view.mask) for view in scene.capture.views) > 0.97


def test_true_objects_cover_their_own_masks_and_not_each_others(captures: Path) -> None:
    """Where LEAST_OVERLAP comes from: objects of one rig, all about its middle."""
    names = ("bunny", "armadillo", "spot", "buddha")
    views = {name: read_capture(captures / name, lights=[1]).views for name in names}
    for name in names:
        surface = read_truth(captures / name).surface
        assert surface is not None
        caster = ray_caster(surface)
        for other in names:
            overlap = np.median([overlap_of(caster, view.camera, view.mask) for view in views[other]])
            assert overlap > 0.98 if other == name else overlap < LEAST_OVERLAP


@pytest.mark.parametrize("width", [64, 100, 1024])
def test_what_is_looked_at_is_spread_over_the_whole_view(scene: SphereScene, width: int) -> None:
    """An upright half of the mask is half of it, whatever the width is a multiple of."""
    caster, camera = ray_caster(scene.reconstruction.surface), camera_at(np.array([1.0, 0, 0]), width)
    every = np.indices((width, width)).reshape(2, -1).T
    mask = camera_hits(caster, camera, every).face.reshape(width, width) >= 0
    assert overlap_of(caster, camera, mask) == 1
    mask[:, : width // 2] = False
    assert overlap_of(caster, camera, mask) == pytest.approx(0.5, abs=0.02)


def test_its_own_capture_is_taken(folders: tuple[Path, Path, Path], tmp_path: Path) -> None:
    capture, own, _ = folders
    assert run(evaluate.main, [str(own), "--truth", str(capture)]) == 0
    assert run(render.main, [str(own), "--capture", str(capture), "--views", "1", "--out", str(tmp_path / "out")]) == 0


@pytest.mark.parametrize(
    ("main", "options"),
    [
        (evaluate.main, ["RESULT", "--truth", "CAPTURE"]),
        (render.main, ["RESULT", "--capture", "CAPTURE", "--out", "OUT"]),
        (render.main, ["RESULT", "--capture", "CAPTURE", "--light", "0,0,1", "--out", "OUT"]),
        (view.main, ["RESULT", "--capture", "CAPTURE", "--no-browser"]),
    ],
)
def test_another_objects_capture_is_refused(
    main: object, options: list[str], folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = {"RESULT": str(folders[2]), "CAPTURE": str(folders[0]), "OUT": str(tmp_path / "out")}
    assert run(main, [words.get(option, option) for option in options]) == 2  # type: ignore[arg-type]
    said = capsys.readouterr().err
    assert "wanted photographs of the result's object" in said and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_views_that_the_result_has_not_are_not_asked(folders: tuple[Path, Path, Path]) -> None:
    """What a few views did not see may stand out in others."""
    capture, _, other = folders
    result = read_reconstruction(other)
    of_one = replace(
        result,
        views=result.views[:1],
        light_names=result.light_names[:1],
        normal_maps=result.normal_maps[:1],
        lights=replace(result.lights, direction=result.lights.direction[:1], intensity=result.lights.intensity[:1]),
    )
    assert len(capture_of(of_one, capture, [2, 3], [1]).views) == 2


MOVED = {"about": "pose", "where": "all views", "text": "cameras were moved", "mended": True}


@pytest.mark.parametrize(
    ("found", "mends"),
    [([MOVED], True), ([MOVED | {"mended": False}], False), ([MOVED | {"about": "lights"}], False), ([], False)],
)
def test_a_capture_is_mended_as_it_was_for_the_result(
    folders: tuple[Path, Path, Path], monkeypatch: pytest.MonkeyPatch, found: list[dict[str, object]], mends: bool
) -> None:
    """Told by all photographs of the result, whatever is asked for; what the result has not is taken as it is."""
    result = read_reconstruction(folders[1])
    numbers, lights = (result.light_names[0], result.light_names[1][:3]), result.lights
    part = replace(
        result,
        views=result.views[:2],
        light_names=numbers,
        normal_maps=result.normal_maps[:2],
        lights=replace(
            lights, **{name: (of[0], of[1][:3]) for name, of in (("direction", lights.direction), ("intensity", lights.intensity))}
        ),
        metrics={"findings": found},
    )
    told = []

    def moved(capture: Capture, *_: object) -> tuple[Capture, list[Finding]]:
        told.append({view.name: view.lights for view in capture.views})
        views = [replace(view, camera=replace(view.camera, translation=view.camera.translation + 1)) for view in capture.views]
        return Capture(capture.name, tuple(views)), []

    monkeypatch.setattr(mvps.sound, "sound", moved)
    given, made = read_capture(folders[0], [1, 2, 3], [2, 5]), capture_of(part, folders[0], [1, 2, 3], [2, 5])
    assert told == ([dict(zip(part.views, numbers, strict=True))] if mends else [])
    pairs = zip(made.views, given.views, strict=True)
    by = [float((after.camera.translation - before.camera.translation).mean()) for after, before in pairs]
    assert by == pytest.approx([1, 1, 0] if mends else [0, 0, 0])
    assert [view.lights for view in made.views] == [(2, 5), (2,) if mends else (2, 5), (2, 5)]
