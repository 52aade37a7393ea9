"""Poses from silhouettes: cameras moved until lines of sight along the outlines touch what the other views leave of the object.

The miss e of coherence.py counts where it is positive. Over all outline points q, with motions x of the cameras (motions.py),

    sum_q rho(max(e_q(x), 0)) + (MASK_NOISE / misfit)^2 |x|^2

is made small by damped Gauss-Newton steps (Levenberg 1944, Marquardt 1963), rho Cauchy's. Cameras start within about the misfit of where
they belong, which is the second term.

Outlines are cut into quarters, and two that do not touch are held out. A pose that is wrong shows in both halves; a mask's staircase does
not, which a straight edge has along all of its length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvps.checks.coherence import Coherence, Fields, coherence, jacobian, outline_points
from mvps.cores import on_cores
from mvps.hull import bounds
from mvps.motions import UNKNOWNS, Object, gauge, moved, without_gauge
from mvps.scene import Camera, Capture, Float
from mvps.silhouette import STAIRCASE_PIXELS, mask_distances
from solvers.low_rank import CAUCHY_95

MASK_NOISE = float((12 * 2 * np.sqrt(np.pi) * STAIRCASE_PIXELS) ** -0.5)
"""Standard deviation, 0.15 pixels, of an outline that is rounded to pixels and smoothed: a Gaussian averages 2 sqrt(pi) sigma of them."""

LEAST_SPACING, MOST_POINTS = 4.0, 2000
"""Pixels between outline points: beyond three the smoothed staircase of a mask (silhouette.py) is another. Points of all views: a tenth of
a second to follow their lines of sight through twenty views."""

PARTS = 4
"""Of a view's outline: with points of both halves beside each other right cameras of blocks and nuts were moved, with eighths of blocks too
(docs/findings/checks.md)."""

FIRST_DAMPING = 1.0
"""Of the motions, in equations of a pixel: a camera moves by no more than its outline's points ask for together."""

MOST_STEPS, STILL_PIXELS = 24, 0.01
"""Gauss-Newton steps, and the root mean square motion below which they end: a fifteenth of a mask's noise."""


@dataclass(frozen=True, eq=False)
class Outlines:
    """The outlines of a capture's masks: the masks' signed distances, the object, and per view the outline points (n, 2)."""

    cameras: tuple[Camera, ...]
    fields: Fields
    body: Object
    points: list[Float]

    def half(self, which: int) -> Outlines:
        """Only every other part of each view's outline: the odd or the even ones."""

        def of(points: Float) -> Float:
            part = np.arange(len(points)) * PARTS // max(len(points), 1)
            chosen: Float = points[part % 2 == which]
            return chosen

        return Outlines(self.cameras, self.fields, self.body, [of(points) for points in self.points])

    def after(self, motions: Float) -> list[Camera]:
        """The cameras after motions (views, 6)."""
        return [moved(camera, self.body, motion) for camera, motion in zip(self.cameras, motions, strict=True)]

    def misses(self, motions: Float) -> list[Coherence]:
        """The misses of all views after motions."""
        cameras = self.after(motions)
        return on_cores(lambda i: coherence(cameras, self.fields, self.body, i, self.points[i]), range(len(cameras)))


