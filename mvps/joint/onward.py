"""A round that is done again on the same mesh: how far the moves go on that it asks for.

A hollow deepens round by round: what a round asks for is some part q of what the last one moved vertices by. All further ones together come
to q / (1 - q) of it, so a round that comes after one which moved them by d, and asks for d' itself, all along their normals, moves them by

    a d',    a = 1 / (1 - q) = sum d d / sum d (d - d')

(Aitken's extrapolation, 1926; Anderson 1965). The sums are over the vertices that views see within AROUND edges of each, for some have
arrived; windows are small, and moves may look alike in one by chance, so q is nowhere taken to be more than that of all vertices together.
Those that no view sees follow the others by ways of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mvps.mesh import vertex_normals
from mvps.scene import Bool, Float, Surface
from mvps.visibility import ray_caster

AROUND = 6
"""Edges of a window, of about a hundred vertices: moves by chance share their errors with a dozen neighbours."""

MOST_GOES_ON = 0.5
"""Most of q, and q where only one round has spoken: hollows have 0.2 to 0.5, and moves are doubled at most (docs/findings/stage_one.md)."""


class Moves(NamedTuple):
    """What a round moved vertices by, taken (V,) along their normals, world units; goes_on: q of all vertices that views see together;
    left: what is still to come of what it asked for by that, in the mean."""

    taken: Float
    goes_on: float
    left: float


def onward(surface: Surface, asked: Float, seen: Bool, before: Moves | float) -> Moves:
    """The moves of a round that asks for `asked` (V,) of a surface's vertices, which views see or not (V,), on the mesh that a first round
    moved before; q instead where there was none."""
    length = float(np.abs(asked[seen]).mean()) if seen.any() else 0.0
    if not isinstance(before, Moves):
        return Moves(asked, before, length * before / (1 - before))
    fallen, whole = before.taken * (before.taken - asked) * seen, before.taken**2 * seen
    factor = float(_factor(fallen.sum(), whole.sum(), 1 / (1 - MOST_GOES_ON)))
    around = ray_caster(surface).around
    for _ in range(AROUND):
        fallen, whole = around @ fallen, around @ whole
    return Moves(asked * _factor(fallen, whole, factor), 1 - 1 / factor, length * (factor - 1))


def _factor(fallen: Float, whole: Float, most: float) -> Float:
    """a, from the sums of d (d - d') and of d d, at least 1 and at most `most`; 1 where nothing moved."""
    bounded: Float = np.clip(fallen, whole / most, whole)
    return np.where(whole > 0, whole / np.maximum(bounded, np.finfo(np.float64).tiny), 1.0)


def carried_on(surface: Surface, moved: Surface, seen: Bool, before: Moves | float) -> tuple[Surface, Moves]:
    """`moved`, what a round made of the surface, with its vertices as far along the surface's normals as their moves go on."""
    normal = vertex_normals(surface)
    asked = ((moved.vertices - surface.vertices) * normal).sum(1)
    moves = onward(surface, asked, seen, before)
    return Surface(moved.vertices + (moves.taken - asked)[:, None] * normal, moved.faces), moves
