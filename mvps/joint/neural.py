"""The neural residual: learnt on vertices that albedo and lobes fit badly, and kept only if it predicts held-out lights better.

With X the moments (neural.py), D the direct part of the prediction I and w the robust weights of samples, over their variance,

    image - I = D X . z + noise,    z ~ N(mean, covariance)    (one population for the object, by expectation maximisation)

gives every vertex its z in one linear solve:  (<D^2 X X^T> + covariance^-1) z = <D X (image - I)> + covariance^-1 mean. The network is
trained on what other views say: the views are dealt into FOLDS, and a sample is predicted with the z of all folds but its own. So it
learns how far z holds in a view that z has not seen, and no vertex can learn its samples by heart. Its loss is sqrt(r^2 + KNEE^2), r the
error over the vertex's level, mean over samples.

Judged (material.py) on samples of held-out lights, of vertices that the network has not seen, again without the sample's own views.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mvps.cores import on_cores
from mvps.joint.blocks import WORKERS, Shaded, evaluate, robust
from mvps.joint.lights import on_some
from mvps.joint.observe import ViewSamples
from mvps.joint.reflectance import Observed
from mvps.joint.steps import CORRELATED
from mvps.joint.trial import parted
from mvps.material import Trial, judged
from mvps.neural import MOMENTS, Layers, inputs, log_factor, moments
from mvps.scene import Float, Residual
from solvers.adam import Adam

NAME = "neural residual where the fit is poor"
NOT_TRIED = "neural residual: not tried, too little fits badly"

LEARN_VERTICES, JUDGE_VERTICES = 3000, 1000
"""Vertices that stand for all while the network is learnt, and others on which it is judged; in this proportion where there are fewer."""

LEAST_VERTICES = 400
"""Below it there is no trial: a hundred to judge on are needed for a standard error that can be believed."""

FOLDS = 4

EM_STEPS, FIRST_DEVIATION = 6, 0.5
"""Of the population of z; its deviation at first, as a change of the prediction."""

WIDTH, STEPS, BATCH, RATE = 24, 600, 1 << 13, 1e-2
"""Two hidden layers; of Adam, the rate falling as a cosine. Twice the width predicted no better (docs/findings/reflectance.md)."""

KNEE = 0.3
"""Between the absolute error, by which it is judged, and the square, which a rendered image shows."""

FLOOR = 0.05
"""Added to reflectances over the object's mean before their logarithm is taken."""


class _Population(NamedTuple):
    """Mean (MOMENTS,) and covariance of z."""

    mean: Tensor
    covariance: Tensor


class _Table(NamedTuple):
    """Samples one after the other: vertex, the network's x (n, inputs), direct part and rest of the prediction, image, weight (n,)."""

    vertex: Tensor
    x: Tensor
    direct: Tensor
    rest: Tensor
    image: Tensor
    weight: Tensor


def _split(shaded: Shaded) -> tuple[Tensor, Tensor]:
    """The prediction's direct part and its inter-reflection."""
    return shaded.predicted - shaded.rest, shaded.rest


def _sums(of: Observed, every: int, first: int) -> Tensor:
    """(V, MOMENTS + 1, MOMENTS + 1) products of (D X, image - I) with themselves, summed over samples of views first, first + every ...."""
    vertices = of.vertices
    sums = vertices.normal.new_zeros(len(vertices.normal), MOMENTS + 1, MOMENTS + 1)
    for samples, lights in zip(of.views[first::every], of.lights[first::every], strict=True):
        for part in samples.chunks():
            index, towards = samples.vertex[part], samples.towards[part]
            normal, scale = vertices.normal[index], vertices.scale[index]
            shaded = evaluate(normal, vertices.reflectance[index], towards, lights, of.law, samples.gathered_of(part))
            residual = samples.image[part] - shaded.predicted
            certain = robust(residual, scale, shaded.unsure) / (CORRELATED * scale[:, None] ** 2)
            weight = samples.weight[part, None] * samples.data[part] * certain
            direct, _ = _split(shaded)
            rows = torch.cat([moments(normal, towards, lights.direction) * direct[..., None], residual[..., None]], -1)
            sums.index_add_(0, index, (rows * weight[..., None]).transpose(1, 2) @ rows)
    return sums


