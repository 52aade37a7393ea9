"""Which reflectance model an object needs: every component on trial, kept only if held-out photographs are predicted better.

Greedy, in this order: lobes from wide to narrow, their sharpness (the only unknown that no closed step gives), the law's other terms.
With e_v the mean absolute error of vertex v's held-out samples over their mean value, before and after,

    gain = mean(log e_before - log e_after),      noise = sd(log e_before - log e_after) / sqrt(n)

and a component stays where gain > CERTAIN * noise: vertices are compared with themselves, which takes their differences out of the noise,
and by ratios, because errors have long tails. Where there are errors of several kinds (of samples in the light, of samples in shadow), one
must gain by that, and none lose by as much.

That surfaces which see each other light each other needs no proof, and a shallow hollow without that light looks like a deep one with
it (Nayar, Ikeuchi and Kanade 1991), so that on a surface that is still too shallow samples in the light speak against it. Inter-reflection
stays unless held-out samples deep in shadow, where nothing else shines, lose by more than CERTAIN * noise; those in the light, where there
are none in shadow.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from mvps.scene import Float
from solvers.bounded import minimise

SHARPNESS = (8.0, 32.0, 128.0)
"""Lobes' sharpness: half-value widths of 24, 12 and 6 degrees of the half vector, roughness about 0.7, 0.5 and 0.35 of a GGX lobe."""

SHARPENED = 2.0
"""Largest factor between a lobe's sharpness at first and as solved: candidates lie a factor of four apart, so that lobes meet but never
change places."""

SHARPENING_STEP, SHARPENING_TOLERANCE, MOST_SHARPENED = 0.35, 0.1, 16
"""Of the logarithm of the sharpness: half of that range, and a tenth of a lobe's width in angle; models that are tried."""

CERTAIN = 3.0
"""Standard errors that a gain must exceed: fewer than one in a hundred runs of half a dozen trials then keeps a component by chance."""

POOR_FIT = 0.1
"""Residual, as a share of the images' signal, above which a model is said to fit badly: albedo and lobes leave 1 to 4 % on matte and glossy
objects."""


@dataclass(frozen=True)
class Model:
    """sharpness of the lobes; whether the diffuse term changes at grazing angles; whether surfaces light each other, diffusely and by their
    lobes; whether a neural residual takes what is left."""

    sharpness: tuple[float, ...] = ()
    grazing: bool = False
    bounce: bool = False
    gleam: bool = False
    neural: bool = False


LARGEST = Model(SHARPNESS, True, True, True, True)
"""All components there are."""


@dataclass(frozen=True)
class Trial:
    """One component: its name, whether it was kept, gain and noise (logarithm of the error), seconds it took to find out."""

    name: str
    kept: bool
    gain: float
    noise: float
    seconds: float


def choose(largest: Model, held_out: Callable[[Model], Float], sharpen: bool = True) -> tuple[Model, list[Trial]]:
    """The model that the object needs, starting from Lambert's, and the account of the trials.

    largest: what may be tried, its lobes from wide to narrow; its neural residual comes later and is not. sharpen: solve the lobes'
    sharpness, which takes longer than all else. held_out gives the errors, as in `judged`, of held-out samples under a model, NaN where a
    vertex has none.
    """
    # The search for the lobes' sharpness comes by the same models again.
    held_out = cache(held_out)
    model = Model()
    errors = held_out(model)
    trials = []

    def try_out(name: str, add: Callable[[Model], Model], judge: Callable[[str, Float, Float], Trial] = judged) -> None:
        nonlocal model, errors
        start = time.perf_counter()
        trial = add(model)
        with_it = held_out(trial)
        judgement = judge(name, errors, with_it)
        trials.append(replace(judgement, seconds=time.perf_counter() - start))
        if judgement.kept:
            model, errors = trial, with_it

    for s in largest.sharpness:
        try_out(f"lobe of sharpness {s:g}", lambda chosen, s=s: replace(chosen, sharpness=(*chosen.sharpness, s)))  # type: ignore[misc]
    if sharpen and model.sharpness:
        try_out("sharpness of the lobes solved", lambda chosen: sharpened(chosen, errors, held_out))
    if largest.grazing:
        try_out("diffuse term that changes at grazing angles", lambda chosen: replace(chosen, grazing=True))
    if largest.bounce:
        try_out("inter-reflection", lambda chosen: replace(chosen, bounce=True), presumed)
    return model, trials


def gained(before: Float, after: Float) -> tuple[float, float]:
    """Gain and noise, as above, of errors (n,) over errors (n,), of those that differ; 0 where none do. One alone has no scatter: its noise
    is as much as it gains or loses, which proves nothing."""
    both = (before > 0) & (after > 0) & (before != after)
    ratio = np.log(before[both] / after[both])
    if not len(ratio):
        return 0.0, 0.0
    gain = float(ratio.mean())
    return gain, float(ratio.std() / np.sqrt(len(ratio))) if len(ratio) > 1 else abs(gain)


def judged(name: str, before: Float, after: Float) -> Trial:
    """The verdict on a component from the errors (n,) without and with it, or from those of several kinds of samples (kinds, n): one must
    gain, none lose. The account is that of the surest; its time is left at 0."""
    of_kinds = _of_kinds(before, after)
    kept = any(gain > CERTAIN * noise for gain, noise in of_kinds) and not any(-gain > CERTAIN * noise for gain, noise in of_kinds)
    gain, noise = max(of_kinds, key=lambda of_kind: of_kind[0] - CERTAIN * of_kind[1])
    return Trial(name, kept, gain, noise, 0.0)


def presumed(name: str, before: Float, after: Float) -> Trial:
    """As `judged`, of a component that is there unless the last kind of samples that has an account speaks against it. One that changes
    nothing goes."""
    gain, noise = _of_kinds(before, after)[-1]
    return Trial(name, gain != 0 and gain > -CERTAIN * noise, gain, noise, 0.0)


def _of_kinds(before: Float, after: Float) -> list[tuple[float, float]]:
    """Gain and noise of every kind of samples; a kind that no vertex has, or that does not change, has none."""
    of_kinds = [gained(b, a) for b, a in zip(np.atleast_2d(before), np.atleast_2d(after), strict=True)]
    return [of_kind for of_kind in of_kinds if any(of_kind)] or of_kinds


def sharpened(model: Model, errors: Float, held_out: Callable[[Model], Float]) -> Model:
    """The model with the sharpness of its lobes that predicts the first kind of samples best; errors: of the model as it is."""
    at_first = np.array(model.sharpness)

    def by(change: Float) -> Model:
        return replace(model, sharpness=tuple((at_first * np.exp(change)).tolist()))

    def loss(change: Float) -> float:
        return -gained(np.atleast_2d(errors)[0], np.atleast_2d(held_out(by(change)))[0])[0]

    reach = np.full(len(at_first), np.log(SHARPENED))
    best, _ = minimise(loss, 0 * reach, -reach, reach, SHARPENING_STEP, SHARPENING_TOLERANCE, MOST_SHARPENED)
    return by(best)
