"""Normals of surfaces that Lambert's law says nothing of (metals, enamel, dark gloss) by virtual exemplars.

An exemplar is a patch that faces along n, of one of the object's two materials, bodies with lobes (shading.py) over half vectors h, whose
weights w are solved before (two_materials.py):

    f = sum_k w_k D_k,     D_0 = (n . l)+,     D_k = (n . l)+ gain exp(s_k (h . n - 1))

Of a pixel's values I exemplars with normal n leave the part

    r(n) = 1 - (I . f)^2 / (|I|^2 |f|^2)

of the material that explains more. What n, w and the lights alone say is the same for all pixels seen from one side, so r is a few
products of matrices, for all n of a grid on the hemisphere. No start is needed, and none can be wrong (Hui and Sankaranarayanan 2017, whose
exemplars are measured reflectances). With m values and errors of unknown size n has the density r^(-m / 2); its mean is the pixel's normal,
and as neighbouring lights share the model's errors (two count as one) its variance is that of r^(-m / 4).

Whether an object is of such a kind, patches tell that are of any mixture x of a body and one lobe, each pixel's own:

    r(n) = 1 - max over k of max over x >= 0 of (2 x . b - x . G x) / |I|^2,     b = D^T I,     G = D^T D

in closed form: both parts where both come out positive, else the one that explains more.

Objects whose pixels mostly gain nothing by lobes keep the normals of Lambert's law: what that leaves of them is shaded or lit by other
surfaces, of which exemplars know no more. On others, pixels stay that it fits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvps.camera import pixel_centres, rays
from mvps.cores import on_cores
from mvps.correlation import sphere
from mvps.material import POOR_FIT, SHARPNESS
from mvps.mesh import normalise
from mvps.scene import RELIABLE, Bool, Float, Int, NormalMap, View
from mvps.shading import against, gain, half_dot_normal, half_length, lobe

Weights = NDArray[np.float32]
"""(materials, 1 + lobes) of bodies and lobes, at least zero; each material's up to a factor."""

Ask = Callable[[Tensor, Tensor, Tensor, list[Tensor]], Tensor]
"""Of values, whether they are usable, normals and their exemplars."""

BY_EXEMPLARS, BY_MATERIALS = "normals by exemplars of two materials", "lights by two materials"
"""How normals and lights were found, for the account."""

NORMALS = 2000
"""Directions on the whole sphere, 4.5 degrees apart: with 6000 metals' normals err by 0.2 degrees less, for three times the time
(docs/findings/one_view.md)."""

ASKED = 2000
"""Pixels that say whether an object is of such a kind."""

GAINED, MISSED = 1.5, 0.2
"""(r_0 + MISSED^2) / (r + MISSED^2), r_0 what exemplars without lobes leave, from which on lobes explain a pixel, and the part of its light
that none has to explain, which cast shadows and other surfaces take or give."""

SHINY = 1 / 3
"""Part of an object's pixels that lobes explain, from which on exemplars are asked: up to 0.24 on matte and glossy objects, 0.38 and more
on patina, enamel, dark gloss and metals (docs/findings/one_view.md)."""

FEWEST = 5
"""Values of a pixel that tell a normal, a body and a lobe, and whether they fit."""

LEAST = 1e-4
"""Least r that is believed: no patch lies nearer to an exemplar than half of the grid's step."""

SIDES = 0.1
"""Width of the directions to the camera that count as one, tangents: half of it is less than the grid's step."""

PIXELS_AT_ONCE = 128
"""Whose r at all normals stay in the processor's cache."""


def is_shiny(view: View, direction: Float, intensity: Float, device: torch.device) -> bool:
    """Whether lobes explain what a view of the object shows under lights direction, intensity (lights, 3)."""
    known = np.flatnonzero(enough(view))
    some = np.sort(np.random.default_rng(0).permutation(known)[:ASKED])
    return bool(len(some)) and bool((_answers(view, direction, intensity, some, device, _gain) > GAINED).mean() > SHINY)


