"""The documentation says what is so: figures are those of their tables, files and options are those of the program, examples run."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from textwrap import dedent
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from sphere_scene import SphereScene, make_sphere

from mvps.command import lights_argument
from mvps.export import write_reconstruction
from mvps.load.calibration import read_calibration
from mvps.reconstruct import Settings
from mvps.scene import Residual
from mvps.texture import bake
from mvps.viewpoints import read_cameras

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if path.name != "next.md")


def page(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def below(name: str, heading: str) -> str:
    """The first indented block below a heading."""
    part = page(name).split(f"# {heading}\n", 1)[1]
    block = re.search(r"(?:^    .*\n|^\n)+", part[part.index("\n    ") + 1 :], re.MULTILINE)
    assert block is not None
    return dedent(block[0])


def cells(text: str) -> Iterator[list[str]]:
    """The cells of every table's lines."""
    for line in text.splitlines():
        if line.startswith("| "):
            yield [cell.strip() for cell in line.strip("|").split(" | ")]


# ------------------------------------------------------------------------------------------------ figures


def test_figures_of_the_capture_guide_are_those_of_the_hard_cases() -> None:
    known = {row[0]: [row[1], row[2], row[3], row[4], row[7]] for row in cells(page("hard_cases.md")) if len(row) == 8}
    told = [(row[0].strip("`"), row[2:]) for row in cells(page("capture.md")) if len(row) == 7 and row[0].startswith("`")]
    assert len(told) > 40
    assert not [(case, figures, known.get(case)) for case, figures in told if figures != known.get(case)]


def test_counts_of_wrong_statuses_are_those_of_the_hard_cases() -> None:
    text = page("hard_cases.md")
    patterns = (r"(\d+) good,", r"(\d+) bad,", r"bad but called converged: (\d+) of", r"good but doubted: (\d+) of")
    good, bad, called, doubted = (sum(int(n) for n in re.findall(pattern, text)) for pattern in patterns)
    assert called == 0
    guide = page("capture.md")
    assert f"none of {bad} bad results" in guide and f"{doubted} of {good} good ones were doubted" in guide


def test_figures_of_presets_are_those_of_the_benchmarks() -> None:
    for preset, *told, _ in (row for row in cells(page("start.md")) if len(row) == 5 and row[0].startswith("`")):
        table = (ROOT / "benchmarks" / f"accuracy-{preset.strip('`')}.md").read_text(encoding="utf-8")
        head, *rows = cells(table)
        bunny = dict(zip(head, next(row for row in rows if row[0] == "bunny"), strict=True))
        assert told == [bunny["s"], bunny["Chamfer px"], bunny["mesh normal deg"]], preset


# ------------------------------------------------------------------------------------------------ files


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere(3)


def test_every_file_of_a_result_is_described(scene: SphereScene, tmp_path: Path) -> None:
    made, vertices = scene.reconstruction, len(scene.reconstruction.surface.vertices)
    layers = ((np.zeros((1, 2), np.float32), np.zeros(1, np.float32)),)
    residual = Residual(np.zeros(vertices, np.float32), np.zeros((vertices, 2), np.float32), layers)
    object.__setattr__(made.material, "residual", residual)
    write_reconstruction(
        made,
        tmp_path / "result",
        bake(made.surface, made.material, made.lights, scene.capture, 1)[0],
        "<p>report</p>",
        cameras={"view_01": scene.capture.views[0].camera},
    )
    first = made.views[0]
    written = {str(path.relative_to(tmp_path / "result")).replace(first, "view_01") for path in (tmp_path / "result").rglob("*")}
    written = {name for name in written if "/" not in name or "view_01" in name}
    assert "model_normal.png" in written
    tree = below("formats.md", "A result")
    assert not [name for name in written if name not in tree]
    with np.load(tmp_path / "result" / "material.npz") as arrays:
        names = {re.sub(r"_\d+$", "_K", name) for name in arrays.files}
    assert "residual_bias_K" in names
    described = page("formats.md").split("### material.npz")[1].split("### lights.json")[0]
    assert not [name for name in names if f"`{name}`" not in described]


def test_every_setting_is_described() -> None:
    described = page("formats.md").split("### settings.json")[1].split("###")[0]
    assert not [field.name for field in fields(Settings) if f"`{field.name}`" not in described]


def test_the_program_that_writes_a_calibration_does(scene: SphereScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = [view.camera for view in scene.capture.views]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "CAPTURE").mkdir()
    exec(below("formats.md", "Writing Calib_Results.mat"), {"cameras": [(c.K, c.rotation, c.translation) for c in cameras]})
    (tmp_path / "CAPTURE" / "scene.json").write_text(below("formats.md", "scene.json"))
    found = read_calibration(tmp_path / "CAPTURE").camera(2, cameras[1].height, cameras[1].width)
    for name in ("K", "rotation", "translation"):
        np.testing.assert_allclose(getattr(found, name), getattr(cameras[1], name), atol=1e-12)


def test_opengl_s_poses_are_turned_as_described() -> None:
    # A camera at (0, 0, 5) that looks down, its image's top along y: in OpenGL's axes the identity.
    M = np.eye(4)
    M[2, 3] = 5
    assert "`R = diag(1, -1, -1) M[:3, :3].T`, `T = -R M[:3, 3]`" in page("formats.md")
    R = np.diag([1, -1, -1]) @ M[:3, :3].T
    T = -R @ M[:3, 3]
    # What is above the origin lies nearer; y upwards in the world is upwards in the picture, which counts down.
    np.testing.assert_allclose([R @ p + T for p in np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0]])], [[0, 0, 5], [0, 0, 4], [0, -1, 5]])


