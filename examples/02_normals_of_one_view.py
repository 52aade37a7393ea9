"""Normals of a single view: photographs from one camera, lights not known, an open surface out.

python examples/02_normals_of_one_view.py CAPTURE picture.png
"""

import sys

import cv2
import numpy as np

from mvps.export import normal_picture
from mvps.load import read_capture
from mvps.progress import Progress
from mvps.reconstruct import Settings, reconstruct


def main(path: str, out: str) -> None:
    capture = read_capture(path, views=[1])
    result = reconstruct(capture, Settings(path, preset="draft"), None, Progress())
    print(result.metrics["status"]["text"])

    # Left the mean photograph, right the normals: red to the right, green upwards, blue towards the camera.
    view = capture.views[0]
    photograph = np.zeros((*view.mask.shape, 3))
    photograph[view.mask] = view.radiance().mean(1)
    photograph = np.rint(255 * np.clip(photograph / photograph.max(), 0, 1) ** (1 / 2.2)).astype(np.uint8)
    normals = result.normal_maps[0] @ view.camera.rotation.T * (1, -1, -1)
    cv2.imwrite(out, np.concatenate([photograph, normal_picture(normals)], 1)[..., ::-1])


if __name__ == "__main__":
    main(*sys.argv[1:3])
