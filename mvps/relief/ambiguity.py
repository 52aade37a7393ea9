"""Lights of one view without calibration, up to what integrability, the outline and a few albedos tell.

A robust rank-3 factorisation (solvers/low_rank.py) gives b' and s' with I_pl = b'_p . s'_l, and b = A b', s = A^-T s' for an unknown A
(3, 3). Three things are known of b = albedo * normal, each robustly, and A minimises their sum:

integrability   b is a surface's: with h = (b_x, b_y, b . r), r = (x, y, 1) the pixel's ray, the slopes (h_x / h_z, h_y / h_z) have no
                curl, (h x d_x h)_x + (h x d_y h)_y = 0, where h x dh turns with the cofactors of A (Yuille and Snow 1997; perspective:
                Papadhimitri and Favaro 2013). Divided by |b'|^2 with the first two rows of the cofactors of unit size: so no collapse
                of A lowers it. It leaves the generalised bas-relief (Belhumeur et al. 1999): three unknowns.
albedo          few different ones: Renyi's quadratic entropy of log |b|, - sum_pq exp(-(log |b_p| / |b_q|)^2 / 2 h^2) over pairs of
                pixels of one colour (Alldrin et al. 2007 minimise Shannon's), h shrinking from LOOSE to TIGHT.
outline         normals in the mask's outer band are nearly those of its inflated silhouette: Geman and McClure's function. The
                outline tells convex from concave, which nothing else here does.

The start is the A that maps b' to the inflated silhouette's normals (as calibrate.py does with a hull's).
What lobes say of the bas-relief comes after (joint/bas_relief.py).

Of metals, enamel and dark gloss the factors say little, and what resolves them then puts lights anywhere. The silhouette's normals n, wrong
as they are pixel by pixel, say where lights are to some degrees whatever the material: least squares of I_pl / |I_p| = n_p . s_l. So the
factors are b' under these lights where this leaves less of the photographs, or where the others are not to be believed: where they leave
more than NO_BODY, or what they came to is FAR_DEG from these lights. The lights are these where neither are.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mvps.camera import pixel_centres
from mvps.mesh import angles_deg, lengths, normalise
from mvps.pixel_samples import BRIGHT_QUANTILE, SHADOWED, grey_under, lamp_colours
from mvps.scene import Bool, Float, Int, View
from solvers.low_rank import CAUCHY_95, MAD_TO_SIGMA, factorise, of_length_one, robust_weights, solve_rows

PAIRS, BLOCKS, BAND, FACTORED = 16000, 12000, 1000, 4000
"""Pairs of pixels, blocks of 2 x 2 cells and outline pixels that are drawn, and pixels that are factorised: nine unknowns against
thousands of equations leave the error to the model."""

CELL = 2
"""Side of a cell, pixels, whose mean has half of a pixel's noise: with single pixels noise of some percent outweighs the slopes' curl, and
larger cells blur the slopes."""

LOOSE, TIGHT = 0.4, 0.1
"""h of the albedos' logarithms: from the error of a first guess to the shades of one paint."""

ROUGH = 0.2
"""Scale, radians, of the outline's normals: a pixel from the edge of a ball of 50 pixels the normal has turned by as much."""

SHARE_OF_OUTLINE = 0.3
"""Weight of the outline beside the other two: a guess, which keeps convex from concave and holds what noise leaves open of them (at 0.1,
noise of 3 % turned lights by up to 8 deg, docs/findings/one_view.md)."""

ONE_COLOUR = 0.05
"""Difference of log chroma at which two pixels no longer count as of one colour."""

NO_BODY = 0.2
"""Of the photographs, that factors leave which are not to be believed: half way between what they leave on matte and glossy objects at most
and where there is no diffuse body (calibrate.py)."""

FAR_DEG = 30.0
"""Mean angle from the lights under the inflated silhouette's normals from which resolved ones cannot be right: those were 5 to 23 deg off
on 71 views of all materials, 11 in the median (docs/findings/one_view.md)."""

SWEEPS = 5


@dataclass(frozen=True)
class Pseudo:
    """The factors of one view: left (pixels, 3) b' over `bright` (pixels,); right (lights, 3) s'; weight (pixels,) share of samples that
    were believed; residual: weighted relative RMS that the factors leave."""

    left: Float
    right: Float
    bright: Float
    weight: Float
    residual: float


@dataclass(frozen=True)
class Resolved:
    """What resolves a view's factors: pseudo, the factors; rough (pixels, 3) normals of the inflated silhouette; A (3, 3), camera frame."""

    pseudo: Pseudo
    rough: Float
    A: Float

    @property
    def lights(self) -> Float:
        """(lights, 3) intensity times direction, camera frame."""
        scaled: Float = self.pseudo.right @ np.linalg.inv(self.A)
        return scaled


