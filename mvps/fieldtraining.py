"""Training of a field along rays: what Stage I (occupancy.py) and the radiance fields of its ablations (radiance.py) have in common.

The field starts at the visual hull's signed distance. Rays of foreground pixels are rendered and compared, rays of a ring around the
silhouettes say by their opacity what is inside. Samples lie in a band around the surface last seen along the ray, which shrinks while the
field's edge gets sharper. The surface point x is the ray's crossing of d = 0, differentiable through its two samples. How samples stop a
ray, and what the rendering is compared with, is the field's own.

All lengths are in pixel footprints at the object, so that the capture's unit does not matter.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mvps.camera import pixel_footprint
from mvps.field import Grid, OccupancyField, SampledField, covering, gradient
from mvps.fieldrays import FieldRays, ring_rays, trace
from mvps.mesh import largest_pieces
from mvps.scene import Capture, Float, SignedDistanceGrid, Surface
from solvers.adam import Adam

COARSE_FACTOR = 4
"""Coarse cells of the surface's grid are this many fine ones wide; the field is evaluated finely only near its level set."""

POINTS_PER_CALL = 1 << 16

PARTS = 2
"""Parts of a batch on a CPU, a thread each: fixed, because the order of a sum is part of its value. A GPU takes the batch as a whole."""

TRACED = 2.5
"""Cells, pixels, of the grid on which rays find the surface: the band of samples around what they find is wider than its error."""

SMOOTHED = 4
"""Every so many rays one asks for smoothness."""


@dataclass(frozen=True)
class TrainingSettings:
    """Lengths in pixel footprints; pairs go from the first value to the second in equal ratios.

    steps, rays, ring_rays: Adam steps and rays in each; samples, ring_samples: per ray
    finest, levels, features: spacing of the finest grid, grids (each twice as coarse as the next), features on a node
    hidden: units of the network; band, width: of the sampling interval (+-) and of the field's edge, at first as wide as the hull of few
    views bulges; step: of finite differences
    ring: half-width in pixels of the ring around the silhouette; mask: weight of its loss
    grid_rate, network_rate: Adam's; voxel: of the extracted surface, at first as long as the edges that it is remeshed to; finer where the
    surface itself goes on: cells of 1.5 left spot's, `fine`, 0.014 px farther inside
    strides: every so many pixels take part, one after the other
    """

    steps: int = 250
    rays: int = 1024
    ring_rays: int = 512
    samples: int = 6
    ring_samples: int = 4
    finest: float = 3.0
    levels: int = 4
    features: int = 4
    hidden: int = 32
    band: tuple[float, float] = (16.0, 2.0)
    width: tuple[float, float] = (3.0, 0.5)
    step: tuple[float, float] = (2.0, 1.0)
    ring: int = 5
    mask: float = 0.2
    grid_rate: float = 0.1
    network_rate: float = 0.02
    voxel: float = 2.0
    strides: tuple[int, ...] = (4, 2, 1)


@dataclass(frozen=True)
class Phase:
    """A moment of the training: progress from 0 to 1 in steps, and what the settings' pairs have come to."""

    progress: float
    band: float
    width: float
    step: float

    @staticmethod
    def at(progress: float, settings: TrainingSettings) -> Phase:
        """The phase at this progress."""
        return Phase(progress, *(between(pair, progress) for pair in (settings.band, settings.width, settings.step)))


def between(pair: tuple[float, float], progress: float) -> float:
    """What a pair of the settings has come to; its second value from two thirds of the steps on."""
    return float(pair[0] * (pair[1] / pair[0]) ** min(1.0, 1.5 * progress))


@dataclass(frozen=True, eq=False)
class Frame:
    """World = centre + unit * local; low, high (3,) the local box around the hull."""

    centre: Float
    unit: float
    low: Tensor
    high: Tensor


