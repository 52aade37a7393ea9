"""Pictures of a view: photograph, re-rendering and what the re-rendering is made of, under one of the view's lights."""

from __future__ import annotations

import base64
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mvps.camera import DILIGENT_FROM_CAMERA
from mvps.gleam import Senders
from mvps.pbr import reflectance_scale, srgb_bytes
from mvps.rendering import RAYS_ACROSS, light_arriving, photograph_and_gloss, points_under, shadow_at
from mvps.scene import Bool, Float, Reconstruction, View, expected_error_deg
from mvps.visibility import RayCaster

LARGEST_SIDE = 800
"""Pixels of a picture: as wide as a page when it is enlarged."""
JPEG_QUALITIES = (85, 70, 50, 30, 20, 10)
"""The first that LARGEST_BYTES allow is taken: nothing but grain has half a megabyte at 85 and an eighth at 20."""
LARGEST_BYTES = 200_000
"""Of a picture: 32 of them in base64 leave nearly half of a page to the model."""
ERROR_SPAN = 0.25
"""Error that is drawn brightest, as a share of the photograph's white."""
EXPECTED_SPAN = 20.0
"""Expected error of normals that is drawn brightest, degrees: twice what is of no use as a measurement (verdict.py)."""


class Picture(NamedTuple):
    """A picture (height, width, 3) uint8 RGB, its title and a sentence for those who do not see it."""

    image: NDArray[np.uint8]
    title: str
    text: str


def view_pictures(caster: RayCaster, senders: Senders | None, reconstruction: Reconstruction, view: View) -> tuple[str, list[Picture]]:
    """The light shown ("light 3") and the pictures of a view that the result holds."""
    place = reconstruction.views.index(view.name)
    shared = [k for k, number in enumerate(view.lights) if number in reconstruction.light_names[place]]
    shared = [k for k in shared if view.shown[k]] or shared
    # The photograph of middling brightness shows both lit and shadowed parts.
    brightness = view.samples[:, shared].mean((0, 2))
    chosen = shared[int(np.argsort(brightness, kind="stable")[len(shared) // 2])]
    row = reconstruction.light_names[place].index(view.lights[chosen])
    direction, intensity = (values[place][row : row + 1] for values in (reconstruction.lights.direction, reconstruction.lights.intensity))
    material = reconstruction.material
    measured = view.radiance([chosen])[:, 0]
    arriving = light_arriving(senders, direction, view.camera.centre)
    shown = photograph_and_gloss(caster, material, view.camera, view.pixels, direction, intensity, arriving, RAYS_ACROSS)
    rendered, specular = (image[:, 0] for image in shown)
    points = points_under(caster, material, view.camera, view.pixels)
    cast = shadow_at(caster, material.law, points, direction)[:, 0]
    attached = points.normal @ direction[0] <= 0
    white = float(np.percentile(measured, 99.5)) or 1.0
    error = np.abs(measured - rendered).mean(1) / white
    normals = points.normal @ view.camera.rotation.T @ DILIGENT_FROM_CAMERA
    shadow = np.where(attached, 0.45, np.where(cast, 0.0, 1.0))[:, None].repeat(3, 1)
    known = points.confidence > 0
    expected = np.where(known, expected_error_deg(np.where(known, points.confidence, 1.0)), EXPECTED_SPAN)
    mean_error = f"mean absolute error {100 * error.mean():.1f} % of white"
    rows: list[tuple[str, str, NDArray[np.uint8]]] = [
        ("photograph", "what the camera saw", srgb_bytes(measured / white)),
        ("re-rendering", "the reconstruction under the same light", srgb_bytes(rendered / white)),
        (f"error, white = {100 * ERROR_SPAN:.0f} %", mean_error, _heat(error / ERROR_SPAN)),
        ("normals", "x red, y green, z to the camera blue", np.rint((normals + 1) * 127.5).clip(0, 255).astype(np.uint8)),
        ("albedo", "the colour without light and gloss", srgb_bytes(points.albedo / reflectance_scale(material))),
        ("specular", "the gloss of the re-rendering alone", srgb_bytes(specular / white)),
        (
            f"expected error of normals, white = {EXPECTED_SPAN:.0f} deg",
            f"median {np.median(expected):.1f} deg; white too where no photograph shows the place",
            _heat(expected / EXPECTED_SPAN),
        ),
        ("shadow", "black: cast, grey: attached, white: lit", np.rint(shadow * 255).astype(np.uint8)),
    ]
    return f"light {view.lights[chosen]}", [
        Picture(_on_image(view.mask, values), title, f"{title} of {view.name}: {text}") for title, text, values in rows
    ]


def data_address(image: NDArray[np.uint8]) -> str:
    """The picture (height, width, 3) RGB as a JPEG inside an address of its own (RFC 2397)."""
    bgr = np.ascontiguousarray(image[..., ::-1])
    for quality in JPEG_QUALITIES:
        data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= LARGEST_BYTES:
            break
    return "data:image/jpeg;base64," + base64.b64encode(data).decode("ascii")


def _heat(values: Float) -> NDArray[np.uint8]:
    """(n, 3) colours from black over red and yellow to white of values (n,), clipped to [0, 1]."""
    colours: NDArray[np.uint8] = np.rint(255 * np.clip(3 * np.clip(values, 0, 1)[:, None] - (0, 1, 2), 0, 1)).astype(np.uint8)
    return colours


def _on_image(mask: Bool, values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Values (pixels, 3) on the image, cut to the foreground and reduced to LARGEST_SIDE."""
    image: Any = np.full((*mask.shape, 3), 24, np.uint8)
    image[mask] = values
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    image = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    shrink = LARGEST_SIDE / max(image.shape[:2])
    if shrink < 1:
        size = (max(1, round(image.shape[1] * shrink)), max(1, round(image.shape[0] * shrink)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    cut: NDArray[np.uint8] = image
    return cut
