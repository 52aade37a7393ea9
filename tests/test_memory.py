"""A limit of memory: what it allows, what it refuses, and that a run obeys it without other values."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from sphere_scene import make_sphere

from mvps import cores, memory, reconstruct
from mvps.command import run
from mvps.cores import at_a_time, on_cores, one_by_one, work_on
from mvps.joint.blocks import Vertices
from mvps.joint.lighting import FEWER_VERTICES, LIGHT_VERTICES, MOST_TOGETHER, vertices_for
from mvps.joint.state import State, senders_of
from mvps.load import read_capture
from mvps.material import LARGEST
from mvps.memory import Together, keep_below, likely_vertices, peak_bytes, room_for, solved_together
from mvps.scene import CaptureError, Lights
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings

SIZES = [(50_000, 96)] * 19 + [(60_000, 96)]
PROGRAM = 4e8


@pytest.fixture(autouse=True)
def four_cores(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(cores.os, "sched_getaffinity", lambda _: set(range(4)))
    monkeypatch.setattr(memory, "_limit", [])
    work_on(4)
    yield
    monkeypatch.undo()
    work_on(len(os.sched_getaffinity(0)))


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "small"
    write_capture(*render_capture(SceneSettings(views=8, lights=10, size=96)), folder)
    return folder


@pytest.mark.parametrize("views", [1, 2, 3, 4])
def test_as_many_views_at_a_time_as_the_limit_allows(views: int) -> None:
    keep_below(peak_bytes(PROGRAM, SIZES, likely_vertices(SIZES, "standard"), views) / 1e9 + 1e-6, PROGRAM, SIZES, "standard")
    assert at_a_time() == views


def test_more_than_enough_memory_changes_nothing() -> None:
    keep_below(1000, PROGRAM, SIZES, "fine")
    assert at_a_time() == 4


def test_a_limit_that_cannot_be_kept_is_refused_with_one_that_can() -> None:
    with pytest.raises(CaptureError, match=r"20 views of up to 96 lights .* given 1; use") as refused:
        keep_below(1, PROGRAM, SIZES, "standard")
    keep_below(float(str(refused.value).split("at least ")[1].split()[0]), PROGRAM, SIZES, "standard")
    assert at_a_time() >= 1


def test_a_mesh_that_is_larger_than_expected_leaves_fewer_views_or_is_refused() -> None:
    vertices = likely_vertices(SIZES, "standard")
    room_for(1e9)
    keep_below(peak_bytes(PROGRAM, SIZES, vertices, 4) / 1e9 + 1e-6, PROGRAM, SIZES, "standard")
    room_for(vertices + 1)
    assert at_a_time() == 3
    with pytest.raises(CaptureError, match="mesh of about"):
        room_for(3 * vertices)


def test_lights_of_their_own_take_room() -> None:
    """Where those of 20 views are solved for together: 1.35 GB, measured 1.4."""
    vertices = likely_vertices(SIZES, "draft")
    keep_below((peak_bytes(PROGRAM, SIZES, vertices, 2) + 1e6) / 1e9, PROGRAM, SIZES, "draft")
    room_for(vertices, together=Together(96, LIGHT_VERTICES))
    assert at_a_time() == 2
    with pytest.raises(CaptureError, match="of up to 96 lights whose 1920 lights are solved for together and a mesh") as refused:
        room_for(vertices, together=Together(1920, LIGHT_VERTICES))
    more = float(str(refused.value).split("at least ")[1].split()[0]) - peak_bytes(PROGRAM, SIZES, 0, 1) / 1e9
    assert abs(more - 1.35) < 0.1


@pytest.mark.parametrize(("one_rig", "together"), [(True, 3), (False, 5)])
def test_lights_of_one_rig_are_the_same_in_all_views(one_rig: bool, together: int) -> None:
    towards = np.array([[0.0, 0.0, 1.0]])
    lights = Lights(tuple(towards.repeat(n, 0) for n in (3, 2)), tuple(np.ones((n, 3)) for n in (3, 2)), one_rig)
    assert solved_together(lights, 0) == together and solved_together(lights, 4) == together + 2


def _lights(views: int, count: int, one_rig: bool) -> Lights:
    towards = np.tile([[0.0, 0.0, 1.0]], (count, 1))
    return Lights((towards,) * views, (np.ones((count, 3)),) * views, one_rig)


@pytest.mark.parametrize(
    ("views", "count", "one_rig", "times"), [(20, 32, True, 1), (5, 7, True, 1), (5, 7, False, 5), (12, 12, False, 4), (20, 96, False, 1)]
)
def test_lights_that_a_view_has_to_itself_are_solved_on_more_vertices(views: int, count: int, one_rig: bool, times: int) -> None:
    """While these take no more room than MOST_TOGETHER do on as many as a rig's."""
    lights = _lights(views, count, one_rig)
    assert vertices_for(lights, True, False) == times * LIGHT_VERTICES and vertices_for(lights, True, True) == times * FEWER_VERTICES
    assert vertices_for(lights, False, False) == LIGHT_VERTICES
    together = Together(solved_together(lights, 0), vertices_for(lights, True, False))
    beside = peak_bytes(PROGRAM, SIZES, 0, 1)
    most = max(together.lights, MOST_TOGETHER) * LIGHT_VERTICES * memory.LIGHT + together.lights**2 * memory.PAIR
    assert peak_bytes(PROGRAM, SIZES, 1e4, 1, together=together) - beside <= max(most, 1e4 * memory.VERTEX)


