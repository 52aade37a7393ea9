"""The whole way from Python: read a capture, check it, reconstruct it, write the result, look at a view of it.

python examples/03_reconstruct.py CAPTURE RESULT picture.png
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from mvps.load import read_capture
from mvps.progress import Progress
from mvps.reconstruct import Settings, reconstruct, write
from mvps.render import render_view
from mvps.sound import sound
from mvps.visibility import RayCaster


def main(path: str, result: str, out: str) -> None:
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
    cv2.imwrite(out, np.rint(255 * np.clip(both / both.max(), 0, 1) ** (1 / 2.2)).astype(np.uint8)[..., ::-1])


if __name__ == "__main__":
    main(*sys.argv[1:4])