class _Relative:
    """A view's grey photographs, as white lamps would make them, over what a pixel is at its brightest: image (pixels, lights) over bright
    (pixels,), known where neither clipped nor in shadow, and its noise."""

    def __init__(self, view: View, colour: Float | None = None) -> None:
        """colour (lights, 3) of the lights, mean one; as the view as a whole tells it if None."""
        colour = lamp_colours(view) if colour is None else colour
        image = grey_under(view.samples, colour).astype(np.float64) * view.scale
        self.bright: Float = np.maximum(
            np.quantile(image[:, view.shown] if view.shown.any() else image, BRIGHT_QUANTILE, axis=1), view.scale
        )
        self.known = view.usable() & (image > SHADOWED * self.bright[:, None])
        self.image: Float = image / self.bright[:, None]
        self.noise = view.scale / float(np.median(self.bright))

    def factored(self, right: Float) -> Pseudo:
        """The factors with these lights (lights, 3)."""
        known = self.known.astype(np.float64)
        weight = known
        for _ in range(SWEEPS):
            left = solve_rows(self.image, weight, right)
            off = self.image - left @ right.T
            weight = robust_weights(off, known, self.noise)
        residual = float(np.sqrt((weight * off**2).sum() / max((weight * self.image**2).sum(), 1e-300)))
        return Pseudo(left, right, self.bright, weight.mean(1), residual)


def factors(view: View, generator: np.random.Generator) -> Pseudo:
    """Robust factorisation of a view's grey photographs: of FACTORED pixels, then of all for these lights."""
    grey = _Relative(view)
    drawn = generator.permutation(len(grey.image))[:FACTORED]
    return grey.factored(factorise(grey.image[drawn], grey.known[drawn], 3, floor=grey.noise).right)


def lights_under(view: View, rough: Float) -> Float:
    """(lights, 3) intensity times direction, camera frame, by least squares under rough normals (pixels, 3) as they are."""
    grey = _Relative(view)
    image, _ = of_length_one(grey.image, grey.known)
    return solve_rows(image.T, grey.known.T.astype(np.float64), rough)


def away_deg(lights: Float, under: Float) -> float:
    """Mean angle, degrees, between lights (lights, 3) and those under rough normals (lights, 3), of photographs that have samples."""
    told = lengths(under) > 0
    return float(angles_deg(normalise(lights[told]), normalise(under[told])).mean()) if told.any() else 0.0


def factors_under(view: View, lights: Float, colour: Float | None = None) -> Pseudo:
    """Factors of a view's grey photographs under lights (lights, 3), intensity times direction, that are known up to A; colour (lights, 3),
    mean one, that of the view as a whole if None."""
    return _Relative(view, colour).factored(lights)


def outer_band(view: View) -> Int:
    """(n,) pixels near the outline, not on it where they mix: 1.5 pixels deep, up to a tenth of the mask's radius, at least 4. The frame,
    where it cuts the mask off, is no outline."""
    padded = np.pad(view.mask.astype(np.uint8), 1, mode="edge")
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1][view.mask]
    radius = np.sqrt(view.mask.sum() / np.pi)
    return np.flatnonzero((depth > 1.5) & (depth <= max(4.0, 0.1 * radius)))


def _blocks(index: Int) -> Int:
    """(n, 2, CELL, 2, CELL) positions of pixels in every square of 2 x 2 cells that the mask holds, none where it is too thin.

    index (height, width) of pixels, -1 outside.
    """
    side = 2 * CELL
    if min(index.shape) < side:
        return np.zeros((0, 2, CELL, 2, CELL), index.dtype)
    squares = sliding_window_view(index, (side, side)).reshape(-1, side, side)
    return squares[(squares >= 0).all((1, 2))].reshape(-1, 2, CELL, 2, CELL)


