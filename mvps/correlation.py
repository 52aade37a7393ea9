"""Lights by correlation: for each light the direction under which a rough shape's shading looks most like the photographs.

For normals n_p, a direction l, the camera along v and h = (v + l) / |v + l| two kinds of surface are told apart,

    matte   S_p(l) = (n . l)+
    glossy  S_p(l) = (n . l)+ (0.2 + exp(10 (h . n - 1)))

and l maximises the correlation over p of S_p(l) with the square roots of the photograph's values: roots keep highlights from deciding
alone.
The kind that correlates better on average is the object's. A factorisation (calibrate) is far more accurate where Lambert's law holds; of
metals, which have no diffuse body, it says nothing, and this does.

Intensity: the median over lit pixels of value over shading.

Where the camera moves and the lights stand still in the world, l is sought over the pixels of all views together, each with its own v. On
hulls of metals that correlates as well as a light of each view's own does where it is so, a third as well where the lights stand still with
the camera, and 0.6 to 0.7 times as well in the frame of the cameras where they are others in every view.
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

AS_WELL = 0.8
"""Of the correlation of each view's own lights, from which lights that stand still in the world explain the views; half way between the
two kinds. So much better than lights that stand still with the camera they must be, too."""

TOLD = 0.5
"""Least correlation that tells anything: of a sheet, whose hull has none of its normals, it is 0.3 whatever is true."""

TOLD_BY_OTHERS = 2 / 3
"""Of what a view says of its lights, from which the other views say the same: 0.74 and more where they share lights, up to 0.62 where they
do not (two exceptions, 0.71 and 0.84; docs/findings/lights.md)."""


def sphere(count: int) -> Float:
    """(count, 3) evenly spread directions (Fibonacci's spiral)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], 1)


def directions(count: int) -> Float:
    """(n, 3) those of `count` evenly spread directions that can light what the camera sees, camera frame."""
    all_around = sphere(count)
    # Beyond 107 degrees from the camera a light grazes the rims of what is seen, and nothing else.
    return all_around[all_around[:, 2] < 0.3]


def shading(normal: Float, light: Float, glossy: bool, towards: Float = TOWARDS_CAMERA) -> NDArray[np.float32]:
    """(n, lights) S for normals (n, 3), lights (lights, 3) and the direction to the camera (3,), of one frame."""
    n, direct = normal.astype(np.float32), light.astype(np.float32)
    lit: NDArray[np.float32] = np.maximum(n @ direct.T, 0)
    if not glossy:
        return lit
    half = normalise(light + towards).astype(np.float32)
    glossed: NDArray[np.float32] = lit * (BODY + np.exp(SHARPNESS * (n @ half.T - 1)))
    return glossed


def _standardised(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Columns less their means, of length one; what is NaN says nothing."""
    unknown = np.isnan(values)
    if unknown.any():
        known = np.where(unknown, 0, values)
        away = np.where(unknown, 0, known - known.sum(0) / np.maximum((~unknown).sum(0), 1)).astype(np.float32)
    else:
        away = values - values.mean(0)
    unit: NDArray[np.float32] = away / np.maximum(np.linalg.norm(away, axis=0), np.finfo(np.float32).tiny)
    return unit


def _roots(image: Float) -> NDArray[np.float32]:
    """Standardised square roots of values (n, lights)."""
    return _standardised(np.sqrt(np.maximum(image, 0)).astype(np.float32))


def searched(image: Float, normal: Float, glossy: bool, count: int = ALL_AROUND) -> tuple[Float, Float]:
    """Direction (lights, 3), camera frame, and correlation (lights,) for values (n, lights), NaN where unknown, of pixels with normals
    (n, 3)."""
    candidates = directions(count)
    root = _roots(image)
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
    return _of_intensity(direction, image, shading(normal, direction, True))


def alike_in_all_views(images: list[Float], normals: list[Float], glossy: bool) -> bool | None:
    """Whether lights that stand still with the camera are the same in all views; None where correlation tells nothing. images: per view
    (n, lights), two lights or more; normals: (n, 3), camera frame."""
    few, candidates = max(FEW_PIXELS // len(images), 1), directions(FEW_DIRECTIONS)
    of_views = []
    for image, normal in zip(images, normals, strict=True):
        of_views.append(_standardised(shading(normal[:few], candidates, glossy)).T @ _roots(image[:few]))
    everywhere, count = np.sum(of_views, axis=0), images[0].shape[1]
    said = np.stack([correlation[(everywhere - correlation).argmax(0)] for correlation in of_views])
    own = float(np.einsum("vll->", said)) / (len(said) * count)
    other = (float(said.sum()) / len(said) - own * count) / (count * (count - 1))
    best = float(np.mean([correlation.max(0) for correlation in of_views]))
    return own - other > TOLD_BY_OTHERS * (best - other) if best > TOLD else None


def lamps_of_a_glossy_surface(images: list[Float], normals: list[Float], rotations: list[Float]) -> Float | None:
    """(lights, 3) intensity times direction, world frame, of lights that stand still in the world; None where they explain views less well
    than lights of their own, or of their cameras, do. images: per view (n, lights); normals: (n, 3), camera frame; rotations: (3, 3) camera
    from world."""
    few = max(FEW_PIXELS // len(images), 1)
    some_images, some_normals = [image[:few] for image in images], [normal[:few] for normal in normals]
    told = _correlation(some_images, some_normals, rotations, sphere(FEW_DIRECTIONS)).max(0).mean()
    of_views = zip(some_images, some_normals, strict=True)
    apart = np.mean([searched(image, normal, True, FEW_DIRECTIONS)[1].mean() for image, normal in of_views])
    with_camera = searched(np.concatenate(some_images), np.concatenate(some_normals), True, FEW_DIRECTIONS)[1].mean()
    if told < max(TOLD, AS_WELL * apart, with_camera / AS_WELL):
        return None
    candidates = sphere(ALL_AROUND)
    direction = candidates[_correlation(images, normals, rotations, candidates).argmax(0)]
    return _of_intensity(direction, np.concatenate(images), _in_world(normals, rotations, direction))


def _in_world(normals: list[Float], rotations: list[Float], light: Float) -> NDArray[np.float32]:
    """(n, lights) glossy S of all views' pixels, light in the world's frame."""
    return np.concatenate([shading(n @ R, light, True, TOWARDS_CAMERA @ R) for n, R in zip(normals, rotations, strict=True)])


def _correlation(images: list[Float], normals: list[Float], rotations: list[Float], candidates: Float) -> NDArray[np.float32]:
    """(candidates, lights) of all views' pixels together."""
    root = _roots(np.concatenate(images))
    found: NDArray[np.float32] = _standardised(_in_world(normals, rotations, candidates)).T @ root
    return found


def _of_intensity(direction: Float, image: Float, shaded: NDArray[np.float32]) -> Float:
    """(lights, 3) directions times intensities, for values (n, lights) of pixels whose glossy S is `shaded`."""
    lit = shaded > LIT * (1 + BODY)
    ratio = np.where(lit, image / np.where(lit, shaded, 1), np.nan)
    # A light that lights nothing well has the others' mean.
    known = (lit & ~np.isnan(image)).any(0)
    level = np.full(len(direction), np.nan)
    level[known] = np.nanmedian(ratio[:, known], axis=0)
    good = known & (np.nan_to_num(level) > 0)
    level[~good] = level[good].mean() if good.any() else 1.0
    product: Float = direction * level[:, None]
    return product
