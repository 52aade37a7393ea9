"""A curve that photographs alone do not prove, told by what is solved with and without it.

Under I = code^e codes have the likelihood of the residuals over what a step of the code is in I (Box and Cox 1964, equation 8), by which an
exponent that only flattens or stretches photographs gains nothing. With s a vertex's residuals' scale, and but for the mean logarithm of
the codes, which is the same for all exponents,

    -log likelihood of a sample  =  mean log (s / I) - log e  =  mean log (s / rms I) + mean log (rms I / geometric mean I) - log e

s / rms I is what Stage II leaves unexplained in the light (joint/refine.py) on the hull: enough to tell, in a few seconds each. Exponents
are tried in steps from 1 upwards until they get worse; between the steps the likelihood is a parabola.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mvps.calibrate import uncalibrated_lights
from mvps.checks.radiometry import BETTER
from mvps.cores import on_cores
from mvps.device import chosen_device
from mvps.hull import hull_grid, hull_of_masks
from mvps.joint.refine import refine
from mvps.joint.thinned import thinned
from mvps.own_units import in_own_units, own_units
from mvps.photometric import normal_maps
from mvps.plan import Parts, first_pass
from mvps.pyramid import levels
from mvps.scene import Capture, CaptureError, Float, View

EXPONENTS = (1.0, 1.4, 1.8, 2.2, 2.6)
"""From none to beyond the strongest of displays' (2.4), in steps over which lights turn by some 3 degrees."""

PIXELS, LIT_SHARE = 1000, 0.75
"""Of a view whose contrast is looked at, and of a pixel's samples, from the brightest down: those that are lit, whose residuals count. By
half of them exponents under noise come out 0.3 too large (docs/findings/checks.md)."""


def exponent_left_in(under: Callable[[float], Capture]) -> tuple[float, float] | None:
    """The exponent that was left in photographs, and by which factor less is unexplained with it undone; None where that is less than
    BETTER or grows to the end of EXPONENTS. under(e): the capture with what is recorded to the power of e, and checked. What cannot be
    solved is as bad as can be, and next to it nothing is told."""
    found: list[float] = []
    for exponent in EXPONENTS:
        try:
            found.append(misfit(under(exponent), exponent))
        except CaptureError:
            found.append(np.inf)
        if found[-1] > min(found) or np.isinf(found[0]):
            break
    best = int(np.argmin(found))
    gain = found[0] - found[best]
    # What gets ever better the farther it is bent is no curve of a display but a shape that is not understood (a plane).
    if not gain >= np.log(BETTER) or best + 1 == len(found) or np.isinf(found[best + 1]):
        return None
    before, at, after = found[best - 1 : best + 2]
    step = (EXPONENTS[1] - EXPONENTS[0]) * (before - after) / (before + after - 2 * at) / 2
    return EXPONENTS[best] + step, float(np.exp(gain))


def misfit(capture: Capture, exponent: float) -> float:
    """-log likelihood of a sample of the capture, whose radiances are codes to the power of `exponent`, but for a constant."""
    capture = levels(capture)[-1]
    capture = in_own_units(capture, own_units(capture))
    hull = hull_of_masks(capture, hull_grid(capture))
    # The same wherever the reconstruction runs, that others may undo the same.
    seed, device = 0, chosen_device("cpu")
    lights = uncalibrated_lights(capture, hull, seed).lights
    maps = normal_maps(*thinned(capture, lights), device)
    refined = refine(capture, hull, lights, maps, Parts().law(), first_pass(True, False), seed, device, lambda *_: None)
    left = refined.in_light[refined.in_light > 0]
    return float(np.log(left).mean()) + contrast(capture) - float(np.log(exponent)) if len(left) else np.inf


def contrast(capture: Capture) -> float:
    """Mean logarithm of the root mean square over the geometric mean of a pixel's lit samples; inf where no pixel has two."""
    of_pixels = np.concatenate(on_cores(_contrast, capture.views))
    return float(of_pixels.mean()) if len(of_pixels) else np.inf


def _contrast(view: View) -> Float:
    """That of some pixels."""
    chosen = np.sort(np.random.default_rng(0).permutation(len(view.pixels))[:PIXELS])
    image, usable = view.samples[chosen].mean(-1, dtype=np.float64), view.usable()[chosen]
    order = np.argsort(np.argsort(np.where(usable, -image, 1.0), axis=1), axis=1)
    lit = usable & (order < LIT_SHARE * usable.sum(1, keepdims=True)) & (image > 0)
    count = np.maximum(lit.sum(1), 1)
    square, log = ((values * lit).sum(1) / count for values in (image**2, np.log(np.maximum(image, 1.0))))
    several = count > 1
    return np.asarray(np.log(square[several]) / 2 - log[several])