def with_exemplars(
    view: View, direction: Float, intensity: Float, weights: Weights, maps: NormalMap, device: torch.device, all_over: bool
) -> NormalMap:
    """Photometric stereo with exemplars' normals where Lambert's law fits badly, or all over, where a pixel has values enough.

    direction, intensity (lights, 3): of the view's photographs; weights (materials, 1 + lobes): of the object's materials; maps: by
    Lambert's law under these lights.
    """
    rows = np.flatnonzero(enough(view))
    if not all_over:
        rows = rows[misfit(view, direction, intensity, maps, rows) > POOR_FIT]
    normal, confidence, albedo = (of_pixels.copy() for of_pixels in (maps.normal, maps.confidence, maps.albedo))
    found, sigma, body = matched(view, direction, intensity, weights, rows, device)
    normal[rows], confidence[rows] = found, 1 / (1 + (sigma / RELIABLE) ** 2)
    albedo[rows] *= (body / np.maximum(albedo[rows].mean(1), np.finfo(np.float32).tiny))[:, None]
    return replace(maps, normal=normal, confidence=confidence, albedo=albedo)


def enough(view: View) -> Bool:
    """(pixels,) whether a pixel has FEWEST values."""
    found: Bool = view.usable().sum(1) >= FEWEST
    return found


def values(view: View, intensity: Float, rows: Int) -> NDArray[np.float32]:
    """(n, lights) grey radiance over intensity (lights, 3) of some of the view's pixels, rows (n,); 0 where it is not known."""
    image: NDArray[np.float32] = (view.samples[rows] * (view.scale / intensity).astype(np.float32)).mean(-1)
    return np.where(view.usable()[rows], image, np.float32(0))


def misfit(view: View, direction: Float, intensity: Float, maps: NormalMap, rows: Int) -> Float:
    """(n,) by how much Lambert's law is off under lights direction, intensity (lights, 3), over the light that some of the view's pixels,
    rows (n,), send."""
    image = values(view, intensity, rows)
    shaded = maps.albedo[rows].mean(1, keepdims=True) * np.maximum(maps.normal[rows] @ direction.T, 0) * view.usable()[rows]
    off: Float = np.abs(image - shaded).sum(1) / np.maximum(image.sum(1), np.finfo(np.float32).tiny)
    return off


def matched(
    view: View, direction: Float, intensity: Float, weights: Weights, rows: Int, device: torch.device
) -> tuple[Float, Float, Float]:
    """Normals (n, 3), world frame, their standard deviations (n,), radians, and the diffuse part (n,) of the likeliest exemplars of some of
    the view's pixels, rows (n,), under lights direction, intensity (lights, 3), of materials with weights (materials, 1 + lobes)."""
    of = torch.from_numpy(weights).to(device)
    x, y, z, sigma, body = _answers(
        view, direction, intensity, rows, device, lambda image, known, grid, shown: _likeliest(image, known, grid, shown, of)
    )
    return np.column_stack([x, y, z]) @ view.camera.rotation, sigma, body


