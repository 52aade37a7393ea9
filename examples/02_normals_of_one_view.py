"""Normals of a single view: photographs from one camera, lights not known, an open surface out.

python examples/02_normals_of_one_view.py CAPTURE picture.png
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvps.command import run
from mvps.export import normal_picture
from mvps.load import read_capture
from mvps.progress import Progress
from mvps.reconstruct import Settings, reconstruct
from mvps.scene import CaptureError
from mvps.texture import png_bytes


def main(argv: Sequence[str]) -> None:
    if len(argv) != 2:
        raise CaptureError(f"wanted CAPTURE picture.png, given {len(argv)} arguments")
    path, out = argv
    capture = read_capture(path, views=[1])
    result = reconstruct(capture, Settings(path, preset="draft"), None, Progress())
    print(result.metrics["status"]["text"])

    # Left the mean photograph, right the normals: red to the right, green upwards, blue towards the camera.
    view = capture.views[0]
    photograph = np.zeros((*view.mask.shape, 3))
    photograph[view.mask] = view.radiance().mean(1)
    photograph = np.rint(255 * np.clip(photograph / photograph.max(), 0, 1) ** (1 / 2.2)).astype(np.uint8)
    normals = result.normal_maps[0] @ view.camera.rotation.T * (1, -1, -1)
    Path(out).write_bytes(png_bytes(np.concatenate([photograph, normal_picture(normals)], 1)))


if __name__ == "__main__":
    sys.exit(run(main))
