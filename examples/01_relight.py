"""A finished reconstruction, seen four ways: photograph, refined normals, albedo, and lit from a side that was never photographed.

python examples/01_relight.py RESULT CAPTURE picture.png
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from mvps.command import run
from mvps.export import read_reconstruction
from mvps.illumination import Illumination
from mvps.layers import rendered
from mvps.load import read_capture
from mvps.pbr import srgb_bytes, white_level
from mvps.scene import CaptureError
from mvps.texture import png_bytes
from mvps.visibility import RayCaster

FINER = 3
"""Pixels of the picture to one of the photograph's."""


def main(argv: Sequence[str]) -> None:
    if len(argv) != 3:
        raise CaptureError(f"wanted RESULT CAPTURE picture.png, given {len(argv)} arguments")
    result, capture, out = argv
    reconstruction = read_reconstruction(Path(result))
    view = read_capture(capture).views[0]
    camera = replace(
        view.camera, K=np.diag([FINER, FINER, 1.0]) @ view.camera.K, height=FINER * view.camera.height, width=FINER * view.camera.width
    )
    # A light from the upper right, halfway to the camera. Camera axes: x right, y down, z forward.
    direction = np.array([[1.0, -1.0, -1.0]]) / np.sqrt(3) @ camera.rotation
    light = Illumination(direction, np.ones((1, 3)))
    layers, coverage = rendered(RayCaster(reconstruction.surface), reconstruction.material, camera, light, ("image", "albedo", "normals"))

    photo = np.full((*view.mask.shape, 3), white_level(view.radiance()[:, 0]), np.float32)
    photo[view.mask] = view.radiance()[:, 0]
    photo = cv2.resize(photo, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR)
    # Radiance and albedo are linear; screens want a curve. Normals are directions and stay as they are.
    on_object = coverage > 0
    photo, albedo, relit = (srgb_bytes(x / white_level(x[on_object])) for x in (photo, layers["albedo"], layers["image"]))
    local = layers["normals"] @ camera.rotation.T * (1, -1, -1)
    normals = np.rint(127.5 * (local + 1)).astype(np.uint8)

    rows, columns = np.nonzero(on_object)
    box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    paper = 255 * (1 - coverage[..., None])
    shown = [np.rint(x * coverage[..., None] + paper)[box].astype(np.uint8) for x in (photo, normals, albedo, relit)]
    Path(out).write_bytes(png_bytes(np.concatenate(shown, 1)))


if __name__ == "__main__":
    sys.exit(run(main))