def test_files_of_cameras_and_lights_are_read_as_described(tmp_path: Path) -> None:
    (tmp_path / "cameras.json").write_text(below("formats.md", "Cameras"))
    assert read_cameras(tmp_path / "cameras.json")["front"].width == 640
    (tmp_path / "lights.json").write_text(below("formats.md", "A list of lights"))
    assert lights_argument(str(tmp_path / "lights.json")) == {"view_01": (1, 8, 16), "view_02": (2,)}


# ------------------------------------------------------------------------------------------------ names


def test_every_example_is_shown_with_its_picture() -> None:
    text = page("examples.md")
    for example in sorted((ROOT / "examples").glob("*.py")):
        part = text.split(f"## {example.name}\n", 1)[1].split("\n## ", 1)[0]
        picture = re.search(r"!\[[^]]+\]\(([^)]+)\)", part)
        assert picture and (DOCS / picture[1]).is_file() and f'--8<-- "examples/{example.name}"' in part, example.name


def test_options_that_are_named_exist() -> None:
    sources = [path.read_text(encoding="utf-8") for folder in ("mvps", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    known = {word for text in sources for word in re.findall(r'"--([a-z][a-z-]+)"', text)}
    # Made of names in a table (mvps.synthetic, mvps.compare); help; of pip and mkdocs.
    known |= {"views", "lights", "size", "seed", "free-lights", "hold-out-views", "device", "help", "strict"}
    for path in (*PAGES, ROOT / "README.md"):
        named = set(re.findall(r"(?<![\w-])--([a-z][a-z-]+)", path.read_text(encoding="utf-8")))
        assert not named - known, path.name


def test_members_that_the_api_pages_pick_exist() -> None:
    """mkdocs leaves out without a word what is not there."""
    picked = [found for path in PAGES for found in re.findall(r"^::: (\S+)\n    options:\n      members: \[(.*)\]", path.read_text(), re.M)]
    assert picked
    for module, names in picked:
        path = ROOT / module.replace(".", "/")
        tree = ast.parse((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(encoding="utf-8"))
        there = {node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)}
        there |= {ast.unparse(t) for n in tree.body for t in getattr(n, "targets", [getattr(n, "target", None)]) if isinstance(t, ast.Name)}
        assert not set(names.split(", ")) - there, module


ROOMS = (
    *("scene", "load", "reconstruct", "export", "texture", "pbr", "gltf", "atlas", "report", "viewer", "view", "evaluate", "measures"),
    *("compare", "render", "new_pictures", "layers", "illumination", "viewpoints", "edits", "synthetic", "hull", "calibrate", "joint"),
)
"""Of mvps, that a program of its own imports."""


def test_every_room_has_its_place_in_the_api() -> None:
    shown = {found for path in (DOCS / "api").glob("*.md") for found in re.findall(r"^::: mvps\.(\w+)$", path.read_text(), re.M)}
    assert not set(ROOMS) - shown
    index, nav = page("api/index.md"), (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = {path.name for path in (DOCS / "api").glob("*.md")} - {"index.md"}
    assert not [name for name in pages if f"]({name})" not in index or f"api/{name}" not in nav]


def test_no_page_leads_to_what_the_site_leaves_out() -> None:
    """mkdocs does not warn of that."""
    assert not [path.name for path in PAGES if re.search(r"\]\([^)]*(next\.md|docstrings\.py)", path.read_text(encoding="utf-8"))]


# ------------------------------------------------------------------------------------------------ docstrings


@pytest.fixture
def docstrings(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """docs/docstrings.py, which needs nothing of Griffe but a class to stand below."""
    monkeypatch.setitem(sys.modules, "griffe", SimpleNamespace(Extension=object))
    spec = importlib.util.spec_from_file_location("docstrings", DOCS / "docstrings.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("text", "html"),
    [
        ("One *line*\nof `x_k` < 3.", "<p>One *line* of <code>x_k</code> &lt; 3.</p>"),
        ("So\n\n    a = b,   c = d\n      e\n\nholds.", "<p>So</p>\n<pre><code>a = b,   c = d\n  e</code></pre>\n<p>holds.</p>"),
        (
            "Of:\n\na    one\n     and more\nbcd  two   gaps\nEnd.",
            '<p>Of:</p>\n<table class="columns"><tbody><tr><td><code>a</code></td><td><p>one and more</p></td></tr>'
            "<tr><td><code>bcd</code></td><td><p>two   gaps</p></td></tr></tbody></table>\n<p>End.</p>",
        ),
        (
            "  a  one, so\n\n       x = y\n\n     ends\n  b  two",
            '<table class="columns"><tbody><tr><td><code>a</code></td><td><p>one, so</p><pre><code>x = y</code></pre><p>ends</p></td></tr>'
            "<tr><td><code>b</code></td><td><p>two</p></td></tr></tbody></table>",
        ),
        ("    minimise over a   f(a)", "<pre><code>minimise over a   f(a)</code></pre>"),
    ],
    ids=["paragraph", "formula", "table", "table with a formula", "one row is none"],
)
def test_docstrings_as_html(docstrings: ModuleType, text: str, html: str) -> None:
    assert docstrings.as_html(text) == html
