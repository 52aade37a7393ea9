"""Cameras from silhouettes: changed until lines of sight along the outlines touch what the other views leave of the object.

The miss e of coherence.py counts where it is positive. Over all outline points q, with unknowns x of the cameras in pixels (motions of
each, motions.py; or a principal point that all share, principal.py),

    sum_q rho(max(e_q(x), 0)) + (MASK_NOISE / misfit)^2 |x|^2

is made small by damped Gauss-Newton steps (Levenberg 1944, Marquardt 1963), rho Cauchy's. Cameras start within about the misfit of where
they belong, which is the second term.

Outlines are cut into quarters, and two that do not touch are held out. A camera that is wrong shows in both halves; a mask's staircase does
not, which a straight edge has along all of its length.

Where a boundary runs along rows or columns of pixels it is off by the same part of a pixel, up to half of one, over its whole run, and in
all views to which an upright object looks alike. There is no step of the staircase to average over: neither do points there say anything,
nor misses that such a boundary of another view decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mvps.camera import project
from mvps.checks.coherence import Coherence, Fields, coherence, gradients, jacobian, outline_points
from mvps.cores import on_cores
from mvps.hull import masks_box
from mvps.motions import UNKNOWNS, Object, derivatives, gauge, moved, without_gauge
from mvps.scene import Bool, Camera, Capture, Float
from mvps.silhouette import STAIRCASE_PIXELS, mask_distances
from solvers.low_rank import CAUCHY_95

MASK_NOISE = float((12 * 2 * np.sqrt(np.pi) * STAIRCASE_PIXELS) ** -0.5)
"""Standard deviation, 0.15 pixels, of an outline that is rounded to pixels and smoothed: a Gaussian averages 2 sqrt(pi) sigma of them."""

DOUBTFUL_PIXELS = 2 * MASK_NOISE
"""Mean of the positive misses from which cameras and masks contradict each other: a miss has the noise of two views' masks, and is the
largest of several."""

LEAST_SPACING, MOST_POINTS = 4.0, 2000
"""Pixels between outline points: beyond three the smoothed staircase of a mask (silhouette.py) is another. Points of all views: a tenth of
a second to follow their lines of sight through twenty views."""

DECIDES = 0.25
"""Weight from which a view has a part in deciding a miss."""

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

    def among(self, views: Sequence[int]) -> Outlines:
        """Only some of the views."""
        cameras = tuple(self.cameras[j] for j in views)
        return Outlines(cameras, [self.fields[j] for j in views], self.body, [self.points[j] for j in views])

    def half(self, which: int) -> Outlines:
        """Only every other part of each view's outline: the odd or the even ones."""

        def of(points: Float) -> Float:
            part = np.arange(len(points)) * PARTS // max(len(points), 1)
            chosen: Float = points[part % 2 == which]
            return chosen

        return replace(self, points=[of(points) for points in self.points])

    def misses(self) -> list[Coherence]:
        """The misses of all views."""
        return on_cores(self._of_view, range(len(self.cameras)))

    def _of_view(self, i: int) -> Coherence:
        """Those of a view, at most 0 where a boundary decides that runs along pixels."""
        found = coherence(self.cameras, self.fields, self.body, i, self.points[i])
        untold = np.zeros(len(found.miss), bool)
        for side in range(2):
            decides = (found.miss > 0) & (found.weight[:, side] > DECIDES)
            for j in np.unique(found.against[decides, side]):
                rows = np.flatnonzero(decides & (found.against[:, side] == j))
                untold[rows] |= along_pixels(self.fields[j], project(self.cameras[j], found.point[rows])[0])
        return replace(found, miss=np.where(untold, 0.0, found.miss))


