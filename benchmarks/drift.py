"""Do lights and normals slide along the bas-relief family? Errors against ground truth over many rounds of Stage II.

    python benchmarks/drift.py CAPTURES [bunny armadillo spot buddha] [--rounds 30]

Starts where `standard` starts its joint refinement, after Stage I, and goes on for many more rounds at edges of 2 pixels, one call of
`refine` a round. Writes drift.json and drift.md beside this file, where captures of earlier runs stay.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from mvps import measures
from mvps.coarse import coarse
from mvps.device import chosen_device
from mvps.joint.refine import RefineSettings, RoundSettings, refine
from mvps.load import read_capture, read_truth
from mvps.plan import Parts
from mvps.progress import Progress
from mvps.reconstruct import Settings
from mvps.scene import Capture, Lights, NormalMap, Truth

HERE = Path(__file__).resolve().parent
EDGE, REACH, STEP = 2.0, 1.2, 0.3


def errors(capture: Capture, truth: Truth, lights: Lights, maps: tuple[NormalMap, ...]) -> dict[str, float]:
    """Light direction and intensity errors, and the normal maps' error."""
    estimated = measures.by_photograph(lights, [v.name for v in capture.views], [v.lights for v in capture.views])
    pictures = {}
    for view, of_view in zip(capture.views, maps, strict=True):
        picture = np.full((*view.mask.shape, 3), np.nan)
        picture[view.mask] = of_view.normal
        pictures[view.name] = picture
    normals = measures.normal_errors(pictures, truth.normals, capture)
    return measures.light_errors(estimated, measures.true_lights(truth)) | normals


def trajectory(path: Path, rounds: int) -> list[dict[str, float]]:
    """One record of errors a round."""
    capture, truth, settings, progress = read_capture(path), read_truth(path), Settings(str(path)), Progress()
    device = chosen_device(settings.device)
    state, _ = coarse(capture, settings, None, Parts(), progress, lambda _, make: make())
    records = []
    one = RefineSettings((RoundSettings(EDGE, REACH, STEP),))
    for k in range(rounds):
        state = refine(capture, state.surface, state.lights, state.maps, state.law, one, k, device, lambda *_: None)
        records.append(errors(capture, truth, state.lights, state.maps))
    return records


def table(found: dict[str, list[dict[str, float]]]) -> str:
    """Every fifth round as Markdown: light deg / intensity % / normal map deg."""
    shown = sorted({k for records in found.values() for k in range(1, 1 + len(records)) if k < 5 or k % 5 == 0})
    lines = ["| capture | " + " | ".join(str(k) for k in shown) + " |", "|" + "---|" * (len(shown) + 1)]
    for name, records in found.items():
        cells = [
            f"{r['light_error_deg']:.2f} / {100 * r['intensity_error']:.2f} / {r['normal_error_deg']:.2f}"
            for r in (records[k - 1] for k in shown if k <= len(records))
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", type=Path)
    parser.add_argument("names", nargs="*", default=["bunny", "armadillo", "spot", "buddha"])
    parser.add_argument("--rounds", type=int, default=30)
    given = parser.parse_args()
    record = HERE / "drift.json"
    found = json.loads(record.read_text(encoding="utf-8")) if record.exists() else {}
    found |= {name: trajectory(given.captures / name, given.rounds) for name in given.names}
    record.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    command = f"python benchmarks/drift.py CAPTURES {' '.join(found)} --rounds {given.rounds}"
    text = f"`{command}`: light deg / intensity % / normal map deg by round.\n\n{table(found)}\n"
    (HERE / "drift.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
