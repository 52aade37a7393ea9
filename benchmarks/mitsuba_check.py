"""Is model.glb what we render? Mitsuba 3 renders the file under cameras and lights of the capture.

    python benchmarks/mitsuba_check.py RESULT CAPTURE [RESULT CAPTURE ...] [--pictures DIR]

for results of mvps.reconstruct, each with the capture it was made from. The file is read by glb.py and shown by Mitsuba's own plugins
(mitsuba_scene.py); nothing of mvps.texture or mvps.gltf takes part. Photographs are those of held-out lights, or of the first two where
none were held out, in up to VIEWS views. Writes mitsuba.md beside this file; needs pip install mvps[mitsuba].
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from glb import Array, Model, read_glb, reflected, tangent_gap_deg
from mitsuba_scene import mesh, render, sensor

from mvps.camera import view_directions
from mvps.command import run
from mvps.compare.tables import as_markdown
from mvps.export import read_reconstruction
from mvps.illumination import Illumination
from mvps.layers import rendered
from mvps.load import read_capture
from mvps.mesh import normalise
from mvps.pbr import glossy
from mvps.rendering import diffuse_shading, light_senders, points_under, shadow_at, specular_shading
from mvps.scene import Capture, Reconstruction, View
from mvps.visibility import ray_caster

HERE = Path(__file__).resolve().parent
VIEWS, GAIN = 4, 4
"""Views of a capture; factor of differences in the pictures."""
PIXELS, LEAST_COSINE = 200, 0.05
"""Of a view, in the comparison of lobes; cosines below which nothing is to be seen."""
NOTE = """Direct light, 16 samples a pixel, inside the outlines of both, peak 1 (what saturates the photographs). `others off`: ours without
inter-reflection, which glTF's direct light has not. `both lit`: of these the pixels, their share behind, that neither shows in shadow:
our shadow rays start a fifth of an edge's length away from the mesh, Mitsuba's on it. `lobes`: relative RMS difference between our lobes
and glTF's, and between the whole reflectances, over lit pixels and lights of all views. `tangents`: mean angle between the file's tangents
and those that a reader makes of the texture coordinates."""


class Pair(NamedTuple):
    """One photograph (height, width, 3), ours with and without inter-reflection, Mitsuba's; inside: of the outlines of both and the mask;
    lit: of these, in the light in both."""

    photograph: Array
    ours: Array
    direct: Array
    mitsuba: Array
    inside: Any
    lit: Any


def photographs(result: Reconstruction, capture: Path) -> Capture:
    """Views and lights to compare."""
    held = [n for n in result.settings.get("hold_out_lights") or [1, 2] if n in result.light_names[0]]
    step = -(-len(result.views) // VIEWS)
    return read_capture(capture, [int(name[5:]) for name in result.views[::step]], held)


def pairs(result: Reconstruction, model: Model, chosen: Capture) -> Iterator[Pair]:
    """Photograph by photograph."""
    caster, material, shown = ray_caster(result.surface), result.material, mesh(model)
    senders = light_senders(result.surface, material)
    for view in chosen.views:
        camera, at = sensor(view.camera), result.views.index(view.name)
        for k, number in enumerate(view.lights):
            row = result.light_names[at].index(number)
            direction, intensity = result.lights.direction[at][row], result.lights.intensity[at][row]
            light = Illumination(direction[None], intensity[None])
            layers, coverage = rendered(caster, material, view.camera, light, ("image", "shadow"), senders)
            direct, _ = rendered(caster, material, view.camera, light, ("image",))
            # glTF's reflectance is ours over pi times the scale.
            other, covered = render(shown, camera, direction, np.pi * model.extras["albedo_scale"] * intensity)
            inside = (coverage == 1) & (covered > 0.999) & view.mask
            bright, of_other = (image.max(-1) for image in (direct["image"], other))
            lit = inside & (layers["shadow"] == 0) & (of_other > bright / 2)
            yield Pair(pictured(view, k), layers["image"], direct["image"], other, inside, lit)


def pictured(view: View, k: int) -> Array:
    """(height, width, 3) photograph of the light at position k, in parts of what saturates it."""
    image = np.zeros((*view.mask.shape, 3), np.float32)
    image[view.mask] = view.radiance([k])[:, 0] / (view.scale * view.saturation)
    return image


def psnr(a: Array, b: Array, where: Any) -> float:
    """dB, peak 1, both clipped there."""
    return float(-10 * np.log10(((np.minimum(a, 1) - np.minimum(b, 1))[where] ** 2).mean()))


def lobes_gap(result: Reconstruction, capture: Path, scale: float) -> tuple[float, float]:
    """Relative RMS difference between our reflectance and glTF's over lit pixels and all lights: of the specular part, of the whole."""
    caster, material = ray_caster(result.surface), result.material
    sums = np.zeros(4)
    for view in read_capture(capture, [int(name[5:]) for name in result.views], [1]).views:
        at = result.views.index(view.name)
        direction, intensity = result.lights.direction[at], result.lights.intensity[at]
        points = points_under(caster, material, view.camera, view.pixels[:: max(1, len(view.pixels) // PIXELS)])
        points = points.part(points.hit)
        towards = view_directions(view.camera, points.position)
        lit = (points.normal @ direction.T > LEAST_COSINE) & ((points.normal * towards).sum(1) > LEAST_COSINE)[:, None]
        i, k = np.nonzero(lit & ~shadow_at(caster, material.law, points, direction))
        body = points.albedo[i] * diffuse_shading(points.normal, towards, direction, material.grazing)[i, k, None]
        lobes = np.broadcast_to(specular_shading(points.normal, towards, direction, points.specular_weight, material.law), (*lit.shape, 3))[
            i, k
        ]
        half = normalise(towards[i] + direction[k])
        pairs = ((points.normal[i], direction[k]), (points.normal[i], towards[i]), (points.normal[i], half), (towards[i], half))
        n_dot_l, n_dot_v, h_dot_n, v_dot_h = ((a * b).sum(1) for a, b in pairs)
        rough, reflectance = glossy(points.specular_weight, material.law)
        f0: Any = np.minimum(reflectance / scale, 1)[i]
        theirs, largest = reflected(n_dot_l, n_dot_v, h_dot_n, v_dot_h, rough[i] ** 2, f0)
        theirs = scale * theirs * n_dot_l[:, None] * intensity[k]
        base = points.albedo[i] / (1 - f0.max(1, keepdims=True)) * (1 - largest) * n_dot_l[:, None] * intensity[k]
        body, lobes = body * intensity[k], np.asarray(lobes * intensity[k])
        sums += [float((a**2).sum()) for a in (theirs - lobes, lobes, theirs + base - lobes - body, lobes + body)]
    return float(np.sqrt(sums[0] / max(sums[1], 1e-30))), float(np.sqrt(sums[2] / sums[3]))


def row(folder: Path, capture: Path, pictures: Path | None) -> list[str]:
    """A line of the table."""
    result, model = read_reconstruction(folder), read_glb(folder / "model.glb")
    found = list(pairs(result, model, photographs(result, capture)))
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(pictures / f"{folder.name}.png"), np.concatenate([strip(pair) for pair in found[:4]])[..., ::-1])

    def mean(a: str, b: str, where: str = "inside") -> str:
        return f"{np.mean([psnr(getattr(pair, a), getattr(pair, b), getattr(pair, where)) for pair in found]):.1f}"

    lobes, whole = lobes_gap(result, capture, model.extras["albedo_scale"])
    part = np.mean([pair.lit.sum() / pair.inside.sum() for pair in found])
    against = [mean("mitsuba", "ours"), mean("mitsuba", "direct"), f"{mean('mitsuba', 'direct', 'lit')} ({100 * part:.0f} %)"]
    photographed = [mean("ours", "photograph"), mean("mitsuba", "photograph")]
    of_lobes = f"{100 * lobes:.1f}" if result.material.specular_weight.any() else "-"
    rest = [of_lobes, f"{100 * whole:.1f}", f"{tangent_gap_deg(model).mean():.2f}"]
    count = f"{len(found)} {'held out' if result.settings.get('hold_out_lights') else 'used'}"
    return [folder.name, str(len(model.faces)), count, *against, *photographed, *rest]


def strip(pair: Pair) -> Any:
    """Photograph, ours, Mitsuba's, and their difference about grey."""
    coded = [np.clip(image, 0, 1) ** (1 / 2.2) for image in (pair.photograph, pair.ours, pair.mitsuba)]
    error = 0.5 + GAIN * (pair.mitsuba - pair.ours) * pair.inside[..., None]
    return np.rint(np.concatenate([*coded, np.clip(error, 0, 1)], 1) * 255).astype(np.uint8)


HEAD = ("result", "faces", "photographs", "against ours, dB", "others off, dB", "both lit, dB (share)")
TAIL = ("ours against photographs, dB", "Mitsuba against photographs, dB", "lobes, %", "reflectance, %", "tangents, deg")


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path, metavar="RESULT CAPTURE")
    parser.add_argument("--pictures", type=Path, help="folder for photographs, renderings and their differences side by side")
    given = parser.parse_args(argv)
    if len(given.paths) % 2:
        parser.error("wanted pairs of a result and its capture, given an odd number of folders")
    pairs = zip(given.paths[::2], given.paths[1::2], strict=True)
    table = as_markdown([[*HEAD, *TAIL], *(row(result, capture, given.pictures) for result, capture in pairs)])
    text = f"`python benchmarks/mitsuba_check.py RESULT CAPTURE ...`: model.glb in Mitsuba 3.\n\n{table}\n\n{NOTE}\n"
    (HERE / "mitsuba.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    sys.exit(run(main))
