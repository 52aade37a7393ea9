"""Pictures of a result: a capture's views under their own lights, or any camera under any light.

    python -m mvps.render RESULT --capture CAPTURE --views 4,8 --out DIR

writes DIR/view_04/001.png and so on: linear 16-bit RGB at the capture's exposure (65535 is what saturates the photographs),
named by the lights' numbers, black where no surface is, and mask.png, white where one is. Given a light or a camera,

    python -m mvps.render RESULT --turntable 72 --envmap studio.hdr --out DIR --video

it writes DIR/turn_0001_image.png and so on, a picture a camera and layer (new_pictures.py).
"""

from __future__ import annotations

from argparse import SUPPRESS, ArgumentTypeError, Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mvps.command import finite, number_list, parse, parser, positive, run, whole
from mvps.scene import CaptureError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mvps.gleam import Senders
    from mvps.scene import Camera, Reconstruction
    from mvps.visibility import RayCaster

WHITE = 65535
SAMPLES_PER_CHUNK = 1 << 22
LAYERS = ("image", "albedo", "specular", "normals", "depth", "shadow", "confidence")
"""What layers.py renders, by name; here, because --help does not wait for it."""
FORMATS = ("png", "png16", "exr")
LARGEST = 1e12
"""Of an option's numbers: radiance times exposure, and light over a squared distance, are numbers in single precision too."""