class _Known:
    """Residuals of what is known of b = A b', for pixels drawn among some (pixels,)."""

    def __init__(self, view: View, pseudo: Pseudo, rough: Float, generator: np.random.Generator, among: Bool) -> None:
        # (n, row of cells, row in a cell, column of cells, column in a cell)
        blocks = _blocks(view.pixel_index)
        blocks = blocks[generator.permutation(len(blocks))[:BLOCKS]]
        # Drawn from all, so that answers differ by what is left out and not by what is drawn.
        blocks = blocks[among[blocks].all((1, 2, 3, 4))]
        centres = pixel_centres(view.pixels)
        ray = np.concatenate([centres, np.ones((len(centres), 1))], 1) @ np.linalg.inv(view.camera.K).T
        # Of the ray's coordinates over those of the image, in units of the latter's first.
        self.stretch, self.skew = view.camera.K[1, 1] / view.camera.K[0, 0], view.camera.K[0, 1] / view.camera.K[0, 0]
        self.of_blocks, self.rays = (of[blocks].mean((2, 4)).reshape(-1, 4, 3) for of in (pseudo.left, ray))
        self.size = np.maximum(np.linalg.norm(self.of_blocks, axis=2).mean(1) ** 2, 1e-300)
        pairs = generator.integers(0, len(among), (2, PAIRS))
        pairs = pairs[:, among[pairs].all(0)]
        self.of_pairs, self.brightness = pseudo.left[pairs], np.log(pseudo.bright[pairs])
        chroma = log_chroma(view)
        apart = ((chroma[pairs[0]] - chroma[pairs[1]]) ** 2).sum(1)
        self.alike = np.exp(-apart / (2 * ONE_COLOUR**2))
        band = outer_band(view)
        band = band[generator.permutation(len(band))[:BAND]]
        band = band[among[band]]
        self.of_band, self.rough = pseudo.left[band], rough[band]

    def curl(self, A: Float) -> Float:
        """(blocks,) of the slopes, up to the factor that keeps it from collapsing."""
        cofactors = np.stack([np.cross(A[1], A[2]), np.cross(A[2], A[0])])
        h = self.of_blocks @ (A / np.sqrt(np.linalg.norm(cofactors))).T
        h[..., 2] = (h * self.rays).sum(-1)
        middle = h.mean(1)
        right = (h[:, 1] + h[:, 3] - h[:, 0] - h[:, 2]) / 2
        down = (h[:, 2] + h[:, 3] - h[:, 0] - h[:, 1]) / 2
        down = self.stretch * down + self.skew * right
        along_y = middle[:, 2] * down[:, 0] - middle[:, 0] * down[:, 2]
        along_x = middle[:, 2] * right[:, 1] - middle[:, 1] * right[:, 2]
        curl: Float = (along_y - along_x) / self.size
        return curl

    def residuals(self, A: Float, h: float, curl_scale: float) -> Float:
        """Roots of the three robust losses, each of mean up to its weight, signed so that they are smooth."""
        curl = self.curl(A) / (CAUCHY_95 * curl_scale)
        albedo = np.log(np.maximum(np.linalg.norm(self.of_pairs @ A.T, axis=2), 1e-300)) + self.brightness
        apart = (albedo[0] - albedo[1]) / h
        off = (normalise(self.of_band @ A.T) - self.rough) / ROUGH
        off /= np.sqrt(1 + (off**2).sum(1, keepdims=True))
        return np.concatenate(
            [
                np.sign(curl) * np.sqrt(np.log1p(curl**2) / max(len(curl), 1)),
                np.sign(apart) * np.sqrt(-np.expm1(-(apart**2) / 2) * self.alike / max(float(self.alike.sum()), 1e-300)),
                off.ravel() * np.sqrt(SHARE_OF_OUTLINE / max(len(off), 1)),
            ]
        )


def log_chroma(view: View) -> Float:
    """(pixels, 3) logarithm of the colour that all lights together give a pixel, grey being 0."""
    total = np.maximum(view.samples.sum(1, dtype=np.float64), 1.0)
    chroma: Float = np.log(total / total.mean(1, keepdims=True))
    return chroma


def _unimodular(A: Float) -> Float:
    scaled: Float = A / np.cbrt(max(abs(float(np.linalg.det(A))), 1e-300))
    return scaled


def _solved(known: _Known, start: Float, h: float) -> Float:
    """A that minimises the losses with albedos' kernel h, from start."""
    curl = known.curl(start)
    scale = max(MAD_TO_SIGMA * float(np.median(np.abs(curl))), 1e-12) if len(curl) else 1.0

    def residuals(x: NDArray[np.float64]) -> Float:
        return known.residuals(_unimodular(x.reshape(3, 3)), h, scale)

    return _unimodular(least_squares(residuals, start.ravel(), max_nfev=20).x.reshape(3, 3))


def resolved(view: View, pseudo: Pseudo, rough: Float, start: Float, generator: np.random.Generator) -> Float:
    """(3, 3) A of b = A b', camera frame, |det A| = 1; rough (pixels, 3): the inflated silhouette's normals; start (3, 3): first guess."""
    known = _Known(view, pseudo, rough, generator, np.ones(len(rough), bool))
    A = _unimodular(start)
    for h in np.geomspace(LOOSE, TIGHT, SWEEPS):
        A = _solved(known, A, float(h))
    return A


def first_resolved(view: View, pseudo: Pseudo, rough: Float, start: Float, under: Float, generator: np.random.Generator) -> Resolved | None:
    """The view's first factors with their ambiguity resolved: `pseudo` from start (3, 3), or those under the lights `under` (lights, 3),
    which the rough normals (pixels, 3) tell; None where nothing but these lights is to be believed."""
    of_rough = factors_under(view, under)
    tries = [(pseudo, start)] if pseudo.residual < of_rough.residual else []
    for factors_, A in [*tries, (of_rough, np.eye(3))]:
        if factors_.residual < NO_BODY:
            found = Resolved(factors_, rough, resolved(view, factors_, rough, A, generator))
            if away_deg(found.lights, under) < FAR_DEG:
                return found
    return None


def resolved_by(view: View, found: Resolved, generator: np.random.Generator, among: Bool) -> Float:
    """A as some pixels among (pixels,) alone have it, near the one that was found by all."""
    return _solved(_Known(view, found.pseudo, found.rough, generator, among), found.A, TIGHT)
