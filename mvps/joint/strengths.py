"""How bright the photographs of each view are, of views under one rig: cameras that expose every view anew, flashes that fade.

The photographs of view i are e_i times as bright as the rig's lamps make them: its lights' intensities are e_i times the rig's. log e are
unknowns of the lights' block (lights.py), with the image itself as derivative; what all views have in common is the lights' scale.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mvps.joint.blocks import DirectionalLights
from mvps.scene import Lights

ROUNDING = 1e-4
"""Relative difference of views' brightness that is rounding: directions are turned into every view's frame in single precision."""

ALIKE, ROUGHLY_ALIKE = 0.03, 0.5
"""Step of log e up to which views are exposed alike, and the same on a hull or where the model fits badly. Where they were alike it was
0.026 at most (a plane; else 0.012), and 0.27 on the hull of a gear of gold (docs/findings/lights.md)."""


def strengths_of(lights: Lights) -> list[float] | None:
    """e of views under one rig, their mean 1; None where all are as bright, and without a rig."""
    found = _relative([of_view.sum() for of_view in lights.intensity])
    return found if lights.one_rig and max(abs(e - 1) for e in found) >= ROUNDING else None


def strengths_in(lights: Sequence[DirectionalLights]) -> list[float]:
    """e of the views' lights, all of one rig, their mean 1."""
    return _relative([float(of_view.intensity.double().sum()) for of_view in lights])


def _relative(sums: Sequence[float]) -> list[float]:
    relative: list[float] = (np.array(sums) / np.mean(sums)).tolist()
    return relative


def exposed_alike(strengths: Sequence[float], bound: float = ALIKE) -> bool:
    """Whether views are as bright, as far as surfaces and models that are not exact can tell."""
    step = np.log(strengths)
    return bool(np.abs(step - step.mean()).max() <= bound)
