"""Pictures of a result from any camera under any light, as files: the whole way behind mvps.render's cameras and lights.

A file a camera and layer, CAMERA_LAYER.png: 8-bit sRGB with coverage as transparency, 16-bit linear, or EXR with the values as they are
(radiance, world units, unit vectors). In PNG normals are (n + 1) / 2, depth is near white to far black, from the nearest to the
farthest point of all the pictures, and albedo is over the object's white before any edit, as in the report, the meshes and edits. Videos
show what the 8-bit PNGs do, whatever the pictures' format.
"""

from __future__ import annotations

import shutil
import subprocess
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mvps.camera import DILIGENT_FROM_CAMERA
from mvps.edits import edited, read_edits
from mvps.export import read_reconstruction
from mvps.folders import appearing_whole
from mvps.illumination import Illumination, environment_lights
from mvps.layers import PIXELS_AT_A_TIME, Layer, rendered
from mvps.load import read_environment
from mvps.mesh import lengths, normalise
from mvps.pbr import reflectance_scale, srgb_bytes, white_level
from mvps.progress import Progress
from mvps.render import LARGEST
from mvps.rendering import light_senders
from mvps.same_object import capture_of, photographs_in
from mvps.scene import Camera, CaptureError, Float, Material, Reconstruction
from mvps.texture import png_bytes
from mvps.viewpoints import ball_around, look_at, read_cameras, turntable
from mvps.visibility import RayCaster, ray_caster

SHOULDER = (1.0, 1.0, 2.0)
"""Direction of the light where none is asked for; x right, y up, z towards the camera."""

FRAMES_PER_SECOND = 24
"""Of videos: cinema's."""


PREMULTIPLIED = ("exr", "png16")
"""Formats whose light is that of the whole pixel, what the object covers of it times what that part sends: so OpenEXR has it, and so it is
before black, where nothing tells the rest."""

LIGHT = ("image", "specular")
"""Layers of light. The others are values, which are those of the part that is covered."""


class Range(NamedTuple):
    """Of the values that all pictures of a command show: the factor of radiance, 0 while it is not known; depths that are white and
    black; the albedo that is white."""

    exposure: float
    nearest: float
    farthest: float
    white: float


def write_pictures(given: Namespace) -> None:
    """Renders what the options of mvps.render ask for into a new folder. CaptureError about everything that is wrong with them, and where
    the encoder of videos fails: then the folder has the pictures all the same, and the videos that came out."""
    result = read_reconstruction(given.result)
    cameras = chosen_cameras(given, result)
    sizes = {f"{camera.width} x {camera.height}": None for camera in cameras.values()}
    if given.video and len(sizes) > 1:
        raise CaptureError(f"--video: wanted cameras of one size, given {' and '.join([*sizes][:2])}; leave --video out")
    material = result.material
    if "edit" in given:
        seen_from = views_of(result, given.capture) if "capture" in given else cameras
        material = edited(result.surface, material, read_edits(given.edit), seen_from)
    environment = None
    if "envmap" in given:
        environment = environment_lights(read_environment(given.envmap), given.envmap_lights, np.array(given.up), given.envmap_turn)
    encoder = ffmpeg() if given.video else ""
    caster = ray_caster(result.surface)
    senders = None if given.no_bounce else light_senders(result.surface, material)
    failed = ""
    # What overflows is found by check_finite, which says it better.
    with appearing_whole(given.out) as writing, np.errstate(all="ignore"):
        frames = writing / ".frames" if given.video and given.format != "png" else writing
        frames.mkdir(exist_ok=True)
        depths = depths_of(given, caster, material, cameras)
        shown = Range(given.exposure if "exposure" in given else 0.0, *depths, reflectance_scale(result.material))
        with Progress().stage("render", total=len(cameras)) as stage:
            for name, camera in cameras.items():
                light = chosen_light(given, camera, environment, ball_around(result.surface)[0])
                exposing = not shown.exposure and not {"image", "specular"}.isdisjoint(given.layers)
                layers = tuple(dict.fromkeys((*given.layers, "image"))) if exposing else given.layers
                found, coverage = rendered(caster, material, camera, light, layers, senders)
                check_finite(found)
                shown = shown._replace(exposure=exposure_of(found["image"], coverage)) if exposing else shown
                for layer in given.layers:
                    write_layer(writing, f"{name}_{layer}", layer, found[layer], coverage, shown, given.format)
                    if frames != writing:
                        write_layer(frames, f"{name}_{layer}", layer, found[layer], coverage, shown, "png")
                stage.advance(1)
        for layer in given.layers if given.video else ():
            failed = failed or write_video(encoder, frames, list(cameras), layer, writing)
        if frames != writing:
            shutil.rmtree(frames)
    if failed:
        wanted = f"wanted a video of {len(cameras)} pictures, given an encoder that fails ({failed[:200]})"
        raise CaptureError(f"--video: {wanted}; the pictures are in {given.out}: make the video from them, or leave --video out")


