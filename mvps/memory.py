"""How much memory a reconstruction takes, and how many views at a time keep it below a limit.

    peak = PROGRAM + PIXEL pixels + KEPT samples + VERTEX vertices + views at a time * IN_WORK * samples of the largest view

pixels: of all masks; samples: pixels times lights. vertices: of the last mesh. Before there is one its area is known from the masks, four
times the mean projection of a convex body (Cauchy 1832), and DENSITY says how many vertices a preset puts on a pixel's area at most.
Sizes are in bytes, measured as the largest resident set (docs/method.md).
"""

from __future__ import annotations

from collections.abc import Sequence

from mvps.cores import at_a_time, work_on
from mvps.scene import CaptureError

PROGRAM = 500e6
"""Libraries (0.4 GB as imported), and what the allocator keeps of work that is done."""

PIXEL = 400.0
"""Normal maps, Stage I's rays and grids, the hull's."""

KEPT = 8.0
"""Three code values of two bytes, whether they are saturated, and a byte for those of fewer lights (joint/thinned.py)."""

VERTEX = 3200.0
"""Normal equations, samples under fewer lights, the factor of the fusion, sums of the sweep."""

IN_WORK = 25.0
"""Grey value, usable, shadow, gathered light, and copies of those that hit."""

DENSITY = {"draft": 0.35, "standard": 3.6, "fine": 8.0}
"""Vertices over the area in pixels: edges of 2, 1.5 and 0.8 pixels, of which creases split no more than on the most creased capture."""


def peak_bytes(sizes: Sequence[tuple[int, int]], preset: str, views: int) -> float:
    """The largest resident set to expect for views of `sizes` (pixels of the mask, lights), with so many `views` at a time."""
    pixels, samples = sum(of_mask for of_mask, _ in sizes), [of_mask * lights for of_mask, lights in sizes]
    vertices = DENSITY[preset] * 4 * pixels / len(sizes)
    return PROGRAM + PIXEL * pixels + KEPT * sum(samples) + VERTEX * vertices + views * IN_WORK * max(samples)


def keep_below(gigabytes: float, sizes: Sequence[tuple[int, int]], preset: str) -> None:
    """Work on no more views at a time than a limit allows, in 10^9 bytes. CaptureError where one is too many."""
    fits = [views for views in range(1, at_a_time() + 1) if peak_bytes(sizes, preset, views) <= 1e9 * gigabytes]
    if not fits:
        least = peak_bytes(sizes, preset, 1) / 1e9
        most = max(lights for _, lights in sizes)
        raise CaptureError(
            f"--max-memory: wanted at least {least + 0.05:.1f} GB, which {len(sizes)} views of up to {most} lights may take"
            f" in preset {preset}, given {gigabytes:g}; use fewer --views or --lights, or a quicker --preset"
        )
    work_on(fits[-1])
