"""Colours of the body, of the lobes and of the lights, once the grey image model is known.

With a light's colour r taken out, its channels' intensities over their mean, y_c = radiance_c / r_c, a vertex with albedo a (RGB) and grey
weights w_k shows

    y_c = a_c q_c + t_c S,     q_c = dI/da + e b (G_c - G),     S = sum_k w_k q_k   (blocks.py)

where t is the lobes' colour: white on dielectrics, the body's on metals. Once albedos are known, what diffuse surfaces send has their
colour, b G_c (bounce.py); where lobes take part in it (gleam.py) it counts as grey. Every vertex's albedo is eliminated (variable
projection: Golub and Pereyra 1973), and with sums <.> over its samples, divided by its residual variance and less of channels that a light
lacks (`told_by_channels`),

    a_c = (<q_c y_c> - t_c <q_c S>) / <q_c q_c>,   at least 0

One t for the object is, with a0 = <q y> / <q q> and H_vc = <S S> - <q_c S>^2 / <q_c q_c>,

    t_c = sum_v g_vc / sum_v H_vc,   g_vc = <S y_c> - a0_c <q_c S>   where a is at its bound, without a0, and H = <S S>

and an object of several materials has, around that, places with colours of variance tau_c^2, which is what their g_vc scatter by beyond
their own variance H_vc (DerSimonian and Laird 1986; a place of which g says little has the object's colour):

    tau_c^2 = (sum_v (g_vc - H_vc t_c)^2 / H_vc - (V - 1)) / (sum_v H_vc - sum_v H_vc^2 / sum_v H_vc),   at least 0
    t_vc = t_c + tau_c^2 (g_vc - H_vc t_c) / (1 + H_vc tau_c^2),   at least 0

Lobes stay white unless a colour predicts held-out lights better (material.py), and have one colour unless several do. Lights' colours are
solved in turn with these two, as ratios of robust sums over what is predicted,

    r_lc = sum w radiance_c (a_c q + t_c S) / sum w (a_c q + t_c S)^2,     w = (diffuse part / all)^2   on top of the robust weights

because lobes may have other colours still. What one view sees of lights that it has to itself may have no body but what the model's error
makes up; there POOR_FIT^2 is added to w, so that lobes in their colours tell where bodies make less than that part. One factor per channel
is free where all has the body's colour. Lights as such are taken for white on average, of which n have a mean r of one within sigma /
sqrt(n), sigma their own scatter. Highlights of all but metals have the colour of their light (Shafer 1985), so that under such lights t is
the mean of r, with the variance that the sums above give it,

    mean r_c = 1 + (t_c - 1) v / (v + 1 / H_c),   v = sigma^2 / n,   H_c = sum_v H_vc

unless some t_c is further from white than three standard deviations of that: then it is the lobes' own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from enum import Enum
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mvps.bounce import on_vertices
from mvps.cores import on_cores
from mvps.gleam import Senders, terms
from mvps.joint.reflectance import Chunk, Observed, chunks
from mvps.joint.trial import parted
from mvps.material import POOR_FIT, Trial, judged
from mvps.pixel_samples import DARKEST, told_by_channels
from mvps.scene import Bool, Float
from mvps.shading import most_albedo

BOUND_SWEEPS = 4
"""Of the formulas for a and t in turn: which vertices have no body settles in two or three."""

LIGHT_SWEEPS = 3
"""Of lights' colours in turn with the others; every round goes on from those of the last."""

ALIKE = 1e-6
"""Part of the lobes' squares beyond the body's that tells them apart; single precision leaves 1e-7 of where they shine alike."""

TINY = np.finfo(float).tiny

COLOURED = 3.0
"""Times the median of all lights in a channel, or a part of it, from which a lamp is a coloured one: white ones from 2700 to 6500 K are
within 2.8 of each other's (Planck's law at 610, 540 and 460 nm over the sum)."""

BY_CHANCE = 3.0
"""Standard deviations that the mean colour of lights which are white on average is from white at most."""

Single = NDArray[np.float32]


class _Sums(NamedTuple):
    """Per vertex <q q>, <q S>, <S S>, <q y>, <S y>, <y y>, (V, 3) each."""

    qq: Float
    qS: Float
    SS: Float
    qy: Float
    Sy: Float
    yy: Float


