"""How much memory a reconstruction takes, and how many views at a time keep it below a limit.

    peak = program + HELD + PIXEL pixels + KEPT samples + views at a time * IN_WORK samples of the largest view
           + max(VERTEX vertices + sent, 3 sent, LIGHT lights solved along + PAIR lights^2 + sent)
    sent = views at a time * SENT sending * most lights of a view

program: what it takes with its libraries, which their build decides (torch for the CPU 0.3 GB, for CUDA 0.6); pixels: of all masks;
samples: pixels times lights; vertices: of the last mesh; sending: patches that light others by lobes (gleam.py), known when lobes are; in
grey while vertices are solved, in three channels while textures are made; lights: those that are solved for together, of all views where
every view has its own; solved along: vertices that are eliminated from their equations. Before there is a mesh its area is known from the
masks, four times the mean projection of a convex body (Cauchy 1832), and DENSITY says how many vertices a preset is likely to put on a
pixel's area. Creases may ask for more, so every mesh is looked at again. Sizes are in bytes, measured as the largest resident set
(docs/findings/cost.md).
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import NamedTuple

from mvps.cores import at_a_time, work_on
from mvps.scene import CaptureError, Lights

HELD = 185e6
"""What the allocator keeps of work that is done."""

PIXEL = 400.0
"""Normal maps, Stage I's rays and grids, the hull's."""

KEPT = 8.0
"""Three code values of two bytes, whether they are saturated, and a byte for those of fewer lights (joint/thinned.py)."""

VERTEX = 6500.0
"""Normal equations, samples under fewer lights, the factor of the fusion, sums of the sweep: 2700 to 5800 measured."""

IN_WORK = 25.0
"""Grey value, usable, shadow, gathered light, and copies of those that hit."""

SENT = 45.0
"""What a patch sends in one channel under a light by way of three lobes: five terms of four bytes, and what makes them."""

LIGHT, PAIR = 72.0, 216.0
"""Derivatives of a vertex' six unknowns by a light's three, in float32; three matrices of 3 by 3 in float64."""

DENSITY = {"draft": 0.35, "standard": 0.8, "fine": 2.8}
"""Vertices over the area in pixels. In `standard` 0.67 and 0.73 on two captures, 2.3 and 2.7 on two that are creased all over."""

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8
"""Numbers of glibc's options (malloc.h)."""

LARGEST_KEPT = 32 << 20
"""Bytes of the largest piece that glibc itself would come to keep (mallopt(3): DEFAULT_MMAP_THRESHOLD_MAX)."""

_limit: list[tuple[float, float, Sequence[tuple[int, int]]]] = []


def keep_freed() -> None:
    """From now on the C library keeps what is freed for the next array, in one pool for all threads; to be called before there are any.

    Left to itself glibc returns it to the system, which then clears its pages once more and has threads wait for each other meanwhile, and
    holds a pool for every thread. Other C libraries have no such options.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for option, value in ((M_ARENA_MAX, 1), (M_MMAP_THRESHOLD, LARGEST_KEPT), (M_TRIM_THRESHOLD, 2**31 - 1)):
            mallopt(option, value)


class Together(NamedTuple):
    """What one system of equations of lights has: how many of them, and of vertices that are solved along with them."""

    lights: int = 0
    vertices: int = 0


NONE_TOGETHER = Together()


def peak_bytes(
    program: float, sizes: Sequence[tuple[int, int]], vertices: float, views: int, sending: int = 0, together: Together = NONE_TOGETHER
) -> float:
    """The largest resident set to expect for views of `sizes` (pixels of the mask, lights), with so many `views` at a time."""
    pixels, samples = sum(of_mask for of_mask, _ in sizes), [of_mask * count for of_mask, count in sizes]
    sent = views * SENT * sending * max(count for _, count in sizes)
    held = program + HELD + PIXEL * pixels + KEPT * sum(samples) + views * IN_WORK * max(samples)
    along, lights = min(vertices, together.vertices), together.lights
    return held + max(VERTEX * vertices + sent, 3 * sent, LIGHT * lights * along + PAIR * lights**2 + sent)


def likely_vertices(sizes: Sequence[tuple[int, int]], preset: str) -> float:
    """Vertices of the last mesh, from the masks alone."""
    return DENSITY[preset] * 4 * sum(pixels for pixels, _ in sizes) / len(sizes)


def keep_below(gigabytes: float, program: float, sizes: Sequence[tuple[int, int]], preset: str) -> None:
    """Keep this process below a limit, in 10^9 bytes; program: bytes that it takes with all libraries imported. CaptureError where it
    cannot be, as far as the masks tell."""
    _limit[:] = [(1e9 * gigabytes, program, sizes)]
    room_for(likely_vertices(sizes, preset))


def solved_together(lights: Lights, strengths: int) -> int:
    """How many lights one system of equations has: those of the rig, or of all views where they are not one rig's. strengths: how many
    photographs' are unknowns beside them (joint/strengths.py), three of which are as many as a light's."""
    of_views = [len(intensity) for intensity in lights.intensity]
    return (max(of_views) if lights.one_rig else sum(of_views)) + -(-strengths // 3)


def room_for(vertices: float, sending: int = 0, together: Together = NONE_TOGETHER) -> None:
    """Work on no more views at a time than the limit, where there is one, allows beside a mesh, what its patches send and the lights' own
    equations. CaptureError where one is too many."""
    for limit, program, sizes in _limit:
        fits = [views for views in range(1, at_a_time() + 1) if peak_bytes(program, sizes, vertices, views, sending, together) <= limit]
        if not fits:
            least, most = peak_bytes(program, sizes, vertices, 1, sending, together) / 1e9, max(count for _, count in sizes)
            own = f" whose {together.lights} lights are solved for together" if together.lights > most else ""
            raise CaptureError(
                f"--max-memory: wanted at least {least + 0.05:.1f} GB for {len(sizes)} views of up to {most} lights{own} and a mesh of"
                f" about {vertices:.0f} vertices, given {limit / 1e9:g}; use fewer --views or --lights, or a quicker --preset"
            )
        work_on(fits[-1])