def composited(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (rays, samples) and opacity (rays,) where sample i stops what reaches it with probability alpha_i (rays, samples):
    weight_i = alpha_i prod_{j<i} (1 - alpha_j)."""
    # The small constant keeps the product's gradient finite behind an opaque sample.
    clear = torch.cumprod(1 - alpha + 1e-7, 1)
    weight = alpha * torch.cat([torch.ones_like(clear[:, :1]), clear[:, :-1]], 1)
    return weight, 1 - clear[:, -1]


def crossing(distance: Tensor, signed_distance: Tensor, otherwise: Tensor) -> Tensor:
    """(rays,) distance at which rays first enter the surface between two samples, linear in between; `otherwise` where none does."""
    enters = (signed_distance[:, :-1] > 0) & (signed_distance[:, 1:] <= 0)
    first = enters.to(torch.uint8).argmax(1, keepdim=True)
    d0, d1 = signed_distance.gather(1, first), signed_distance.gather(1, first + 1)
    t0, t1 = distance.gather(1, first), distance.gather(1, first + 1)
    root = t0 + (t1 - t0) * d0 / (d0 - d1).clamp_min(1e-3)
    return torch.where(enters.any(1), root[:, 0], otherwise)


@dataclass(frozen=True, eq=False)
class Draw:
    """A random part of the rays: their numbers (n,), shift of their samples (n, 1), steps aside (n / SMOOTHED, 3) for smoothness."""

    chosen: Tensor
    jitter: Tensor
    aside: Tensor


class Met(NamedTuple):
    """How n rays of foreground pixels meet the surface. chosen (n,): their numbers; hit (n,): 1 where more than half of the ray stops;
    weight, opacity (n, samples), (n,) of the rendering; colour (n, samples, channels) of the field; normal (n, 3) of the field at the
    surface, not normalised; aside (n / SMOOTHED, 3): the same a little aside of the first ones."""

    chosen: Tensor
    hit: Tensor
    weight: Tensor
    opacity: Tensor
    colour: Tensor
    normal: Tensor
    aside: Tensor


class Training(ABC):
    """The field, its rays with the surface's distance last seen along each, the optimiser, and the threads that share the work."""

    def __init__(
        self,
        field: OccupancyField,
        frame: Frame,
        data: FieldRays,
        ring: FieldRays,
        settings: TrainingSettings,
        generator: torch.Generator,
        trained: bool,
    ) -> None:
        self.field, self.frame, self.data, self.ring, self.settings = field, frame, data, ring, settings
        self.generator = generator
        self.parts = PARTS if frame.low.device.type == "cpu" else 1
        self.pool_of_threads = ThreadPoolExecutor(self.parts)
        self.seen = torch.zeros_like(data.weight)
        self.ring_seen = torch.zeros_like(ring.weight)
        self.pool = self.ring_pool = torch.zeros(0, dtype=torch.long, device=frame.low.device)
        self.trained = trained
        # A tiny epsilon: a node's gradients are small only because few rays pass it.
        self.optimiser = Adam([*field.network(), *field.features], betas=(0.9, 0.99), epsilon=1e-12)

    @abstractmethod
    def rendering(self, distance: Tensor, value: Tensor, width: float) -> tuple[Tensor, Tensor]:
        """Weights (rays, samples) and opacity (rays,) of samples at distances along rays, with the field's values there (rays, samples),
        nearest first."""

    @abstractmethod
    def loss(self, met: Met, phase: Phase) -> Tensor:
        """Of rays of foreground pixels, all but the mask's."""

    def widen(self, stride: int) -> None:
        """Take in the pixels of this stride and find the surface along their rays anew."""
        low, high = self.frame.low, self.frame.high
        values = sampled(self.field, low, high, TRACED)
        frozen = SampledField(values, Grid(low, TRACED, values.shape))
        self.pool = (self.data.stride >= stride).nonzero()[:, 0]
        self.ring_pool = (self.ring.stride >= min(stride, 2)).nonzero()[:, 0]

        def traced(rays: FieldRays, chosen: Tensor, through: bool) -> Tensor:
            parts = self.pool_of_threads.map(
                lambda c: trace(frozen, rays.anchor[c], rays.direction[c], low, high, through), chosen.chunk(self.parts)
            )
            return torch.cat(list(parts))

        self.seen[self.pool] = traced(self.data, self.pool, False)
        self.ring_seen[self.ring_pool] = traced(self.ring, self.ring_pool, True)

    def march(self, rays: FieldRays, draw: Draw, around: Tensor, band: float, samples: int) -> tuple[Tensor, Tensor]:
        """Jittered distances (rays, samples) in a band around a distance, and the points (rays, samples, 3) there."""
        distance = around[:, None] + band * ((torch.arange(samples, device=around.device) + draw.jitter) / samples * 2 - 1)
        return distance, rays.anchor[draw.chosen][:, None] + distance[..., None] * rays.direction[draw.chosen][:, None]

    def _draw(self, pool: Tensor, count: int) -> list[Draw]:
        """Rays drawn from a pool, dealt into parts."""
        generator, device = self.generator, pool.device
        chosen = pool[torch.randint(len(pool), (count,), generator=generator, device=device)]
        jitter = torch.rand(count, 1, generator=generator, device=device)
        aside = torch.randn(count // SMOOTHED, 3, generator=generator, device=device)
        return [Draw(*values) for values in zip(*(v.chunk(self.parts) for v in (chosen, jitter, aside)), strict=True)]

    def mask_loss(self, draw: Draw, distance: Tensor, value: Tensor, width: float) -> tuple[Tensor, Tensor]:
        """Cross-entropy of the opacity along rays of the ring, and the distance of their closest approach; of samples' distances and signed
        distances (rays, samples)."""
        _, opacity = self.rendering(distance, value, width)
        nearest = distance.gather(1, value.detach().argmin(1, keepdim=True))[:, 0]
        return torch.nn.functional.binary_cross_entropy(opacity.clamp(1e-4, 1 - 1e-4), self.ring.inside[draw.chosen]), nearest

    def surface_loss(self, draw: Draw, distance: Tensor, value: Tensor, colour: Tensor, phase: Phase) -> tuple[Tensor, Tensor]:
        """`loss` along rays of foreground pixels, and where they meet the surface; of samples' distances, signed distances (rays, samples)
        and colours (rays, samples, channels)."""
        data, chosen = self.data, draw.chosen
        weight, opacity = self.rendering(distance, value, phase.width)
        middle = torch.cat([distance[:, :1], (distance[:, 1:] + distance[:, :-1]) / 2], 1)
        depth = crossing(distance, value, (weight * middle).sum(1) / weight.sum(1).clamp_min(1e-4))
        nearest = distance.gather(1, value.detach().argmin(1, keepdim=True))[:, 0]
        x = data.anchor[chosen] + depth[:, None] * data.direction[chosen]
        few = len(draw.aside)
        normals, _ = gradient(self.field, torch.cat([x, x[:few].detach() + draw.aside * phase.step]), phase.step)
        hit = (opacity.detach() > 0.5).float()
        met = Met(chosen, hit, weight, opacity, colour, normals[: len(x)], normals[len(x) :])
        return self.loss(met, phase), torch.where(opacity > 0.5, depth, nearest).detach()

    def step(self, phase: Phase, rate: float) -> Tensor:
        """One step of the optimiser, rates times `rate`; the loss, not waited for. The parts of a batch are independent and run on a core
        each."""
        s = self.settings
        draws, ring_draws = self._draw(self.pool, s.rays), self._draw(self.ring_pool, s.ring_rays)
        network, features = self.field.network(), self.field.in_use()

        def part(k: int) -> tuple[Tensor, tuple[Tensor, ...], Tensor, Tensor]:
            draw, ring_draw = draws[k], ring_draws[k]
            distance, points = self.march(self.data, draw, self.seen[draw.chosen], phase.band, s.samples)
            ring_distance, ring_points = self.march(self.ring, ring_draw, self.ring_seen[ring_draw.chosen], phase.band, s.ring_samples)
            # One call for both: its gradients are as large as the grids, whatever the number of points.
            value, colour = self.field(torch.cat([points.view(-1, 3), ring_points.view(-1, 3)]))
            of_data, of_ring = value.split([distance.numel(), ring_distance.numel()])
            colour = colour[: distance.numel()].view(*distance.shape, -1)
            loss, seen = self.surface_loss(draw, distance, of_data.view(distance.shape), colour, phase)
            of_mask, ring_seen = self.mask_loss(ring_draw, ring_distance, of_ring.view(ring_distance.shape), phase.width)
            total = (loss + s.mask * of_mask) / self.parts
            return total.detach(), torch.autograd.grad(total, network + features), seen, ring_seen

        parts = list(self.pool_of_threads.map(part, range(self.parts)))
        for draw, ring_draw, (_, _, seen, ring_seen) in zip(draws, ring_draws, parts, strict=True):
            self.seen[draw.chosen], self.ring_seen[ring_draw.chosen] = seen, ring_seen
        rates = [rate * s.network_rate] * len(network) + [rate * s.grid_rate] * len(features)
        self.optimiser.step(list(zip(*(gradients for _, gradients, _, _ in parts), strict=True)), rates, self.pool_of_threads)
        return torch.stack([loss for loss, *_ in parts]).double().sum()

    def run(self, on_step: Callable[[int, Tensor], None]) -> None:
        """All steps: ever more of the pixels; grids from coarse to fine; rates that rise shortly and fall to a 20th."""
        s = self.settings
        for k in range(s.steps):
            progress = k / s.steps
            if k == 0 or int(progress * len(s.strides)) != int((k - 1) / s.steps * len(s.strides)):
                self.widen(s.strides[int(progress * len(s.strides))])
            coarse_to_fine = max(2, min(s.levels, 2 + int(progress / 0.6 * (s.levels - 1))))
            self.field.activate(s.levels if self.trained else coarse_to_fine)
            rate = min(1.0, (k + 1) / 20) * 0.05 ** max(0.0, (progress - 0.3) / 0.7)
            on_step(k, self.step(Phase.at(progress, s), rate))

    def surface(self, on_step: Callable[[int, Tensor], None], pieces: int = 1) -> Surface:
        """The field's surface after all steps, so many pieces of it; world units. on_step(step from 0, loss) is called after every step."""
        torch.set_num_threads(1)
        with self.pool_of_threads:
            self.run(on_step)
        return extract(self.field, self.frame, self.settings.voxel, pieces)


def hull_frame(capture: Capture, grid: SignedDistanceGrid, device: torch.device) -> Frame:
    """The frame of a capture's field, from the signed distance of its hull."""
    solid = np.argwhere(grid.values < 0)
    low, high = (grid.origin + grid.spacing * (corner + pad) for corner, pad in ((solid.min(0), -1), (solid.max(0), 1)))
    centre = (low + high) / 2
    unit = pixel_footprint([view.camera for view in capture.views], centre)
    # Two pixels of room: the surface may lie a little outside a hull whose masks are a little small.
    local = [torch.tensor((corner - centre) / unit, dtype=torch.float32, device=device) for corner in (low, high)]
    return Frame(centre, unit, local[0] - 2, local[1] + 2)


def field_grids(grid: SignedDistanceGrid, frame: Frame, settings: TrainingSettings) -> tuple[Tensor, Grid, list[Grid]]:
    """The hull's signed distance (x, y, z) in pixel footprints, its grid, and the grids of the features, from coarse to fine."""
    from_hull = (grid.origin - frame.centre) / frame.unit, grid.values / frame.unit
    low, base = (torch.tensor(values, dtype=torch.float32, device=frame.low.device) for values in from_hull)
    grids = [covering(frame.low, frame.high, settings.finest * 2**level) for level in range(settings.levels)][::-1]
    return base, Grid(low, grid.spacing / frame.unit, base.shape), grids


def silhouette_rays(capture: Capture, frame: Frame, settings: TrainingSettings) -> FieldRays:
    """The rays of the ring around every silhouette."""
    return ring_rays(capture, frame.centre, frame.unit, settings.ring, frame.low.device)


@torch.no_grad()
def sampled(field: OccupancyField, low: Tensor, high: Tensor, voxel: float) -> Tensor:
    """Signed distance on a grid of `voxel` from low (3,) to beyond high (3,); far from the surface interpolated from a coarse grid."""

    def values(points: Tensor) -> Tensor:
        return torch.cat([field.signed_distance(part) for part in points.split(POINTS_PER_CALL)])

    cell = voxel * COARSE_FACTOR
    size = (((high - low) / cell).ceil().long() + 1).tolist()
    axes = [low[k] + cell * torch.arange(size[k], device=low.device) for k in range(3)]
    coarse = values(torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).view(-1, 3)).view(*size)
    fine_size = [(n - 1) * COARSE_FACTOR + 1 for n in size]
    fine = torch.nn.functional.interpolate(coarse[None, None], size=fine_size, mode="trilinear", align_corners=True)[0, 0]
    near = fine.abs() < cell
    fine[near] = values(low + voxel * near.nonzero().float())
    return fine


def extract(field: OccupancyField, frame: Frame, voxel: float, pieces: int) -> Surface:
    """The field's zero level set on a grid of `voxel`, its largest pieces, faces outwards; world units."""
    from skimage.measure import marching_cubes

    vertices, faces, _, _ = marching_cubes(sampled(field, frame.low, frame.high, voxel).cpu().numpy(), 0.0)
    local = frame.low.cpu().numpy().astype(np.float64) + voxel * vertices.astype(np.float64)
    return largest_pieces(Surface(frame.centre + frame.unit * local, faces), pieces)