def _sums(of: Observed, ratios: Sequence[Float], samples_of: Callable[[int], Iterable[Chunk]], sent: Senders | None = None) -> _Sums:
    """samples_of: those of a view by its number; sent: as in `colours`."""
    scale, beyond_grey = of.vertices.scale.cpu().numpy(), None if sent is None else _beyond_grey(of, sent)

    def of_view(i: int) -> _Sums:
        out = _Sums(*(np.zeros((len(of.views[i].vertex), 3)) for _ in _Sums._fields))
        ratio, more = ratios[i].astype(np.float32), None if beyond_grey is None else beyond_grey(i)
        told = told_by_channels(ratios[i]).astype(np.float32)
        for chunk in samples_of(i):
            w, q, S, y = chunk.weight / scale[chunk.rows, None] ** 2, chunk.basis, chunk.predicted - chunk.diffuse, chunk.image / ratio
            told_y = told * y
            if more is None:
                qq, qS, qy = _by_channels(w * q * q, told), _by_channels(w * q * S, told), _over_lights(w * q, told_y)
            else:
                q_c = q[..., None] + more(chunk.part)
                told_q = told * q_c
                qq, qS, qy = _over_lights(w, told_q * q_c), _over_lights(w * S, told_q), _over_lights(w, q_c * told_y)
            sums = qq, qS, _by_channels(w * S * S, told), qy, _over_lights(w * S, told_y), _over_lights(w, told_y * y)
            for total, of_chunk in zip(out, sums, strict=True):
                total[chunk.part] = of_chunk
        return out

    total = _Sums(*(np.zeros((len(of.vertices.normal), 3)) for _ in _Sums._fields))
    for samples, part in zip(of.views, on_cores(of_view, range(len(of.views))), strict=True):
        index = samples.vertex.cpu().numpy()
        for whole, some in zip(total, part, strict=True):
            whole[index] += some
    return total


def _over_lights(weight: Single, values: Single) -> Single:
    """(n, 3) sums of values (n, lights, 3) with weights (n, lights)."""
    return (weight[:, None] @ values)[:, 0]


def _by_channels(values: Single, told: Single) -> Single:
    """(n, 3) sums of values (n, lights) by how much the lights' channels tell (lights, 3); (n, 1) where all tell as much."""
    return values.sum(1, keepdims=True) if (told == 1).all() else values @ told


def _beyond_grey(of: Observed, sent: Senders) -> Callable[[int], Callable[[slice], Single]]:
    """e b (G_c - G) (n, lights, 3) of some pairs of a view by its number."""
    weights = on_vertices(sent.sources.of, of.surface)

    def of_view(i: int) -> Callable[[slice], Single]:
        samples, lights = of.views[i], of.lights[i]
        assert samples.gathered is not None
        G = terms(sent, lights.direction.double().cpu().numpy(), of.capture.views[i].camera.centre)
        rows, grey = weights[samples.vertex.cpu().numpy()], samples.gathered[..., :1].cpu().numpy()
        strength = np.float32(of.law.bounce) * lights.intensity.cpu().numpy()[:, None]
        return lambda part: strength * (G.through(rows[part])[:, :, 0] - grey[part])

    return of_view


def _albedo(sums: _Sums, tint: Float) -> Float:
    """(V, 3), 0 for a vertex without samples. tint (V, 3)."""
    return np.maximum((sums.qy - tint * sums.qS) / np.maximum(sums.qq, TINY), 0)


def _lobes_alone(sums: _Sums, tint: Float) -> tuple[Float, Float]:
    """H and g (V, 3), zeros where lobes cannot be told from the body; tint (3,) tells which vertices have none."""
    body: Bool = sums.qy - tint * sums.qS > 0
    part = np.where(body, sums.qS / np.maximum(sums.qq, TINY), 0)
    H, g = sums.SS - part * sums.qS, sums.Sy - part * sums.qy
    known = (H > ALIKE * sums.SS) & (sums.qq > 0)
    return np.where(known, H, 0), np.where(known, g, 0)


def _tint(sums: _Sums) -> tuple[Float, Float]:
    """The lobes' colour (3,), one for the object and white where there are none, and its variance."""
    tint = np.ones(3)
    for _ in range(BOUND_SWEEPS):
        H, g = (values.sum(0) for values in _lobes_alone(sums, tint))
        tint = np.where(H > 0, np.maximum(g, 0) / np.where(H > 0, H, 1), 1.0)
    return tint, np.where(H > 0, 1 / np.where(H > 0, H, 1), np.inf)


