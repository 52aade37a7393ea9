"""Lambert's law on a given mesh under given lights: the material of results that have a shape and no reflectance of their own.

Albedo is linear least squares over a vertex's samples (observe.py), in colour (colours.py); the normals are the mesh's.
"""

from __future__ import annotations

import numpy as np
import torch

from mvps.joint.blocks import Vertices
from mvps.joint.colours import colours
from mvps.joint.observe import channel_ratio, observe
from mvps.joint.photometry import from_nearest, grey_lights
from mvps.joint.reflectance import Observed
from mvps.joint.steps import lambert_albedo
from mvps.mesh import vertex_normals
from mvps.scene import Bool, Capture, Law, Lights, Material, Surface

UNSTATED = 0.5
"""Confidence (scene.py) of a normal of which no error is stated: it may no longer tell a slope from flat ground."""


def lambertian_material(capture: Capture, surface: Surface, lights: Lights, device: torch.device) -> Material:
    """Albedo of the surface's vertices under `lights`, cast shadows left out; where no view sees a vertex, that of the nearest one seen."""
    views, grey = observe(capture, surface, lights, device), grey_lights(lights, device)
    normal = vertex_normals(surface)
    turned = torch.tensor(normal, dtype=torch.float32, device=device)
    albedo = lambert_albedo(views, turned, grey)
    # A scale above all residuals: no sample is an outlier.
    vertices = Vertices(turned, albedo[:, None], albedo.max().expand_as(albedo))
    observed = Observed(capture, surface, views, vertices, grey, Law(()))
    coloured, _ = colours(observed, [channel_ratio(intensity) for intensity in lights.intensity], False)
    known: Bool = np.isfinite(coloured[:, 0])
    confidence = np.where(known, UNSTATED, 0.0)
    return Material(normal, coloured[from_nearest(surface, known)], np.zeros((len(normal), 0)), np.zeros(0), confidence)