def _summed(of: Observed, parts: int) -> list[Tensor]:
    """`_sums` of the views dealt into parts."""
    return on_cores(lambda k: _sums(of, parts, k), range(parts))


def _population(sums: Tensor) -> _Population:
    """Of the vertices with these sums."""
    H, g = sums[:, :MOMENTS, :MOMENTS].double(), sums[:, :MOMENTS, MOMENTS].double()
    size = H.sum(0).diagonal()
    tiny = torch.finfo(torch.float32).tiny
    # A moment that is m times smaller than 1 may be m times larger.
    covariance = torch.diag(FIRST_DEVIATION**2 * size[0].clamp_min(tiny) / size.clamp_min(tiny))
    least, mean = 1e-6 * covariance, torch.zeros_like(size)
    for _ in range(EM_STEPS):
        precision = torch.linalg.inv(covariance)
        spread = torch.linalg.inv(H + precision)
        z = (spread @ (g + precision @ mean)[..., None])[..., 0]
        mean = z.mean(0)
        covariance = (z - mean).T @ (z - mean) / len(z) + spread.mean(0) + least
    return _Population(mean, covariance)


def _solved(sums: Tensor, population: _Population) -> Tensor:
    """(V, MOMENTS) z of each vertex."""
    precision = torch.linalg.inv(population.covariance)
    left = sums[:, :MOMENTS, :MOMENTS].double() + precision
    right = sums[:, :MOMENTS, MOMENTS].double() + precision @ population.mean
    solved: Tensor = torch.linalg.solve(left, right[..., None])[..., 0].float()
    return solved


def _table(of: Observed, views: list[ViewSamples], codes: Sequence[Tensor]) -> _Table:
    """The samples of `views` that are data; view i is predicted with codes[i % FOLDS] (V, codes)."""
    columns: list[list[Tensor]] = [[] for _ in _Table._fields]
    for i, (samples, lights) in enumerate(zip(views, of.lights, strict=True)):
        for part in samples.chunks():
            index, towards = samples.vertex[part], samples.towards[part]
            normal = of.vertices.normal[index]
            shaded = evaluate(normal, of.vertices.reflectance[index], towards, lights, of.law, samples.gathered_of(part))
            x = inputs(normal, towards, lights.direction, codes[i % FOLDS][index])
            data, image = samples.data[part], samples.image[part]
            vertex, weight = (a[:, None].expand_as(image) for a in (index, samples.weight[part]))
            for column, values in zip(columns, (vertex, x, *_split(shaded), image, weight), strict=True):
                column.append(values[data])
    return _Table(*(torch.cat(column) for column in columns))


def _begun(inputs_: int, generator: torch.Generator, like: Tensor) -> Layers:
    """Layers that answer 0."""

    def uniform(reach: float, *size: int) -> Tensor:
        return (2 * torch.rand(size, generator=generator, device=like.device) - 1) * reach

    hidden = [(uniform(a**-0.5, b, a), uniform(a**-0.5, b)) for a, b in pairwise((inputs_, WIDTH, WIDTH))]
    return [*hidden, (like.new_zeros(1, WIDTH), like.new_zeros(1))]


def _trained(table: _Table, level: Tensor, generator: torch.Generator) -> Layers:
    """The network for samples of vertices with levels (V,)."""
    mean, deviation = table.x.mean(0), table.x.std(0).clamp_min(1e-6)
    x, layers = (table.x - mean) / deviation, _begun(table.x.shape[1], generator, table.x)
    parameters = [p.requires_grad_() for layer in layers for p in layer]
    adam, unit = Adam(parameters, (0.9, 0.99), 1e-8), level[table.vertex]
    with ThreadPoolExecutor(1) as pool:
        for step in range(STEPS):
            rows = torch.randint(len(x), (BATCH,), generator=generator, device=x.device)
            predicted = table.direct[rows] * log_factor(x[rows], layers).exp() + table.rest[rows]
            error = (predicted - table.image[rows]) / unit[rows]
            loss = (table.weight[rows] * (error**2 + KNEE**2).sqrt()).mean()
            rate = RATE * (1 + float(np.cos(np.pi * step / STEPS))) / 2
            gradients = torch.autograd.grad(loss, parameters)
            adam.step([[gradient] for gradient in gradients], [rate] * len(parameters), pool)
    (first, bias), *rest = [(w.detach(), b.detach()) for w, b in layers]
    return [(first / deviation, bias - first @ (mean / deviation)), *rest]