def _tints(sums: _Sums, tint: Float) -> Float:
    """Colours (V, 3) of every vertex' lobes, around the object's (3,)."""
    H, g = _lobes_alone(sums, tint)
    beyond, total = g - H * tint, H.sum(0)
    chance = (beyond**2 / np.maximum(H, TINY)).sum(0) - np.maximum((H > 0).sum(0) - 1, 0)
    variance = np.maximum(chance, 0) / np.maximum(total - (H**2).sum(0) / np.maximum(total, TINY), TINY)
    of_each: Float = np.maximum(tint + variance * beyond / (1 + variance * H), 0)
    return of_each


def _errors(kept: _Sums, albedo: Float, tint: Float) -> Float:
    """(V,) root mean square error of samples over their root mean square; NaN without any."""
    square = kept.yy - 2 * albedo * kept.qy - 2 * tint * kept.Sy + albedo**2 * kept.qq + 2 * albedo * tint * kept.qS + tint**2 * kept.SS
    level = kept.yy.sum(1)
    return np.where(level > 0, np.sqrt(np.maximum(square.sum(1), 0) / np.where(level > 0, level, 1)), np.nan)


class LobeColour(Enum):
    """What colour lobes have: that of their light, one for the object, or one for every vertex."""

    WHITE = "white"
    ONE = "one"
    EACH = "each"


def _of_kind(kind: LobeColour, sums: _Sums) -> Float:
    """(V, 3) colours of the lobes."""
    if kind is LobeColour.WHITE:
        return np.ones_like(sums.qq)
    tint, _ = _tint(sums)
    return _tints(sums, tint) if kind is LobeColour.EACH else np.tile(tint, (len(sums.qq), 1))


def lobes_in_colour(of: Observed, ratios: Sequence[Float], some: torch.Tensor) -> tuple[LobeColour, list[Trial]]:
    """Which colours of lobes predict the lights held out (trial.py) best, on some vertices."""
    start = time.perf_counter()
    chosen = torch.zeros(len(of.vertices.normal), dtype=torch.bool, device=some.device)
    chosen[some] = True
    few = [samples.of_pairs(chosen[samples.vertex].nonzero()[:, 0]) for samples in of.views]
    parts = (of._replace(views=views) for views in parted(few))
    fitted, kept = (_sums(part, ratios, partial(chunks, part)) for part in parts)

    def error(kind: LobeColour) -> Float:
        tint = _of_kind(kind, fitted)
        return _errors(kept, _albedo(fitted, tint), tint)

    found, trials = LobeColour.WHITE, []
    for kind, name in ((LobeColour.ONE, "lobes in a colour of their own"), (LobeColour.EACH, "lobes in a colour of every place")):
        trial = judged(name, error(found), error(kind))
        trials.append(replace(trial, seconds=time.perf_counter() - start))
        found, start = kind if trial.kept else found, time.perf_counter()
    return found, trials


def colours(of: Observed, ratios: Sequence[Float], kind: LobeColour, sent: Senders | None = None) -> tuple[Float, Float]:
    """Albedo (V, 3), NaN where no view sees the vertex or none could be that strong, and the lobes' colour (V, 3), under lights of known
    channel ratios (lights, 3).

    sent: what diffuse surfaces send light on by, in colour; None: what arrives counts as grey.
    """
    sums = _sums(of, ratios, partial(chunks, of), sent)
    tint = _of_kind(kind, sums)
    albedo = _albedo(sums, tint)
    return np.where(_possible(of, sums, albedo), albedo, np.nan), tint


def _possible(of: Observed, sums: _Sums, albedo: Float) -> Bool:
    """(V, 3) where a view sees the vertex and the albedo (V, 3) could be that strong: where the model takes a vertex to be all but dark it
    is light over next to nothing."""
    seen = torch.from_numpy(sums.qq.any(1)).to(of.vertices.reflectance.device)
    return np.asarray((sums.qq > 0) & (albedo.mean(1, keepdims=True) <= most_albedo(of.vertices.reflectance[seen], of.law)))


