"""Fewer lights of every view: enough for vertices, which several views see, and for pixels on the way.

Of a view's L lights every k-th stays, other ones in the next view: what one light does not show of a place, another view's light does. k is
the largest number that leaves ENOUGH_LIGHTS of each view and ENOUGH_PHOTOGRAPHS in all, or as many times fewer of both as a caller says.
"""

from __future__ import annotations

from collections.abc import Sequence

from mvps.once import once_for
from mvps.scene import Capture, Lights

ENOUGH_LIGHTS = 12
"""Two samples for each of a pixel's six unknowns: two of the normal, albedo, three lobes."""

ENOUGH_PHOTOGRAPHS = 240
"""Twenty views of a dozen lights: of few views a vertex is seen in one or two, which then keep more of their lights."""


def kept(counts: Sequence[int], fewer: int = 1) -> list[slice]:
    """Which lights of each view stay, for the numbers of lights that the views have; all where there are no more than enough. fewer: how
    many times fewer are enough."""
    spare = fewer * sum(counts) // ENOUGH_PHOTOGRAPHS
    steps = [max(1, min(fewer * count // ENOUGH_LIGHTS, spare)) for count in counts]
    return [slice(i % k, None, k) for i, k in enumerate(steps)]


def abundant(capture: Capture) -> bool:
    """Whether the views have ENOUGH_PHOTOGRAPHS of which none shows what ENOUGH_LIGHTS others of its view do: every place is then seen from
    many sides under many lights."""
    return sum(min(len(view.lights), ENOUGH_LIGHTS) for view in capture.views) >= ENOUGH_PHOTOGRAPHS


@once_for
def _part(capture: Capture, fewer: int) -> Capture:
    """The capture with the kept lights of each view, its samples copied."""
    keep = kept([len(view.lights) for view in capture.views], fewer)
    return capture.select({view.name: view.lights[rows] for view, rows in zip(capture.views, keep, strict=True)})


def thinned(capture: Capture, lights: Lights, fewer: int = 1) -> tuple[Capture, Lights]:
    """The capture with the kept lights of each view (fewer: see `kept`), its samples copied once for a capture, and these lights."""
    keep = kept([len(view.lights) for view in capture.views], fewer)
    if all(rows.step == 1 for rows in keep):
        return capture, lights
    direction, intensity = (
        tuple(values[rows] for rows, values in zip(keep, of_views, strict=True)) for of_views in (lights.direction, lights.intensity)
    )
    # Views keep different lights of the rig.
    return _part(capture, fewer), Lights(direction, intensity, False)
