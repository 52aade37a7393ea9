"""Textures of a reconstruction: base colour from the photographs, tangent-space normals, roughness, specular colour.

Base colour. In every view, each foreground pixel with first hit x gets one albedo, from all its lights:

    minimise over a   sum_l log(1 + r_l^2 / b^2),   r_l = I_l - E_l (a d_l + specular_l),     E intensity of the light,

colours of lights taken out, d the diffuse shading and what other surfaces send, over unsaturated samples of lights that reach x, by
reweighted least squares. With the scale b, half the mean of |r|, highlights, shadow borders and inter-reflections count as outliers
(Cauchy's weights: Holland and Welsch 1977). A texel takes the mean of these albedos, interpolated between pixels, over the views that see
it, with weights of the squared density of pixels on the surface, (cos(view angle) / footprint^2)^2, so that the nearest and most frontal
views decide. A view sees a texel where the first hits of the surrounding pixels lie at the texel. A texel that no view sees keeps the
vertices' albedo.

Normal map. T, N: interpolated tangent and mesh normal, B = N x T; the refined normal n, the vertices' with what the pixels' normals tell
beyond them (texel_normals.py), is stored as (x, y, z) with x T + y B + z N = n, coded (c + 1) / 2; glTF's convention, green up.

Levels of detail. A texel of a shell, a surface with fewer faces, shows the nearest point of the full one: its albedo from the
photographs, its material, its refined normal, which the normal map then tells relative to the shell's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mvps.atlas import Atlas, Texels, build_atlas, padded, rasterise, vertex_tangents
from mvps.camera import bilinear, inside_image, project, surface_pixel, view_directions
from mvps.cores import on_cores, one_by_one
from mvps.gleam import Senders
from mvps.mesh import face_areas, lengths, nearest, normalise, vertex_normals
from mvps.pbr import glossy, srgb_bytes, white_level
from mvps.pixel_samples import DARK
from mvps.rendering import Arriving, diffuse_shading, light_arriving, light_senders, points_under, shadow_at, specular_shading
from mvps.scene import Bool, Capture, Float, Int, Law, Lights, Material, Surface, View
from mvps.texel_normals import Places, Shown, texel_normals
from mvps.visibility import RayCaster, ray_caster

LARGEST_SIDE = 4096
"""Textures larger than this, texels, do not load on every graphics card."""
FILLED = 0.4
"""Share of an atlas that charts cover, about; used only to keep below LARGEST_SIDE."""
REBUILT = 3
"""Times that an atlas is made again, coarser, because it came out larger than that: many small charts fill less, and the room between
them, which is so many texels, stays."""
SAMPLES_PER_CHUNK = 1 << 16
TEXELS_PER_CHUNK = 1 << 18
REWEIGHTINGS = 4
STEEPEST_VIEW = 0.2
"""Smallest cosine between normal and view direction: beyond, one pixel spreads over more than five texels."""

LEAST_ENTERING = 1e-3
"""Smallest share of light that enters the body: where F0 is 1, nothing is left for a base colour to return."""


@dataclass(frozen=True, eq=False)
class Textures:
    """A surface with an atlas and its pictures, each (height, width) of the atlas.

    mesh_normal       (V, 3) unit vertex normals that the normal map is relative to
    base_color        (h, w, 3) uint8 sRGB of albedo / (scale (1 - max F0)), with the scale of mvps.pbr for the texels
    normal_map        (h, w, 3) uint8;  roughness (h, w) uint8, linear
    specular_color    (h, w, 3) uint8 sRGB of F0 / specular_level, the largest F0 (mvps.pbr)
    from_photographs  share of texels that a view saw
    """

    surface: Surface
    atlas: Atlas
    mesh_normal: Float
    base_color: NDArray[np.uint8]
    normal_map: NDArray[np.uint8]
    roughness: NDArray[np.uint8]
    specular_color: NDArray[np.uint8]
    specular_level: float
    scale: float
    from_photographs: float


def bake(
    surface: Surface,
    material: Material,
    lights: Lights,
    capture: Capture,
    texels_per_pixel: float,
    shells: Sequence[Surface] = (),
    maps: Sequence[NDArray[np.float32]] = (),
) -> list[Textures]:
    """Textures of a surface with its material, then of shells near it, all with the surface's exposure.

    They are made from a capture's photographs under lights (in the order of the capture's views), and the normals (height, width, 3) of
    their pixels, world frame, NaN outside the mask; without maps the vertices' stay. texels_per_pixel: along one pixel's footprint.
    ValueError where the lights do not fit the capture's photographs.
    """
    _check_lights(lights, capture)
    pixel = surface_pixel(capture, surface)
    normal = normalise(vertex_normals(surface))
    levels = (surface, *shells)
    # Charts are cut on one core: meanwhile it is told what sends light to where.
    charted, sent = on_cores(
        lambda make: make(),
        (lambda: [_charted(surface, shell, pixel / texels_per_pixel) for shell in levels], lambda: light_senders(surface, material)),
    )
    values = (surface.vertices, normal, material.normal)
    position, outward, own = (np.concatenate([_at(source, surface, of) for _, _, source in charted]) for of in values)
    places = Places(*(np.concatenate([getattr(source, name) for _, _, source in charted]) for name in Places._fields))
    albedo, seen, shown = _photographed(surface, material, lights, capture, sent, (position, normalise(outward)), maps)
    refined = texel_normals(surface, places, normalise(own), shown)
    ends = np.cumsum([len(source.face) for _, _, source in charted])
    made: list[Textures] = []
    for shell, (atlas, texels, source), end in zip(levels, charted, ends, strict=True):
        part = slice(end - len(source.face), end)
        of_shell = np.where(seen[part, None], albedo[part], _at(source, surface, material.albedo))
        weight = _at(source, surface, material.specular_weight)
        scale = made[0].scale if made else None
        share = float(seen[part].mean()) if end > part.start else 0.0
        made.append(_pictures(shell, atlas, texels, of_shell, weight, refined[part], material.law, share, scale))
    return made


def _charted(surface: Surface, shell: Surface, texel: float) -> tuple[Atlas, Texels, Texels]:
    """The shell's atlas with texels of about this side, coarser where it would be larger than LARGEST_SIDE, its texels, and those with the
    faces of the surface that they show."""
    smallest = np.sqrt(face_areas(shell).sum() / FILLED) / LARGEST_SIDE
    texel = max(texel, float(smallest))
    atlas = build_atlas(shell, texel)
    for _ in range(REBUILT):
        side = max(atlas.height, atlas.width)
        if side <= LARGEST_SIDE:
            break
        texel *= 1.02 * side / LARGEST_SIDE
        atlas = build_atlas(shell, texel)
    texels = rasterise(atlas.uv, atlas.faces, atlas.height, atlas.width)
    if shell is surface:
        return atlas, texels, texels
    shown = nearest(surface, _at(texels, shell, shell.vertices))
    return atlas, texels, texels._replace(face=shown.face, barycentric=shown.barycentric)


def _pictures(
    shell: Surface,
    atlas: Atlas,
    texels: Texels,
    albedo: Float,
    weight: Float,
    refined: Float,
    law: Law,
    from_photographs: float,
    scale: float | None,
) -> Textures:
    """Textures of albedo, lobes' weights and refined normals (n, ...) at the texels of a shell; scale: None for that of mvps.pbr."""
    rough, specular = glossy(weight, law)
    scale = white_level(albedo + specular.max(1, keepdims=True)) if scale is None else scale
    specular = np.minimum(specular / scale, 1)
    entering = np.maximum(1 - specular.max(1, keepdims=True), LEAST_ENTERING)
    level = min(white_level(specular), 1.0) if (specular > 0).any() else 0.0
    mesh_normal = vertex_normals(shell)
    shading = _tangent_space(atlas, texels, mesh_normal, refined)
    return Textures(
        surface=shell,
        atlas=atlas,
        mesh_normal=mesh_normal,
        base_color=_picture(atlas, texels, srgb_bytes(albedo / (scale * entering))),
        normal_map=_picture(atlas, texels, np.rint((shading + 1) * 127.5).astype(np.uint8)),
        roughness=_picture(atlas, texels, np.rint(rough * 255).astype(np.uint8)),
        specular_color=_picture(atlas, texels, srgb_bytes(specular / (level or 1.0))),
        specular_level=level,
        scale=scale,
        from_photographs=from_photographs,
    )


