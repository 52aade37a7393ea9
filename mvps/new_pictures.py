"""Pictures of a result from any camera under any light, as files: the whole way behind mvps.render's cameras and lights.

A file a camera and layer, CAMERA_LAYER.png: 8-bit sRGB with coverage as transparency, 16-bit linear, or EXR with the values as they are
(radiance, world units, unit vectors). In PNG normals are (n + 1) / 2 and depth is near white to far black.
"""

from __future__ import annotations

import shutil
import subprocess
from argparse import Namespace
from pathlib import Path

import numpy as np

from mvps.camera import DILIGENT_FROM_CAMERA
from mvps.edits import edited, read_edits
from mvps.export import read_reconstruction
from mvps.folders import appearing_whole
from mvps.illumination import Illumination, environment_lights
from mvps.layers import Layer, rendered
from mvps.load import read_environment
from mvps.mesh import lengths, normalise
from mvps.pbr import srgb_bytes, white_level
from mvps.progress import Progress
from mvps.rendering import light_senders
from mvps.same_object import capture_of
from mvps.scene import Camera, CaptureError, Float, Reconstruction
from mvps.texture import png_bytes
from mvps.viewpoints import ball_around, look_at, read_cameras, turntable
from mvps.visibility import ray_caster

SHOULDER = (1.0, 1.0, 2.0)
"""Direction of the light where none is asked for; x right, y up, z towards the camera."""

FRAMES_PER_SECOND = 24
"""Of videos: cinema's."""


def write_pictures(given: Namespace) -> None:
    """Renders what the options of mvps.render ask for into a new folder. CaptureError about everything that is wrong with them."""
    if given.video and given.format == "exr":
        raise CaptureError("--video: wanted pictures in png or png16 to make it of, given --format exr")
    result = read_reconstruction(given.result)
    cameras = chosen_cameras(given, result)
    material = result.material
    if "edit" in given:
        seen_from = {v.name: v.camera for v in capture_of(result, given.capture, lights=[1]).views} if "capture" in given else cameras
        material = edited(result.surface, material, read_edits(given.edit), seen_from)
    environment = None
    if "envmap" in given:
        environment = environment_lights(read_environment(given.envmap), given.envmap_lights, np.array(given.up), given.envmap_turn)
    encoder = ffmpeg() if given.video else ""
    caster = ray_caster(result.surface)
    senders = None if given.no_bounce else light_senders(result.surface, material)
    exposure = given.exposure if "exposure" in given else 0.0
    with appearing_whole(given.out) as writing, Progress().stage("render", total=len(cameras)) as stage:
        for name, camera in cameras.items():
            light = chosen_light(given, camera, environment, ball_around(result.surface)[0])
            found, coverage = rendered(caster, material, camera, light, given.layers, senders)
            if "image" in found and not exposure:
                exposure = 1 / white_level(found["image"][coverage > 0])
            for layer, values in found.items():
                write_layer(writing, f"{name}_{layer}", layer, values, coverage, exposure or 1.0, given.format)
            stage.advance(1)
        for layer in given.layers if given.video else ():
            write_video(encoder, writing, list(cameras), layer)


def chosen_cameras(given: Namespace, result: Reconstruction) -> dict[str, Camera]:
    """By name, those of the option that names any. CaptureError where two do, or an option lacks the one that it belongs to."""
    width, height = given.size
    named = [f"--{option}" for option in ("cameras", "camera", "turntable") if option in given]
    if len(named) > 1:
        raise CaptureError(f"wanted one of --cameras, --camera and --turntable, given {' and '.join(named)}")
    for option, owner in (("target", "camera"), ("views", "capture")):
        if option in given and owner not in given:
            raise CaptureError(f"--{option}: wanted together with --{owner}, given alone")
    centre, _ = ball_around(result.surface)
    if "cameras" in given:
        return read_cameras(given.cameras)
    if "camera" in given:
        target = np.array(given.target) if "target" in given else centre
        return {"camera": look_at(np.array(given.camera), target, np.array(given.up), width, height, given.fov)}
    if "capture" in given and "turntable" not in given:
        views = capture_of(result, given.capture, given.views if "views" in given else None, [1]).views
        return {view.name: view.camera for view in views}
    frames = given.turntable if "turntable" in given else 1
    if not 1 <= frames <= 9999:
        raise CaptureError(f"--turntable: wanted 1 to 9999 frames, given {frames}")
    around = turntable(result.surface, frames, given.elevation, np.array(given.up), width, height, given.fov)
    return {f"turn_{k:04d}": camera for k, camera in enumerate(around, 1)}


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


def as_shown(layer: str, values: Layer, coverage: Layer, exposure: float) -> Layer:
    """The values of a layer, linear in [0, 1]: what a PNG holds."""
    if layer == "normals":
        return np.float32(0.5) * (values + np.float32(1))
    if layer == "depth":
        seen = values[coverage > 0] if (coverage > 0).any() else np.zeros(1)
        near, far = float(seen.min()), float(seen.max())
        depth: Layer = np.where(coverage > 0, 1 - (values - near) / max(far - near, 1e-12), 0).astype(np.float32)
        return depth
    return values * np.float32(exposure if layer in ("image", "specular") else 1.0)


def write_layer(folder: Path, name: str, layer: str, values: Layer, coverage: Layer, exposure: float, form: str) -> None:
    """One file. form: one of mvps.render's formats."""
    if form == "exr":
        write_exr(folder / f"{name}.exr", values, coverage)
        return
    shown = as_shown(layer, values, coverage, exposure).clip(0, 1)
    if form == "png16":
        (folder / f"{name}.png").write_bytes(png_bytes(np.rint(shown * 65535).astype(np.uint16)))
        return
    # Radiance and albedo are linear and screens are not; the others are no light.
    colour = srgb_bytes(shown) if layer in ("image", "specular", "albedo") else np.rint(shown * 255).astype(np.uint8)
    colour = colour if colour.ndim == 3 else np.repeat(colour[..., None], 3, axis=2)
    alpha = np.rint(coverage * 255).astype(np.uint8)[..., None]
    (folder / f"{name}.png").write_bytes(png_bytes(np.concatenate([colour, alpha], axis=2)))


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


def write_video(encoder: str, folder: Path, names: list[str], layer: str) -> None:
    """LAYER.mp4 of the pictures NAME_LAYER.png in their order, on white."""
    listed = folder / f".{layer}.txt"
    listed.write_text("".join(f"file '{name}_{layer}.png'\nduration {1 / FRAMES_PER_SECOND}\n" for name in names), encoding="utf-8")
    even = "format=rgba,pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white@0"
    onto_white = f"{even},split[a][b];[b]drawbox=c=white:t=fill:replace=1[w];[w][a]overlay,format=yuv420p"
    command = [encoder, "-v", "error", "-f", "concat", "-i", listed.name, "-filter_complex", onto_white, "-r", str(FRAMES_PER_SECOND)]
    done = subprocess.run([*command, f"{layer}.mp4"], cwd=folder, capture_output=True, text=True, check=False)
    listed.unlink()
    if done.returncode:
        raise CaptureError(f"--video: wanted a video of {len(names)} pictures, given an encoder that fails ({done.stderr.strip()[:200]})")
