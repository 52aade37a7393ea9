"""Drawings of numbers as SVG text: a line over rounds, lights on a sphere."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from mvps.pbr import srgb_bytes
from mvps.scene import Float

WIDTH, HEIGHT, LEFT, BOTTOM = 480, 220, 64, 34
RADIUS = 100


def line_chart(values: Sequence[float | None], names: Sequence[str], across: str, up: str) -> str:
    """One line through values, of which one at least is known, at their names' places; `across` and `up` name the axes."""
    places = np.linspace(LEFT, WIDTH - 12, len(values)) if len(values) > 1 else np.array([(LEFT + WIDTH) / 2])
    known = [(x, v, name) for x, v, name in zip(places.tolist(), values, names, strict=True) if v is not None]
    low, high = min(0.0, *(v for _, v, _ in known)), max(0.0, *(v for _, v, _ in known))
    span = (high - low) or 1.0
    marks = [(x, 12 + (high - v) / span * (HEIGHT - 12 - BOTTOM), f"{across} {name}: {v:.4g}") for x, v, name in known]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y, _ in marks)
    dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5"><title>{escape(said)}</title></circle>' for x, y, said in marks)
    every = -(-len(values) // 10)
    ticks = "".join(
        f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{escape(name)}</text>'
        for x, name in list(zip(places, names, strict=True))[::every]
    )
    base, label = HEIGHT - BOTTOM, f"{up}, " + ", ".join(said for _, _, said in marks)
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(label)}">'
        f'<path class="axis" d="M{LEFT - 8} 8V{base}H{WIDTH - 4}"/>'
        f'<text x="{LEFT - 12}" y="16" text-anchor="end">{high:.3g}</text>'
        f'<text x="{LEFT - 12}" y="{base}" text-anchor="end">{low:.3g}</text>'
        f'{ticks}<text x="{(LEFT + WIDTH) / 2:.0f}" y="{HEIGHT - 4}" text-anchor="middle">{escape(across)}</text>'
        f'<polyline class="line" points="{points}"/><g class="dots">{dots}</g></svg>'
    )


def pair_chart(pairs: Sequence[tuple[float, float]], across: str, up: str) -> str:
    """Positive pairs on logarithmic axes, with the diagonal and a band of a factor of two around it."""
    values = np.log2(np.array(pairs))
    low, high = float(np.floor(values.min())), float(np.ceil(values.max()) + (values.max() == values.min()))
    side, base = HEIGHT - BOTTOM - 12, HEIGHT - BOTTOM

    def place(x: float, y: float) -> str:
        return f"{LEFT + (x - low) / (high - low) * side:.1f},{base - (y - low) / (high - low) * side:.1f}"

    ends = [(max(0, -shift), max(0, shift)) for shift in (1, 0, -1)]
    lines = "".join(
        f'<polyline class="{kind}" points="{place(low + x, low + y)} {place(high - y, high - x)}"/>'
        for kind, (x, y) in zip(("axis", "line", "axis"), ends, strict=True)
    )
    dots = "".join(
        f'<circle cx="{at.split(",")[0]}" cy="{at.split(",")[1]}" r="3.5"><title>{a:.3g}, {b:.3g}</title></circle>'
        for (a, b), at in zip(pairs, (place(x, y) for x, y in values.tolist()), strict=True)
    )
    label = f"{up} against {across}: " + ", ".join(f"{a:.3g} {b:.3g}" for a, b in pairs)
    return (
        f'<svg viewBox="0 0 {LEFT + side + 12} {HEIGHT}" role="img" aria-label="{escape(label)}">'
        f'<path class="axis" d="M{LEFT} 8V{base}H{LEFT + side + 4}"/>'
        f'<text x="{LEFT - 6}" y="16" text-anchor="end">{2**high:.3g}</text>'
        f'<text x="{LEFT - 6}" y="{base}" text-anchor="end">{2**low:.3g}</text>'
        f'<text x="{LEFT + side}" y="{base + 16}" text-anchor="end">{2**high:.3g}</text>'
        f'<text x="{LEFT + side / 2:.0f}" y="{HEIGHT - 4}" text-anchor="middle">{escape(across)}</text>'
        f'{lines}<g class="dots">{dots}</g></svg>'
    )


def light_sphere(direction: Float, intensity: Float, numbers: Sequence[int], name: str) -> str:
    """Lights as seen from the camera: direction (lights, 3), x right, y up, z to the camera; areas are intensities (lights, 3).

    A light behind the object (z < 0) is drawn hollow.
    """
    # The outermost first: it is the dark ground on which white lights are told from hollow ones.
    rings = "".join(f'<circle class="ring" r="{RADIUS * np.sin(np.radians(angle)):.1f}"/>' for angle in (90, 60, 30))
    brightness = intensity.mean(1) / max(float(intensity.mean()), 1e-12)
    marks = []
    for k in np.argsort(direction[:, 2], kind="stable"):
        x, y, z = direction[k]
        colour = "#" + "".join(f"{c:02x}" for c in srgb_bytes(intensity[k] / intensity[k].max()))
        fill = colour if z >= 0 else "none"
        angle = np.degrees(np.arccos(np.clip(z, -1, 1)))
        title = f"light {numbers[k]}: {angle:.0f} degrees from the view, intensity {brightness[k]:.2f}"
        radius = 5 * float(np.sqrt(np.clip(brightness[k], 0.1, 4)))
        place = f'cx="{RADIUS * x:.1f}" cy="{-RADIUS * y:.1f}" r="{radius:.1f}"'
        marks.append(f'<circle class="light" {place} fill="{fill}"><title>{title}</title></circle>')
    size = RADIUS + 14
    label = f"{len(direction)} lights of {name} around the direction to the camera, rings at 30, 60 and 90 degrees"
    return (
        f'<figure><svg class="sphere" viewBox="{-size} {-size} {2 * size} {2 * size}" role="img" aria-label="{escape(label)}">'
        f"{rings}{''.join(marks)}</svg><figcaption>{escape(name)}</figcaption></figure>"
    )
