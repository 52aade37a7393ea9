"""Methods side by side, on a small made capture."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import cv2
import numpy as np
import pytest

from mvps.command import run
from mvps.compare.__main__ import main
from mvps.compare.curve import Point, dominated, drawings, points_of, ticks
from mvps.compare.page import page_html
from mvps.compare.pictures import cropped, error_picture
from mvps.compare.running import Run, known_runs, state
from mvps.compare.tables import as_csv, as_markdown, as_text, otherwise_rows, protocol_rows, rows
from mvps.synthetic.files import write_capture
from mvps.synthetic.scene import render_capture
from mvps.synthetic.settings import SceneSettings


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compare") / "made"
    write_capture(*render_capture(SceneSettings(views=5, lights=8, size=64)), folder)
    return folder


@pytest.fixture(scope="module")
def compared(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("compare") / "out"
    assert run(main, [str(capture), "--methods", "ours-draft,hull", "--hold-out-views", "3", "--out", str(out), "--quiet"]) == 0
    return out


def test_table_pictures_and_meshes(compared: Path) -> None:
    table = list(csv.DictReader((compared / "table.csv").read_text().splitlines()))
    assert [row["method"] for row in table] == ["ours-draft", "hull"]
    assert float(table[0]["mesh normal deg"]) < float(table[1]["mesh normal deg"])
    assert float(table[0]["Chamfer px"]) < float(table[1]["Chamfer px"])
    assert all(float(row["s"]) > 0 and float(row["held-out views PSNR dB"]) > 10 for row in table)
    picture = cv2.imread(str(compared / "normals.png"))
    assert picture is not None and picture.std() > 20
    assert (compared / "hull" / "mesh.ply").is_file()
    # The result itself says how well it tells the photographs that were held out, and no truth is needed for it.
    said = json.loads((compared / "ours-draft" / "metrics.json").read_text())["held_out"]["held_out_views_psnr_db"]
    assert said == pytest.approx(known_runs(compared)["ours-draft"].errors["held_out_views_psnr_db"], abs=0.01)
    assert "| method |" in (compared / "table.md").read_text()
    page = (compared / "report.html").read_text()
    assert "<td>hull</td>" in page and "data:image/png;base64," in page and "<svg" not in page


def test_the_page_shows_curves_after_the_first_table() -> None:
    page = page_html(
        "a <b>", {"first": [["method", "s"], ["x", "1"]], "second": [["method", "s"], ["y", "2"]]}, {"error": "<svg></svg>"}, None
    )
    assert "Methods on a &lt;b&gt;" in page and page.index("first") < page.index("<svg>") < page.index("second")


def test_what_is_there_is_not_run_again(capture: Path, compared: Path) -> None:
    before = (compared / "hull" / "mesh.ply").stat().st_mtime_ns
    runs = json.loads((compared / "runs.json").read_text())
    assert run(main, [str(capture), "--methods", "hull", "--hold-out-views", "3", "--out", str(compared), "--quiet"]) == 0
    assert (compared / "hull" / "mesh.ply").stat().st_mtime_ns == before and json.loads((compared / "runs.json").read_text()) == runs
    assert run(main, [str(capture), "--methods", "hull", "--out", str(compared), "--quiet"]) == 0
    assert (compared / "hull" / "mesh.ply").stat().st_mtime_ns > before


def test_a_comparison_that_is_ended_ends_its_method_and_goes_on_later(capture: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mvps.compare", str(capture), "--methods", "hull", "--out", str(tmp_path / "out"), "--quiet"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")

    def runs_method(pid: str) -> bool:
        # Libraries look for others by programs of their own, which nobody waits for.
        place = Path(f"/proc/{pid}/cmdline")
        return place.exists() and b"mvps.methods" in place.read_bytes()

    end = time.monotonic() + 60
    while not (child := [pid for pid in children.read_text().split() if runs_method(pid)]) and time.monotonic() < end:
        time.sleep(0.02)
    process.terminate()
    assert process.wait(60) == 128 + signal.SIGTERM and child and not Path(f"/proc/{child[0]}").exists()
    assert run(main, command[3:]) == 0 and (tmp_path / "out" / "hull" / "mesh.ply").is_file()


def test_another_capture_is_not_told_anothers_figures(capture: Path, tmp_path: Path) -> None:
    other, out = tmp_path / "other", tmp_path / "out"
    write_capture(*render_capture(SceneSettings(views=5, lights=8, size=64, seed=1)), other)
    found = []
    for one in (capture, other):
        assert run(main, [str(one), "--methods", "hull", "--out", str(out), "--quiet"]) == 0
        found.append(known_runs(out)["hull"].errors["chamfer_px"])
    assert found[0] != found[1]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--methods", "ours,magic"], "wanted some of ours"),
        (["--methods", "hull", "--views", "0"], "wanted numbers from 1"),
        (["--methods", "hull", "--device", "gpu"], "wanted one of auto, cpu, cuda, given 'gpu'"),
    ],
)
def test_bad_options(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], said: str) -> None:
    assert run(main, [str(capture), *options, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize("folder", ["-made", os.fsdecode(b"caf\xe9"), "."])
def test_any_name_of_a_folder(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str) -> None:
    place = tmp_path / "here" / folder
    shutil.copytree(capture, place)
    monkeypatch.chdir(tmp_path / "here")
    assert run(main, [f"./{folder}", "--methods", "hull", "--out", "./-out", "--quiet"]) == 0
    title = {"-made": "-made", ".": "here"}.get(folder, "caf\\xe9")
    assert f"<title>Methods on {title}</title>" in (tmp_path / "here" / "-out" / "report.html").read_text()


def test_a_capture_that_no_method_can_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    assert run(main, [str(empty), "--methods", "hull", "--out", str(tmp_path / "out"), "--quiet"]) == 2
    assert "Calib_Results.mat" in capsys.readouterr().err and "Calib_Results.mat" in known_runs(tmp_path / "out")["hull"].failed


def test_a_method_that_cannot_run_says_why(capture: Path, compared: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(capture, bare, ignore=shutil.ignore_patterns("light_directions.txt"))
    shutil.copytree(compared, tmp_path / "out")
    options = ["--methods", "hull,calibrated", "--out", str(tmp_path / "out"), "--quiet"]
    assert run(main, [str(bare), *options, "--hold-out-views", "3"]) == 0
    runs = known_runs(tmp_path / "out")
    assert "light_directions.txt" in runs["calibrated"].failed and not runs["hull"].failed
    assert f"did not run: {runs['calibrated'].failed}" in (tmp_path / "out" / "table.md").read_text()


def test_a_folder_with_other_files_stays(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert run(main, [str(capture), "--methods", "hull", "--out", str(tmp_path)]) == 2
    assert "other files" in capsys.readouterr().err and [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_tables_leave_out_what_no_run_has() -> None:
    runs = [Run("a", (), 12.3, 20.0, 100.0, status="converged", errors={"chamfer_px": 0.1234}), Run("b", (), failed="no lights")]
    lines = rows(runs)
    assert lines == [
        ["method", "Chamfer px", "s", "processor s", "peak MB", "status"],
        ["a", "0.123", "12", "20", "100", "converged"],
        ["b", "-", "-", "-", "-", "did not run: no lights"],
    ]
    assert as_markdown(lines).splitlines()[1] == "|" + " --- |" * 6
    first, second, _ = as_text(lines).splitlines()
    assert first.index("Chamfer px") + len("Chamfer px") == second.index("0.123") + len("0.123")
    assert list(csv.reader(as_csv(lines).splitlines())) == lines


def test_papers_figures_stand_beside_their_protocol_alone() -> None:
    runs = [Run("ours", (), errors={"psnerf_chamfer": 3.25, "chamfer_px": 0.1})]
    lines = protocol_rows("psnerf", runs, "BEAR")
    column = lines[0].index("Chamfer distance, thousandths")
    figures = {(line[0], line[-1]): line[column] for line in lines[1:]}
    source = "Yang et al. (ECCV 2022), MVPS methods, BEAR"
    assert figures["ours", "this comparison"] == "3.25"
    assert [figures[name, source] for name in ("PJ16", "LZ20", "PS-NeRF")] == ["19.58", "8.91", "8.65"]
    assert {line[0] for line in protocol_rows("mvscps", runs, "BEAR")[1:]} == {"ours"}


def test_what_papers_measured_otherwise_stands_by_itself() -> None:
    lines = otherwise_rows("BEAR")
    found = {(line[0], line[1]): line[2:] for line in lines[1:]}
    assert found["RNb-NeuS2", "chamfer_mm"] == ["0.17", "mm", "Bruneau et al. (2025), average", "about; by a protocol of its own"]
    assert found["PS-NeRF", "seconds"][0] == "79200"
    assert not {line[1] for line in lines[1:]} & {"normal_error_deg", "chamfer"}, "these stand beside their protocols"


def test_other_protocols_are_measured_without_running_again(capture: Path, compared: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(compared, out)
    options = ["--methods", "ours-draft", "--hold-out-views", "3", "--out", str(out), "--quiet", "--protocols", "ours,rnbneus"]
    assert run(main, [str(capture), *options]) == 0
    before, after = (known_runs(folder)["ours-draft"] for folder in (compared, out))
    assert after.seconds == before.seconds and after.errors.items() > before.errors.items()
    table = list(csv.DictReader((out / "table_rnbneus.csv").read_text().splitlines()))
    assert [row["method"] for row in table][:2] == ["ours-draft", "PJ16"] and float(table[0]["Chamfer distance, mm"]) < 5
    assert not (out / "table_otherwise.csv").exists()
    assert run(main, [str(capture), *options[:-2], "--published", "BEAR"]) == 0
    assert "19.58" in (out / "table_psnerf.csv").read_text() and "RNb-NeuS2" in (out / "table_otherwise.csv").read_text()


def test_errors_are_seen_where_both_are_known() -> None:
    truth = np.full((4, 6, 3), np.nan)
    truth[1:3, 2:5] = [0.0, 0.0, 1.0]
    assert cropped(truth) == (slice(1, 3), slice(2, 5))
    turned = np.where(np.isnan(truth), np.nan, [0.0, 1.0, 0.0])
    turned[1, 2] = np.nan
    picture = error_picture(turned, truth)
    assert (picture[1, 2] == 0).all() and picture[2, 2].astype(int).sum() > 600 and (picture[0] == 0).all()


def test_curve_joins_our_budgets_and_names_all() -> None:
    runs = [
        Run(name, (), seconds, errors={"chamfer_px": error})
        for name, seconds, error in (("ours", 50, 0.1), ("ours-draft", 15, 0.2), ("hull", 5, 2))
    ]
    (text,) = drawings(runs).values()
    root = ElementTree.fromstring(text)
    assert [t.text for t in root.iter("{http://www.w3.org/2000/svg}text")].count("hull") == 1
    (line,) = root.iter("{http://www.w3.org/2000/svg}polyline")
    assert len(line.attrib["points"].split()) == 2
    # Its style is of itself alone: it stands in pages with styles of their own.
    rules = text.partition("<style>")[2].partition("</style>")[0]
    assert root.attrib["class"] == "curve" and all(rule.startswith(".curve ") for rule in rules.split("}")[:-1])
    assert dominated(points_of(runs, "chamfer_px")) == {"hull": False}
    assert dominated([Point(60, 0.1, "slow"), *points_of(runs, "chamfer_px")]) == {"slow": True, "hull": False}
    assert ticks(0.9, 6) == [1, 2, 5]


def test_a_run_is_of_the_files_that_it_was_made_from(tmp_path: Path) -> None:
    capture, linked, listed = tmp_path / "capture", tmp_path / "linked", tmp_path / "lights.json"
    for folder in (capture / "view_01", linked):
        folder.mkdir(parents=True)
        (folder / "001.png").write_bytes(b"one")
    (capture / "view_02").symlink_to(linked)
    listed.write_text('{"view_01": [1]}')
    options = ["--seed=1", "--views=" + ",".join(map(str, range(1, 200))), f"--lights={listed}"]
    before = state(capture, options)
    assert state(capture, options) == before
    for file in (capture / "view_01" / "001.png", linked / "001.png", listed):
        file.write_bytes(b"other")
        after = state(capture, options)
        assert after != before
        before = after
    (capture / "out" / "hull").mkdir(parents=True)
    (capture / "out" / "runs.json").write_text("{}")
    assert state(capture, options) == before, "a comparison in the capture's folder is none of its files"
