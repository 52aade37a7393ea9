"""Methods side by side on a capture with ground truth: figures on the terminal, normals and their errors in a picture.

python examples/06_compare.py CAPTURE DIR picture.png
"""

import sys
from pathlib import Path

import cv2

from mvps.compare.pictures import cropped, side_by_side
from mvps.compare.running import run_all
from mvps.compare.tables import as_text, rows
from mvps.export import read_reconstruction
from mvps.load import read_truth
from mvps.progress import Progress

METHODS = ("hull", "ours-draft")


def main(capture: str, folder: str, out: str) -> None:
    # Every method runs in a process of its own; what the folder holds already is not run again.
    runs = run_all(Path(capture), METHODS, (), Path(folder), Progress())
    print(as_text(rows([runs[name] for name in METHODS])))

    truth = read_truth(Path(capture)).normals
    view = next(iter(truth))
    box = cropped(truth[view])
    results = {name: read_reconstruction(Path(folder) / name) for name in METHODS}
    maps = {name: result.normal_maps[result.views.index(view)][box] for name, result in results.items()}
    cv2.imwrite(out, side_by_side(truth[view][box], maps)[..., ::-1])


if __name__ == "__main__":
    main(*sys.argv[1:4])