class Unknowns(Protocol):
    """Numbers x, in pixels, by which cameras may be wrong."""

    def zero(self, cameras: Sequence[Camera]) -> Float:
        """x of cameras as they are."""

    def applied(self, cameras: Sequence[Camera], body: Object, x: Float) -> tuple[Camera, ...]:
        """The cameras after x."""

    def derivatives(self, body: Object, camera: Camera, local: Float) -> Float:
        """(n, 3, u) of points (n, 3) in a camera's frame, by what x may do to this camera."""

    def gathered(self, hessian: Float, gradient: Float) -> tuple[Float, Float]:
        """The equations of x from those of all cameras, (views, u, views, u) and (views, u)."""

    def free(self, cameras: Sequence[Camera], body: Object, change: Float) -> Float:
        """The part of a change of x that photographs show."""


class Motions:
    """Every camera on its own: motions (views, 6)."""

    def zero(self, cameras: Sequence[Camera]) -> Float:
        """See Unknowns."""
        return np.zeros((len(cameras), UNKNOWNS))

    def applied(self, cameras: Sequence[Camera], body: Object, x: Float) -> tuple[Camera, ...]:
        """See Unknowns."""
        return tuple(moved(camera, body, motion) for camera, motion in zip(cameras, x, strict=True))

    def derivatives(self, body: Object, camera: Camera, local: Float) -> Float:
        """See Unknowns."""
        return derivatives(camera, body, local)

    def gathered(self, hessian: Float, gradient: Float) -> tuple[Float, Float]:
        """See Unknowns."""
        return hessian.reshape(gradient.size, gradient.size), gradient.ravel()

    def free(self, cameras: Sequence[Camera], body: Object, change: Float) -> Float:
        """The mean pose stays."""
        return without_gauge(change, gauge(cameras, body))


