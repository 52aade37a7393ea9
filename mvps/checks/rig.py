"""Photographs of a rig that were not taken under their own light.

Lights that stand still in the camera's frame give the predictions of prediction.py the same coefficients in all views. A photograph whose
residual with the other views' coefficients is an outlier, twice that with its view's own, and is halved by the place of another light was
taken under that light; where two of a view only changed places they are put back. One whose residual is halved by adding light from
another place had a second light on (a flash).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mvps.checks.outliers import outliers
from mvps.checks.prediction import LIT, RIDGES, Sampled, coefficients, medians
from mvps.cores import on_cores
from mvps.scene import Bool, Float

ONE_RIG = float(np.log(2) / 2)
"""Median of log residuals with the other views' coefficients over those with a view's own, below which one rig is believed: the variance
then does not double (as in mvps/calibrate.py)."""

FEWEST_VIEWS = 3
"""Of two views that differ none is the one to believe."""


SUSPECT = 2.0
"""Residual with the other views' coefficients, over that with a view's own, from which a photograph may be of another light."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """A view by the coefficients of the others: values M and predictions P (n, lights), residuals (lights,)."""

    M: Float
    P: Float
    left: Float


def _fit(M: Float, gram: Float) -> _Fit:
    """By the better of the ridges; gram (lights, lights) of the other views. Lights of which M shows nothing predict nothing."""
    live = np.diag(M.T @ M) > 0
    known = np.where(live[:, None] & live, gram, 0)
    tried = [M @ coefficients(known, ridge) for ridge in RIDGES]
    left = np.array([medians(M - P, (P > LIT) & live) for P in tried])
    best = np.argmin(np.nan_to_num(left, nan=np.inf), axis=0)
    return _Fit(M, np.where(best == 0, tried[0], tried[1]), np.choose(best, left))


def _of_light(fit: _Fit, common: Float, light: int) -> int | None:
    """The light that the photograph at the place `light` was taken under, if another halves its residual; `light` itself where adding
    another, or another exposure, does. common (lights,): the units of the lights' photographs."""
    M, P, half = fit.M, fit.P, fit.left[light] / 2
    alone = medians(M[:, light : light + 1] * common[light] / common - P, P > LIT)
    if np.isfinite(alone).any() and np.nanmin(alone) < half:
        return int(np.nanargmin(alone))
    own, image = P[:, light], M[:, light]
    for other in range(P.shape[1]):
        both = np.stack([own, P[:, other] * (other != light)], 1)
        weight = np.linalg.lstsq(both.T @ both, both.T @ image, rcond=None)[0]
        fitted = (both @ weight)[:, None]
        if weight.min() >= 0 and medians(image[:, None] - fitted, fitted > LIT)[0] < half:
            return light
    return None


def _of_view(M: Float, common: Float, gram: Float, own: Float, far: Bool) -> tuple[dict[int, int], dict[int, int]]:
    """Two photographs of a view to exchange, or else the worst to leave out, by place with the light's place. M (n, lights) in units of the
    lights, common (lights,); own (lights,): residuals by the view's own coefficients; far (lights,): which are outliers. One at a time, for
    one spoils the predictions of all."""
    fit = _fit(M, gram)
    suspects = np.flatnonzero(far & (np.nan_to_num(fit.left) > SUSPECT * np.nan_to_num(own, nan=np.inf)))
    worse = np.log(fit.left / own)
    exchanges: list[tuple[float, int, int]] = []
    without: list[tuple[float, int]] = []
    for k in suspects.tolist():
        for light in np.flatnonzero(np.isfinite(own)).tolist():
            swapped, of_swapped, pair, other = M.copy(), own.copy(), [k, light], [light, k]
            units = common[other] / common[pair]
            swapped[:, pair], of_swapped[pair] = M[:, other] * units, own[other] * units
            after = _fit(swapped, gram).left
            # In their places neither is a suspect any longer.
            if (after[pair] < SUSPECT * of_swapped[pair]).all():
                exchanges.append((float(np.nansum(np.log(after / of_swapped) - worse)), k, light))
        rest = M.copy()
        rest[:, k] = 0
        without.append((float(np.nansum(np.delete(np.log(_fit(rest, gram).left / own) - worse, k))), k))
    # With the culprit gone, or in its place, the others are predicted well: an exchange halves two residuals at least, in all.
    change, k, light = min(exchanges, default=(0.0, 0, 0))
    if change < -2 * np.log(2):
        return {k: light, light: k}, {}
    change, k = min(without, default=(0.0, 0))
    under = _of_light(fit, common, k) if change < -np.log(2) else None
    return {}, {} if under is None else {k: under}


def rig_faults(views: Sequence[Sampled], residuals: Sequence[Float]) -> tuple[dict[str, dict[int, int]], dict[tuple[str, int], str]]:
    """Views with the same lights' numbers, and what predictions within each leave of its photographs (lights,).

    Per view name which place's photograph is of which light, where two changed places; and what is wrong with others, by view name and
    number of the light. Nothing where the lights are no rig.
    """
    if len(views) < FEWEST_VIEWS:
        return {}, {}
    # Coefficients are the same in all views only where the lights have the same units.
    common = np.median([of.level for of in views], axis=0)
    values = [of.values * (of.level / common) for of in views]
    residuals = [own * (of.level / common) for of, own in zip(views, residuals, strict=True)]
    grams = np.stack([M.T @ M for M in values])
    of_others = [_mean(np.delete(grams, i, axis=0)) for i in range(len(views))]
    fits = on_cores(_fit, values, of_others)
    worse = [np.log(np.maximum(fit.left, 1e-12) / np.maximum(own, 1e-12)) for fit, own in zip(fits, residuals, strict=True)]
    told = np.concatenate(worse)
    told = told[~np.isnan(told)]
    if not len(told) or np.median(told) >= ONE_RIG:
        return {}, {}
    back: dict[str, dict[int, int]] = {}
    wrong: dict[tuple[str, int], str] = {}
    for of, M, gram, own, far in zip(views, values, of_others, residuals, outliers(worse, True), strict=True):
        exchanged, others = _of_view(M, common, gram, own, far)
        if exchanged:
            back[of.view.name] = exchanged
        for k, light in others.items():
            what = "a second light or another exposure" if k == light else f"light {of.view.lights[light]}"
            wrong[of.view.name, of.view.lights[k]] = f"was taken under {what}, as the rig's other views tell"
    return back, wrong


def _mean(grams: Float) -> Float:
    """(lights, lights) mean over the views (views, lights, lights) that show both lights."""
    count = (grams > 0).sum(0)
    mean: Float = grams.sum(0) / np.maximum(count, 1)
    return mean
