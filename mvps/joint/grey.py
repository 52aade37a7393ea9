"""Lights without their colours, on which normals and reflectance are solved, and with them again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from mvps.joint.blocks import DirectionalLights
from mvps.mesh import normalise
from mvps.scene import Float, Lights


def tensor32(values: Any, device: torch.device) -> torch.Tensor:
    """Numbers of any shape as float32 on the device."""
    return torch.tensor(np.asarray(values), dtype=torch.float32, device=device)


def grey_lights(lights: Lights, device: torch.device) -> list[DirectionalLights]:
    """Directions and mean intensities as tensors."""
    return [
        DirectionalLights(tensor32(d, device), tensor32(e.mean(1), device)) for d, e in zip(lights.direction, lights.intensity, strict=True)
    ]


def coloured_lights(grey: list[DirectionalLights], ratios: list[Float], like: Lights) -> Lights:
    """Lights from directions, mean intensities and channel ratios (lights, 3); of one rig where `like` is."""
    directions = [normalise(of_view.direction.double().cpu().numpy()) for of_view in grey]
    intensities = [of_view.intensity.double().cpu().numpy()[:, None] * r for of_view, r in zip(grey, ratios, strict=True)]
    return replace(like, direction=tuple(directions), intensity=tuple(intensities))
