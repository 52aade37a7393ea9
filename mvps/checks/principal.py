"""A principal point that is off by the same in all views: found and mended by silhouettes.

With c + s in place of c for the principal point all photographs shift by s pixels, as if every point at depth z of a camera's frame moved
by (s_1 z / f_x, s_2 z / f_y, 0). Seen from all around that is no motion of the world, so the misses of outlines.py tell s: two unknowns
where poses have six a view, and a world that stays where its cameras are. Of cameras on one ring a shift along its axis is a motion of the
world all but for perspective. So s is looked for along the direction that misses tell best, then across it as well where both are sure;
half of the outline points has to confirm what the other half wants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mvps.checks.coherence import Coherence
from mvps.checks.outlines import MASK_NOISE, Outlines, after, equations, fallen, fitted, in_words, misfit, outlines_of, positive, tie_of
from mvps.finding import Finding
from mvps.material import CERTAIN
from mvps.motions import Object
from mvps.scene import Camera, Capture, Float

FRAME_PIXELS = 1.0
"""Mean distance of a surface from where it is, along its normals, from which the frame of the world is in doubt, and with it distances to
anything else in that frame: as much as makes a result useless otherwise (mvps/verdict.py)."""

LEFT = 0.5
"""Part of the squared misses that one shift may leave: what leaves more than it explains is not what is wrong. Of three to twenty cameras
that are off each in its own way it left 0.84 and more (docs/findings/checks.md)."""

ALONG_NORMALS = 0.5
"""Mean part along a closed surface's normals of a shift along one direction of the world."""


@dataclass(frozen=True, eq=False)
class Shared:
    """Unknowns (outlines.py): by how many pixels the principal point of all views is off along axes (k, 2) of the image."""

    axes: Float

    def zero(self, cameras: Sequence[Camera]) -> Float:
        """See Unknowns."""
        return np.zeros(len(self.axes))

    def applied(self, cameras: Sequence[Camera], body: Object, x: Float) -> tuple[Camera, ...]:
        """See Unknowns."""
        shift = np.zeros((3, 3))
        shift[:2, 2] = x @ self.axes
        return tuple(replace(camera, K=camera.K + shift) for camera in cameras)

    def derivatives(self, body: Object, camera: Camera, local: Float) -> Float:
        """See Unknowns; u = 2, along the image's columns and rows."""
        return local[:, 2, None, None] * np.diag(1 / camera.K.diagonal())[:, :2]

    def gathered(self, hessian: Float, gradient: Float) -> tuple[Float, Float]:
        """See Unknowns."""
        return self.axes @ hessian.sum((0, 2)) @ self.axes.T, self.axes @ gradient.sum(0)

    def free(self, cameras: Sequence[Camera], body: Object, change: Float) -> Float:
        """See Unknowns."""
        return change


def _directions(outlines: Outlines, found: list[Coherence]) -> Float:
    """(2, 2) directions of the image, that along which misses tell a shift best first."""
    hessian, _ = equations(outlines, Shared(np.eye(2)), found)
    axes: Float = np.linalg.eigh(hessian)[1].T[::-1]
    return axes


def _fitted(outlines: Outlines, axes: Float, tie: float) -> list[Float]:
    """Shifts along the first of the axes and along both, the second begun where the first ends: far from there misses say nothing of what
    is across."""
    first = Shared(axes[:1])
    along = fitted(outlines, first, first.zero(outlines.cameras), tie, np.inf)
    return [along, fitted(outlines, Shared(axes), np.append(along, 0.0), tie, np.inf)]


def _errors(outlines: Outlines, axes: Float, shift: Float, halves: Sequence[Float], tie: float) -> Float:
    """(2,) standard errors of a shift: what masks' noise makes them, or what halves of the points do if that is more."""
    there = after(outlines, Shared(axes), shift)
    hessian, _ = equations(there, Shared(axes), there.misses())
    by_noise = MASK_NOISE * np.sqrt(np.diag(np.linalg.inv(hessian + tie * np.eye(2))))
    errors: Float = np.maximum(by_noise, np.abs(halves[0] - halves[1]) / 2)
    return errors


def shift_of(outlines: Outlines) -> tuple[Float, int]:
    """The shift (2,) of all principal points that silhouettes want, and along how many directions they tell it: none where half of the
    points does not confirm what the other half wants, or most of the misses is left."""
    found = outlines.misses()
    tie, axes = tie_of(found), _directions(outlines, found)
    halves = [outlines.half(k) for k in range(2)]
    shifts, of_halves = _fitted(outlines, axes, tie), [_fitted(half, axes, tie) for half in halves]
    certain = np.abs(shifts[1]) > CERTAIN * _errors(outlines, axes, shifts[1], [both for _, both in of_halves], tie)
    # No shift lies along the ring's axis alone, but the rounding of an upright object's masks, alike in many views, may look so.
    told = 2 if certain.all() else 1
    of = Shared(axes[:told])
    by_other = [after(half, of, one[told - 1]) for half, one in zip(halves, reversed(of_halves), strict=True)]
    before, then = ([one for half in way for one in half.misses()] for way in (halves, by_other))
    fall, noise = fallen(before, then)
    if fall <= CERTAIN * noise or (positive(then) ** 2).sum() > LEFT * (positive(before) ** 2).sum():
        return np.zeros(2), 0
    return shifts[told - 1] @ of.axes, told


def pointed(capture: Capture, body: Object | None = None) -> tuple[Capture, list[Finding]]:
    """The capture with the principal point of all views where silhouettes want it, and by how much it moved; as it was, and nothing, where
    that does not explain why silhouettes disagree. body: as for `outlines_of`."""
    outlines = outlines_of(capture, body)
    shift, told = shift_of(outlines)
    if not told:
        return capture, []
    mended = after(outlines, Shared(np.eye(2)), shift)
    views = (view.taken_by(camera) for view, camera in zip(capture.views, mended.cameras, strict=True))
    text = (
        f"{in_words(outlines.misses())}; the principal point of all views was moved by {shift[0]:.2f} px to the right and {shift[1]:.2f}"
        f" down, which leaves {misfit(mended.misses()):.2f} px"
    )
    findings = [Finding("pose", "all views", text, True)]
    aside = ALONG_NORMALS * float(np.linalg.norm(shift))
    if told == 1 and aside > FRAME_PIXELS:
        text = (
            "silhouettes do not tell the principal point across the direction that it was moved in; as far off there it puts the object"
            f" {aside:.1f} px from where it is"
        )
        findings.append(Finding("pose", "all views", text, False))
    return Capture(capture.name, tuple(views)), findings
