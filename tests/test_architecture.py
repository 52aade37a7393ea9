"""What the parts may know of each other, how fast every command answers --help, and the size of what one must read at once."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("mvps", "solvers")
MODULES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
SCRIPTS = sorted(path for folder in ("examples", "benchmarks") for path in (ROOT / folder).rglob("*.py"))
TORCH_ROOMS = (
    "baselines",
    "device",
    "checkpoint",
    "shading",
    "neural",
    "rendering",
    "photometric",
    "exemplars",
    "two_materials",
    "occupancy",
    "radiance",
    "fieldtraining",
    "field",
    "fieldrays",
    "joint",
    "measures",
)


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


def syntax(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(path: Path) -> set[str]:
    """Top-level names of what a file imports, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(syntax(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.split(".")[0])
    return names


# ------------------------------------------------------------------------------------------------ import contracts


def lint_imports(root: Path) -> subprocess.CompletedProcess[str]:
    command = [
        sys.executable,
        "-c",
        "from importlinter.cli import lint_imports_command as run; run()",
        "--config",
        "setup.cfg",
        "--no-cache",
    ]
    return subprocess.run(command, cwd=root, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(root)})


def test_import_contracts_hold() -> None:
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize(
    ("file", "line", "contract"),
    [
        ("mvps/photometric.py", "import mvps.hull", "Whole ways, rooms, primitives, values"),
        ("mvps/camera.py", "import mvps.load", "Whole ways, rooms, primitives, values"),
        ("mvps/unheard_of.py", '"""A module in no layer."""', "Whole ways, rooms, primitives, values"),
        ("solvers/low_rank.py", "import mvps.scene", "Solvers know no images and no meshes"),
        ("mvps/scene.py", "import solvers.low_rank", "Values know no solver"),
    ],
)
def test_import_contracts_catch_a_breach(tmp_path: Path, file: str, line: str, contract: str) -> None:
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package)
    shutil.copy(ROOT / "setup.cfg", tmp_path)
    with (tmp_path / file).open("a") as module:
        module.write(f"\n{line}\n")
    result = lint_imports(tmp_path)
    assert result.returncode != 0 and f"{contract} BROKEN" in result.stdout, result.stdout + result.stderr


def test_torch_stays_in_its_rooms() -> None:
    outside = [relative(p) for p in MODULES if "torch" in imported(p) and p.parts[len(ROOT.parts)] == "mvps"]
    assert not [name for name in outside if name.split("/")[1].removesuffix(".py") not in TORCH_ROOMS]


# ------------------------------------------------------------------------------------------------ commands


def commands() -> list[str]:
    """Modules of mvps that are meant for `python -m`."""
    found = []
    for path in MODULES:
        name = relative(path).removesuffix(".py").replace("/", ".")
        if path.name == "__main__.py":
            found.append(name.removesuffix(".__main__"))
        elif any(isinstance(node, ast.If) and "__name__" in ast.unparse(node.test) for node in syntax(path).body):
            found.append(name)
    return found


@pytest.mark.parametrize("module", commands())
def test_help_is_quick_and_needs_no_heavy_import(module: str) -> None:
    seconds, options = [], ["-X", "importtime", "-m", module, "--help"]
    # The best of three: the first fills the file cache, and another process may be busy.
    for _ in range(3):
        start = time.perf_counter()
        result = subprocess.run([sys.executable, *options], cwd=ROOT, capture_output=True, text=True)
        seconds.append(time.perf_counter() - start)
        assert result.returncode == 0, result.stderr
    assert f"usage: python -m {module}" in result.stdout and "default" in result.stdout
    loaded = set(re.findall(r"\| +([a-zA-Z_0-9]+)$", result.stderr, re.MULTILINE))
    assert not loaded & {"torch", "skimage", "igl", "embreex", "cv2", "matplotlib", "trimesh", "gpytoolbox"}
    assert min(seconds) < 1, f"{module} --help took {min(seconds):.2f} s"


@pytest.mark.parametrize("module", commands())
def test_commands_refuse_nonsense_with_one_sentence(module: str) -> None:
    result = subprocess.run([sys.executable, "-m", module, "--no-such-option"], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 2
    assert result.stderr.startswith("mvps: ") and result.stderr.count("\n") == 1 and result.stdout == ""


# ------------------------------------------------------------------------------------------------ reading


@pytest.mark.parametrize("path", MODULES + SCRIPTS, ids=relative)
def test_every_file_says_what_it_is_and_is_short_enough_to_read(path: Path) -> None:
    tree = syntax(path)
    assert ast.get_docstring(tree), "no docstring"
    assert path.read_text(encoding="utf-8").count("\n") <= 450
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and node.end_lineno is not None:
            assert node.end_lineno - node.lineno <= 70, f"{node.name}: {node.end_lineno - node.lineno} lines"


def test_public_functions_are_documented() -> None:
    bare = []
    for path in MODULES:
        for node in syntax(path).body:
            public = isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
            if public and not ast.get_docstring(node):  # type: ignore[arg-type]
                bare.append(f"{relative(path)}: {node.name}")  # type: ignore[attr-defined]
    assert not bare


def test_dependencies_are_those_that_are_imported() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {re.split(r"[<>=~!; ]", d)[0].lower().replace("_", "-") for d in project["dependencies"]}
    used = set().union(*(imported(p) for p in MODULES)) - set(sys.stdlib_module_names) - set(PACKAGES)
    # OpenEXR's module is a file beside the packages, which the standard library's list leaves out.
    distributions = {"OpenEXR": ["OpenEXR"], **packages_distributions()}
    missing = {name for name in used if not declared & {d.lower().replace("_", "-") for d in distributions.get(name, [])}}
    extras = [d for name in ("lpips", "video") for d in project["optional-dependencies"][name]]
    missing -= {re.split(r"[<>=~!; ]", d)[0].replace("-", "_") for d in extras}
    provided = {d.lower().replace("_", "-") for name in used for d in distributions.get(name, [])}
    assert not missing, f"imported, not declared in pyproject.toml: {missing}"
    assert not declared - provided, f"declared in pyproject.toml, imported nowhere: {declared - provided}"


def test_constraints_pin_every_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *(d for extra in project["optional-dependencies"].values() for d in extra)]
    lines = (ROOT / "constraints.txt").read_text().split()
    assert lines[0].startswith("torch==")
    pinned = {line.split("==")[0].lower().replace("_", "-") for line in lines}
    assert {re.split(r"[<>=~!; ]", d)[0].lower().replace("_", "-") for d in wanted} <= pinned