def outlines_of(capture: Capture) -> Outlines:
    """The outlines of all masks. CaptureError where the masks enclose no object."""
    fields = mask_distances(capture)
    points = on_cores(lambda field: outline_points(field, LEAST_SPACING), fields)
    every = -(-sum(len(of_view) for of_view in points) // MOST_POINTS) or 1
    low, high = bounds(capture)
    body = Object((low + high) / 2, float(np.linalg.norm(high - low)) / 2)
    return Outlines(tuple(view.camera for view in capture.views), fields, body, [of_view[::every] for of_view in points])


def positive(found: list[Coherence]) -> Float:
    """(n,) misses of all views' points, 0 where lines of sight meet the others' hull."""
    return np.concatenate([np.maximum(one.miss, 0) for one in found])


def misfit(found: list[Coherence]) -> float:
    """Mean of the positive misses, pixels; 0 without any."""
    miss = positive(found)
    return float(miss[miss > 0].mean()) if (miss > 0).any() else 0.0


def _certain(found: list[Coherence]) -> float:
    """The misfit, at least a mask's noise."""
    return max(misfit(found), MASK_NOISE)


def _equations(outlines: Outlines, motions: Float, found: list[Coherence], scale: float) -> tuple[Float, Float]:
    """Hessian (6 views, 6 views) and gradient (6 views,) of the misses under Cauchy's weights."""
    cameras, unknowns = outlines.after(motions), UNKNOWNS * len(motions)
    hessian, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    for i, one in enumerate(found):
        part = one.of(one.miss > 0)
        slope = jacobian(cameras, outlines.fields, outlines.body, i, part).reshape(-1, unknowns)
        weighted = slope / (1 + (part.miss[:, None] / scale) ** 2)
        hessian += weighted.T @ slope
        gradient += weighted.T @ part.miss
    return hessian, gradient


def _cost(found: list[Coherence], motions: Float, tie: float, scale: float) -> float:
    return float(scale**2 * np.log1p((positive(found) / scale) ** 2).sum() + tie * (motions**2).sum())


def tie_of(found: list[Coherence]) -> float:
    """What a motion of one pixel costs where the misses at first are `found`, in squared pixels of misses: (MASK_NOISE / misfit)^2."""
    return float((MASK_NOISE / _certain(found)) ** 2)


def step(outlines: Outlines, motions: Float, found: list[Coherence], tie: float, damping: float = FIRST_DAMPING) -> Float:
    """The motions (views, 6) after one Gauss-Newton step from `motions`, where the misses are `found`; the mean pose stays."""
    hessian, gradient = _equations(outlines, motions, found, CAUCHY_95 * _certain(found))
    change = -np.linalg.solve(hessian + (tie + damping) * np.eye(len(hessian)), gradient + tie * motions.ravel())
    return motions + without_gauge(change.reshape(motions.shape), gauge(outlines.after(motions), outlines.body))


def fitted(outlines: Outlines, motions: Float, tie: float, bound: float) -> Float:
    """Motions (views, 6), each unknown within +-bound pixels, after which the outlines miss least, starting at `motions`."""
    found, damping = outlines.misses(motions), FIRST_DAMPING
    for _ in range(MOST_STEPS):
        scale = CAUCHY_95 * _certain(found)
        trial = np.clip(step(outlines, motions, found, tie, damping), -bound, bound)
        then = outlines.misses(trial)
        if _cost(then, trial, tie, scale) >= _cost(found, motions, tie, scale):
            damping *= 4
            continue
        moved_by = float(np.sqrt(((trial - motions) ** 2).mean()))
        motions, found, damping = trial, then, damping / 2
        if moved_by < STILL_PIXELS:
            break
    return motions


def by_other_half(outlines: Outlines) -> tuple[float, float]:
    """By how much the positive misses of every half of the points fall, mean in pixels, after one step that the other half asks for, and
    the standard error of that."""
    halves, still = [outlines.half(k) for k in range(2)], np.zeros((len(outlines.cameras), UNKNOWNS))
    before = [half.misses(still) for half in halves]
    asked = [step(half, still, found, tie_of(found)) for half, found in zip(halves, before, strict=True)]
    after = [half.misses(motions) for half, motions in zip(halves, reversed(asked), strict=True)]
    return fallen([one for half in before for one in half], [one for half in after for one in half])


def fallen(before: list[Coherence], after: list[Coherence]) -> tuple[float, float]:
    """By how much the positive misses fall, mean over the points in pixels, and the standard error of that."""
    change = positive(before) - positive(after)
    return (float(change.mean()), float(change.std() / np.sqrt(len(change)))) if len(change) else (0.0, 0.0)
