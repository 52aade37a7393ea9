"""How bright photographs under one rig are: of cameras that expose every view anew, flashes that fade or differ from shot to shot.

The photograph of view i under light l is e_il times as bright as the rig's lamp makes it: the lights' intensities are e_il times the rig's.
log e are unknowns of the lights' block (lights.py), with the image itself as derivative: one for each view, or one for each photograph.
What all views have in common is the lights' scale.

Which of them are unknown is decided by what they explain. With r^2 the weighted sum of squared residuals, g_il and h_il those of the image
with the residual and with itself, the strength of a photograph explains beside everything else, over that of its view,

    h_il (g_il / h_il - sum_l g_il / sum_l h_il)^2 / r^2

Of the sum what a tenth of the photographs explains counts as twice what all others do at most, for a black one is no flicker: of a normal
distribution's squares the largest tenth has 0.44. And strengths of views, whose vertices' albedo makes up for most of them, explain
g^T S^-1 g / r^2 with them less that without, S the lights' system. They stay where half of as much is gone once they are solved, and where
they have settled: what is wrong with a badly fitting model or a wrong shape looks like photographs that are not as bright, but either is
not mended by strengths, or they creep on, or those of photographs have to be many times as far apart as what they explain is wrong by, for
each undoes what others do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mvps.joint.blocks import DirectionalLights
from mvps.scene import Float, Lights

ROUNDING = 1e-4
"""Relative difference of photographs' brightness that is rounding: directions are turned into every view's frame in single precision."""

ALIKE = 0.03
"""Step of log e up to which views are exposed alike. Where they were it was 0.026 at most (a plane; else 0.012) in coarse rounds that fit
(docs/findings/lights.md)."""

SOME, MUCH = 0.02, 0.1
"""Part of what is unexplained that longer steps have to explain, and the same on a hull and where the model fits badly, for what is wrong
there looks like views that are not as bright. On surfaces that fit exposures of a tenth explain 0.5, in three views 0.036 and more, a view
of another object 0.006, a wrong shape of three views 0.010; on hulls others explain 0.06 at most, exposures 0.1 to 0.9 on most
(docs/findings/lights.md)."""

MOST = 0.22
"""Part of what is unexplained from which on strengths of photographs are tried: 0.19 at most where all were as bright and the model fitted
(a plane, the hull of a nut), 0.26 to 0.7 under lamps that flicker by 3 % on most hulls (docs/findings/lights.md)."""

GONE = 0.5
"""Part of what strengths' next step explains that has to be gone once they are solved. Under lamps that did flicker 0.74 of it was, and
more; on metals with flat and round sides, all photographs as bright, at most a fifth, on most more was left than before
(docs/findings/lights.md)."""

SETTLED = 0.1
"""Of the squares that strengths' next step explained, the most that it may explain once they are solved: under lamps that did flicker 0.02
and less, on a metal with flat sides 0.8 (docs/findings/lights.md)."""

APART = 3.0
"""Standard deviation of the logarithms of photographs' strengths over the root mean square share of the signal that they explain, at most:
1.3 to 2.8 under lamps that did flicker, 3.5 to 12 where strengths stood in for a wrong shape, or were wrong by as much themselves
(docs/findings/lights.md)."""

TENTH = 0.1
"""Part of the photographs that may be wrong in other ways."""


@dataclass(frozen=True, eq=False)
class Strengths:
    """of: e of each view's photographs (lights,); unknown: how many of a view are, one or one for each photograph."""

    of: list[Tensor]
    unknown: int


@dataclass(frozen=True)
class Told:
    """Next steps, and the part of what is unexplained that they explain. of_views: steps of the logarithms of views' strengths; lights: all
    other steps; views: those of views, over these; photographs: those of single photographs, over those of views."""

    of_views: list[float]
    lights: float
    views: float
    photographs: float


def as_bright(lights: Sequence[DirectionalLights]) -> Strengths:
    """Strengths of views that are as bright as the rig makes them."""
    return Strengths([torch.ones_like(of_view.intensity) for of_view in lights], 1)


def strengths_of(lights: Lights) -> Float | None:
    """e (views, lights) of photographs under one rig, the mean of a light's 1; None where all are as bright, without a rig, and where views
    have other lights of it."""
    if not lights.one_rig or len({len(of_view) for of_view in lights.intensity}) > 1:
        return None
    intensity = np.array([of_view.mean(1) for of_view in lights.intensity])
    found: Float = intensity / intensity.mean(0)
    return found if np.abs(found - 1).max() >= ROUNDING else None


def unknown_in(strengths: Float) -> int:
    """How many of a view's strengths (views, lights) are unknowns: one where its photographs have the same."""
    apart = strengths / strengths.mean(1, keepdims=True) - 1
    return strengths.shape[1] if np.abs(apart).max() >= ROUNDING else 1


def unknown_of(lights: Lights) -> int:
    """How many strengths of all views are unknowns."""
    known = strengths_of(lights)
    return 0 if known is None else len(known) * unknown_in(known)


def strengths_in(lights: Sequence[DirectionalLights], unknown: int) -> Strengths:
    """e of the lights of a rig's views, as many unknowns of each."""
    intensity = torch.stack([of_view.intensity for of_view in lights])
    return Strengths(list(intensity / intensity.double().mean(0).to(intensity.dtype)), unknown)


def of_photographs(gradient: Tensor, information: Tensor) -> Tensor:
    """What strengths of photographs explain, over those of views, by g and h (views, lights)."""
    of_view = gradient.sum(1, keepdim=True) / information.sum(1, keepdim=True).clamp_min(1e-300)
    each = (information * (gradient / information.clamp_min(1e-300) - of_view) ** 2).flatten().sort().values
    few = max(1, round(TENTH * len(each)))
    rest = each[:-few].sum()
    return rest + torch.minimum(2 * rest, each[-few:].sum())


def needed(told: Told, lights: int, least: float) -> int:
    """How many unknown strengths a view of so many lights needs. least: part of what is unexplained that those of views have to explain."""
    # Lights on their way explain more than what is wrong with them looks like.
    if lights > 1 and told.photographs > max(MOST, told.lights):
        return lights
    step = np.array(told.of_views)
    # What single photographs explain more of is no exposure of views.
    return int(np.abs(step - step.mean()).max() > ALIKE and told.views >= max(least, told.photographs))


def borne_out(told: Told, then: Told, strengths: Strengths, before: float, after: float) -> bool:
    """Whether strengths took at least GONE of what was told off what is unexplained, have SETTLED, and are no more APART than explains
    it; then: what is told once they are solved; before, after: root mean squares of what is unexplained."""
    of_each = strengths.unknown > 1
    explained, left = (rms**2 * (one.photographs if of_each else one.views) for one, rms in ((told, before), (then, after)))
    if after**2 > before**2 - GONE * explained or left > SETTLED * explained:
        return False
    log = torch.stack(strengths.of).double().log()
    # Those of views are mostly made up for by vertices' albedo.
    return not of_each or float((log - log.mean(1, keepdim=True)).square().mean()) <= APART**2 * explained