def png_bytes(image: NDArray[Any]) -> bytes:
    """An RGB or grey image (height, width[, 3]) of 8 or 16 bit as a PNG file, or with transparency (height, width, 4). ValueError where it
    is another kind of array."""
    # OpenCV stores other depths as 8 bit without an error.
    if image.dtype not in (np.uint8, np.uint16) or not image.size or image.shape[2:] not in ((), (3,), (4,)):
        raise ValueError(f"image: wanted (height, width[, 3 or 4]) uint8 or uint16, not empty, given {image.shape} {image.dtype}")
    stored = image[..., [2, 1, 0, 3][: image.shape[2]]] if image.ndim == 3 else image
    data: bytes = cv2.imencode(".png", np.ascontiguousarray(stored))[1].tobytes()
    return data


def pixel_albedo(
    caster: RayCaster,
    material: Material,
    view: View,
    direction: Float,
    intensity: Float,
    arriving: Arriving | None = None,
) -> tuple[Float, NDArray[np.float32], Bool]:
    """What the pixels of a view say of the albedo: first hits (pixels, 3), albedo (pixels, 3), and where there is one (pixels,)."""
    position = np.zeros((len(view.pixels), 3))
    albedo = np.zeros((len(view.pixels), 3), np.float32)
    known = np.zeros(len(view.pixels), bool)
    level = intensity.mean(1).astype(np.float32)
    ratio = intensity / level[:, None]
    # Noise of a channel that a light lacks is not magnified: samples stay as dark there, and so does what they are held against.
    over = np.maximum(ratio, DARK)
    strength = (level[:, None] * (ratio / over)).astype(np.float32).T[:, None]
    step = max(1, SAMPLES_PER_CHUNK // max(1, len(direction)))
    for start in range(0, len(position), step):
        part = slice(start, start + step)
        points = points_under(caster, material, view.camera, view.pixels[part])
        towards = view_directions(view.camera, points.position)
        body = diffuse_shading(points.normal, towards, direction, material.grazing)
        highlight = specular_shading(points.normal, towards, direction, points.specular_weight, material.law)
        usable: Bool = ~shadow_at(caster, material.law, points, direction) & (body > 0) & view.usable()[part] & points.hit[:, None]
        # Channels first: numpy's loops are fast along a long last axis.
        diffuse = np.broadcast_to(body, (3, *body.shape))
        if arriving is not None:
            of_albedo, of_lobes = arriving.at(points)
            diffuse, highlight = diffuse + np.moveaxis(of_albedo, -1, 0), highlight + of_lobes
        white = np.moveaxis(view.samples[part], -1, 0).astype(np.float32) * (view.scale / over.T[:, None]).astype(np.float32)
        measured = white - np.moveaxis(highlight, -1, 0) * strength
        position[part] = points.position
        albedo[part] = _robust_albedo(measured, diffuse * strength, usable).T
        known[part] = usable.any(1)
    return position, albedo, known


def _robust_albedo(measured: NDArray[np.float32], diffuse: NDArray[np.float32], usable: Bool) -> NDArray[np.float32]:
    """(3, n) robust fit a >= 0 of measured (3, n, lights) to a diffuse, over the usable (n, lights); 0 where none is.

    The channels share their weights: a highlight or a shadow's border is an outlier in all of them.
    """
    weight = usable.astype(np.float32)
    count = np.maximum(weight.sum(1, keepdims=True), 1)
    albedo = np.zeros(measured.shape[:2], np.float32)
    for _ in range(REWEIGHTINGS):
        residual = np.zeros_like(weight)
        for c, (image, shading) in enumerate(zip(measured, diffuse, strict=True)):
            weighted = weight * shading
            bottom = np.einsum("nl,nl->n", weighted, shading)
            albedo[c] = np.einsum("nl,nl->n", weighted, image) / np.maximum(bottom, np.float32(1e-30))
            residual += np.abs(image - albedo[c, :, None] * shading)
        residual *= usable
        bound = residual.sum(1, keepdims=True) / (2 * count) + np.float32(1e-12)
        weight = usable / (1 + (residual / bound) ** 2)
    return albedo.clip(0)


def _check_lights(lights: Lights, capture: Capture) -> None:
    given = [len(direction) for direction in lights.direction]
    wanted = [len(view.lights) for view in capture.views]
    if given != wanted:
        raise ValueError(f"lights: wanted one per photograph of every view ({wanted}), given {given}")


def _at(texels: Texels, surface: Surface, values: Float) -> Float:
    """(n, ...) values (V, ...) on the surface's vertices, interpolated at texels."""
    weights = texels.barycentric.reshape(texels.barycentric.shape + (1,) * (values.ndim - 1))
    interpolated: Float = sum(np.take(values, surface.faces[texels.face, k], axis=0) * weights[:, k] for k in range(3))
    return interpolated


def _photographed(
    surface: Surface,
    material: Material,
    lights: Lights,
    capture: Capture,
    sent: Senders | None,
    points: tuple[Float, Float],
    maps: Sequence[NDArray[np.float32]],
) -> tuple[Float, Bool, Shown]:
    """Albedo (n, 3) at surface points, position and mesh normal (n, 3) each, where a photograph shows it (n,), and the pixels' normals."""
    caster, (position, normal) = ray_caster(surface), points
    albedo, normals = np.zeros((2, len(position), 3))
    weights, squares = np.zeros((2, len(position)))

    def solved(i: int) -> list[tuple[Int, Float, Float]]:
        view, direction, intensity = capture.views[i], lights.direction[i], lights.intensity[i]
        arriving = light_arriving(sent, direction, view.camera.centre)
        hit, told, known = pixel_albedo(caster, material, view, direction, intensity, arriving)
        known &= away_from_border(view)
        if maps:
            told = np.concatenate([told, np.nan_to_num(maps[i][view.mask])], 1)
        parts = []
        for start in range(0, len(position), TEXELS_PER_CHUNK):
            part = slice(start, start + TEXELS_PER_CHUNK)
            seen, sampled, weight = _sampled(view, hit, told, known, position[part], normal[part])
            parts.append((start + seen, sampled, weight))
        return parts

    for parts in one_by_one(solved, len(capture.views)):
        for seen, sampled, weight in parts:
            albedo[seen] += weight[:, None] * sampled[:, :3]
            weights[seen] += weight
            squares[seen] += weight**2
            if maps:
                normals[seen] += weight[:, None] * normalise(sampled[:, 3:])
    known = weights > 0
    albedo[known] /= weights[known, None]
    return albedo, known, Shown(normals, weights, squares)


def away_from_border(view: View) -> Bool:
    """(pixels,) False where one of the eight neighbours is background: such a pixel may be mixed with it."""
    inner = cv2.erode(view.mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    away: Bool = inner[view.mask] > 0
    return away


def _sampled(view: View, hit: Float, told: NDArray[np.float32], known: Bool, position: Float, normal: Float) -> tuple[Int, Float, Float]:
    """Which of some surface points (m, 3) the view sees (n,), values (n, k) of the pixels around them, and their weight (n,)."""
    facing = np.einsum("ni,ni->n", normal, view_directions(view.camera, position))
    chosen = np.flatnonzero(facing > STEEPEST_VIEW)
    image, depth = project(view.camera, np.take(position, chosen, axis=0))
    inside = np.flatnonzero((depth > 0) & inside_image(view.camera, image))
    chosen, image, depth = chosen[inside], np.take(image, inside, axis=0), depth[inside]
    where, share = bilinear(view.pixel_index, image)
    pixel = depth / view.camera.focal_length
    # The four pixels around the point hit the surface within a diagonal of it, stretched by the slope.
    away = np.take(hit, where, axis=0) - np.take(position, chosen, axis=0)[:, None]
    near = lengths(away) < (np.sqrt(2) * pixel / facing[chosen])[:, None]
    share = share * (near & np.take(known, where))
    total = share[:, 0] + share[:, 1] + share[:, 2] + share[:, 3]
    # Where the point hides behind another part, all four pixels hit that part instead.
    sees = np.flatnonzero(total > 0.5)
    of_pixels = np.take(told, np.take(where, sees, axis=0), axis=0)
    result = np.einsum("nk,nkc->nc", np.take(share, sees, axis=0), of_pixels) / total[sees, None]
    density = facing[chosen] / pixel**2
    return chosen[sees], result, (density**2 * total)[sees]


def _tangent_space(atlas: Atlas, texels: Texels, mesh_normal: Float, refined: Float) -> Float:
    """(n, 3) refined normals (n, 3) in the basis of tangent, bitangent and mesh normal (V, 3) at the texels; unit, z >= 0."""
    corner = atlas.faces[texels.face]
    tangents = vertex_tangents(atlas, mesh_normal)
    t, n = (normalise((values[corner] * texels.barycentric[..., None]).sum(1)) for values in (tangents, mesh_normal[atlas.vertex]))
    b, r = normalise(np.cross(n, t)), normalise(refined)
    # Interpolated t and n are not exactly perpendicular: solve x t + z n for the part of r in their plane.
    skew, along_t, along_n = (t * n).sum(-1), (r * t).sum(-1), (r * n).sum(-1)
    square = np.maximum(1 - skew**2, 1e-12)
    local = np.stack([(along_t - skew * along_n) / square, (r * b).sum(-1), (along_n - skew * along_t) / square], -1)
    local[:, 2] = local[:, 2].clip(0)
    return normalise(local)


def _picture(atlas: Atlas, texels: Texels, values: NDArray[Any]) -> NDArray[Any]:
    """Values (n, ...) of texels as a picture, its charts padded."""
    image = np.zeros((atlas.height, atlas.width, *values.shape[1:]), values.dtype)
    filled = np.zeros((atlas.height, atlas.width), bool)
    image[texels.row, texels.column] = values
    filled[texels.row, texels.column] = True
    return padded(image, filled)
