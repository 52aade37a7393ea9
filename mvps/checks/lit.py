"""Where the photographs of a view show the object: light, against a background that stays dark under all lights, or another brightness
than the wall's behind it.

With b the mean of a view's photographs over lights and channels (View.frame) and b0 = 1/4096 of full scale (a 12-bit sensor's step: noise
around black ends near it), log(b + b0) has two heaps where the background is dark: noise and object. They are told apart by Otsu's
threshold (1979), moved to the emptiest factor of two between the means of the heaps. A view tells object from background where the deep
half of its mask is lit and what is far from the mask is dark, but for FEW pixels.

A pixel belongs to a mask where its centre sees the object. Pixels that the object covers by less than half, and those that a lens blurs
its light into, are lit too but much darker than their neighbours nearer to the object: the edge of the object outside a mask is where
brightness falls by more than half from a pixel to the next, inside a mask it is where light begins. Where light goes on for more than a
pixel beyond that in three quarters of the sectors of most views, a lens has blurred it: then the edge is no farther out than where
brightness falls by most, which no blur moves (Marr and Hildreth 1980).

Where the background is not dark, w is a polynomial of second degree along both axes of the picture, fitted to what is far from the mask
by Cauchy's reweighted squares, and |b - w| takes the place of b: up to NOISE times its scatter it is the wall, above the object. A wall has
shadows of the object, which differ too: against it masks are found too large, never too small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.polynomial.polynomial import polyvander2d
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_opening, binary_propagation, label, minimum_filter

from mvps.scene import Bool, View
from solvers.low_rank import CAUCHY_95, MAD_TO_SIGMA

DARKEST = 1 / 4096
"""b0, of full scale."""

BINS = 8
"""Of the histogram to a factor of two."""

FEW = 0.05
"""Share of the mask's deep half that may be dark (crevices, a hole that the mask fills), and of what is far that may be lit (a limb that
the mask lacks, a stand)."""

REACH = 10
"""Pixels from the mask's boundary within which its true edge is looked for."""

SECTORS = 16
"""Around the mask's centroid, which tell a mask that is off everywhere from one that lacks a limb or has a side in the shadow."""

STEEP = 0.5
"""Of the brightest neighbour nearer to the mask: what falls off more is no surface but an edge (a pixel half covered, or blurred light)."""

TRUE_EDGES = (-0.12, 0.2)
"""Pixels outside the boundary at which the object may end for a true mask, which shows 0: half of what masks show that are off by one
pixel, grown (-0.2 to -0.8: half of their new pixels are covered in part, and lit) or shrunk (0.4 to 0.7: the rim falls off)."""

PARTIAL = 1 / 3
"""Of its darkest neighbour within the object: a pixel half covered, by 2/3 for what reflection at the rim falls off over a pixel."""

NOISE = 4.0
"""Standard deviations (from the median of absolute deviations) that a wall's own pixels keep within, but for one in ten thousand."""

FITS = 5
"""Of the wall: from then on weights hardly change."""

APART = 2.0
"""How many times darker than the threshold a dark background is: the emptiest factor of two reaches down by the root of that, and a heap
that reaches into it is not apart. (A ball's rim, a fifth as bright as its middle, was taken for a wall of a third.)"""

BLURRED = 2
"""Pixels around what is lit that may hold its light, by lenses and because they show it in part."""

BLOCK = np.ones((3, 3), bool)
"""Of pixels: no mixed pixels along an edge hold one, so a part that holds one is none of an edge's staircase."""


@dataclass(frozen=True, eq=False)
class Lit:
    """lit (height, width) where photographs show light; object: without pixels that the object covers by less than half; pixels from the
    mask's boundary, (sectors,), out to the object's edge (edges), to where brightness falls by most (steepest), and to where light ends
    (ends); judged: whether they tell object from background; dark: whether that is a dark one; blur: pixels beyond the edge that a lens
    lights, if it is known to."""

    lit: Bool
    object: Bool
    edges: NDArray[np.float64]
    steepest: NDArray[np.float64]
    ends: NDArray[np.float64]
    judged: bool
    dark: bool
    blur: float = 0.0

    @property
    def edge(self) -> float:
        """Median over the sectors."""
        return float(np.median(self.edges))

    @property
    def beyond(self) -> float:
        """Pixels that light goes on beyond the edge in three quarters of the sectors: of a sharp one less than the pixel that it covers in
        part."""
        return float(np.quantile(self.ends - self.edges, 0.25))

    def blurred(self) -> Lit:
        """The same of photographs that a lens has blurred: edges no farther out than where brightness falls by most."""
        edges = np.minimum(self.edges, self.steepest)
        return replace(self, edges=edges, blur=float(np.quantile(self.ends - edges, 0.75)))

    @property
    def off(self) -> bool:
        """Whether the mask as a whole is too large or too small: three quarters of the sectors say so, which no shadow makes."""
        least, most = np.quantile(self.edges, (0.25, 0.75))
        return bool(self.judged and ((self.dark and least > TRUE_EDGES[1]) or most < TRUE_EDGES[0]))


