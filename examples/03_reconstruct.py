"""The whole way from Python: read a capture, check it, reconstruct it, write the result, look at a view of it.

python examples/03_reconstruct.py CAPTURE RESULT picture.png
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvps.command import run
from mvps.load import read_capture
from mvps.progress import Progress
from mvps.reconstruct import Settings, reconstruct, write
from mvps.render import render_view
from mvps.scene import CaptureError
from mvps.sound import sound
from mvps.texture import png_bytes
from mvps.visibility import RayCaster


def main(argv: Sequence[str]) -> None:
    if len(argv) != 3:
        raise CaptureError(f"wanted CAPTURE RESULT picture.png, given {len(argv)} arguments")
    path, result, out = argv
    progress = Progress()
    settings = Settings(path, preset="draft", hold_out_lights=(2,))

    # What is wrong with a capture is found in its photographs and masks, and mended where it can be.
    capture, findings = sound(read_capture(path), progress)
    for finding in findings:
        print(f"{finding.where}: {finding.text}")

    reconstruction = reconstruct(capture, settings, None, progress, findings=findings)
    write(reconstruction, capture, settings, Path(result), progress)
    print(f"{len(reconstruction.surface.vertices)} vertices; {reconstruction.metrics['status']['text']}")

    # Left a photograph that the reconstruction has never seen, right its prediction.
    view = capture.views[0]
    photograph = np.zeros((*view.mask.shape, 3))
    photograph[view.mask] = view.radiance([1])[:, 0]
    predicted, _ = render_view(RayCaster(reconstruction.surface), reconstruction, view.name, view.camera)
    both = np.concatenate([photograph, predicted[:, :, 1] / 65535], 1)
    Path(out).write_bytes(png_bytes(np.rint(255 * np.clip(both / both.max(), 0, 1) ** (1 / 2.2)).astype(np.uint8)))


if __name__ == "__main__":
    sys.exit(run(main))
