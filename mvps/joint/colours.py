"""Colours of the body and of the lobes, once lights with their colours and the grey image model are known.

With the lights' colours taken out, y_c = radiance_c / r_c, a vertex with albedo a (RGB) and grey weights w_k shows

    y_c = a_c q + t_c S,     q = dI/da,   S = sum_k w_k q_k   (blocks.py)

where t is the lobes' colour, one for the object: white on dielectrics, the body's on metals. Every vertex's albedo is eliminated (variable
projection: Golub and Pereyra 1973), and with sums <.> over its samples, divided by its residual variance,

    a_c = (<q y_c> - t_c <q S>) / <q q>,   at least 0
    t_c = sum_v (<S y_c> - a0_c <q S>) / sum_v (<S S> - <q S>^2 / <q q>),   a0 = <q y_c> / <q q>;  where a is at its bound, without a0

Lobes stay white unless a colour predicts held-out lights better (material.py).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from mvps.cores import on_cores
from mvps.joint.reflectance import Observed, chunks
from mvps.joint.trial import parted
from mvps.material import Trial, judged
from mvps.scene import Bool, Float

BOUND_SWEEPS = 4
"""Of the two formulas above in turn: which vertices have no body settles in two or three."""

WHITE = (1.0, 1.0, 1.0)


class _Sums(NamedTuple):
    """Per vertex: <q q>, <q S>, <S S> (V,); <q y>, <S y>, <y y> (V, 3)."""

    qq: Float
    qS: Float
    SS: Float
    qy: Float
    Sy: Float
    yy: Float


def _sums(of: Observed, ratios: Sequence[Float]) -> _Sums:
    def of_view(i: int) -> _Sums:
        n = len(of.views[i].vertex)
        out = _Sums(*(np.zeros(n) for _ in range(3)), *(np.zeros((n, 3)) for _ in range(3)))
        scale = of.vertices.scale.cpu().numpy()
        ratio = ratios[i].astype(np.float32)
        for chunk in chunks(of, i):
            w, q, S = chunk.weight / scale[chunk.rows, None] ** 2, chunk.basis, chunk.predicted - chunk.diffuse
            white = chunk.image / ratio
            out.qq[chunk.part], out.qS[chunk.part], out.SS[chunk.part] = (np.einsum("pl,pl->p", w, a) for a in (q * q, q * S, S * S))
            out.qy[chunk.part] = np.einsum("pl,plc->pc", w * q, white)
            out.Sy[chunk.part] = np.einsum("pl,plc->pc", w * S, white)
            out.yy[chunk.part] = np.einsum("pl,plc->pc", w, white**2)
        return out

    n = len(of.vertices.normal)
    total = _Sums(*(np.zeros(n) for _ in range(3)), *(np.zeros((n, 3)) for _ in range(3)))
    for samples, part in zip(of.views, on_cores(of_view, range(len(of.views))), strict=True):
        index = samples.vertex.cpu().numpy()
        for whole, some in zip(total, part, strict=True):
            whole[index] += some
    return total


def _albedo(sums: _Sums, tint: Float) -> Float:
    """(V, 3), 0 for a vertex without samples."""
    return np.maximum((sums.qy - tint * sums.qS[:, None]) / np.maximum(sums.qq, np.finfo(float).tiny)[:, None], 0)


def _tint(sums: _Sums) -> Float:
    """(3,) colour of the lobes; white where there are none."""
    seen = sums.qq > 0
    qq, qS, SS = (values[seen, None] for values in (sums.qq, sums.qS, sums.SS))
    qy, Sy = sums.qy[seen], sums.Sy[seen]
    tint = np.ones(3)
    for _ in range(BOUND_SWEEPS):
        body: Bool = qy - tint * qS > 0
        top = (Sy - np.where(body, qy * qS / qq, 0)).sum(0)
        bottom = np.where(body, SS - qS**2 / qq, SS).sum(0)
        # Lobes that shine like the body cannot be told from it.
        known = bottom > 1e-6 * SS.sum()
        tint = np.where(known, np.maximum(top, 0) / np.where(known, bottom, 1), 1.0)
    return tint


def _errors(kept: _Sums, albedo: Float, tint: Float) -> Float:
    """(V,) root mean square error of samples over their root mean square; NaN without any."""
    qq, qS, SS = (values[:, None] for values in (kept.qq, kept.qS, kept.SS))
    square = kept.yy - 2 * albedo * kept.qy - 2 * tint * kept.Sy + albedo**2 * qq + 2 * albedo * tint * qS + tint**2 * SS
    level = kept.yy.sum(1)
    return np.where(level > 0, np.sqrt(np.maximum(square.sum(1), 0) / np.where(level > 0, level, 1)), np.nan)


def lobes_in_colour(of: Observed, ratios: Sequence[Float], some: torch.Tensor) -> Trial:
    """Whether lobes in a colour of their own predict the lights held out (trial.py) better than white ones, on some vertices."""
    start = time.perf_counter()
    chosen = torch.zeros(len(of.vertices.normal), dtype=torch.bool, device=some.device)
    chosen[some] = True
    few = [samples.of_pairs(chosen[samples.vertex].nonzero()[:, 0]) for samples in of.views]
    fitted, kept = (_sums(of._replace(views=views), ratios) for views in parted(few))
    white, tint = np.array(WHITE), _tint(fitted)
    before, after = (_errors(kept, _albedo(fitted, t), t) for t in (white, tint))
    return replace(judged("lobes in a colour of their own", before, after), seconds=time.perf_counter() - start)


def colours(of: Observed, ratios: Sequence[Float], coloured_lobes: bool) -> tuple[Float, Float]:
    """Albedo (V, 3), NaN where no view sees the vertex, and the lobes' colour (3,), under lights of known channel ratios (lights, 3)."""
    sums = _sums(of, ratios)
    tint = _tint(sums) if coloured_lobes else np.array(WHITE)
    return np.where(sums.qq[:, None] > 0, _albedo(sums, tint), np.nan), tint
