"""Which reflectance model an object needs: every component on trial, kept only if held-out photographs are predicted better.

Greedy, in the order given. With e_v the mean absolute error of vertex v's held-out samples over their mean value, before and after,

    gain = mean(log e_before - log e_after),      noise = sd(log e_before - log e_after) / sqrt(n)

and a component stays where gain > CERTAIN * noise: vertices are compared with themselves, which takes their differences out of the noise,
and by ratios, because errors have long tails.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mvps.scene import Float

CERTAIN = 3.0
"""Standard errors that a gain must exceed: fewer than one in a hundred runs of half a dozen trials then keeps a component by chance."""


@dataclass(frozen=True)
class Model:
    """sharpness of the lobes; whether the diffuse term changes at grazing angles; whether surfaces light each other."""

    sharpness: tuple[float, ...] = ()
    grazing: bool = False
    bounce: bool = False


@dataclass(frozen=True)
class Trial:
    """One component: its name, whether it was kept, gain and noise (logarithm of the error), seconds it took to find out."""

    name: str
    kept: bool
    gain: float
    noise: float
    seconds: float


def candidates(sharpness: Sequence[float]) -> list[tuple[str, Callable[[Model], Model]]]:
    """The components, by name, as functions that add one to a model: lobes from wide to narrow, grazing, inter-reflection."""

    def lobe(s: float) -> Callable[[Model], Model]:
        return lambda model: replace(model, sharpness=(*model.sharpness, s))

    return [
        *((f"lobe of sharpness {s:g}", lobe(s)) for s in sharpness),
        ("diffuse term that changes at grazing angles", lambda model: replace(model, grazing=True)),
        ("inter-reflection", lambda model: replace(model, bounce=True)),
    ]


def choose(added: Sequence[tuple[str, Callable[[Model], Model]]], held_out: Callable[[Model], Float]) -> tuple[Model, list[Trial]]:
    """The model that the object needs, starting from Lambert's, and the account of the trials.

    held_out gives the errors (n,) of the vertices' held-out samples under a model, NaN where a vertex has none.
    """
    model = Model()
    errors = held_out(model)
    trials = []
    for name, add in added:
        start = time.perf_counter()
        trial = add(model)
        with_it = held_out(trial)
        both = (errors > 0) & (with_it > 0)
        ratio = np.log(errors[both] / with_it[both])
        gain, noise = (float(ratio.mean()), float(ratio.std() / np.sqrt(len(ratio)))) if len(ratio) else (0.0, 0.0)
        kept = gain > CERTAIN * noise
        trials.append(Trial(name, kept, gain, noise, time.perf_counter() - start))
        if kept:
            model, errors = trial, with_it
    return model, trials