def test_light_by_way_of_lobes_takes_room() -> None:
    """In grey beside the vertices, in colours when these are done."""
    few, many = (peak_bytes(PROGRAM, SIZES, 1e5, 2, sending) - peak_bytes(PROGRAM, SIZES, 1e5, 2) for sending in (1000, 100000))
    assert few == 2 * 96 * 1000 * memory.SENT
    assert many == 3 * 100 * few - memory.VERTEX * 1e5
    keep_below((peak_bytes(PROGRAM, SIZES, 1e5, 1, 100000) + 1e6) / 1e9, PROGRAM, SIZES, "draft")
    room_for(1e5)
    assert at_a_time() > 1
    room_for(1e5, 100000)
    assert at_a_time() == 1


def test_results_come_in_order_whatever_the_number_at_a_time() -> None:
    for most in (1, 3):
        work_on(most)
        assert on_cores(lambda a, b: a - b, range(9), range(0, 18, 2)) == [-k for k in range(9)]
        assert list(one_by_one(lambda k: 2 * k, 9)) == list(range(0, 18, 2))


def test_a_refused_limit_ends_before_photographs_are_decoded(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvps.load.diligent.decode", lambda *_: pytest.fail("decoded"))
    assert run(reconstruct.main, [str(capture), "--out", str(tmp_path / "r"), "--max-memory", "0.1", "--quiet"]) == 2
    assert run(reconstruct.main, [str(capture), "--out", str(tmp_path / "r"), "--max-memory", "-3", "--quiet"]) == 2
    assert list(tmp_path.iterdir()) == []


IN_A_PROCESS_OF_ITS_OWN = """
import sys
from mvps import reconstruct
from mvps.command import run
from mvps.progress import peak_memory_mb
code = run(reconstruct.main, sys.argv[1:])
print(peak_memory_mb())
sys.exit(code)
"""


def test_a_limit_is_obeyed_and_changes_no_value(capture: Path, tmp_path: Path) -> None:
    sizes = [(len(view.pixels), len(view.lights)) for view in read_capture(capture).views]
    imports = "import mvps.joint.refine, mvps.texture; from mvps.progress import peak_memory_mb; print(peak_memory_mb())"
    program = 1e6 * float(subprocess.run([sys.executable, "-c", imports], capture_output=True, text=True, check=True).stdout)
    # What the same imports take differs by some MB from process to process.
    tight = (peak_bytes(program, sizes, 3 * likely_vertices(sizes, "draft"), 1) + 20e6) / 1e9
    limits = {"tight": tight, "free": 100.0}
    for name, limit in limits.items():
        options = [str(capture), "--out", str(tmp_path / name), "--preset", "draft", "--quiet", "--max-memory", str(limit)]
        done = subprocess.run([sys.executable, "-c", IN_A_PROCESS_OF_ITS_OWN, *options], capture_output=True, text=True, check=True)
        assert float(done.stdout.splitlines()[-1]) < 1000 * limit
    for file in ("mesh.ply", "material.npz", "lights.json"):
        assert (tmp_path / "tight" / file).read_bytes() == (tmp_path / "free" / file).read_bytes()


@pytest.mark.skipif(not os.confstr("CS_GNU_LIBC_VERSION"), reason="an option of glibc")
def test_freed_memory_serves_the_next_array() -> None:
    """Pages that the system hands out anew (minor faults) when twelve arrays of 2048 pages each are made, dropped and made again."""
    program = """
import resource, sys
import numpy as np
from mvps.memory import keep_freed
if sys.argv[1:]:
    keep_freed()
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    arrays = [np.ones(1 << 20) for _ in range(12)]
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
print(sum(faults() for _ in range(4)))
"""
    without, kept = (int(subprocess.check_output([sys.executable, "-c", program, *options])) for options in ([], ["keep"]))
    assert kept < 2048 < without


def test_what_sends_light_on_makes_no_room_that_lights_need(monkeypatch: pytest.MonkeyPatch) -> None:
    """Asked when patches are known, after the mesh was."""
    asked = []
    monkeypatch.setattr("mvps.joint.state.room_for", lambda *of: asked.append(of))
    scene = make_sphere(2)
    state = State(
        scene.reconstruction.surface,
        scene.reconstruction.lights,
        (),
        scene.reconstruction.material.law,
        LARGEST,
        0.0,
        together=Together(960, LIGHT_VERTICES),
    )
    n = len(state.surface.vertices)
    senders_of(state, Vertices(torch.zeros(n, 3), torch.ones(n, 2), torch.ones(n)))
    assert asked == [(n, 0, (960, LIGHT_VERTICES))]