def _answers(view: View, direction: Float, intensity: Float, rows: Int, device: torch.device, ask: Ask) -> Float:
    """(k, n) what is asked of some of the view's pixels, rows (n,), and the exemplars that they are held against."""
    torch.set_num_threads(1)
    R = view.camera.rotation
    towards = -rays(view.camera, pixel_centres(view.pixels[rows]))[1] @ R.T
    side = np.unique(np.round(towards[:, :2] / -towards[:, 2:] / SIDES).astype(int), axis=0, return_inverse=True)[1].ravel()
    image = torch.from_numpy(values(view, intensity, rows)).to(device)
    usable = torch.from_numpy(view.usable()[rows].astype(np.float32)).to(device)
    places, answers = [np.zeros(0, int)], []
    for number in np.unique(side):
        of_side = np.flatnonzero(side == number)
        exemplars = _exemplars(normalise(towards[of_side].mean(0)[None]), direction @ R.T, device)
        parts = np.array_split(of_side, -(-len(of_side) // PIXELS_AT_ONCE))
        places += parts
        answers += on_cores(lambda part, of=exemplars: ask(image[part], usable[part], *of).double().cpu().numpy(), parts)
    order = np.argsort(np.concatenate(places))
    return np.concatenate(answers, 1)[:, order] if answers else np.zeros((5, 0))


def _exemplars(towards: Float, light: Float, device: torch.device) -> tuple[Tensor, list[Tensor]]:
    """Normals (n, 3) that a camera along towards (1, 3) sees, and D_0, D_1 ... (n, lights) of patches under light (lights, 3)."""
    grid = sphere(NORMALS)
    normal, view, direct = (torch.from_numpy(a.astype(np.float32)).to(device) for a in (grid[grid @ towards[0] > 0], towards, light))
    return normal, patches(normal, view, direct)


def patches(normal: Tensor, towards: Tensor, light: Tensor) -> list[Tensor]:
    """D_0, D_1 ... (n, lights) of patches that face along normal (n, 3), seen from towards (1, 3), under light (lights, 3)."""
    n_dot_l, v_dot_l = against(normal, light), against(towards, light)
    lit = n_dot_l.clamp_min(0)
    half = half_dot_normal(against(normal, towards), lit, v_dot_l)
    gained = lit * gain(half_length(v_dot_l))
    return [lit, *(gained * lobe(half, s, False)[0] for s in SHARPNESS)]


def _gain(image: Tensor, usable: Tensor, _: Tensor, shown: list[Tensor]) -> Tensor:
    """(1, m) what exemplars without lobes leave of values (m, lights) that are usable (m, lights), over what those with lobes do."""
    image = image / _level(image)
    without, left = (_left(image, usable, some).amin(1) + MISSED**2 for some in (shown[:1], shown))
    return (without / left)[None]


def _likeliest(image: Tensor, usable: Tensor, grid: Tensor, shown: list[Tensor], weights: Tensor) -> Tensor:
    """(5, m) normals, standard deviations and diffuse parts for values (m, lights) that are usable (m, lights)."""
    level = _level(image)
    left, body = left_by_materials(image / level, usable, shown, weights)
    exponent = -usable.sum(1, keepdim=True) / 2 * left.log()
    normal = torch.nn.functional.normalize(torch.softmax(exponent, 1) @ grid, dim=1)
    # E[1 - cos] of a small angle is half of its square, so the variance along either of two tangents.
    variance = 1 - ((torch.softmax(exponent / 2, 1) @ grid) * normal).sum(1)
    best = left.argmin(1, keepdim=True)
    return torch.cat([normal.T, variance.clamp_min(LEAST).sqrt()[None], (body.gather(1, best) * level).T])


def left_by_materials(image: Tensor, usable: Tensor, shown: list[Tensor], weights: Tensor) -> tuple[Tensor, Tensor]:
    """r, LEAST at least, and the diffuse part, (m, normals) both, of values (m, lights) that are usable (m, lights), by the better of
    materials with weights (materials, 1 + lobes). shown: D_0, D_1 ... (normals, lights)."""
    tiny = torch.finfo(image.dtype).tiny
    explained, body = (image.new_zeros(len(image), len(shown[0])) for _ in range(2))
    for of_material in weights:
        sent = sum((w * part for w, part in zip(of_material[1:], shown[1:], strict=True)), start=of_material[0] * shown[0])
        b, g = image @ sent.T, (usable @ sent.square().T).clamp_min(tiny)
        by_this = b * b / g
        better = by_this > explained
        explained, body = torch.where(better, by_this, explained), torch.where(better, of_material[0] * b / g, body)
    return (1 - explained / _squares(image)).clamp_min(LEAST), body


def _level(image: Tensor) -> Tensor:
    """(m, 1) the largest of values (m, lights)."""
    return image.amax(1, keepdim=True).clamp_min(torch.finfo(image.dtype).tiny)


def _squares(image: Tensor) -> Tensor:
    """(m, 1) |I|^2 of values (m, lights)."""
    return (image * image).sum(1, keepdim=True).clamp_min(torch.finfo(image.dtype).tiny)


def _left(image: Tensor, usable: Tensor, shown: list[Tensor]) -> Tensor:
    """(m, normals) r, LEAST at least, of values (m, lights), by patches that are each of any body and lobe."""
    diffuse = shown[0]
    b0, g00 = image @ diffuse.T, (usable @ diffuse.T.square()).clamp_min(torch.finfo(image.dtype).tiny)
    by_body = b0 * b0 / g00
    explained = by_body
    for lobed in shown[1:]:
        b1, g11, g01 = image @ lobed.T, (usable @ lobed.T.square()).clamp_min(torch.finfo(image.dtype).tiny), usable @ (diffuse * lobed).T
        # A lobe and a body that look alike to these lights tell nothing apart.
        free = (g00 * g11 - g01 * g01).clamp_min_(1e-5 * g00 * g11)
        x0, x1 = (b0 * g11 - b1 * g01) / free, (b1 * g00 - b0 * g01) / free
        by_these = torch.where((x0 >= 0) & (x1 >= 0), x0 * b0 + x1 * b1, torch.maximum(by_body, b1 * b1 / g11))
        explained = torch.maximum(explained, by_these)
    return (1 - explained / _squares(image)).clamp_min(LEAST)
