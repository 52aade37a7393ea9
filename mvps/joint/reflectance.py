"""Colour: albedo per channel and the lights' colours, once normals, weights and grey intensities are known.

    radiance_c / (e r_c) = a_c q_0 + sum_k w_k q_0 E_k,      q_0 = max(n.l, 0),   e mean intensity, r_c ratio of channel c

is linear in a_c for given ratios and in r_c for given albedos; both are robust ratios of sums, taken in turn. One light's ratios
are free up to a common factor per channel, which the albedo takes up: ratios have mean one over the lights.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from mvps.camera import bilinear, project
from mvps.joint.blocks import WORKERS, DirectionalLights, Vertices, evaluate, robust
from mvps.joint.observe import ViewSamples
from mvps.scene import Capture, Float, Surface, View

COLOUR_SWEEPS = 3
PAIRS_PER_CHUNK = 2048


def _sums(
    view: View,
    samples: ViewSamples,
    surface: Surface,
    vertices: Vertices,
    lights: DirectionalLights,
    sharpness: torch.Tensor,
    ratio: NDArray[np.float32],
    albedo: NDArray[np.float32],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Per pair numerator (n, 3) and denominator (n,) of the albedo; per light numerator and denominator (lights, 3) of the ratios."""
    n, count = len(samples.vertex), len(ratio)
    top, bottom = np.zeros((n, 3)), np.zeros(n)
    light_top, light_bottom = np.zeros((count, 3)), np.zeros((count, 3))
    # Rows of reflectance with the albedo set to zero shade the lobes alone.
    bare = vertices.reflectance.clone()
    bare[:, 0] = 0
    for start in range(0, n, PAIRS_PER_CHUNK):
        part = slice(start, start + PAIRS_PER_CHUNK)
        index, towards = samples.vertex[part], samples.towards[part]
        full = evaluate(vertices.normal[index], vertices.reflectance[index], towards, lights, sharpness)
        lobes = evaluate(vertices.normal[index], bare[index], towards, lights, sharpness).predicted.numpy()
        weight = samples.weight[part, None] * samples.data[part] * robust(full.predicted - samples.image[part], vertices.scale[index])
        w, q = weight.numpy(), full.basis[0].numpy()
        positions, weights = bilinear(view.pixel_index, project(view.camera, surface.vertices[index.numpy()])[0])
        image = np.einsum("pklc,pk->plc", view.samples[positions].astype(np.float32) * np.float32(view.scale), weights)
        top[part] = np.einsum("pl,plc->pc", w * q, image / ratio) - (w * q * lobes).sum(1)[:, None]
        bottom[part] = (w * q * q).sum(1)
        predicted = q[..., None] * albedo[index.numpy()][:, None] + lobes[..., None]
        light_top += np.einsum("pl,plc,plc->lc", w, image, predicted)
        light_bottom += np.einsum("pl,plc->lc", w, predicted**2)
    return top, bottom, light_top, light_bottom


def colours(
    capture: Capture,
    surface: Surface,
    views: list[ViewSamples],
    vertices: Vertices,
    lights: list[DirectionalLights],
    sharpness: torch.Tensor,
    ratios: list[Float],
    one_rig: bool,
) -> tuple[NDArray[np.float64], list[Float]]:
    """Albedo (V, 3), NaN where no view sees the vertex, and per view the lights' channel ratios (lights, 3).

    Starts from `ratios`; the mean over the channels of albedo and ratio stays what the grey solution says.
    """
    grey = vertices.reflectance[:, :1].numpy()
    albedo = np.repeat(grey, 3, 1)
    host = replace(vertices)
    for _ in range(COLOUR_SWEEPS):
        tasks = list(zip(capture.views, views, lights, ratios, strict=True))
        with ThreadPoolExecutor(WORKERS) as pool:
            now = albedo
            sums = list(pool.map(lambda t: _sums(t[0], t[1], surface, host, t[2], sharpness, t[3].astype(np.float32), now), tasks))
        top, bottom = np.zeros((len(grey), 3)), np.zeros(len(grey))
        for samples, part in zip(views, sums, strict=True):
            top[samples.vertex.numpy()] += part[0]
            bottom[samples.vertex.numpy()] += part[1]
        with np.errstate(invalid="ignore", divide="ignore"):
            albedo = np.where(bottom[:, None] > 0, np.maximum(top / bottom[:, None], 0), np.nan)
        albedo = np.nan_to_num(albedo, nan=0.0).astype(np.float32)
        ratios = _ratios([(part[2], part[3]) for part in sums], one_rig)
    known = bottom > 0
    result = np.full((len(grey), 3), np.nan)
    result[known] = albedo[known]
    return result, ratios


def _ratios(sums: list[tuple[Float, Float]], one_rig: bool) -> list[Float]:
    if one_rig:
        sums = [(np.sum([t for t, _ in sums], axis=0), np.sum([b for _, b in sums], axis=0))] * len(sums)
    ratios = [top / np.maximum(bottom, 1e-300) for top, bottom in sums]
    ratios = [ratio / np.maximum(ratio.mean(1, keepdims=True), 1e-300) for ratio in ratios]
    # A common tint of all lights is a tint of the object: the convention is lights that are white on average.
    tint = np.mean(np.concatenate(ratios), axis=0)
    ratios = [ratio / tint for ratio in ratios]
    return [ratio / ratio.mean(1, keepdims=True) for ratio in ratios]
