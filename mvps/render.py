"""Re-render views of a capture under their own lights, as its photographs were taken.

    python -m mvps.render RESULT --capture CAPTURE --views 4,8 --out DIR

writes DIR/view_04/001.png and so on: linear 16-bit RGB at the capture's exposure (65535 is what saturates the photographs),
named by the lights' numbers, black where no surface is, and mask.png, white where one is.
"""

from __future__ import annotations

from argparse import SUPPRESS
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mvps.command import number_list, parse, parser, run

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mvps.bounce import Sources
    from mvps.scene import Camera, Reconstruction
    from mvps.visibility import RayCaster

WHITE = 65535
SAMPLES_PER_CHUNK = 1 << 22


def render_view(
    caster: RayCaster, reconstruction: Reconstruction, view: str, camera: Camera, sources: Sources | None = None
) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Code values (height, width, lights, 3) of a view of the result under its lights, and where the surface is (height, width).

    sources: what sends light to other parts (rendering.light_sources). CaptureError where the result has no such view.
    """
    import numpy as np

    from mvps.rendering import light_arriving, photograph
    from mvps.scene import CaptureError
    from mvps.visibility import camera_hits

    if view not in reconstruction.views:
        raise CaptureError(f"views: wanted one of the result's {', '.join(reconstruction.views)}, given {view}; choose other --views")
    position = reconstruction.views.index(view)
    direction, intensity = reconstruction.lights.direction[position], reconstruction.lights.intensity[position]
    every = np.indices((camera.height, camera.width)).reshape(2, -1).T
    hit = camera_hits(caster, camera, every).face >= 0
    image = np.zeros((len(every), len(direction), 3), np.uint16)
    chosen = np.flatnonzero(hit)
    arriving = light_arriving(sources, reconstruction.material, direction)
    step = max(1, SAMPLES_PER_CHUNK // max(1, len(direction)))
    for start in range(0, len(chosen), step):
        part = chosen[start : start + step]
        radiance = photograph(caster, reconstruction.material, camera, every[part], direction, intensity, arriving)
        image[part] = np.rint((radiance * WHITE).clip(0, WHITE)).astype(np.uint16)
    return image.reshape(camera.height, camera.width, -1, 3), hit.reshape(camera.height, camera.width)


def render_views(result: Path, capture: Path, views: Sequence[int] | None, out: Path) -> None:
    """Re-render views (numbers from 1; None: all of the result's) of a result with the capture's cameras into a new folder."""
    import numpy as np

    from mvps.export import read_reconstruction
    from mvps.folders import appearing_whole
    from mvps.load import read_capture
    from mvps.progress import Progress
    from mvps.rendering import light_sources
    from mvps.scene import CaptureError
    from mvps.texture import png_bytes
    from mvps.visibility import ray_caster

    reconstruction = read_reconstruction(result)
    # Only the cameras are needed; one photograph of each view is the least that a capture can be read with.
    found = read_capture(capture, views=views, lights=[1]).views
    chosen = [view for view in found if views is not None or view.name in reconstruction.views]
    if not chosen:
        raise CaptureError(
            f"{capture}: wanted the capture of the result's {', '.join(reconstruction.views)}, given one without these views"
        )
    caster, sources = ray_caster(reconstruction.surface), light_sources(reconstruction.surface, reconstruction.material)
    with appearing_whole(out) as writing, Progress().stage("render", total=len(chosen)) as stage:
        for view in chosen:
            image, mask = render_view(caster, reconstruction, view.name, view.camera, sources)
            folder = writing / view.name
            folder.mkdir()
            (folder / "mask.png").write_bytes(png_bytes(np.where(mask, 255, 0).astype(np.uint8)))
            for k, number in enumerate(reconstruction.light_names[reconstruction.views.index(view.name)]):
                (folder / f"{number:03d}.png").write_bytes(png_bytes(image[:, :, k]))
            stage.advance(1)


def main(argv: Sequence[str]) -> None:
    """The command line."""
    made = parser(
        "mvps.render",
        "Re-render views of a capture from a result, each under its own lights, as linear 16-bit PNG files\n"
        "DIR/view_04/001.png and so on, at the exposure of the photographs; mask.png beside them shows where the surface is.",
    )
    made.add_argument("result", type=Path, metavar="RESULT", help="folder that mvps.reconstruct wrote")
    made.add_argument(
        "--capture", type=Path, required=True, default=SUPPRESS, metavar="CAPTURE", help="folder of the photographs, for its cameras"
    )
    made.add_argument(
        "--views",
        type=number_list,
        default=SUPPRESS,
        metavar="N,N",
        help="numbers of views, counted from 1; all of the result's if left out",
    )
    made.add_argument("--out", type=Path, required=True, default=SUPPRESS, metavar="DIR", help="new folder for the images")
    options = parse(made, argv)
    render_views(options.result, options.capture, options.views if "views" in options else None, options.out)


if __name__ == "__main__":
    raise SystemExit(run(main))
