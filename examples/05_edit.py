"""The same object of other materials: as it is, turned in hue, polished, of gold.

python examples/05_edit.py RESULT picture.png
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvps.command import run
from mvps.edits import edited
from mvps.export import read_reconstruction
from mvps.illumination import Illumination
from mvps.layers import rendered
from mvps.pbr import srgb_bytes, white_level
from mvps.scene import CaptureError
from mvps.texture import png_bytes
from mvps.viewpoints import turntable
from mvps.visibility import RayCaster

EDITS = ([], [{"albedo": {"hue_deg": 120}}], [{"preset": "polished"}], [{"preset": "gold"}])


def main(argv: Sequence[str]) -> None:
    if len(argv) != 2:
        raise CaptureError(f"wanted RESULT picture.png, given {len(argv)} arguments")
    result, out = argv
    reconstruction = read_reconstruction(Path(result))
    surface, caster = reconstruction.surface, RayCaster(reconstruction.surface)
    (camera,) = turntable(surface, 1, 15.0, np.array([0.0, 0.0, 1.0]), 240, 240)

    # Two lights in the camera's frame (x right, y down, z forward): from the right above, and a weaker one from the left.
    direction = np.array([[0.5, -0.6, -0.62], [-0.7, -0.1, -0.7]])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    light = Illumination(direction @ camera.rotation, np.array([[1.0, 1.0, 1.0], [0.3, 0.35, 0.4]]))

    pictures, white = [], 0.0
    for edits in EDITS:
        material = edited(surface, reconstruction.material, edits, {})
        layers, coverage = rendered(caster, material, camera, light, ("image",))
        white = white or white_level(layers["image"][coverage > 0])
        pictures.append(srgb_bytes(layers["image"] / white * coverage[..., None] + 1 - coverage[..., None]))
    Path(out).write_bytes(png_bytes(np.concatenate(pictures, 1)))


if __name__ == "__main__":
    sys.exit(run(main))