def render_view(
    caster: RayCaster, reconstruction: Reconstruction, view: str, camera: Camera, senders: Senders | None = None
) -> tuple[NDArray[np.uint16], NDArray[np.bool_]]:
    """Code values (height, width, lights, 3) of a view of the result under its lights, and where the surface is (height, width).

    senders: what sends light to other parts (rendering.light_senders). CaptureError where the result has no such view.
    """
    import numpy as np

    from mvps.rendering import RAYS_ACROSS, light_arriving, photograph
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
    arriving = light_arriving(senders, direction, camera.centre)
    step = max(1, SAMPLES_PER_CHUNK // max(1, len(direction)))
    for start in range(0, len(chosen), step):
        part = chosen[start : start + step]
        radiance = photograph(caster, reconstruction.material, camera, every[part], direction, intensity, arriving, RAYS_ACROSS)
        image[part] = np.rint((radiance * WHITE).clip(0, WHITE)).astype(np.uint16)
    return image.reshape(camera.height, camera.width, -1, 3), hit.reshape(camera.height, camera.width)


def render_views(
    result: Path, capture: Path, views: Sequence[int] | None, out: Path, edit: Path | None = None, bounce: bool = True
) -> None:
    """Re-render views (numbers from 1; None: all of the result's) of a result with the capture's cameras into a new folder. edit: a file of
    edits of the material; bounce: with light that surfaces send each other."""
    from dataclasses import replace

    import numpy as np

    from mvps.edits import edited, read_edits
    from mvps.export import read_reconstruction
    from mvps.folders import appearing_whole
    from mvps.progress import Progress
    from mvps.rendering import light_senders
    from mvps.same_object import capture_of, photographs_in
    from mvps.scene import CaptureError
    from mvps.texture import png_bytes
    from mvps.visibility import ray_caster

    reconstruction = read_reconstruction(result)
    # Only the cameras are needed; one photograph of each view is the least that a capture can be read with.
    own = photographs_in(reconstruction, capture)[0]
    found = capture_of(reconstruction, capture, views or own, [1]).views
    chosen = [view for view in found if views is not None or view.name in reconstruction.views]
    if not chosen:
        raise CaptureError(
            f"{capture}: wanted the capture of the result's {', '.join(reconstruction.views)}, given one without these views"
        )
    if edit is not None:
        cameras = {view.name: view.camera for view in capture_of(reconstruction, capture, own, [1]).views}
        material = edited(reconstruction.surface, reconstruction.material, read_edits(edit), cameras)
        reconstruction = replace(reconstruction, material=material)
    caster = ray_caster(reconstruction.surface)
    senders = light_senders(reconstruction.surface, reconstruction.material) if bounce else None
    with appearing_whole(out) as writing, Progress().stage("render", total=len(chosen)) as stage:
        for view in chosen:
            image, mask = render_view(caster, reconstruction, view.name, view.camera, senders)
            folder = writing / view.name
            folder.mkdir()
            (folder / "mask.png").write_bytes(png_bytes(np.where(mask, 255, 0).astype(np.uint8)))
            for k, number in enumerate(reconstruction.light_names[reconstruction.views.index(view.name)]):
                (folder / f"{number:03d}.png").write_bytes(png_bytes(image[:, :, k]))
            stage.advance(1)


def numbers(counts: tuple[int, ...], wanted: str) -> Callable[[str], tuple[float, ...]]:
    """A type for options of that many finite numbers, separated by commas; wanted: in words."""

    def numbers_(text: str) -> tuple[float, ...]:
        try:
            found = tuple(float(word) for word in text.split(","))
        except ValueError:
            found = ()
        if len(found) not in counts or not all(abs(x) <= LARGEST for x in found):
            raise ArgumentTypeError(f"wanted {wanted}, separated by commas, up to {LARGEST:g}, given {text!r}")
        return found

    return numbers_


def direction(text: str) -> tuple[float, ...]:
    """Three numbers that are not all zero."""
    found = numbers((3,), "three numbers")(text)
    if not any(found):
        raise ArgumentTypeError(f"wanted a direction, given {text!r}")
    return found


def size(text: str) -> tuple[int, int]:
    """Width and height: "800x600"."""
    words = text.lower().split("x")
    if len(words) != 2 or not all(word.isdecimal() and 1 <= int(word) <= 16384 for word in words):
        raise ArgumentTypeError(f"wanted width and height such as 800x600, up to 16384, given {text!r}")
    return int(words[0]), int(words[1])


def angle(text: str) -> float:
    """Degrees from 0.01, from where on cameras are not too far away for single precision, to below 180."""
    degrees = positive(text)
    if not 0.01 <= degrees < 180:
        raise ArgumentTypeError(f"wanted degrees below 180, 0.01 at least, given {text!r}")
    return degrees


def factor(text: str) -> float:
    """A number above zero."""
    number = positive(text)
    if not 1 / LARGEST <= number <= LARGEST:
        raise ArgumentTypeError(f"wanted {1 / LARGEST:g} to {LARGEST:g}, given {text!r}")
    return number


def count(text: str) -> int:
    """A whole number from 1 to 65536."""
    number = whole(text)
    if not 1 <= number <= 65536:
        raise ArgumentTypeError(f"wanted 1 to 65536, given {text!r}")
    return number


def layer_list(text: str) -> tuple[str, ...]:
    """Names of layers, separated by commas."""
    names = tuple(word.strip() for word in text.split(","))
    for name in names:
        if name not in LAYERS:
            raise ArgumentTypeError(f"wanted some of {', '.join(LAYERS)}, given {name!r}")
    return tuple(dict.fromkeys(names))


def options() -> Any:
    """The command line's parser."""
    made = parser(
        "mvps.render",
        "Pictures of a result. With --capture and no more than --views, --edit, --no-bounce: its views, each under its own lights,\n"
        "as linear 16-bit PNG files DIR/view_04/001.png and so on, at the exposure of the photographs; mask.png beside them shows\n"
        "where the surface is. With a light or a camera of your own, layers, a format, an exposure or a video:\n"
        "DIR/CAMERA_LAYER.png, transparent where nothing is.",
    )
    made.add_argument("result", type=Path, metavar="RESULT", help="folder that mvps.reconstruct wrote")
    made.add_argument("--out", type=Path, required=True, default=SUPPRESS, metavar="DIR", help="new folder for the images")
    vector, colour = numbers((3,), "three numbers"), numbers((3, 6), "three numbers, or six with red, green and blue")
    cameras = made.add_argument_group("cameras", "of a capture, or one of the others; a turntable of one frame if none is given")
    cameras.add_argument("--capture", type=Path, default=SUPPRESS, metavar="CAPTURE", help="folder of the photographs, for its cameras")
    cameras.add_argument("--views", type=number_list, default=SUPPRESS, metavar="N,N", help="of the capture's views; all if left out")
    cameras.add_argument("--camera", type=vector, default=SUPPRESS, metavar="X,Y,Z", help="place of a camera, world units")
    cameras.add_argument("--target", type=vector, default=SUPPRESS, metavar="X,Y,Z", help="what it looks at; else the object's middle")
    cameras.add_argument("--turntable", type=int, default=SUPPRESS, metavar="FRAMES", help="cameras evenly around the object")
    cameras.add_argument("--elevation", type=finite, default=15.0, metavar="DEG", help="of the turntable's cameras above the horizon")
    cameras.add_argument("--cameras", type=Path, default=SUPPRESS, metavar="FILE", help=CAMERAS_HELP)
    cameras.add_argument("--up", type=direction, default=UP, metavar="X,Y,Z", help=UP_HELP)
    cameras.add_argument("--fov", type=angle, default=30.0, metavar="DEG", help="field of view of --camera and --turntable")
    cameras.add_argument("--size", type=size, default=(640, 640), metavar="WxH", help="pixels of --camera and --turntable")
    lights = made.add_argument_group("lights", "together; without any, one from above the camera's right shoulder")
    lights.add_argument("--light", type=colour, action="append", default=[], metavar="X,Y,Z[,R,G,B]", help="towards a light; its intensity")
    lights.add_argument("--point", type=colour, action="append", default=[], metavar="X,Y,Z[,R,G,B]", help=POINT_HELP)
    lights.add_argument("--envmap", type=Path, default=SUPPRESS, metavar="FILE", help="environment map, .hdr or .exr, equirectangular")
    lights.add_argument("--envmap-turn", type=finite, default=0.0, metavar="DEG", help="turn of the environment about --up")
    lights.add_argument("--envmap-lights", type=count, default=256, metavar="N", help="directional lights that stand for it")
    lights.add_argument("--frame", choices=("world", "camera"), default="world", help=FRAME_HELP)
    lights.add_argument("--no-bounce", action="store_true", help="without light that surfaces send each other")
    pictures = made.add_argument_group("pictures")
    pictures.add_argument("--layers", type=layer_list, default=("image",), metavar="NAMES", help=LAYERS_HELP)
    pictures.add_argument("--format", choices=FORMATS, default="png", help="8-bit sRGB, 16-bit linear, or EXR: values as they are")
    pictures.add_argument(
        "--exposure",
        type=factor,
        default=SUPPRESS,
        metavar="X",
        help=EXPOSURE_HELP,
    )
    pictures.add_argument("--video", action="store_true", help="an MP4 of each layer too (needs imageio-ffmpeg)")
    pictures.add_argument("--edit", type=Path, default=SUPPRESS, metavar="FILE", help="edits of the material (docs/edits.md)")
    return made


CAMERAS_HELP = 'JSON: {"cameras": [{"name", "K", "rotation", "translation", "width", "height"}]}, camera_from_world, OpenCV axes'
POINT_HELP = "place of a point of light, world units; its intensity at the object's middle"
UP = (0.0, 0.0, 1.0)
UP_HELP = "upwards in the world, for --camera, --turntable and --envmap"
LAYERS_HELP = f"some of {','.join(LAYERS)}; albedo in PNG and videos is over the object's white, whatever --exposure is"
EXPOSURE_HELP = "factor of radiance, in image and specular; if left out, highlights of the first picture that shows the object become white"
FRAME_HELP = "of --light and --point; camera: x right, y up, z towards the camera, fixed to each camera, its origin in the object's middle"
OWN = ("camera", "turntable", "cameras", "envmap")


def asks_for_own(given: Namespace) -> bool:
    """Whether the options want more than a capture's views under their own lights."""
    plain = given.layers == ("image",) and given.format == "png" and not (given.video or "exposure" in given)
    return not plain or bool(given.light or given.point) or any(name in given for name in OWN)


def check_used(given: Namespace) -> None:
    """CaptureError about an option of a camera or a light that is not there."""
    placed = any(name in given for name in ("camera", "turntable", "cameras"))
    around = "turntable" in given or not (placed or "capture" in given)
    own = around or "camera" in given
    uses = {
        "target": ("camera" in given, "--camera"),
        "views": ("capture" in given and not placed, "--capture, for its cameras"),
        "elevation": (around, "--turntable"),
        "size": (own, "--camera or --turntable"),
        "fov": (own, "--camera or --turntable"),
        "up": (own or "envmap" in given, "--camera, --turntable or --envmap"),
        "envmap_turn": ("envmap" in given, "--envmap"),
        "envmap_lights": ("envmap" in given, "--envmap"),
        "frame": (bool(given.light or given.point), "--light or --point"),
    }
    made = options()
    for name, (used, wanted) in uses.items():
        if not used and name in given and getattr(given, name) != made.get_default(name):
            raise CaptureError(f"--{name.replace('_', '-')}: wanted together with {wanted}, given without; leave it out")


def main(argv: Sequence[str]) -> None:
    """The command line."""
    given = parse(options(), argv)
    own = asks_for_own(given)
    if not own and "capture" not in given:
        raise CaptureError("wanted --capture for the photographs' views, or a light or a camera, given neither; see --help")
    check_used(given)
    if not own:
        views, edit = (getattr(given, name, None) for name in ("views", "edit"))
        render_views(given.result, given.capture, views, given.out, edit, not given.no_bounce)
        return
    from mvps.new_pictures import write_pictures

    write_pictures(given)


if __name__ == "__main__":
    raise SystemExit(run(main))
