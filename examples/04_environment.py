"""A result under the light of a place: an environment map, turned about the object in four steps.

python examples/04_environment.py RESULT ENVIRONMENT.hdr picture.png
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mvps.command import run
from mvps.export import read_reconstruction
from mvps.illumination import environment_lights
from mvps.layers import rendered
from mvps.load import read_environment
from mvps.pbr import srgb_bytes, white_level
from mvps.scene import CaptureError
from mvps.texture import png_bytes
from mvps.viewpoints import turntable
from mvps.visibility import RayCaster

UP = np.array([0.0, 0.0, 1.0])


def main(argv: Sequence[str]) -> None:
    if len(argv) != 3:
        raise CaptureError(f"wanted RESULT ENVIRONMENT.hdr picture.png, given {len(argv)} arguments")
    result, environment, out = argv
    reconstruction, sky = read_reconstruction(Path(result)), read_environment(environment)
    caster = RayCaster(reconstruction.surface)
    (camera,) = turntable(reconstruction.surface, 1, 15.0, UP, 240, 240)

    pictures, white = [], 0.0
    for turn in (0.0, 90.0, 180.0, 270.0):
        # 128 directional lights stand for the environment; together they send what it sends.
        light = environment_lights(sky, 128, UP, turn)
        layers, coverage = rendered(caster, reconstruction.material, camera, light, ("image",))
        # One exposure for all, from the first.
        white = white or white_level(layers["image"][coverage > 0])
        pictures.append(srgb_bytes(layers["image"] / white * coverage[..., None] + 1 - coverage[..., None]))
    Path(out).write_bytes(png_bytes(np.concatenate(pictures, 1)))


if __name__ == "__main__":
    sys.exit(run(main))
