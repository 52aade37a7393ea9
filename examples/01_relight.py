"""A finished reconstruction, seen four ways: photograph, refined normals, albedo, and lit from a side that was never photographed.

python examples/01_relight.py RESULT CAPTURE picture.png
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from mvps.export import read_reconstruction
from mvps.load import read_capture
from mvps.rendering import photograph, points_under
from mvps.visibility import RayCaster


def picture(view, values):
    """Values (pixels, 3) of a view's foreground pixels as an image, white around the object."""
    image = np.ones((*view.mask.shape, 3))
    image[view.mask] = np.clip(values, 0, 1)
    rows, columns = np.nonzero(view.mask)
    return image[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]


def main(result: str, capture: str, out: str) -> None:
    reconstruction = read_reconstruction(Path(result))
    view = read_capture(capture).views[0]
    caster = RayCaster(reconstruction.surface)
    points = points_under(caster, reconstruction.material, view.camera, view.pixels)

    # A light from the upper right, halfway to the camera. Camera axes: x right, y down, z forward.
    light = np.array([[1.0, -1.0, -1.0]]) / np.sqrt(3) @ view.camera.rotation
    relit = photograph(caster, reconstruction.material, view.camera, view.pixels, light, np.ones((1, 3)))[:, 0]
    brightest = np.quantile(relit, 0.99)

    photo = view.radiance()[:, 0]
    local = points.normal @ view.camera.rotation.T * (1, -1, -1)
    albedo = points.albedo / np.quantile(points.albedo, 0.99)
    layers = [photo / np.quantile(photo, 0.99), (local + 1) / 2, albedo, relit / brightest]
    # Radiance and albedo are linear; screens want a gamma. Normals are directions and stay as they are.
    shown = [picture(view, np.clip(layer, 0, 1) ** (1 if i == 1 else 1 / 2.2)) for i, layer in enumerate(layers)]
    row = cv2.resize(np.concatenate(shown, 1), None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(out, np.rint(255 * np.clip(row, 0, 1)).astype(np.uint8)[..., ::-1])


if __name__ == "__main__":
    main(*sys.argv[1:4])
