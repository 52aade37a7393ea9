"""Photographs that do not belong: black ones, of another object, from another view, moved, with another light.

Each photograph is predicted from the others of its view (prediction.py). r_0 is what it leaves, and r_d what it leaves when moved by d.

suspect                  b = log(r_0 / median of r_d on a ring) is -1 to -4 for photographs that belong; it is an outlier over the whole
                         capture (outliers.py).
moved                    A suspect whose edges (edges.py) agree twice as well with those of the others when it is moved.
another object or view   A suspect whose detail is not the object's, so that moving it changes nothing: b is 0 within the spread of r_d
                         around the ring, its edges agree in place less than half as well as elsewhere, and where it is lit the
                         prediction, times whatever factor, leaves most of its variance. (Of a smooth ball moving changes little
                         either; and most of what a raking lamp shows of a sheet or a ring is shadow, which nothing predicts, and its
                         bright level that of an edge.)
black                    Its level is below the part of the view's photographs that predictions leave, its highlights are dark too, and it
                         shows nothing of the object, or its light is not weak in other views of a rig.
another light            In a rig (rig.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mvps.checks.edges import agreement
from mvps.checks.outliers import outliers
from mvps.checks.prediction import FEWEST_PIXELS, LIT, PIXELS, RIDGES, Sampled, coefficients, grey, medians, sampled, shifted
from mvps.checks.rig import rig_faults
from mvps.cores import on_cores
from mvps.finding import Finding
from mvps.scene import Bool, Capture, Float, View
from solvers.low_rank import MAD_TO_SIGMA

FEWEST_LIGHTS = 4
"""Of a view: fewer photographs predict none (three factors)."""

RING = 8
"""Directions of the ring, and its least radius in pixels; RING_SHARE of the object's size where that is more."""

RING_SHARE = 1 / 16

UNRELATED = 2.5
"""Standard deviations within which 99 % of photographs lie that have nothing to do with the view (normal quantile 2.33)."""

SURELY = 4.0
"""Standard deviations that the best of the (2 reach + 1)^2 places must reach: chance reaches 2.7 to 3.5."""

RELATED = 0.5
"""Of the variance of a photograph's lit pixels, what its prediction explains at least if it shows the object."""

BLACK, HIGHLIGHTS = 0.05, 0.99
"""Part of the other photographs' highlights, a high quantile of their pixels: a lamp that has failed leaves a room's light and noise."""

PASSES = 10
"""What is left out no longer disturbs the predictions of others, which are looked at again while something is found."""


@dataclass(frozen=True, eq=False)
class _Predicted:
    """A view's photographs (lights,): residual r_0, log(r_0 / ring) and the ring's log spread; and by which ridge (place in RIDGES)."""

    of: Sampled
    residual: Float
    b: Float
    spread: Float
    ridge: Any


def _ring(view: View) -> list[tuple[int, int]]:
    radius = max(float(RING), RING_SHARE * np.sqrt(len(view.pixels)))
    angles = 2 * np.pi * np.arange(RING) / RING
    return [(int(np.rint(radius * np.sin(a))), int(np.rint(radius * np.cos(a)))) for a in angles]


def _predicted(of: Sampled) -> _Predicted:
    gram = of.values.T @ of.values
    moved = [shifted(of, shift) for shift in _ring(of.view)]
    rows = []
    for ridge in RIDGES:
        P = of.values @ coefficients(gram, ridge)
        lit = P > LIT
        still = medians(of.values - P, lit)
        around = np.log(np.maximum([medians(M - P[inside], lit[inside]) for inside, M in moved], 1e-12))
        rows.append((still, np.log(np.maximum(still, 1e-12)) - np.median(around, 0), around.std(0)))
    best = np.where(rows[1][1] < rows[0][1], 1, 0)
    residual, b, spread = (np.choose(best, pair) for pair in zip(*rows, strict=True))
    return _Predicted(of, residual, b, spread, best)


def _resembles(p: _Predicted, light: int) -> bool:
    """Whether a photograph's lit pixels are in proportion to their predictions, or too few to tell."""
    M = p.of.values
    image, predicted = M[:, light], M @ coefficients(M.T @ M, RIDGES[p.ridge[light]])[:, light]
    # Its own bright level may be of the little that it shows, and all else noise.
    lit = (predicted > LIT) & (image * min(float(p.of.level[light]), 1.0) > LIT)
    if lit.sum() < FEWEST_PIXELS:
        return True
    correlation = float(np.corrcoef(image[lit], predicted[lit])[0, 1])
    return correlation > 0 and correlation**2 > RELATED


