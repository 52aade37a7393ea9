"""Does Blender show model.glb as we render it?

    python benchmarks/blender_check.py RESULT CAPTURE [RESULT CAPTURE ...] [--pictures DIR]

for results of mvps.reconstruct, each with the capture it was made from, whose cameras are used. Blender reads the file with its own
importer, as a user would, and Cycles renders it under one directional light of the capture, without further bounces. Needs Blender as a
module (pip install bpy). Writes blender.md beside this file.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import cv2
import numpy as np
from glb import Array, read_glb

from mvps.command import run
from mvps.compare.tables import as_markdown
from mvps.export import read_reconstruction
from mvps.illumination import Illumination, frame_of
from mvps.layers import rendered
from mvps.load import read_capture
from mvps.scene import Camera
from mvps.visibility import ray_caster

HERE = Path(__file__).resolve().parent
VIEWS, SAMPLES = 3, 16
"""Views of a capture; rays of a pixel: the light has no extent."""

BLENDER_FROM_GLTF = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""The importer turns glTF's y axis, up, into Blender's z."""


def opened(path: Path) -> None:
    """An empty scene with the file, rendered linearly by Cycles without bounces, nothing around it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(path))
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.max_bounces, scene.cycles.use_denoising = SAMPLES, 0, False
    scene.render.film_transparent = True
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.angle = 0
    for one in (camera, sun):
        scene.collection.objects.link(one)
    scene.camera = camera


def matrix(values: Array) -> Any:
    """A matrix (4, 4) of Blender's."""
    import mathutils

    return mathutils.Matrix(values.tolist())


def aim(camera: Camera, farthest: float) -> None:
    """Blender's camera as ours; farthest: from the origin that anything of the object is, world units."""
    scene, made = bpy.context.scene, bpy.context.scene.camera
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.rotation.T @ np.diag([1.0, -1.0, -1.0]), camera.centre
    made.matrix_world = matrix(BLENDER_FROM_GLTF @ pose)
    made.data.sensor_fit, made.data.lens = "HORIZONTAL", camera.K[0, 0] / camera.width * made.data.sensor_width
    made.data.shift_x = 0.5 - camera.K[0, 2] / camera.width
    made.data.shift_y = (camera.K[1, 2] - camera.height / 2) / camera.width
    made.data.clip_start = 1e-4 * farthest
    made.data.clip_end = float(np.linalg.norm(camera.centre)) + 2 * farthest
    scene.render.resolution_x, scene.render.resolution_y = camera.width, camera.height


def shine(direction: Array, intensity: Array) -> None:
    """Blender's sun as a directional light of ours (3,), (3,); a white body straight below returns intensity over pi."""
    sun = bpy.context.scene.objects["sun"]
    towards = BLENDER_FROM_GLTF[:3, :3] @ direction
    pose = np.eye(4)
    # A sun shines along its -z.
    pose[:3, :3] = frame_of(towards)
    sun.matrix_world = matrix(pose)
    sun.data.energy, sun.data.color = float(intensity.max()), (intensity / intensity.max()).tolist()


def picture(folder: Path) -> tuple[Array, Array]:
    """What Cycles makes of the scene: radiance (height, width, 3) and coverage (height, width)."""
    scene = bpy.context.scene
    scene.render.filepath = str(folder / "blender.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath, check_existing=False)
    values = np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], 4)[::-1]
    bpy.data.images.remove(image)
    return values[..., :3], values[..., 3]


def compared(result: Path, capture: Path, folder: Path) -> tuple[list[float], list[Array]]:
    """Of some views PSNR, dB, peak the brightest thousandth, inside both outlines; and pictures, ours beside Blender's."""
    made = read_reconstruction(result)
    scale = float(read_glb(result / "model.glb").extras["albedo_scale"])
    caster, farthest = ray_caster(made.surface), float(np.linalg.norm(made.surface.vertices, axis=1).max())
    opened(result / "model.glb")
    found, shown = [], []
    for view in read_capture(capture, [int(name[5:]) for name in made.views], [made.light_names[0][0]]).views[
        :: -(-len(made.views) // VIEWS)
    ]:
        at = made.views.index(view.name)
        direction, intensity = made.lights.direction[at][0], made.lights.intensity[at][0]
        layers, coverage = rendered(caster, made.material, view.camera, Illumination(direction[None], intensity[None]), ("image",))
        aim(view.camera, farthest)
        # glTF's reflectance is ours over pi times the scale.
        shine(direction, np.pi * scale * intensity)
        theirs, covered = picture(folder)
        inside = (coverage == 1) & (covered > 0.999)
        white = float(np.quantile(layers["image"][inside], 0.999))
        a, b = (np.minimum(image / white, 1) for image in (layers["image"], theirs))
        found.append(float(-10 * np.log10(((a - b)[inside] ** 2).mean())))
        shown.append(np.concatenate([a, b, np.clip(0.5 + 4 * (b - a) * inside[..., None], 0, 1)], 1))
    return found, shown


def main(argv: Sequence[str]) -> None:
    """The command line."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("paths", nargs="+", type=Path, metavar="RESULT CAPTURE")
    made.add_argument("--pictures", type=Path, metavar="DIR", help="ours, Blender's, four times their difference")
    given = made.parse_args(argv)
    if len(given.paths) % 2:
        made.error("wanted pairs of a result and its capture, given an odd number of folders")
    lines = [["result", "views", "against ours, dB", "worst"]]
    for result, capture in zip(given.paths[::2], given.paths[1::2], strict=True):
        with tempfile.TemporaryDirectory() as folder:
            found, shown = compared(result, capture, Path(folder))
        lines.append([result.name, str(len(found)), f"{np.mean(found):.1f}", f"{min(found):.1f}"])
        if given.pictures:
            code = np.where(np.concatenate(shown) > 0, np.concatenate(shown), 0) ** (1 / 2.2)
            given.pictures.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(given.pictures / f"{result.name}.png"), np.rint(255 * code[..., ::-1]).astype(np.uint8))
    command = "python benchmarks/blender_check.py RESULT CAPTURE ..."
    note = (
        f"Blender {bpy.app.version_string}, Cycles, {SAMPLES} rays a pixel, no bounces, one light of the capture; ours without"
        " inter-reflection. Peak is our brightest thousandth."
    )
    text = f"`{command}`: model.glb in Blender.\n\n{as_markdown(lines)}\n\n{note}\n"
    (HERE / "blender.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    sys.exit(run(main))
