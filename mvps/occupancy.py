"""Stage I: a neural occupancy field from silhouettes and the views' normals, by volume rendering.

Field (field.py):  d(x) = hull's signed distance + residual of feature grids and a small network, in pixel footprints; occupancy
o = sigmoid(-d / width). Along a ray with samples d_i the probability of passing sample i unstopped is sigmoid(d_i / width) where the ray
has only come nearer, so a segment stops it with

    alpha_i = 1 - min(sigmoid(d_i / w) / sigmoid(d_{i-1} / w), 1),      weight_i = alpha_i prod_{j<i} (1 - alpha_j)

(occupancy rendering of UNISURF, Oechsle et al. 2021, in the unbiased form of NeuS, Wang et al. 2021: the weight peaks where d = 0 and
not before it, which is what pulls a plain occupancy's surface inwards). Samples and steps: fieldtraining.py.

Losses (Yang et al. 2022, eq. 3-5), all but the last robust (Geman and McClure 1985), the first two weighted by the normals' confidence:

    normal  |n(x) - n_photometric|^2,   n(x) = grad d by finite differences
    colour  |c - (albedo, normal)|^2 rendered against the pixel's photometric stereo, whose agreement between views places the surface
    smooth  |n(x) - n(x + e)|^2
    mask    cross-entropy of the ray's opacity in a ring around the silhouette

All lengths are in pixel footprints at the object, so that the capture's unit does not matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mvps.field import OccupancyField
from mvps.fieldrays import foreground_rays
from mvps.fieldtraining import Met, Phase, Training, TrainingSettings, between, composited, field_grids, hull_frame, silhouette_rays
from mvps.scene import Capture, NormalMap, SignedDistanceGrid, Surface

COLOURS = 6
"""Rendered features: albedo and normal, three channels each."""


@dataclass(frozen=True)
class OccupancySettings(TrainingSettings):
    """normal, colour, smooth: weights of the losses; outlier: |difference| of unit normals or relative colours at which a pixel counts as
    an outlier."""

    normal: float = 2.0
    colour: float = 0.5
    smooth: float = 0.03
    outlier: tuple[float, float] = (2.0, 0.5)


CONTINUED = OccupancySettings(steps=100, band=(4.0, 2.0), width=(1.0, 0.5), step=(1.0, 1.0), outlier=(0.5, 0.5), voxel=1.25, strides=(2, 1))
"""For a field that other normal maps have trained already: its surface is off by the last band at most, so all starts where that ended."""

EASED = OccupancySettings(steps=120)
"""Where photographs abound and the model fits: rounds after it go on as far (docs/findings/stage_one.md)."""


def composite(signed_distance: Tensor, width: float) -> tuple[Tensor, Tensor]:
    """Weights (rays, samples) and opacity (rays,) of signed distances (rays, samples) along rays, nearest first."""
    outside = torch.nn.functional.logsigmoid(signed_distance / width)
    nearer = (outside[:, 1:] - outside[:, :-1]).clamp_max(0)
    return composited(-torch.expm1(torch.cat([outside[:, :1], nearer], 1)))


def robust_square(square: Tensor, outlier: float) -> Tensor:
    """Geman-McClure's bounded function of a squared residual."""
    return square / (1 + square / outlier**2)


class _Training(Training):
    settings: OccupancySettings

    def rendering(self, distance: Tensor, value: Tensor, width: float) -> tuple[Tensor, Tensor]:
        return composite(value, width)

    def loss(self, met: Met, phase: Phase) -> Tensor:
        """Normal, colour and smoothness."""
        s, few, outlier = self.settings, len(met.aside), between(self.settings.outlier, phase.progress)
        trust = self.data.weight[met.chosen] * met.hit
        rendered = (met.weight[:, :, None] * met.colour).sum(1) / met.opacity[:, None].clamp_min(1e-3)
        of_normal = (trust * robust_square((met.normal - self.data.normal[met.chosen]).square().sum(1), outlier)).mean()
        of_colour = (trust * robust_square((rendered - self.data.colour[met.chosen]).square().sum(1), outlier)).mean()
        of_smooth = (met.hit[:few] * robust_square((met.normal[:few] - met.aside).square().sum(1), outlier)).mean()
        return s.normal * of_normal + s.colour * of_colour + s.smooth * of_smooth


class Occupancy:
    """The field of a capture, started at its visual hull, of so many pieces. Normal maps train it: once, and again when better ones are
    known."""

    def __init__(
        self, capture: Capture, hull_grid: SignedDistanceGrid, settings: OccupancySettings, seed: int, device: torch.device, pieces: int = 1
    ) -> None:
        self._capture, self._frame, self._pieces = capture, hull_frame(capture, hull_grid, device), pieces
        start = field_grids(hull_grid, self._frame, settings)
        self._field = OccupancyField(*start, settings.features, settings.hidden, COLOURS, torch.Generator().manual_seed(seed))
        self._generator = torch.Generator(device).manual_seed(seed)
        self._trained = False

    def trained(self, normal_maps: tuple[NormalMap, ...], settings: OccupancySettings, on_step: Callable[[int, Tensor], None]) -> Surface:
        """The field's surface after training on the capture's masks and normal maps; world units.

        on_step(step from 0, loss) is called after every step. The same seed and calls give the same surface, on a CPU.
        """
        frame = self._frame
        data = foreground_rays(self._capture, normal_maps, frame.centre, frame.unit, frame.low.device)
        ring = silhouette_rays(self._capture, frame, settings)
        training = _Training(self._field, frame, data, ring, settings, self._generator, self._trained)
        surface = training.surface(on_step, self._pieces)
        self._trained = True
        return surface
