"""Radiance fields: Stage I as Yang et al. 2022 have it, learnt from photographs averaged over their lights, for ablations.

Field (field.py):  d(x) in pixel footprints, surface at d = 0, and a radiance c(x, v) or c(x, v, n) of position, view direction and normal.
Along a ray sample i stops what reaches it with probability

    NeRF      alpha_i = 1 - exp(-sigma_i delta_i),   sigma = softplus(-d / w)           (Mildenhall et al. 2020; c without the normal)
    UNISURF   alpha_i = o_i,                         o = sigmoid(-d / w)                (Oechsle et al. 2021; c with the normal)

    weight_i = alpha_i prod_{j<i} (1 - alpha_j),     colour = sum_i weight_i c_i

with sigma per pixel footprint and delta the distance between samples. At d = 0 an occupancy is one half, and so is the alpha of a
density over one pixel footprint, 1 - exp(-log 2), for any w: the surface that a mesh is made of. Both stop a part of the ray before it,
so what is seen as the surface lies a little outside of d = 0.

Losses (eq. 3 to 5) and their weights (supplement: 1, 0.05, 0.005); colours from 0 to 1, the brightest of the averaged photographs:

    colour  |colour - mean over the lights of photograph / intensity|^2
    normal  |n(x) - n_photometric|^2 by its confidence, n(x) = grad d / |grad d| by finite differences; left out without photometric stereo
    smooth  |n(x) - n(x + e)|^2
    mask    as in Stage I

Masks, start at the hull, grids, rays, samples, steps and mesh are those of Stage I (fieldtraining.py): only rendering and losses differ.
Besides the smaller field and its few steps this departs from the paper in the start at the hull, the masks, and the shrinking band of
samples, all of which NeRF gets too. The normal where the ray crosses d = 0 stands for the one at the expected depth (losses) and for those
at the samples (radiance).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import repeat

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mvps.field import Grid, OccupancyField
from mvps.fieldrays import FieldRays, PixelValues, pixel_rays
from mvps.fieldtraining import Frame, Met, Phase, Training, TrainingSettings, composited, field_grids, hull_frame, silhouette_rays
from mvps.scene import Capture, Float, Lights, NormalMap, SignedDistanceGrid, Surface, View

FEATURES = 16
"""What the field says of a point to the head that makes its radiance."""


@dataclass(frozen=True)
class RadianceSettings(TrainingSettings):
    """colour, normal, smooth: weights of the losses. width: half of Stage I's, because a plain rendering puts the level inside by a part of
    it (bunny, median: NeRF 0.86 px with Stage I's and 0.40 with half, UNISURF 0.41 and 0.24). The edge is then about two steps between
    samples wide, which are 5 pixels at first and 0.7 in the end, so that it falls between none."""

    width: tuple[float, float] = (1.5, 0.25)
    colour: float = 1.0
    normal: float = 0.05
    smooth: float = 0.005


class RadianceField(OccupancyField):
    """An OccupancyField whose colours are features, and the head that makes radiance of them: one hidden layer."""

    def __init__(
        self,
        base: Tensor,
        base_grid: Grid,
        grids: Sequence[Grid],
        settings: TrainingSettings,
        with_normal: bool,
        generator: torch.Generator,
    ) -> None:
        """with_normal: radiance depends on the surface's normal too; else as OccupancyField."""
        super().__init__(base, base_grid, grids, settings.features, settings.hidden, FEATURES, generator)
        self.with_normal = with_normal
        inputs = FEATURES + (6 if with_normal else 3)
        first = torch.randn(settings.hidden, inputs, generator=generator) * (2 / inputs) ** 0.5
        self.head_first = nn.Parameter(first.to(base.device))
        self.head_first_bias = nn.Parameter(torch.zeros(settings.hidden, device=base.device))
        self.head_last = nn.Parameter(torch.zeros(3, settings.hidden, device=base.device))
        self.head_last_bias = nn.Parameter(torch.zeros(3, device=base.device))

    def network(self) -> list[nn.Parameter]:
        """All weights and biases, the head's included."""
        return [*super().network(), self.head_first, self.head_first_bias, self.head_last, self.head_last_bias]

    def radiance(self, features: Tensor, direction: Tensor, normal: Tensor) -> Tensor:
        """(rays, samples, 3) in 0 to 1 of features (rays, samples, FEATURES) along rays of direction and surface normal (rays, 3)."""
        of_ray = torch.cat([direction, normal], 1) if self.with_normal else direction
        inputs = torch.cat([features, of_ray[:, None].expand(-1, features.shape[1], -1)], 2).flatten(0, 1)
        hidden = torch.relu(torch.addmm(self.head_first_bias, inputs, self.head_first.T))
        return torch.sigmoid(torch.addmm(self.head_last_bias, hidden, self.head_last.T)).view(*features.shape[:2], 3)


def density_alpha(distance: Tensor, value: Tensor, width: float) -> Tensor:
    """(rays, samples) of densities softplus(-value / width) at distances (rays, samples), both per sample; the last interval is as long as
    the one before."""
    interval = distance.diff(dim=1)
    return -torch.expm1(-nn.functional.softplus(-value / width) * torch.cat([interval, interval[:, -1:]], 1))


def occupancy_alpha(value: Tensor, width: float) -> Tensor:
    """(rays, samples) occupancies of signed distances (rays, samples)."""
    return torch.sigmoid(-value / width)


class _Training(Training):
    field: RadianceField
    settings: RadianceSettings

    def rendering(self, distance: Tensor, value: Tensor, width: float) -> tuple[Tensor, Tensor]:
        # The field that knows its normal is UNISURF's.
        return composited(occupancy_alpha(value, width) if self.field.with_normal else density_alpha(distance, value, width))

    def loss(self, met: Met, phase: Phase) -> Tensor:
        """Colour, normal and smoothness."""
        s, data, few = self.settings, self.data, len(met.aside)
        normal, aside = (nn.functional.normalize(of, dim=1) for of in (met.normal, met.aside))
        radiance = self.field.radiance(met.colour, data.direction[met.chosen], normal)
        rendered = (met.weight[:, :, None] * radiance).sum(1)
        of_colour = (rendered - data.colour[met.chosen]).square().sum(1).mean()
        trust = data.weight[met.chosen] * met.hit
        of_normal = (trust * (normal - data.normal[met.chosen]).square().sum(1)).mean()
        of_smooth = (met.hit[:few] * (normal[:few] - aside).square().sum(1)).mean()
        return s.colour * of_colour + s.normal * of_normal + s.smooth * of_smooth


def averaged(view: View, intensity: Float) -> NDArray[np.float32]:
    """(pixels, 3) mean over the lights of radiance over intensity (lights, 3), of a view's foreground pixels; without photographs that
    were left out."""
    factor = (view.scale * view.shown[:, None] / (max(1, int(view.shown.sum())) * intensity)).astype(np.float32)
    mean: NDArray[np.float32] = np.einsum("plc,lc->pc", view.samples, factor)
    return mean


def averaged_rays(capture: Capture, lights: Lights, normal_maps: tuple[NormalMap, ...] | None, frame: Frame) -> FieldRays:
    """Rays of all foreground pixels with the averaged photographs, and with the normals where maps are given (weight 0 where not)."""
    colours = [averaged(view, intensity) for view, intensity in zip(capture.views, lights.intensity, strict=True)]
    brightest = max(max(float(colour.max(initial=0)) for colour in colours), 1e-12)
    values = []
    for colour, maps in zip(colours, normal_maps or repeat(None, len(colours)), strict=True):
        nothing = np.zeros(len(colour))
        normal, weight = (np.zeros_like(colour), nothing) if maps is None else (maps.normal, maps.confidence)
        values.append(PixelValues(nothing == 0, normal, colour / brightest, weight))
    return pixel_rays(capture, values, frame.centre, frame.unit, frame.low.device)


def radiance_surface(
    capture: Capture,
    hull_grid: SignedDistanceGrid,
    lights: Lights,
    normal_maps: tuple[NormalMap, ...] | None,
    density: bool,
    settings: RadianceSettings,
    seed: int,
    device: torch.device,
    on_step: Callable[[int, Tensor], None],
) -> Surface:
    """The surface of a radiance field, a density (NeRF) or an occupancy (UNISURF), started at the visual hull and trained on the averaged
    photographs and, where given, on normal maps; world units.

    lights: only their intensities are looked at. on_step(step from 0, loss) is called after every step. The same seed gives the same
    surface, on a CPU.
    """
    frame = hull_frame(capture, hull_grid, device)
    made = torch.Generator().manual_seed(seed)
    field = RadianceField(*field_grids(hull_grid, frame, settings), settings, not density, made)
    data, ring = averaged_rays(capture, lights, normal_maps, frame), silhouette_rays(capture, frame, settings)
    generator = torch.Generator(device).manual_seed(seed)
    return _Training(field, frame, data, ring, settings, generator, False).surface(on_step)
