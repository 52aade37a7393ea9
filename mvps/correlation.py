"""Lights by correlation: for each light the direction under which a rough shape's shading looks most like the photographs.

For normals n_p, a direction l, the camera along v and h = (v + l) / |v + l| two kinds of surface are told apart,

    matte   S_p(l) = (n . l)+
    glossy  S_p(l) = (n . l)+ (0.2 + exp(10 (h . n - 1)))

and l maximises the correlation over p of S_p(l) with the square roots of the photograph's values: roots keep highlights from deciding
alone.
The kind that correlates better on average is the object's. A factorisation (calibrate) is far more accurate where Lambert's law holds; of
metals, which have no diffuse body, it says nothing, and this does.

Intensity: the median over lit pixels of value over shading.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mvps.mesh import normalise
from mvps.scene import Float

BODY, SHARPNESS = 0.2, 10.0
"""Of the glossy kind: a lobe 21 degrees wide at half its height, wider than most so that a rough shape's normals still meet it."""

ALL_AROUND = 4000
"""Directions on the whole sphere: 3.2 degrees apart, less than a hull's normals tell."""

FEW_PIXELS, FEW_DIRECTIONS = 4000, 1000
"""Of the choice between the kinds, where differences of correlation are large."""

LIT = 0.3
"""Shading, of the largest there can be, from which a pixel takes part in the intensity."""

TOWARDS_CAMERA = np.array([0.0, 0.0, -1.0])


def directions(count: int) -> Float:
    """(n, 3) those of `count` evenly spread directions (Fibonacci's spiral) that can light what the camera sees, camera frame."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    radius = np.sqrt(1 - z**2)
    sphere = np.stack([radius * np.cos(turn), radius * np.sin(turn), z], 1)
    # Beyond 107 degrees from the camera a light grazes the rims of what is seen, and nothing else.
    return sphere[z < 0.3]


def shading(normal: Float, light: Float, glossy: bool) -> NDArray[np.float32]:
    """(n, lights) S for normals (n, 3) and lights (lights, 3), camera frame."""
    n, direct = normal.astype(np.float32), light.astype(np.float32)
    lit: NDArray[np.float32] = np.maximum(n @ direct.T, 0)
    if not glossy:
        return lit
    half = normalise(light + TOWARDS_CAMERA).astype(np.float32)
    glossed: NDArray[np.float32] = lit * (BODY + np.exp(SHARPNESS * (n @ half.T - 1)))
    return glossed


def _standardised(values: NDArray[np.float32]) -> NDArray[np.float32]:
    away = values - values.mean(0)
    unit: NDArray[np.float32] = away / np.maximum(np.linalg.norm(away, axis=0), np.finfo(np.float32).tiny)
    return unit


def searched(image: Float, normal: Float, glossy: bool, count: int = ALL_AROUND) -> tuple[Float, Float]:
    """Direction (lights, 3), camera frame, and correlation (lights,) for values (n, lights) of pixels with normals (n, 3)."""
    candidates = directions(count)
    root = _standardised(np.sqrt(np.maximum(image, 0)).astype(np.float32))
    correlation = _standardised(shading(normal, candidates, glossy)).T @ root
    best = correlation.argmax(0)
    return candidates[best], correlation[best, np.arange(image.shape[1])].astype(float)


def is_glossy(images: list[Float], normals: list[Float], generator: np.random.Generator) -> bool:
    """Whether the glossy kind explains images, each (n, lights) under lights of its own, better, for normals (n, 3) each."""
    kinds = []
    for image, normal in zip(images, normals, strict=True):
        some = generator.permutation(len(image))[: max(FEW_PIXELS // len(images), 1)]
        kinds.append([searched(image[some], normal[some], glossy, FEW_DIRECTIONS)[1].mean() for glossy in (False, True)])
    matte, glossy = np.mean(kinds, axis=0)
    return bool(glossy > matte)


def glossy_lights(image: Float, normal: Float) -> Float:
    """(lights, 3) intensity times direction, camera frame, of a glossy surface."""
    direction, _ = searched(image, normal, True)
    shaded = shading(normal, direction, True)
    lit = shaded > LIT * (1 + BODY)
    ratio = np.where(lit, image / np.where(lit, shaded, 1), np.nan)
    # A light that lights nothing well has the others' mean.
    known = lit.any(0)
    level = np.full(len(direction), np.nan)
    level[known] = np.nanmedian(ratio[:, known], axis=0)
    good = known & (np.nan_to_num(level) > 0)
    level[~good] = level[good].mean() if good.any() else 1.0
    product: Float = direction * level[:, None]
    return product