def depths_of(given: Namespace, caster: RayCaster, material: Material, cameras: dict[str, Camera]) -> tuple[float, float]:
    """The nearest and the farthest depth in any of the pictures; only looked for where they are shown."""
    if "depth" not in given.layers or (given.format == "exr" and not given.video):
        return 0.0, 1.0
    seen = []
    with Progress().stage("depth", total=len(cameras)) as stage:
        for camera in cameras.values():
            found, coverage = rendered(caster, material, camera, Illumination(), ["depth"])
            check_finite(found)
            depth = found["depth"][coverage > 0]
            seen += [float(depth.min()), float(depth.max())] if len(depth) else []
            stage.advance(1)
    return min(seen, default=0.0), max(seen, default=1.0)


def exposure_of(image: Layer, coverage: Layer) -> float:
    """The factor that makes a picture's highlights white; 0 where it shows nothing or all is dark."""
    seen = image[coverage > 0]
    return min(1 / white_level(seen), LARGEST) if seen.any() else 0.0


def check_finite(found: dict[str, Layer]) -> None:
    """CaptureError where values are too large for a picture."""
    for layer, values in found.items():
        if not np.isfinite(values).all():
            raise CaptureError(
                f"{layer}: wanted values that are finite in single precision, given larger ones; try weaker lights, a camera nearer to the"
                " object, or milder edits"
            )


def chosen_cameras(given: Namespace, result: Reconstruction) -> dict[str, Camera]:
    """By name, those of the option that names any. CaptureError where two do."""
    width, height = given.size
    named = [f"--{option}" for option in ("cameras", "camera", "turntable") if option in given]
    if len(named) > 1:
        raise CaptureError(f"wanted one of --cameras, --camera and --turntable, given {' and '.join(named)}")
    centre, _ = ball_around(result.surface)
    if "cameras" in given:
        return read_cameras(given.cameras)
    if "camera" in given:
        target = np.array(given.target) if "target" in given else centre
        return {"camera": look_at(np.array(given.camera), target, np.array(given.up), width, height, given.fov)}
    if "capture" in given and "turntable" not in given:
        return views_of(result, given.capture, given.views if "views" in given else None)
    frames = given.turntable if "turntable" in given else 1
    if not 1 <= frames <= 9999:
        raise CaptureError(f"--turntable: wanted 1 to 9999 frames, given {frames}")
    around = turntable(result.surface, frames, given.elevation, np.array(given.up), width, height, given.fov)
    return {f"turn_{k:04d}": camera for k, camera in enumerate(around, 1)}


def views_of(result: Reconstruction, capture: Path, views: Sequence[int] | None = None) -> dict[str, Camera]:
    """Cameras of a capture's views, by names: of those with these numbers, or of the result's."""
    own = photographs_in(result, capture)[0]
    return {view.name: view.camera for view in capture_of(result, capture, views or own, [1]).views}


def chosen_light(given: Namespace, camera: Camera, environment: Illumination | None, centre: Float) -> Illumination:
    """All lights that the options name, as a camera sees them; world frame. centre (3,): the object's."""
    to_world = camera.rotation.T @ DILIGENT_FROM_CAMERA if given.frame == "camera" else np.eye(3)
    directional, points = list(given.light), given.point
    if not directional and not points and environment is None:
        to_world, directional = camera.rotation.T @ DILIGENT_FROM_CAMERA, [SHOULDER]
    if any(lengths(np.array(light[:3])) == 0 for light in directional):
        raise CaptureError("--light: wanted a direction, given 0,0,0")
    directions = normalise(np.array([light[:3] for light in directional]).reshape(-1, 3) @ to_world.T)
    colours, strengths = (np.array([x[3:] or (1.0,) * 3 for x in lights]).reshape(-1, 3) for lights in (directional, points))
    if (colours < 0).any() or (strengths < 0).any():
        raise CaptureError("--light, --point: wanted intensities of 0 and more, given a negative one")
    places = np.array([point[:3] for point in points]).reshape(-1, 3)
    places = places @ to_world.T + centre if given.frame == "camera" else places
    own = Illumination(directions, colours, places, strengths * (lengths(places - centre) ** 2)[:, None])
    return own if environment is None else own.with_also(environment)


