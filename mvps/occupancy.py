"""Stage I prototype."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mvps.camera import pixel_centres, pixel_footprint, rays
from mvps.field import Lattice, OccupancyField, gradient, lattice
from mvps.mesh import largest_component
from mvps.scene import Capture, Float, NormalMap, SignedDistanceGrid, Surface


@dataclass(frozen=True)
class OccupancySettings:
    steps: int = 600
    rays: int = 2048
    mask_rays: int = 1024
    samples: int = 8
    mask_samples: int = 4
    finest: float = 2.0
    levels: int = 5
    features: int = 4
    hidden: int = 32
    band: tuple[float, float] = (8.0, 2.0)
    width: tuple[float, float] = (1.5, 0.5)
    ring: int = 5
    w_normal: float = 1.0
    w_colour: float = 0.5
    w_mask: float = 0.2
    w_smooth: float = 0.1
    rate: float = 0.05
    net_rate: float = 0.005
    normal_colour: bool = True
    through: bool = True
    step: tuple[float, float] = (2.0, 1.0)
    stride: tuple[int, ...] = (4, 2, 1)
    robust: float = 0.5
    root: bool = True
    voxel: float = 1.25
    device: str = "cpu"


class Rays(NamedTuple):
    anchor: Tensor
    direction: Tensor
    normal: Tensor
    colour: Tensor
    weight: Tensor
    inside: Tensor
    stride: Tensor


def composite(signed_distance: Tensor, width: float) -> tuple[Tensor, Tensor]:
    outside = torch.nn.functional.logsigmoid(signed_distance / width)
    before, after = outside[:, :-1], outside[:, 1:]
    alpha = -torch.expm1((after - before).clamp_max(0))
    first = -torch.expm1(outside[:, :1])
    alpha = torch.cat([first, alpha], 1)
    clear = torch.cumprod(1 - alpha + 1e-7, 1)
    weight = alpha * torch.cat([torch.ones_like(first), clear[:, :-1]], 1)
    return weight, 1 - clear[:, -1]


def crossing(ts, val, fallback):
    enters = (val[:, :-1] > 0) & (val[:, 1:] <= 0)
    first = enters.to(torch.uint8).argmax(1, keepdim=True)
    d0, d1 = val.gather(1, first), val.gather(1, first + 1)
    t0, t1 = ts.gather(1, first), ts.gather(1, first + 1)
    root = t0 + (t1 - t0) * d0 / (d0 - d1).clamp_min(1e-3)
    return torch.where(enters.any(1), root[:, 0], fallback)


def make_rays(capture, normal_maps, centre, unit, s, ring):
    import cv2

    out = []
    for view, nm in zip(capture.views, normal_maps):
        m = view.mask.astype(np.uint8)
        if ring:
            din = cv2.distanceTransform(m, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            dout = cv2.distanceTransform(1 - m, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
            px = np.argwhere((din + dout) < ring + 0.5)
            inside = view.mask[px[:, 0], px[:, 1]]
            n = c = np.zeros((len(px), 3))
            w = np.ones(len(px))
        else:
            px = view.pixels
            inside = np.ones(len(px), bool)
            n, c, w = nm.normal, nm.albedo, nm.confidence
        o, d = rays(view.camera, pixel_centres(px))
        o = (o - centre) / unit
        a = o - d * (o * d).sum(-1, keepdims=True)
        stride = np.where((px % 4 == 0).all(1), 4, np.where((px % 2 == 0).all(1), 2, 1))
        out.append((a, d, n, c, w, inside, stride))
    cols = [np.concatenate(x) for x in zip(*out)]
    t = [torch.tensor(x, dtype=torch.float32, device=s.device) for x in cols]
    return Rays(*t)


@torch.no_grad()
def trace(field, anchor, direction, low, high, through=False):
    """first crossing or closest approach"""
    safe = torch.where(direction.abs() < 1e-9, 1e-9, direction)
    ends = torch.stack([(low - anchor) / safe, (high - anchor) / safe])
    start, stop = ends.amin(0).amax(1), ends.amax(0).amin(1)
    t = torch.where(start < stop, start, 0)
    best = torch.full_like(t, torch.inf); best_t = t.clone()
    live = (start < stop).nonzero()[:, 0]
    while len(live):
        d = torch.cat([field.signed_distance(anchor[i] + t[i, None] * direction[i]) for i in live.split(1 << 15)])
        better = d < best[live]
        best[live] = torch.where(better, d, best[live]); best_t[live] = torch.where(better, t[live], best_t[live])
        t[live] = t[live] + (0.9 * d.abs()).clamp_min(1.0 if through else 0.5)
        live = live[((d > 0.25) | through) & (t[live] < stop[live])]
    return best_t


def schedule(pair, f):
    return pair[0] * (pair[1] / pair[0]) ** f


def robust_square(sq, scale):
    """Geman-McClure-like: scale² sq/(sq+scale²)"""
    return sq / (1 + sq / scale**2)


def occupancy_field(capture, hull_grid, normal_maps, settings, seed, on_step, log=None):
    s = settings
    gen = torch.Generator().manual_seed(seed)
    solid = np.argwhere(hull_grid.values < 0)
    low = hull_grid.origin + hull_grid.spacing * (solid.min(0) - 1)
    high = hull_grid.origin + hull_grid.spacing * (solid.max(0) + 1)
    centre = (low + high) / 2
    unit = pixel_footprint([v.camera for v in capture.views], centre)
    lo = torch.tensor((low - centre) / unit, dtype=torch.float32) - 2
    hi = torch.tensor((high - centre) / unit, dtype=torch.float32) + 2
    reach = float((hi - lo).norm()) / 2
    base_grid = Lattice(
        torch.tensor((hull_grid.origin - centre) / unit, dtype=torch.float32),
        torch.tensor([hull_grid.spacing / unit], dtype=torch.float32),
        torch.tensor([hull_grid.values.shape]),
        torch.tensor([0]),
    )
    base = torch.tensor(hull_grid.values / unit).reshape(-1, 1).float()
    grids = lattice(lo, hi, [s.finest * 2**l for l in range(s.levels)][::-1])
    colours = 6 if s.normal_colour else 3
    field = OccupancyField(base, base_grid, grids, s.features, s.hidden, colours, gen)
    data = make_rays(capture, normal_maps, centre, unit, s, 0)
    ring = make_rays(capture, normal_maps, centre, unit, s, s.ring)
    scale_c = (data.colour.mean(-1) * data.weight).sum() / data.weight.sum()
    target = data.colour / scale_c
    if s.normal_colour:
        target = torch.cat([target, data.normal], 1)
    if log:
        log("rays", len(data.anchor), len(ring.anchor), "unit", unit, "nodes", grids.nodes())
    opt = torch.optim.Adam(
        [
            {"params": [field.table], "lr": s.rate},
            {"params": [field.first, field.first_bias, field.last, field.last_bias], "lr": s.net_rate},
        ],
        betas=(0.9, 0.99),
        eps=1e-12,
        fused=True,
    )
    t = torch.zeros(len(data.anchor))
    tr = torch.zeros(len(ring.anchor))
    stage = -1
    for k in range(s.steps):
        f = k / s.steps
        st = min(int(f * len(s.stride) * 1.0), len(s.stride) - 1)
        if st != stage:
            stage = st
            pool = (data.stride >= s.stride[st]).nonzero()[:, 0]
            t[pool] = trace(field, data.anchor[pool], data.direction[pool], lo, hi)
            rpool = (ring.stride >= min(s.stride[st], 2)).nonzero()[:, 0]
            tr[rpool] = trace(field, ring.anchor[rpool], ring.direction[rpool], lo, hi, True)
            if log:
                log("stage", st, len(pool), len(rpool))
        field.active = max(2, min(s.levels, 2 + int(f / 0.6 * (s.levels - 1))))
        band, width, step = schedule(s.band, min(1, f * 1.5)), schedule(s.width, min(1, f * 1.5)), schedule(s.step, min(1, f * 1.5))
        for gpar, r in zip(opt.param_groups, (s.rate, s.net_rate)):
            gpar["lr"] = r * min(1, (k + 1) / 20) * (0.05 ** max(0, (f - 0.3) / 0.7))
        i = pool[torch.randint(len(pool), (s.rays,), generator=gen)]
        j = rpool[torch.randint(len(rpool), (s.mask_rays,), generator=gen)]
        n = s.rays

        def march(origin, direction, position, samples):
            u = torch.rand(len(position), 1, generator=gen)
            ts = position[:, None] + band * ((torch.arange(samples) + u) / samples * 2 - 1)
            val, col = field((origin[:, None] + ts[..., None] * direction[:, None]).view(-1, 3))
            val = val.view(-1, samples)
            w, opacity = composite(val, width)
            return ts, val, col.view(-1, samples, colours), w, opacity

        a, d = data.anchor[i], data.direction[i]
        ts, val, col, w, opacity = march(a, d, t[i], s.samples)
        mid = torch.cat([ts[:, :1], (ts[:, 1:] + ts[:, :-1]) / 2], 1)
        depth = (w * mid).sum(1) / w.sum(1).clamp_min(1e-4)
        if s.root:
            depth = crossing(ts, val, depth)
        with torch.no_grad():
            low_t = ts.gather(1, val.argmin(1, keepdim=True))[:, 0]
            t[i] = torch.where((opacity > 0.5), depth, low_t)
        mts, mval, _, _, mop = march(ring.anchor[j], ring.direction[j], tr[j], s.mask_samples)
        with torch.no_grad():
            tr[j] = mts.gather(1, mval.argmin(1, keepdim=True))[:, 0]
        x = a + (depth if s.through else depth.detach())[:, None] * d
        hit = (opacity[:n].detach() > 0.5).float()
        q = n // 4
        jit = torch.randn(q, 3, generator=gen) * step
        g, _ = gradient(field, torch.cat([x, x[:q].detach() + jit]), step)
        gx, gj = g[:n], g[n:]
        conf = data.weight[i] * hit
        ln = (conf * robust_square((gx - data.normal[i]).square().sum(1), s.robust)).mean()
        ls = (hit[:q] * robust_square((gx[:q] - gj).square().sum(1), s.robust)).mean()
        c = (w[:, :, None] * col).sum(1) / opacity[:, None].clamp_min(1e-3)
        lc = (conf * robust_square((c - target[i]).square().sum(1), s.robust)).mean()
        op = mop.clamp(1e-4, 1 - 1e-4)
        lm = torch.nn.functional.binary_cross_entropy(op, ring.inside[j])
        loss = s.w_normal * ln + s.w_smooth * ls + s.w_colour * lc + s.w_mask * lm
        opt.zero_grad(set_to_none=True)
        loss.backward()
        opt.step()
        on_step(k, float(loss.detach()))
        if log and (k % 100 == 99):
            log(k, f"n {ln:.4f} s {ls:.4f} c {lc:.4f} m {lm:.4f} band {band:.2f} width {width:.2f} active {field.active}")
    return extract(field, lo, hi, s.voxel, centre, unit)


@torch.no_grad()
def extract(field, lo, hi, voxel, centre, unit):
    from skimage.measure import marching_cubes

    factor = 4
    size = ((hi - lo) / (voxel * factor)).ceil().long() + 1
    ax = [lo[k] + voxel * factor * torch.arange(int(size[k])) for k in range(3)]
    pts = torch.stack(torch.meshgrid(*ax, indexing="ij"), -1).view(-1, 3)
    ev = lambda p: torch.cat([field.signed_distance(q) for q in p.split(1 << 16)])
    coarse = ev(pts).view(*size.tolist())
    fine = torch.nn.functional.interpolate(
        coarse[None, None], size=[int((n - 1) * factor + 1) for n in size], mode="trilinear", align_corners=True
    )[0, 0]
    near = fine.abs() < voxel * factor
    idx = near.nonzero()
    fine[near] = ev(lo + voxel * idx.float())
    m = torch.nn.functional.max_pool3d(near[None, None].float(), 3, 1, 1)[0, 0] > 0
    V, F, _, _ = marching_cubes(fine.numpy(), 0.0)
    return largest_component(Surface(centre + unit * (lo.numpy().astype(np.float64) + voxel * V.astype(np.float64)), F))
