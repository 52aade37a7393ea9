"""Lambert's albedo on a surface that stays as it is, under lights that do.

The vertices' step (steps.py) with normals tied to the mesh's and no lobes: a robust albedo, then its colours.
"""

from __future__ import annotations

import torch

from mvps.joint.blocks import Vertices
from mvps.joint.colours import LobeColour, colours
from mvps.joint.grey import grey_lights
from mvps.joint.observe import channel_ratio, observe
from mvps.joint.reflectance import Observed
from mvps.joint.state import State, material_of
from mvps.joint.steps import free_reflectance, lambert_albedo, vertex_steps
from mvps.material import Model
from mvps.mesh import vertex_normals
from mvps.scene import Capture, Law, Lights, Material, Surface

STEPS = 3
HELD = 1e-4
"""Standard deviation, radians, of normals from the mesh's: they stay."""


def lambertian(capture: Capture, lights: Lights, surface: Surface, device: torch.device) -> Material:
    """The surface's material without lobes: albedo (V, 3) under its own normals, from the photographs under lights (in their order)."""
    views, grey, law = observe(capture, surface, lights, device), grey_lights(lights, device), Law(())
    normal = torch.tensor(vertex_normals(surface), dtype=torch.float32, device=device)
    albedo = lambert_albedo(views, normal, grey)
    # No sample is an outlier before the first residuals are known.
    vertices = Vertices(normal, albedo[:, None], albedo.median().expand(len(albedo)))
    vertices = vertex_steps(views, vertices, grey, law, free_reflectance(normal, HELD, 1), STEPS)
    state = State(surface, lights, (), law, Model(), 0.0, vertices, views=views)
    observed = Observed(capture, surface, views, vertices, grey, law)
    coloured, _ = colours(observed, [channel_ratio(e) for e in lights.intensity], LobeColour.WHITE)
    return material_of(state, coloured)