def as_shown(layer: str, values: Layer, coverage: Layer, shown: Range) -> Layer:
    """The values of a layer, linear in [0, 1]: what a PNG holds."""
    if layer == "normals":
        return np.float32(0.5) * (values + np.float32(1))
    if layer == "depth":
        depth: Layer = 1 - (values - shown.nearest) / max(shown.farthest - shown.nearest, 1e-12)
        return np.where(coverage > 0, depth, 0).astype(np.float32)
    if layer == "albedo":
        return values / np.float32(shown.white)
    return values * np.float32((shown.exposure or 1.0) if layer in LIGHT else 1.0)


def write_layer(folder: Path, name: str, layer: str, values: Layer, coverage: Layer, shown: Range, form: str) -> None:
    """One file. form: one of mvps.render's formats."""
    if form in PREMULTIPLIED and layer in LIGHT:
        values = values * coverage[..., None]
    if form == "exr":
        write_exr(folder / f"{name}.exr", values, coverage)
        return
    rows = max(1, PIXELS_AT_A_TIME // values.shape[1])
    parts = [slice(start, start + rows) for start in range(0, len(values), rows)]
    coded = np.concatenate([code_values(layer, values[part], coverage[part], shown, form) for part in parts])
    (folder / f"{name}.png").write_bytes(png_bytes(coded))


def code_values(layer: str, values: Layer, coverage: Layer, shown: Range, form: str) -> NDArray[Any]:
    """What a PNG stores of some rows: 16 bits, or 8 bits with coverage as transparency."""
    part = as_shown(layer, values, coverage, shown).clip(0, 1)
    if form == "png16":
        linear: NDArray[np.uint16] = np.rint(part * 65535).astype(np.uint16)
        return linear
    # Radiance and albedo are linear and screens are not; the others are no light.
    colour = srgb_bytes(part) if layer in ("image", "specular", "albedo") else np.rint(part * 255).astype(np.uint8)
    colour = colour if colour.ndim == 3 else np.repeat(colour[..., None], 3, axis=2)
    alpha = np.rint(coverage * 255).astype(np.uint8)[..., None]
    coded: NDArray[np.uint8] = np.concatenate([colour, alpha], axis=2)
    return coded


def write_exr(path: Path, values: Layer, coverage: Layer) -> None:
    """32-bit floats: channels R, G, B or Y, and A."""
    import OpenEXR

    planes = np.moveaxis(values, 2, 0) if values.ndim == 3 else values[None]
    parts = {name: np.ascontiguousarray(plane) for name, plane in zip("RGB" if len(planes) == 3 else "Y", planes, strict=True)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {**parts, "A": np.ascontiguousarray(coverage)}).write(str(path))


def ffmpeg() -> str:
    """The encoder's program. CaptureError where imageio-ffmpeg is not installed."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError:
        found = shutil.which("ffmpeg")
        if found is None:
            raise CaptureError('--video: wanted imageio-ffmpeg or a program ffmpeg, given neither; pip install "mvps[video]"') from None
        return found
    return str(get_ffmpeg_exe())


def write_video(encoder: str, folder: Path, names: list[str], layer: str, out: Path) -> str:
    """LAYER.mp4 in the folder `out`, of the 8-bit pictures NAME_LAYER.png in their order, on white. What the encoder says where it fails,
    and then no file; else empty."""
    listed, video = folder / f".{layer}.txt", out.resolve() / f"{layer}.mp4"
    listed.write_text("".join(f"file '{name}_{layer}.png'\nduration {1 / FRAMES_PER_SECOND}\n" for name in names), encoding="utf-8")
    even = "format=rgba,pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white@0"
    onto_white = f"{even},split[a][b];[b]drawbox=c=white:t=fill:replace=1[w];[w][a]overlay,format=yuv420p"
    # Unless told that names are safe the encoder refuses spaces, + and letters beyond ASCII, which cameras' names may have.
    reading = ["-f", "concat", "-safe", "0", "-i", listed.name]
    command = [encoder, "-v", "error", *reading, "-filter_complex", onto_white, "-r", str(FRAMES_PER_SECOND), str(video)]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
        failed = (done.stderr.strip() or f"exit status {done.returncode}") if done.returncode else ""
    except OSError as error:
        failed = error.strerror or "it does not start"
    listed.unlink()
    if failed:
        video.unlink(missing_ok=True)
    return failed
