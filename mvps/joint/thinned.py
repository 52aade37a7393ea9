"""Fewer lights of every view, for steps on the way.

Of a view's L lights every k-th stays, other ones in the next view: what one light does not show of a place, another view's light does. k is
the largest number that leaves ENOUGH_LIGHTS of each view and ENOUGH_PHOTOGRAPHS in all.
"""

from __future__ import annotations

from mvps.scene import Capture, Lights

ENOUGH_LIGHTS = 12
"""Two samples for each of a pixel's six unknowns: two of the normal, albedo, three lobes."""

ENOUGH_PHOTOGRAPHS = 240
"""Twenty views of a dozen lights: of few views a vertex is seen in one or two, which then keep more of their lights."""


def thinned(capture: Capture, lights: Lights) -> tuple[Capture, Lights]:
    """The capture with fewer lights of each view, all where there are no more than enough, and their lights."""
    keep = {}
    spare = sum(len(view.lights) for view in capture.views) // ENOUGH_PHOTOGRAPHS
    for i, view in enumerate(capture.views):
        k = max(1, min(len(view.lights) // ENOUGH_LIGHTS, spare))
        keep[view.name] = list(range(i % k, len(view.lights), k))
    if all(len(keep[view.name]) == len(view.lights) for view in capture.views):
        return capture, lights
    part = capture.select({view.name: [view.lights[j] for j in keep[view.name]] for view in capture.views})
    direction, intensity = (
        tuple(values[keep[view.name]] for view, values in zip(capture.views, of_views, strict=True))
        for of_views in (lights.direction, lights.intensity)
    )
    # Views keep different lights of the rig.
    return part, Lights(direction, intensity, False)
