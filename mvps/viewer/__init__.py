"""A model to turn and to light, as a part of a page: a canvas, its controls, the model's data and the program that shows it.

The browser's graphics processor evaluates the same image model (shading.py) for every pixel,

    radiance = sum over lights of  E visibility (albedo D(n . l) D(n . v) + gain sum_k weight_k exp(sharpness_k (h . n - 1))) max(n . l, 0),

with normal, albedo and weights interpolated between vertices. Visibility comes from who shows the page: traced by Embree for every vertex
(mvps.view), or from a picture of depths as each light sees them (a page without a server). An environment, which only mvps.view has, is up
to 32 directional lights (illumination.py) whose sum is evaluated at the vertices. What rests, mvps.view traces pixel by pixel (picture.py).

Data, one array after the other, compressed by deflate (RFC 1950), written in base64:

    position  (V, 3) uint16   over the box from low to high        normal  (V, 3) int16 over 32767
    albedo    (V, 3) uint8    square root, over `white`            weight  (V, 4) uint8 square root, over `lobe_white`, 0 beyond the lobes
    hue       (V, 3) uint8    square root, over `hue_white`, times the lobes' colours of the object in the mean
    confidence  (V,) uint8                                         faces   (F, 3) uint32

The box's corners, and all that the graphics processor is given, are relative to its `centre` in the world.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.mesh import LEAST_FACES, decimated, nearest, normalise
from mvps.scene import Float, Material, Surface
from mvps.shading import returned
from mvps.visibility import Hits, interpolate

MOST_LOBES = 4
"""As many as a vertex attribute holds; the model chooses from three."""

AROUND_BYTES = 10_000
"""At most, of the part: what is neither the program nor the model's arrays."""


@cache
def program() -> str:
    """The viewer's JavaScript."""
    return (Path(__file__).parent / "viewer.js").read_text(encoding="utf-8")


def _root_bytes(values: Float, white: Float | float) -> NDArray[np.uint8]:
    """Square roots of values over white, as bytes: dark ones keep their digits."""
    coded: NDArray[np.uint8] = np.rint(255 * np.sqrt(np.clip(values / np.maximum(white, 1e-12), 0, 1))).astype(np.uint8)
    return coded


def packed(surface: Surface, material: Material) -> tuple[dict[str, Any], bytes]:
    """What the program must know of the model, as JSON values, and its compressed arrays.

    Lobes beyond MOST_LOBES, which an edited material may have, are left out, the faintest first.
    """
    low, high = surface.vertices.min(0), surface.vertices.max(0)
    # Graphics processors have single precision: far from the world's origin it would not tell vertices apart.
    centre = (low + high) / 2
    span = np.maximum(high - low, 1e-300)
    weight = material.specular_weight if material.specular_weight.ndim == 3 else material.specular_weight[..., None].repeat(3, 2)
    kept = np.sort(np.argsort(-weight.sum((0, 2)), kind="stable")[:MOST_LOBES])
    weight, sharpness = weight[:, kept], material.sharpness[kept]
    total = weight.sum(0)
    tint = np.where(total.sum(1, keepdims=True) > 0, 3 * total / np.maximum(total.sum(1, keepdims=True), 1e-300), 1.0)
    grey = np.zeros((len(surface.vertices), MOST_LOBES))
    grey[:, : len(kept)] = weight.mean(2)
    # Of places whose lobes have another colour than the object's in the mean (joint/colours.py, edits).
    common = np.einsum("vk,kc->vc", grey[:, : len(kept)], tint)
    hue = np.where(common > 0, weight.sum(1) / np.where(common > 0, common, 1), 1.0)
    white, hue_white = float(np.quantile(material.albedo, 0.999)) or 1.0, max(float(hue.max()), 1e-12)
    lobe_white = np.maximum(grey.max(0), 1e-12)
    arrays = (
        np.rint(65535 * (surface.vertices - low) / span).astype("<u2"),
        np.rint(32767 * material.normal).astype("<i2"),
        _root_bytes(material.albedo, white),
        _root_bytes(grey, lobe_white),
        _root_bytes(hue, hue_white),
        np.rint(255 * material.confidence).astype(np.uint8),
        surface.faces.astype("<u4"),
    )
    about = {
        "vertices": len(surface.vertices),
        "faces": len(surface.faces),
        "centre": centre.tolist(),
        "low": (low - centre).tolist(),
        "high": (high - centre).tolist(),
        "white": white,
        "lobe_white": lobe_white.tolist(),
        "hue_white": hue_white,
        "sharpness": [*sharpness.tolist(), *[1.0] * (MOST_LOBES - len(kept))],
        "tint": [*tint.tolist(), *[[1.0] * 3] * (MOST_LOBES - len(kept))],
        "grazing": material.grazing,
        "microfacet": material.microfacet,
    }
    return about, zlib.compress(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays), 6)


def brightest(material: Material) -> float:
    """What the brightest places return of light from everywhere, over a white diffuse surface; 1 where nothing returns any."""
    weight = material.specular_weight if material.specular_weight.ndim == 3 else material.specular_weight[..., None]
    total = material.albedo + np.einsum("vkc,k->vc", weight, returned(tuple(material.sharpness), material.microfacet)[1:])
    return float(np.quantile(total, 0.999)) or 1.0


