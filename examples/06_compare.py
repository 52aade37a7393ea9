"""Methods side by side on a capture with ground truth: figures on the terminal, normals and their errors in a picture.

python examples/06_compare.py CAPTURE DIR picture.png
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from mvps.command import run
from mvps.compare.pictures import cropped, side_by_side
from mvps.compare.running import run_all
from mvps.compare.tables import as_text, rows
from mvps.export import read_reconstruction
from mvps.load import read_truth
from mvps.progress import Progress
from mvps.scene import CaptureError
from mvps.texture import png_bytes

METHODS = ("hull", "ours-draft")


def main(argv: Sequence[str]) -> None:
    if len(argv) != 3:
        raise CaptureError(f"wanted CAPTURE DIR picture.png, given {len(argv)} arguments")
    capture, folder, out = argv
    truth = read_truth(Path(capture)).normals
    if not truth:
        raise CaptureError(f"{capture}: wanted a capture with true normals, given one without; python -m mvps.synthetic makes one")

    # Every method runs in a process of its own; what the folder holds already is not run again.
    runs = run_all(Path(capture), METHODS, (), Path(folder), Progress())
    print(as_text(rows([runs[name] for name in METHODS])))

    view = next(iter(truth))
    box = cropped(truth[view])
    results = {name: read_reconstruction(Path(folder) / name) for name in METHODS}
    maps = {name: result.normal_maps[result.views.index(view)][box] for name, result in results.items()}
    Path(out).write_bytes(png_bytes(side_by_side(truth[view][box], maps)))


if __name__ == "__main__":
    sys.exit(run(main))