def outlines_of(capture: Capture, body: Object | None = None) -> Outlines:
    """The outlines of all masks. body: where the object is, in the masks' box if None, with a CaptureError where they enclose none."""
    fields = mask_distances(capture)
    points = on_cores(_told_points, fields)
    every = -(-sum(len(of_view) for of_view in points) // MOST_POINTS) or 1
    within = body or Object.between(*masks_box(capture)[:2])
    return Outlines(tuple(view.camera for view in capture.views), fields, within, [of_view[::every] for of_view in points])


def _told_points(field: NDArray[np.float32]) -> Float:
    """(n, 2) points of a mask's outline, but for runs along pixels."""
    points = outline_points(field, LEAST_SPACING)
    told: Float = points[~along_pixels(field, points)]
    return told


def along_pixels(field: NDArray[np.float32], image: Float) -> Bool:
    """(n,) whether the boundary of a mask with this signed distance runs along rows or columns of pixels at image coordinates (n, 2),
    without a step as far as smoothing reaches: the distance then does not change along it at all."""
    slope = np.abs(gradients(field, image))
    return np.asarray(slope.min(1) <= np.finfo(np.float32).eps * slope.max(1))


def positive(found: list[Coherence]) -> Float:
    """(n,) misses of all views' points, 0 where lines of sight meet the others' hull."""
    return np.concatenate([np.maximum(one.miss, 0) for one in found])


def misfit(found: list[Coherence]) -> float:
    """Mean of the positive misses, pixels; 0 without any."""
    miss = positive(found)
    return float(miss[miss > 0].mean()) if (miss > 0).any() else 0.0


def in_words(found: list[Coherence]) -> str:
    """The misfit, as a finding begins."""
    return f"lines of sight along the outlines miss what the other views leave of the object by {misfit(found):.2f} px in the mean"


def _certain(found: list[Coherence]) -> float:
    """The misfit, at least a mask's noise."""
    return max(misfit(found), MASK_NOISE)


def _scale(found: list[Coherence]) -> float:
    """Of Cauchy's weights, pixels."""
    return CAUCHY_95 * _certain(found)


def after(outlines: Outlines, of: Unknowns, x: Float) -> Outlines:
    """The outlines with the cameras after x."""
    return replace(outlines, cameras=of.applied(outlines.cameras, outlines.body, x))


def equations(outlines: Outlines, of: Unknowns, found: list[Coherence]) -> tuple[Float, Float]:
    """Hessian and gradient by x of the misses, found with these cameras, under Cauchy's weights."""
    cameras, by, scale = outlines.cameras, partial(of.derivatives, outlines.body), _scale(found)
    hessian, gradient = np.zeros(1), np.zeros(1)
    for i, one in enumerate(found):
        part = one.of(one.miss > 0)
        by_camera = jacobian(cameras, outlines.fields, i, part, by)
        slope = by_camera.reshape(len(by_camera), by_camera.shape[1] * by_camera.shape[2])
        weighted = slope / (1 + (part.miss[:, None] / scale) ** 2)
        hessian = hessian + weighted.T @ slope
        gradient = gradient + weighted.T @ part.miss
    views = len(cameras)
    each = len(gradient) // views
    return of.gathered(hessian.reshape(views, each, views, each), gradient.reshape(views, each))


def _cost(found: list[Coherence], x: Float, tie: float, scale: float) -> float:
    return float(scale**2 * np.log1p((positive(found) / scale) ** 2).sum() + tie * (x**2).sum())


def tie_of(found: list[Coherence]) -> float:
    """What an unknown of one pixel costs where the misses at first are `found`, in squared pixels of misses: (MASK_NOISE / misfit)^2."""
    return float((MASK_NOISE / _certain(found)) ** 2)


def step(outlines: Outlines, of: Unknowns, x: Float, found: list[Coherence], tie: float, damping: float = FIRST_DAMPING) -> Float:
    """x after one Gauss-Newton step, where the misses after x are `found`."""
    there = after(outlines, of, x)
    hessian, gradient = equations(there, of, found)
    change = -np.linalg.solve(hessian + (tie + damping) * np.eye(len(hessian)), gradient + tie * x.ravel())
    return x + of.free(there.cameras, outlines.body, change.reshape(x.shape))


def fitted(outlines: Outlines, of: Unknowns, x: Float, tie: float, bound: float) -> Float:
    """x, each unknown within +-bound pixels, after which the outlines miss least, starting at `x`."""
    found, damping = after(outlines, of, x).misses(), FIRST_DAMPING
    for _ in range(MOST_STEPS):
        scale = _scale(found)
        trial = np.clip(step(outlines, of, x, found, tie, damping), -bound, bound)
        moved_by = float(np.sqrt(((trial - x) ** 2).mean()))
        then = after(outlines, of, trial).misses()
        better = _cost(then, trial, tie, scale) < _cost(found, x, tie, scale)
        # A step that is short for its damping says nothing; one that is shorter by far and no better, that there is none.
        if moved_by < (STILL_PIXELS if better else STILL_PIXELS / 10):
            return trial if better else x
        if better:
            x, found, damping = trial, then, damping / 2
        else:
            damping *= 4
    return x


def by_other_half(outlines: Outlines) -> tuple[float, float]:
    """By how much the positive misses of every half of the points fall, mean in pixels, after one step of all cameras that the other half
    asks for, and the standard error of that."""
    halves, of = [outlines.half(k) for k in range(2)], Motions()
    still = of.zero(outlines.cameras)
    before = [half.misses() for half in halves]
    asked = [step(half, of, still, found, tie_of(found)) for half, found in zip(halves, before, strict=True)]
    then = [after(half, of, motions).misses() for half, motions in zip(halves, reversed(asked), strict=True)]
    return fallen([one for half in before for one in half], [one for half in then for one in half])


def fallen(before: list[Coherence], after: list[Coherence]) -> tuple[float, float]:
    """By how much the positive misses fall, mean over the points in pixels, and the standard error of that."""
    change = positive(before) - positive(after)
    return (float(change.mean()), float(change.std() / np.sqrt(len(change)))) if len(change) else (0.0, 0.0)