def carried_over(surface: Surface, material: Material, points: Float) -> Material:
    """The material at the places of the surface nearest to points (n, 3), without its neural residual, which the viewer does not show."""
    distance, _, face, barycentric = nearest(surface, points)
    hits = Hits(face, barycentric, distance)
    normal, albedo, weight, confidence = (
        interpolate(surface, hits, values) for values in (material.normal, material.albedo, material.specular_weight, material.confidence)
    )
    # Normals that cancel leave none: one of the corners' serves as well.
    normal = np.where(normal.any(1, keepdims=True), normal, material.normal[surface.faces[face, 0]])
    return replace(material, normal=normalise(normal), albedo=albedo, specular_weight=weight, confidence=confidence, residual=None)


def packed_within(surface: Surface, material: Material, most: int) -> tuple[dict[str, Any], bytes] | None:
    """`packed`, with as few faces as arrays of `most` bytes ask for. None where that cannot be had (mvps.mesh.decimated)."""
    about, data = packed(surface, material)
    faces = len(surface.faces)
    while len(data) > most:
        faces = int(faces * 0.95 * max(most, 0) / len(data))
        fewer = decimated(surface, faces) if faces >= LEAST_FACES else None
        if fewer is None:
            return None
        about, data = packed(fewer, carried_over(surface, material, fewer.vertices))
    return about, data


def _options(names: Sequence[str]) -> str:
    return "".join(f"<option>{escape(name)}</option>" for name in names)


def _controls(environments: Sequence[str], materials: Sequence[str]) -> str:
    around = f'<label>Material <select id="viewer-material">{_options(materials)}</select></label> ' if materials else ""
    if environments:
        around += (
            '<label>Environment <select id="viewer-environment"><option value="">none</option>'
            + _options(environments)
            + "</select></label> "
            '<label>turned <input id="viewer-turn" type="range" min="0" max="345" step="15" value="0"></label>'
        )
    return (
        '<p class="viewer-controls"><label>Show <select id="viewer-layer">'
        + _options(("image", "albedo", "highlights", "normals", "confidence", "depth", "shadow"))
        + '</select></label> <label>Drag <select id="viewer-drag"><option value="turn">turns the object</option>'
        '<option value="light">moves the light</option></select></label>'
        ' <label>Fill light <input id="viewer-fill" type="range" min="0" max="1" step="0.05" value="0.1"></label>'
        ' <label>Exposure <input id="viewer-exposure" type="range" min="-2" max="3" step="0.1" value="0.5"></label></p>'
        '<p class="viewer-controls"><label>Light <select id="viewer-light"></select></label>'
        ' <button type="button" id="viewer-more">add</button> <button type="button" id="viewer-fewer">remove</button>'
        ' <label>Colour <input id="viewer-colour" type="color" value="#ffffff"></label>'
        ' <label>Strength <input id="viewer-strength" type="range" min="0" max="3" step="0.05" value="1"></label> ' + around + "</p>"
    )


def viewer_html(
    surface: Surface,
    material: Material,
    up: Float,
    looking_from: Float,
    served: bool = False,
    environments: Sequence[str] = (),
    materials: Sequence[str] = (),
    room: int | None = None,
    exposed: Material | None = None,
) -> str:
    """The part of a page; up, looking_from (3,): upwards and towards the first camera, world frame. served: visibility is asked of the
    server that the page came from, and environments and other materials, by their names; the first of these is `material`. room: bytes
    that the part may take, any number if None; a model that needs more is shown with fewer faces, and a line says so. exposed: the material
    for which pictures are exposed, `material` if None."""
    # Base64 has four letters for three bytes.
    most = None if room is None else (room - AROUND_BYTES - len(program().encode())) * 3 // 4
    model = packed(surface, material) if most is None else packed_within(surface, material, most)
    if model is None:
        return f"<p>The model of {len(surface.faces):,} faces is too large for this page; model.glb shows it.</p>"
    about, data = model
    about |= {"up": np.asarray(up).tolist(), "from": np.asarray(looking_from).tolist(), "served": served}
    about["exposed"] = brightest(exposed or material)
    fewer = ""
    if about["faces"] < len(surface.faces):
        fewer = f"<p>The page has room for {about['faces']:,} of the model's {len(surface.faces):,} faces; model.glb shows all of them.</p>"
    return (
        f'{fewer}<div class="viewer"><canvas id="viewer" tabindex="0" aria-label="The model: drag to turn it, drag with the right button or'
        ' with Shift to move the light, scroll to come closer; arrow keys turn it, with Shift they move the light"></canvas>'
        + ('<img id="viewer-exact" alt="" hidden>' if served else "")
        + _controls(environments, materials)
        + '<p id="viewer-said" role="status"></p></div>\n'
        f'<script type="application/json" id="viewer-about">{json.dumps(about)}</script>\n'
        f'<script type="text/plain" id="viewer-data">{base64.b64encode(data).decode("ascii")}</script>\n'
        f"<script>{program()}</script>"
    )


STYLE = (
    ".viewer canvas{width:100%;max-width:48rem;aspect-ratio:4/3;background:#222;touch-action:none;display:block;cursor:grab}"
    ".viewer{position:relative}#viewer-exact{position:absolute;top:0;left:0;width:100%;max-width:48rem;aspect-ratio:4/3;pointer-events:none}"
    ".viewer-controls label{margin-right:1.2em;white-space:nowrap}"
    ".beside{display:flex;flex-wrap:wrap;gap:1rem}.beside>div{flex:1 1 20rem;min-width:0}"
)
"""Of the part, for the page's style sheet."""
