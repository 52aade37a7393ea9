"""Poses from photographs: a quick reconstruction, and cameras moved until its photographs agree (mvps/joint/bundle.py).

In turn, because lights, shape and poses are solved from each other. Cameras are moved by one part of the lights, and stay moved where the
model that comes of it predicts another part of the lights better. So do those that silhouettes moved: a mask is off by the same part of a
pixel all along a straight edge, and right cameras of blocks would follow it.
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
from mvps.motions import Object, with_motions
from mvps.photometric import normal_maps
from mvps.scene import Capture, Float, Law, Lights

TURNS = 2
"""Of the quick reconstruction and the cameras: what is left after two is within what photographs tell (docs/findings/checks.md)."""

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


def split(capture: Capture, model: Model) -> tuple[tuple[Capture, Lights], tuple[Capture, Lights]]:
    """Photographs and lights by which vertices are solved, and those that are held out."""
    stride = max(2, round(min(len(view.lights) for view in capture.views) / ENOUGH_LIGHTS))
    return part(capture, model.lights, 0, stride), part(capture, model.lights, 1, stride)


def confirmed(capture: Capture, body: Object, motions: Float) -> bool:
    """Whether held-out lights are predicted better by cameras after motions (views, 6); yes where views have too few lights to
    tell."""
    if not tells(capture):
        return True
    model = quick_model(capture, chosen_device("cpu"))
    (fit, lights), (held, their_lights) = split(capture, model)
    errors = []
    for by in (np.zeros_like(motions), motions):
        vertices = solved(with_motions(fit, body, by), lights, model)[1]
        errors.append(prediction_errors(with_motions(held, body, by), their_lights, vertices))
    return gained(*errors)[0] > 0


def by_photographs(capture: Capture, body: Object) -> tuple[Capture, list[float]]:
    """The capture with its cameras moved, and by which factor the errors of held-out lights fell in each turn that was kept; as it was
    where views have too few lights or nothing was gained."""
    factors = list[float]()
    for _ in range(TURNS if tells(capture) else 0):
        model = quick_model(capture, chosen_device("cpu"))
        (fit, lights), (held, their_lights) = split(capture, model)
        _, before = solved(fit, lights, model)
        motions, after = aligned(fit, lights, before, body)
        moved = with_motions(held, body, motions)
        gain, noise = gained(prediction_errors(held, their_lights, before), prediction_errors(moved, their_lights, after))
        if gain <= CERTAIN * noise:
            break
        capture = with_motions(capture, body, motions)
        factors.append(float(np.exp(-gain)))
    return capture, factors