def _without_own_views(of: Observed, population: _Population | None, described: Tensor) -> tuple[_Population, list[Tensor]]:
    """The population, from these vertices where none is given, and per fold the codes (V, codes) from the views of the others."""
    folds = _summed(of, FOLDS)
    total = torch.stack(folds).sum(0)
    population = population or _population(total)
    return population, [torch.cat([_solved(total - own, population), described], 1) for own in folds]


def _learnt(of: Observed, described: Tensor, level: Tensor, generator: torch.Generator) -> tuple[_Population, Layers]:
    population, codes = _without_own_views(of, None, described)
    return population, _trained(_table(of, of.views, codes), level, generator)


def _errors(table: _Table, predicted: Tensor, vertices: int) -> Float:
    """(V,) mean absolute error of the samples over their mean; NaN without any."""
    error, level = table.image.new_zeros(vertices), table.image.new_zeros(vertices)
    error.index_add_(0, table.vertex, table.weight * (predicted - table.image).abs())
    level.index_add_(0, table.vertex, table.weight * table.image)
    ratio: Float = torch.where(level > 0, error / level, torch.nan).double().cpu().numpy()
    return ratio


def neural_residual(of: Observed, relative: Tensor, poor: float, generator: np.random.Generator) -> tuple[Trial, Residual | None]:
    """The trial of the residual on the vertices whose relative residual (V,), NaN without samples, is above `poor`, and the residual itself
    where it is kept. None is tried where the median is not above `poor`: there views held out gained nothing
    (docs/findings/reflectance.md)."""
    start = time.perf_counter()
    bad = torch.nonzero(relative > poor)[:, 0]
    if not float(relative.nanmedian()) > poor or len(bad) < LEAST_VERTICES:
        return Trial(NOT_TRIED, False, 0.0, 0.0, time.perf_counter() - start), None
    seeded = torch.Generator(bad.device).manual_seed(int(generator.integers(2**31)))
    order = torch.from_numpy(generator.permutation(len(bad))[: LEARN_VERTICES + JUDGE_VERTICES]).to(bad.device)
    judge, learn = (part.sort().values for part in order.tensor_split([len(order) * JUDGE_VERTICES // (LEARN_VERTICES + JUDGE_VERTICES)]))
    level = (of.vertices.scale / relative)[bad]
    views, vertices = on_some(of.views, of.vertices, bad)
    of = of._replace(views=views, vertices=vertices)
    size = vertices.reflectance.mean(0).clamp_min(torch.finfo(torch.float32).tiny)
    described = torch.cat([torch.log(vertices.reflectance / size + FLOOR), torch.log(relative[bad])[:, None]], 1)

    def on(some: Tensor) -> Observed:
        few, state = on_some(views, vertices, some)
        return of._replace(views=few, vertices=state)

    learning, judging = on(learn), on(judge)
    fitted = learning._replace(views=parted(learning.views)[0])
    population, layers = _learnt(fitted, described[learn], level[learn], seeded)
    seen, kept = parted(judging.views)
    _, codes = _without_own_views(judging._replace(views=seen), population, described[judge])
    table = _table(judging, kept, codes)
    after = table.direct * log_factor(table.x, layers).exp() + table.rest
    trial = judged(NAME, *(_errors(table, predicted, len(judge)) for predicted in (table.direct + table.rest, after)))
    residual = None
    if trial.kept:
        population, layers = _learnt(learning, described[learn], level[learn], seeded)
        z = _solved(torch.stack(_summed(of, WORKERS)).sum(0), population)
        residual = _on_all(torch.cat([z, described], 1), bad, len(relative), layers)
    return replace(trial, seconds=time.perf_counter() - start), residual


def _on_all(code: Tensor, rows: Tensor, vertices: int, layers: Layers) -> Residual:
    """The residual as a value, for codes of some rows of the vertices."""
    share, codes = np.zeros(vertices, np.float32), np.zeros((vertices, code.shape[1]), np.float32)
    where = rows.cpu().numpy()
    share[where], codes[where] = 1, code.cpu().numpy()
    return Residual(share, codes, tuple((w.cpu().numpy(), b.cpu().numpy()) for w, b in layers))