def steps(mask: Bool) -> NDArray[np.float32]:
    """(height, width) signed distance in pixels to the mask's boundary, negative inside, of the staircase of pixels itself."""

    def beside(of: Bool) -> NDArray[np.float32]:
        # Squares of distances between pixels are whole numbers: rounded to them, they are the same on every call.
        distance = cv2.distanceTransform(of.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        return np.asarray(np.sqrt(np.rint(distance * distance)), np.float32)

    return np.where(mask, 0.5 - beside(mask), beside(~mask) - 0.5).astype(np.float32)


def threshold(frame: NDArray[np.float32], full_scale: float) -> float:
    """Code value between background and object."""
    low = np.log2(DARKEST * full_scale)
    x = np.log2(frame + np.float32(DARKEST * full_scale))
    count = np.bincount(((x - low) * BINS).astype(np.int64).ravel()).astype(np.float64)
    if np.count_nonzero(count) < 2:
        return float(frame.max())
    centre = low + (np.arange(len(count)) + 0.5) / BINS
    below, moment = np.cumsum(count), np.cumsum(count * centre)
    total, mean = below[-1], moment[-1] / below[-1]
    inner = (below > 0) & (below < total)
    between = np.zeros(len(count))
    between[inner] = (mean * below[inner] - moment[inner]) ** 2 / (below[inner] * (total - below[inner]))
    split = int(between.argmax())
    dark = moment[split] / below[split]
    bright = (moment[-1] - moment[split]) / (total - below[split])
    octave = np.convolve(count, np.ones(BINS))[BINS - 1 :]
    starts = centre - 0.5 / BINS
    free = (starts >= dark) & (starts + 1 <= bright)
    if not free.any():
        return float(2 ** (starts[split] + 1 / BINS) - 2**low)
    return float(2 ** (starts[int(np.where(free, octave, np.inf).argmin())] + 0.5) - 2**low)


def lit_part(view: View, distance: NDArray[np.float32]) -> Lit | None:
    """What the photographs of a view show; distance: `steps` of its mask. None where the view's frame is not known."""
    if view.frame is None:
        return None
    far, full_scale = distance > REACH, 1 / view.scale
    least = threshold(view.frame, full_scale)
    if not far.any() or APART * np.median(view.frame[far]) <= least:
        if _has_dark_sides(view.frame, view.mask, far, least, full_scale):
            least = threshold(view.frame[view.frame <= least], full_scale)
        return _told_apart(view, distance, view.frame, least, True)
    contrast, scatter = against_wall(view.frame, far)
    return _told_apart(view, distance, contrast, max(NOISE * scatter, DARKEST / view.scale), False)


def _has_dark_sides(frame: NDArray[np.float32], mask: Bool, far: Bool, least: float, full_scale: float) -> bool:
    """Whether what is dark within a mask, farther from what is lit than light is blurred, is brighter than what is far from the mask."""
    sides = binary_opening(mask & ~binary_dilation(frame > least, BLOCK, BLURRED), BLOCK)
    if not (sides.any() and far.any()):
        return False
    return bool(np.median(frame[sides]) > APART * np.quantile(frame[far], 1 - FEW) + DARKEST * full_scale)


def against_wall(frame: NDArray[np.float32], far: Bool) -> tuple[NDArray[np.float32], float]:
    """|b - w| (height, width) and the scatter about w of what is far (height, width), code values."""
    rows, columns = (np.linspace(-1, 1, size) for size in frame.shape)
    terms = polyvander2d(*np.meshgrid(rows, columns, indexing="ij"), (2, 2))
    known, shown = terms[far], frame[far].astype(np.float64)
    weight = np.ones(len(shown))
    for _ in range(FITS):
        root = np.sqrt(weight)
        wall = np.linalg.lstsq(known * root[:, None], shown * root, rcond=None)[0]
        away = np.abs(known @ wall - shown)
        scatter = float(MAD_TO_SIGMA * np.median(away))
        weight = 1 / (1 + (away / max(CAUCHY_95 * scatter, 1e-6)) ** 2)
    return np.abs(frame - terms @ wall).astype(np.float32), scatter


def _told_apart(view: View, distance: NDArray[np.float32], frame: NDArray[np.float32], least: float, dark: bool) -> Lit:
    """Object and background by values of pixels (height, width), the object's above `least`."""
    lit = frame > least
    inner = minimum_filter(lit, 3, mode="nearest")
    darkest = minimum_filter(np.where(inner, frame, np.inf), 3, mode="nearest")
    half = lit & (inner | np.isinf(darkest) | (frame >= PARTIAL * darkest))
    far = distance > REACH
    deep = view.mask & (distance <= np.median(distance[view.mask]))
    judged = bool(lit[deep].mean() >= 1 - FEW and far.any() and lit[far].mean() <= FEW)
    edges, steepest, ends = _edges(view, frame, distance, lit)
    return Lit(lit, half, edges, steepest, ends, judged, dark)


def _edges(view: View, frame: NDArray[np.float32], distance: NDArray[np.float32], lit: Bool) -> list[NDArray[np.float64]]:
    """Edges, steepest and ends (sectors,) of Lit: distances out from the mask's boundary; negative where the object ends inside."""
    near = np.abs(distance) < REACH
    surface = np.where(view.mask, lit, lit & (frame >= STEEP * _nearer(frame, distance)))
    rows, columns = np.nonzero(near)
    middle = view.pixels.mean(0)
    angle = np.arctan2(rows - middle[0], columns - middle[1])
    sector = ((angle / (2 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
    ring = np.floor(distance[near]).astype(np.int64) + REACH
    at = sector * 2 * REACH + ring
    shape, cells = (SECTORS, 2 * REACH), SECTORS * 2 * REACH
    pixels = np.bincount(at, minlength=cells).reshape(shape)

    def mean(of: NDArray[np.generic], without: Any) -> NDArray[np.float64]:
        return np.where(pixels > 0, np.bincount(at, of[near], cells).reshape(shape) / np.maximum(pixels, 1), without)

    # Where a sector has no such pixels (a thin part) nothing speaks against the mask.
    inside = np.arange(2 * REACH) < REACH
    share, level = mean(surface, inside), mean(frame, 0)
    outwards, inwards = _run(share[:, REACH:]), _run(1 - share[:, REACH - 1 :: -1])
    falls = level[:, REACH - 1 : -1] - level[:, REACH:]
    return [out - inwards for out in (outwards, falls.argmax(1), _run(mean(lit, inside)[:, REACH:]))]


def _nearer(frame: NDArray[np.float32], distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """(height, width) the brightest of a pixel's eight neighbours that are nearer to the mask."""
    height, width = frame.shape
    values, far = np.pad(frame, 1, mode="edge"), np.pad(distance, 1, constant_values=np.inf)
    brightest = np.zeros_like(frame)
    for row in range(3):
        for column in range(3):
            part = slice(row, row + height), slice(column, column + width)
            np.maximum(brightest, np.where(far[part] < distance, values[part], 0), out=brightest)
    return brightest


def _run(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum (sectors,) of shares (sectors, rings) from the first ring to the first that is less than half, that one included."""
    whole = np.cumprod(share >= 0.5, axis=1)
    counted = np.column_stack([np.ones(len(share)), whole[:, :-1]])
    total: NDArray[np.float64] = (share * counted).sum(1)
    return total


def moved(view: View, distance: NDArray[np.float32], found: Lit) -> Bool:
    """The mask with its boundary moved to the edge of the object, no farther than where the median edge lies and a pixel and a half."""
    reach = abs(found.edge) + 1.5
    if found.edge > 0:
        return np.asarray(binary_propagation(view.mask, mask=view.mask | (found.object & (distance < reach))))
    dark = view.mask & ~found.object & (distance > -reach)
    return np.asarray(~binary_propagation(~view.mask, mask=~view.mask | dark))


def stray_parts(mask: Bool, found: Lit) -> list[Bool]:
    """Dark parts of a mask that reach its boundary and hold a block."""
    dark = mask & ~found.lit
    return [part for part in _parts(dark) if (_grown(part) & ~mask).any()]


def missing_parts(mask: Bool, found: Lit) -> list[Bool]:
    """Lit parts outside a mask that touch it, hold a block and reach farther from it than a lens blurs light, and a pixel."""
    beyond = steps(mask) > found.blur + 1
    return [part for part in _parts(found.object & ~mask) if (_grown(part) & mask).any() and (part & beyond).any()]


def _grown(part: Bool) -> Bool:
    """The part and the pixels around it."""
    grown: Bool = binary_dilation(part, BLOCK)
    return grown


def _parts(of: Bool) -> list[Bool]:
    """Connected parts that hold a block of 3 x 3 pixels."""
    whole = binary_opening(of, BLOCK)
    if not whole.any():
        return []
    numbers, _ = label(of, BLOCK)
    return [numbers == number for number in np.unique(numbers[whole])]