def light_ratios(of: Observed, ratios: list[Float], one_rig: bool) -> list[Float]:
    """Per view the lights' channel ratios (lights, 3), from `ratios` on. All samples are kept meanwhile: those of some thousand vertices
    are enough."""
    kept = on_cores(lambda i: list(chunks(of, i)), range(len(of.views)))
    least = 0.0 if one_rig else POOR_FIT**2

    def sweep(ratios: list[Float]) -> list[Float]:
        sums = _sums(of, ratios, kept.__getitem__)
        tint, variance = _tint(sums)
        tints = _tints(sums, tint)
        albedo = _albedo(sums, tints)
        albedo, tints = np.where(_possible(of, sums, albedo), (albedo, tints), 0)
        solved = _white(_ratios(on_cores(lambda i: _of_lights(kept[i], len(ratios[i]), albedo, tints, least), range(len(kept))), one_rig))
        # The tint is that under lights which were perhaps not white on average.
        under = np.concatenate(ratios).mean(0)
        mean = _mean_colour(solved[0] if one_rig else np.concatenate(solved), under * tint, under**2 * variance)
        return [_relative(ratio * mean) for ratio in solved]

    for _ in range(LIGHT_SWEEPS):
        ratios = sweep(ratios)
    return ratios


def ratios_of_known(of: Observed, albedo: Float, tint: Float, one_rig: bool) -> list[Float]:
    """Per view the channel ratios (lights, 3) of lights in front of a known object: albedo and lobes' colour (V, 3)."""
    counts = [len(lights.intensity) for lights in of.lights]
    return _ratios(on_cores(lambda i: _of_lights(chunks(of, i), counts[i], albedo, tint), range(len(of.views))), one_rig)


def _mean_colour(ratios: Float, tint: Float, variance: Float) -> Float:
    """Mean (3,) of lights' colours, from `ratios` (lights, 3), white on average, under which lobes would have the colour `tint`, known
    up to `variance`."""
    level = tint.mean()
    if len(ratios) < 2 or not (level > 0 and np.isfinite(variance).all()):
        return np.ones(3)
    beyond, certain = tint / level - 1, variance / level**2
    chance = ratios.var(0, ddof=1).mean() / len(ratios)
    if (beyond**2 > BY_CHANCE**2 * (chance + certain)).any():
        return np.ones(3)
    return np.asarray(1 + beyond * chance / np.maximum(chance + certain, TINY))


def _of_lights(of_view: Iterable[Chunk], count: int, albedo: Float, tint: Float, least: float = 0.0) -> tuple[Float, Float]:
    """Numerators and denominators of r (count, 3) of a view's samples, for albedo and the lobes' colour (V, 3); least: added to w."""
    top, bottom = np.zeros((2, count, 3))
    body, lobes = albedo.astype(np.float32), tint.astype(np.float32)
    for chunk in of_view:
        weight = chunk.weight * ((chunk.diffuse / np.maximum(chunk.predicted, 1e-12)) ** 2 + least)
        shown = chunk.basis[..., None] * body[chunk.rows, None] + (chunk.predicted - chunk.diffuse)[..., None] * lobes[chunk.rows, None]
        weighted = weight[..., None] * shown
        top += np.einsum("plc,plc->lc", weighted, chunk.image)
        bottom += np.einsum("plc,plc->lc", weighted, shown)
    return top, bottom


def _ratios(sums: list[tuple[Float, Float]], one_rig: bool) -> list[Float]:
    """r (lights, 3) of every view."""
    if one_rig:
        sums = [(np.sum([t for t, _ in sums], axis=0), np.sum([b for _, b in sums], axis=0))] * len(sums)
    ratios = [top / np.maximum(bottom, 1e-300) for top, bottom in sums]
    # Of a photograph that was left out no sample speaks: white.
    ratios = [np.where(ratio.sum(1, keepdims=True) > 0, ratio, 1.0) for ratio in ratios]
    return [_relative(np.maximum(ratio, DARKEST * ratio.mean(1, keepdims=True))) for ratio in ratios]


def _white(ratios: list[Float]) -> list[Float]:
    """White on average, but for coloured lamps among white ones: a common tint of all lights may be a tint of the object."""
    every = np.concatenate(ratios)
    alike = (np.abs(np.log(np.maximum(every, 1e-300) / np.median(every, axis=0))) <= np.log(COLOURED)).all(1)
    tint = np.mean(every[alike] if 2 * alike.sum() > len(every) else every, axis=0)
    return [_relative(ratio / tint) for ratio in ratios]


def _relative(ratio: Float) -> Float:
    """Over the channels' mean."""
    return np.asarray(ratio / np.maximum(ratio.mean(1, keepdims=True), 1e-300))
