"""What the account holds, in words: what was captured, why a component of the reflectance model stays or goes, what tests the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np

from mvps.camera import pixel_footprint
from mvps.material import CERTAIN
from mvps.scene import Reconstruction, View

NOT_TRIED = ": not tried, "
"""Between the name of a component that was not on trial and why."""


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value of the account, which may come from a file, can be reckoned with."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _range(numbers: Sequence[int]) -> str:
    """One number, or from the least to the largest."""
    least, largest = min(numbers, default=0), max(numbers, default=0)
    return f"{least:,}" if least == largest else f"{least:,} to {largest:,}"


def _held_back(settings: Mapping[str, Any], what: str) -> str:
    numbers = settings.get(f"hold_out_{what}")
    return f", {len(numbers)} of them held back" if isinstance(numbers, list | tuple) and numbers else ""


def captured(reconstruction: Reconstruction, views: Sequence[View]) -> list[tuple[str, str]]:
    """What was captured, as names and words. views: those of the capture that the reconstruction holds."""
    settings, vertices = reconstruction.settings, reconstruction.surface.vertices
    counts = [len(numbers) for numbers in reconstruction.light_names]
    stands = "world while the camera moves" if reconstruction.lights.fixed else "camera's frame"
    rig = f"one rig that stands still in the {stands}" if reconstruction.lights.one_rig else "other ones in every view"
    given = {True: "; taken from the capture's calibration", False: "; solved from the photographs"}
    solved = settings.get("calibrated_lights")
    size = vertices.max(0) - vertices.min(0)
    facts = [
        ("Views", f"{len(counts):,}{_held_back(settings, 'views')}"),
        ("Lights", f"{_range(counts)} a view{_held_back(settings, 'lights')}: {rig}{given[solved] if isinstance(solved, bool) else ''}"),
        ("Photographs", f"{sum(counts):,}"),
    ]
    if views:
        sizes = sorted({(view.camera.width, view.camera.height) for view in views})
        facts.append(("Size of a photograph", " or ".join(f"{width:,} x {height:,}" for width, height in sizes) + " pixels"))
    # Four digits, as a ruler has: 1234 and not 1.234e+03.
    facts.append(("Size of the object", " x ".join(np.format_float_positional(s, 4, fractional=False, trim="-") for s in size) + " units"))
    if views:
        pixel = pixel_footprint([view.camera for view in views], vertices.mean(0))
        facts.append(("A pixel at the object", f"{pixel:.3g} units"))
    return facts


def reason(component: Mapping[str, Any]) -> str:
    """Why a component of the reflectance model stays, goes, or was not on trial; nothing where the account does not tell."""
    _, apart, why = str(component.get("name", "")).partition(NOT_TRIED)
    gain, noise = component.get("gain"), component.get("noise")
    if apart or not is_number(gain) or not is_number(noise):
        return f"not tried: {why}" if apart else ""
    if gain == 0:
        return "the error does not change"
    said = f"the error {'falls' if gain > 0 else 'rises'} by {100 * abs(np.expm1(-gain)):.2g} %"
    if not component.get("kept") and gain > CERTAIN * noise:
        return f"{said} in the light or in shadow, and rises in the other"
    sure = f"{said}, {abs(gain) / noise:.1f} standard errors" if noise > 0 else f"{said}, everywhere alike"
    return sure if bool(component.get("kept")) == (gain > 0) else f"{sure}: that may be chance"


def without_held_out(status: Mapping[str, Any]) -> str:
    """What a result without held-out photographs has in their place."""
    said = (
        "No photographs were held back to test the result by; mvps.reconstruct does so with --hold-out-lights or --hold-out-views,"
        " and then their error stands here."
    )
    misfit, noise = status.get("misfit"), status.get("noise")
    if not is_number(misfit) or not is_number(noise):
        return said
    return (
        f"{said} Of the photographs that it was made from, the model leaves {100 * misfit:.2g} % of the signal unexplained beside"
        f" noise of {100 * noise:.2g} %: photographs under other lights may be further off."
    )
