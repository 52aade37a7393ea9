"""Poses from photographs: a quick reconstruction, and cameras moved until its photographs agree (mvps/joint/bundle.py).

In turn, because lights, shape and poses are solved from each other. Cameras that silhouettes moved stay so where one part of the lights,
solved for, predicts another part better: a mask is off by the same part of a pixel all along a straight edge, and right cameras of blocks
would follow it.

What cameras want is asked of half of the object, the black cells of a chequered box around it, and judged by the white ones, and the other
way round. The quick surface is wrong, edges and folds too round, and photographs of plain blocks are explained better by cameras that bear
with that than by right ones, under lights that are held out as well; but each edge is so in its own way, and only a camera that is wrong is
so for all of the object (cross-validation: Stone 1974; by cells, for what is beside each other is wrong alike: Roberts et al. 2017).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvps.calibrate import MINIMUM_LIGHTS, uncalibrated_lights
from mvps.device import Device, chosen_device
from mvps.hull import hull_grid, visual_hull
from mvps.joint.bundle import Model, aligned, part, prediction_errors, solved
from mvps.joint.lighting import LIGHT_VERTICES
from mvps.joint.refine import RefineSettings, RoundSettings, refine
from mvps.joint.thinned import ENOUGH_LIGHTS, thinned
from mvps.material import CERTAIN, LARGEST, gained
from mvps.motions import UNKNOWNS, Object, with_motions
from mvps.photometric import normal_maps
from mvps.scene import Capture, Float, Int, Law, Lights, Surface

Split = tuple[tuple[Capture, Lights], tuple[Capture, Lights]]
"""Photographs and lights by which vertices are solved, and those that are held out."""

TURNS = 2
"""Of the quick reconstruction and the cameras: what is left after two is within what photographs tell (docs/findings/checks.md)."""

CELLS = 8
"""Along each side of the object's box: some fifteen pixels wide in small captures, many times what is wrong at an edge; a surface meets
some two hundred."""

ROUNDS = (RoundSettings(3.0, 4.0, 0.5, photometric=False), RoundSettings(2.5, 2.0, 0.4))
"""Of the quick reconstruction: those of the preset `draft`."""


def quick_model(capture: Capture, device: Device) -> Model:
    """Surface, lights, and what a part of the vertices were solved to."""
    surface = visual_hull(hull_grid(capture))
    lights = uncalibrated_lights(capture, surface, 0).lights
    maps = normal_maps(*thinned(capture, lights), device)
    plan = RefineSettings(ROUNDS, half=True)
    refined = refine(capture, surface, lights, maps, Law(LARGEST.sharpness), plan, 0, device, lambda *_: None)
    if refined.carried is None:
        raise ValueError("refine: wanted a round that solves vertices, given none")
    surface, vertices = refined.carried
    among = np.zeros(len(surface.vertices), bool)
    among[np.random.default_rng(0).permutation(len(among))[:LIGHT_VERTICES]] = True
    # What other surfaces send is left to the vertices' albedo: it hardly changes along a pixel.
    return Model(surface, refined.lights, vertices, replace(refined.law, bounce=0.0, gleam=0.0), among)


def tells(capture: Capture) -> bool:
    """Whether views have lights enough for two parts."""
    return min(len(view.lights) for view in capture.views) >= 2 * MINIMUM_LIGHTS


def split(capture: Capture, model: Model) -> Split:
    """Photographs and lights by which vertices are solved, and those that are held out."""
    stride = max(2, round(min(len(view.lights) for view in capture.views) / ENOUGH_LIGHTS))
    return part(capture, model.lights, 0, stride), part(capture, model.lights, 1, stride)


def confirmed(capture: Capture, body: Object, motions: Float) -> bool:
    """Whether held-out lights are predicted better by cameras after motions (views, 6); yes where views have too few lights to
    tell."""
    if not tells(capture):
        return True
    model = quick_model(capture, chosen_device("cpu"))
    parts, cell = split(capture, model), cells(model.surface)
    return gained(*(errors(parts, model, body, by, cell) for by in (np.zeros_like(motions), motions)))[0] > 0


def by_photographs(capture: Capture, body: Object) -> tuple[Capture, list[float]]:
    """The capture with its cameras moved, and by which factor the errors of held-out lights fell in each turn that was kept; as it was
    where views have too few lights or nothing was gained."""
    factors = list[float]()
    for _ in range(TURNS if tells(capture) else 0):
        model = quick_model(capture, chosen_device("cpu"))
        parts = split(capture, model)
        gain, noise = judged_crosswise(parts, model, body)
        if gain <= CERTAIN * noise:
            break
        capture = with_motions(capture, body, aligned(*parts[0], model, body))
        factors.append(float(np.exp(-gain)))
    return capture, factors


def judged_crosswise(parts: Split, model: Model, body: Object) -> tuple[float, float]:
    """Gain and noise, by cells, of the cameras that each half of the object wants for the other half."""
    cell = cells(model.surface)
    black = np.stack(np.unravel_index(cell, (CELLS,) * 3)).sum(0) % 2 == 0
    still = np.zeros((len(parts[0][0].views), UNKNOWNS))
    before, after = [], []
    for own in (black, ~black):
        asked, judge = (replace(model, among=model.among & side) for side in (own, ~own))
        if not (asked.among.any() and judge.among.any()):
            return 0.0, 0.0
        before.append(errors(parts, judge, body, still, cell))
        after.append(errors(parts, judge, body, aligned(*parts[0], asked, body), cell))
    return gained(np.concatenate(before), np.concatenate(after))


def cells(surface: Surface) -> Int:
    """(V,) the cell of each vertex, of CELLS along every side of the box around the surface."""
    low, high = surface.vertices.min(0), surface.vertices.max(0)
    place = ((surface.vertices - low) * (CELLS / np.maximum(high - low, np.finfo(float).tiny))).astype(np.int64)
    row: Int = np.ravel_multi_index(np.minimum(place, CELLS - 1).T, (CELLS,) * 3)
    return row


def errors(parts: Split, model: Model, body: Object, motions: Float, cell: Int) -> Float:
    """(cells,) of held-out lights, by cameras after motions (views, 6) and vertices solved under the others."""
    (fit, lights), (held, their_lights) = parts
    vertices = solved(with_motions(fit, body, motions), lights, model)[1]
    return prediction_errors(with_motions(held, body, motions), their_lights, vertices, cell)
