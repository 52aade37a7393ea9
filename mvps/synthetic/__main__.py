"""python -m mvps.synthetic --out DIR: make a capture whose answer is known."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from mvps.command import parse, parser, run
from mvps.progress import Progress
from mvps.synthetic.settings import SceneSettings


def main(argv: Sequence[str]) -> None:
    """The command line."""
    default = SceneSettings()
    made = parser(
        "mvps.synthetic",
        "Make a capture with ground truth, in the layout of DiLiGenT-MV: an object 150 mm large with folds, a bowl, patches of\n"
        "albedo and a glossy side, rendered with attached and cast shadows, noise and clipping, but no inter-reflection.",
    )
    made.add_argument("--out", type=Path, required=True, metavar="DIR", default=argparse.SUPPRESS, help="folder to make")
    whole = {"views": "number of camera positions", "lights": "photographs per view", "size": "height and width of the images, pixels"}
    for name, text in (whole | {"seed": "of everything random"}).items():
        made.add_argument(f"--{name}", type=int, default=getattr(default, name), metavar="N", help=text)
    for name, text in {"strength": "factor of the specular part; 0: Lambertian", "noise": "noise, as a share of the largest value"}.items():
        made.add_argument(f"--{name}", type=float, default=getattr(default, name), metavar="X", help=text)
    made.add_argument(
        "--free-lights", action="store_true", help="other lights in every view, instead of one rig that moves with the camera"
    )
    options = parse(made, argv)
    names = ("views", "lights", "size", "seed", "strength", "noise", "free_lights")
    # Late, because these import Embree and libigl, which --help need not wait for.
    from mvps.synthetic.files import checked_place, write_capture
    from mvps.synthetic.scene import make_scene, render_capture

    settings = SceneSettings(**{name: getattr(options, name) for name in names})
    checked_place(options.out)
    progress = Progress()
    with progress.stage("shape"):
        scene = make_scene(settings)
    with progress.stage("photographs"):
        capture, truth = render_capture(settings, scene)
    with progress.stage("files"):
        write_capture(capture, truth, options.out)


if __name__ == "__main__":
    raise SystemExit(run(main))