def _fault(p: _Predicted, light: int, spread: float) -> str | None:
    """What is wrong with a photograph that is predicted worse than chance explains; None where it lies in its place."""
    reach = max(abs(step) for shift in _ring(p.of.view) for step in shift)
    found = agreement(p.of.view, light, reach)
    level = float(np.median(found))
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(found - level)))
    here, best = found[reach, reach] - level, found.max() - level
    row, column = (int(place) - reach for place in np.unravel_index(int(np.argmax(found)), found.shape))
    if here >= best / 2:
        return None
    if best > SURELY * sigma and max(abs(row), abs(column)) > 1:
        return f"is moved by about {column} pixels to the right and {row} down against the view's other photographs"
    if here < UNRELATED * sigma and p.b[light] > -UNRELATED * spread and not _resembles(p, light):
        return "shows another object or another view: the view's other photographs predict it no better in place than moved"
    return None


def _unrelated(views: Sequence[_Predicted], same_lights: bool) -> dict[tuple[str, int], str]:
    """What is wrong with single photographs, by view and number of the light."""
    wrong: dict[tuple[str, int], str] = {}
    spreads = np.concatenate([p.spread for p in views])
    if not np.isfinite(spreads).any():
        return wrong
    spread = float(np.nanmedian(spreads))
    for p, far in zip(views, outliers([p.b for p in views], same_lights), strict=True):
        for light in np.flatnonzero(far):
            fault = _fault(p, int(light), spread)
            if fault is not None:
                wrong[p.of.view.name, p.of.view.lights[light]] = fault
    return wrong


def _faint(p: _Predicted) -> Bool:
    """(lights,) photographs with less light than what predictions leave of the view's photographs."""
    live: Bool = np.asarray(p.of.view.usable().any(0))
    if not live.any() or not np.isfinite(p.residual).any():
        return np.zeros_like(live)
    # Of a metal many photographs are dark, but for highlights.
    brightest = np.quantile(grey(p.of.view.samples[p.of.chosen]), HIGHLIGHTS, axis=0)
    faint: Bool = live & (p.of.level < np.nanmedian(p.residual)) & (brightest < BLACK * np.median(brightest[live]))
    return faint


def _black(views: Sequence[_Predicted], same_lights: bool) -> dict[tuple[str, int], str]:
    """Photographs that no light lit. A weak one does: it shows the object, and lights of a rig are weak in all views."""
    faint = [_faint(p) for p in views]
    weak: Any = np.mean(faint, axis=0) > 0.5 if same_lights else True
    wrong: dict[tuple[str, int], str] = {}
    for p, of_view in zip(views, faint, strict=True):
        black = of_view & ~(weak & (p.b < -UNRELATED * p.spread))
        for k in np.flatnonzero(black):
            wrong[p.of.view.name, p.of.view.lights[k]] = f"is black, {100 * p.of.level[k]:.2g} % as bright as the others"
    return wrong


def _found(capture: Capture, one_rig: bool) -> tuple[Capture, dict[tuple[str, int], str], dict[tuple[str, int], str]]:
    """One pass: the capture with photographs put back, what was put back, and what is wrong and to be left out."""
    generator = np.random.default_rng(0)
    enough = [view for view in capture.views if int(view.usable().any(0).sum()) >= FEWEST_LIGHTS]
    samples = [sampled(view, PIXELS, generator) for view in enough]
    views = on_cores(_predicted, samples)
    if not views:
        return capture, {}, {}
    same_lights = one_rig and len({view.lights for view in enough}) == 1
    wrong = _unrelated(views, same_lights) | _black(views, same_lights)
    # Of what is left out nothing more need be said; its light is looked for where it belongs to the view.
    if wrong or not same_lights:
        return capture, {}, wrong
    back, wrong = rig_faults([p.of for p in views], [p.residual for p in views])
    put_back = {}
    changed = []
    for view in capture.views:
        moves = back.get(view.name, {})
        if moves:
            values = view.samples.copy()
            for place, light in moves.items():
                values[:, light] = view.samples[:, place]
                put_back[view.name, view.lights[place]] = f"was taken under light {view.lights[light]} of the rig; put in its place"
            view = replace(view, samples=values)
        changed.append(view)
    return Capture(capture.name, tuple(changed)), put_back, wrong


def photographs(capture: Capture, one_rig: bool = True) -> tuple[Capture, list[Finding]]:
    """The capture without photographs that do not belong (they are no data then), those of a rig that changed places put back. one_rig:
    lights of the same number may be the same in all views."""
    findings: list[Finding] = []
    for _ in range(PASSES):
        after, back, wrong = _found(capture, one_rig)
        if not back and not wrong:
            break
        findings += [Finding("photograph", f"{view}/{light:03d}", text, True) for (view, light), text in back.items()]
        findings += [Finding("photograph", f"{view}/{light:03d}", f"{text}; left out", True) for (view, light), text in wrong.items()]
        capture = after.without({view.name: [n for v, n in wrong if v == view.name] for view in after.views})
    return capture, findings
