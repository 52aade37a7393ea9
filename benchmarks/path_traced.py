"""What the program makes of captures by another renderer: shapes, materials and light between surfaces as Mitsuba 3 traces them.

    python benchmarks/path_traced.py [CASE ...] [--preset standard] [--keep DIR]

Cases are those of CASES, all of them if none is named. Each is made (benchmarks/hard/traced.py), reconstructed and evaluated through the
command line. Writes path_traced.json and path_traced.md beside this file, after every case; cases of earlier runs stay. --keep DIR keeps
DIR/CASE/given, good and result; captures that are there are not made again. Needs pip install mvps[mitsuba].
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import NamedTuple

from accuracy import COLUMNS, HERE, machines, table
from hard.cases import Sample
from hard.lumps import lumps
from hard.scenes import rendered, shaped_as
from hard.traced import BOUNCES, SHAPES, surface_of, traced
from hard_cases import run_one

from mvps.synthetic.settings import SceneSettings

LEFT_OUT = ("model.glb normal deg", "without its map", "F@0.5 mm", "Chamfer mm", "held-out PSNR dB", "runs", "peak MB")
SHOWN = [column for column in COLUMNS if column[0] not in LEFT_OUT]


class Case(NamedTuple):
    """shape and material of hard/traced.py, or the seed of lumps by chance (hard/lumps.py); settings of the photographs; direct: without
    light between surfaces."""

    shape: str | int
    material: str
    settings: SceneSettings = SceneSettings()
    direct: bool = False


CASES = {
    "statue-copper": Case("statue", "copper", SceneSettings(seed=1)),
    "statue-copper-direct": Case("statue", "copper", SceneSettings(seed=1), direct=True),
    "vessel-copper": Case("vessel", "copper", SceneSettings(seed=2)),
    "knot-gold": Case("knot", "gold", SceneSettings(seed=3)),
    "vessel-lacquer": Case("vessel", "lacquer", SceneSettings(seed=4)),
    "coral-patina": Case("coral", "patina", SceneSettings(seed=5)),
    "shell-plastic": Case("shell", "plastic", SceneSettings(seed=6, free_lights=True)),
    "statue-dark": Case("statue", "dark", SceneSettings(seed=7)),
    "coral-cloth": Case("coral", "cloth", SceneSettings(seed=8, views=6, lights=8)),
    "knot-plastic": Case("knot", "plastic", SceneSettings(seed=9)),
    "shell-gilded": Case("shell", "gilded", SceneSettings(seed=11)),
    "cheese-chalk": Case("cheese", "chalk", SceneSettings(seed=15)),
    "bricks-plastic": Case("bricks", "plastic", SceneSettings(seed=16)),
    "statue-chalk": Case("statue", "chalk", SceneSettings(seed=31)),
    "lumps-plastic": Case(101, "plastic", SceneSettings(seed=41, views=12, lights=16, size=192)),
    "lumps-lacquer": Case(102, "lacquer", SceneSettings(seed=42, views=8, lights=10, free_lights=True)),
    "lumps-patina": Case(103, "patina", SceneSettings(seed=43)),
    "lumps-gold": Case(104, "gold", SceneSettings(seed=44, views=16, lights=20)),
    "lumps-dark": Case(105, "dark", SceneSettings(seed=45)),
    "lumps-cloth": Case(106, "cloth", SceneSettings(seed=46, views=20, lights=6, free_lights=True)),
    "coral-plastic": Case("coral", "plastic", SceneSettings(seed=47, views=14, size=200)),
    "vessel-chalk": Case("vessel", "chalk", SceneSettings(seed=48)),
    "cheese-lacquer": Case("cheese", "lacquer", SceneSettings(seed=49, views=8, lights=24)),
    "gear-plastic": Case("gear", "plastic", SceneSettings(seed=61)),
    "mug-plastic": Case("mug", "plastic", SceneSettings(seed=62)),
    "nut-lacquer": Case("nut", "lacquer", SceneSettings(seed=63)),
    "coin-patina": Case("coin", "patina", SceneSettings(seed=64)),
    "steps-cloth": Case("steps", "cloth", SceneSettings(seed=65)),
    "gear-copper": Case("gear", "copper", SceneSettings(seed=66)),
    "nut-copper": Case("nut", "copper", SceneSettings(seed=322)),
    "bricks-copper": Case("bricks", "copper", SceneSettings(seed=323, lights=16, spread=70)),
    "lumps-inlaid": Case(201, "inlaid", SceneSettings(seed=201)),
    "lumps-contrast": Case(202, "contrast", SceneSettings(seed=202, lights=16)),
    "statue-enamel": Case("statue", "enamel", SceneSettings(seed=204, views=12)),
    "coral-bronze": Case("coral", "bronze", SceneSettings(seed=206, views=14, lights=16)),
    "lumps-brushed": Case(207, "brushed", SceneSettings(seed=207)),
    "cheese-bright": Case("cheese", "bright", SceneSettings(seed=208, views=12)),
    "statue-wide": Case("statue", "plastic", SceneSettings(seed=209, lights=16, spread=80)),
    "bolt-aluminium": Case("bolt", "aluminium", SceneSettings(seed=706)),
    "gem-aluminium": Case("gem", "aluminium", SceneSettings(seed=717)),
    "windows-chalk": Case("windows", "chalk", SceneSettings(seed=903)),
    "mug-chalk": Case("mug", "chalk", SceneSettings(seed=902)),
}


def made(case: Case) -> Sample:
    """The capture and its truth."""
    surface = surface_of(SHAPES[case.shape]()) if isinstance(case.shape, str) else lumps(case.shape)
    scene = shaped_as(surface, case.settings)
    take = traced(scene.surface, case.material, 2 if case.direct else BOUNCES)
    capture, truth = rendered(case.settings, lambda _: scene, take)
    return Sample(capture, capture, truth)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", help=" ".join(CASES))
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--limit", type=float, default=600.0, metavar="S", help="seconds after which a command counts as hanging")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep captures and results")
    given = parser.parse_args()
    unknown = [name for name in given.cases if name not in CASES]
    if unknown:
        parser.error(f"wanted cases among {' '.join(CASES)}, given {' '.join(unknown)}")
    stem = HERE / ("path_traced" if given.preset == "standard" else f"path_traced-{given.preset}")
    before = json.loads(stem.with_suffix(".json").read_text(encoding="utf-8"))["rows"] if stem.with_suffix(".json").exists() else []
    found = {row["case"]: row for row in before}
    for name in given.cases or CASES:
        there = given.keep is not None and (given.keep / name / "good").exists()
        found[name] = run_one(name, None if there else made(CASES[name]), given.preset, given.limit, given.keep)
        rows = [found[name] for name in CASES if name in found]
        stem.with_suffix(".json").write_text(json.dumps({"rows": rows}, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        command = f"python {Path(sys.argv[0]).parent.name}/path_traced.py --preset {given.preset}"
        stem.with_suffix(".md").write_text(f"`{command}` on {machines(rows)}.\n\n{table(rows, SHOWN)}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
