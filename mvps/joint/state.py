"""What rounds of Stage II hand to each other, and what follows from it: the light that surfaces send, the material."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.spatial import cKDTree

from mvps.bounce import Gather
from mvps.cores import neighbours
from mvps.gleam import Senders, patches_of, senders
from mvps.joint.blocks import Vertices
from mvps.joint.observe import ViewSamples, with_gathered
from mvps.joint.steps import confidence
from mvps.material import Model, Trial
from mvps.memory import NONE_TOGETHER, Together, room_for
from mvps.mesh import normalise, vertex_normals
from mvps.scene import Capture, CaptureError, Float, Law, Lights, Material, NormalMap, Surface


@dataclass
class State:
    """What one round hands to the next. noise: of dark pixels (noise.py); under: the photographs, perhaps thinned, that `views` are samples
    of, and their lights; lobed: whether lobes take part in inter-reflection (gleam.py); gathers: what sends light on, without lobes and
    with them, once a round asks for it; together: lights and strengths that are solved for at once, along with vertices (memory.py)."""

    surface: Surface
    lights: Lights
    maps: tuple[NormalMap, ...]
    law: Law
    model: Model
    noise: float
    vertices: Vertices | None = None
    gathers: dict[bool, Gather] = field(default_factory=dict)
    lobed: bool = False
    views: list[ViewSamples] = field(default_factory=list)
    under: tuple[Capture, Lights] | None = None
    trials: list[Trial] = field(default_factory=list)
    together: Together = NONE_TOGETHER


def senders_of(state: State, vertices: Vertices) -> Senders | None:
    """What sends light on, by the vertices' reflectance; None where inter-reflection is not modelled."""
    if not (state.model.bounce or state.lobed):
        return None
    if state.lobed not in state.gathers:
        of = state.gathers[state.lobed] = patches_of(state.surface, state.lobed)
        room_for(len(state.surface.vertices), len(of.normal) * state.lobed, state.together)
    albedo, weight = reflectance_of(vertices)
    return senders(state.gathers[state.lobed], state.surface, state.law, albedo, weight if state.lobed else None)


def senders_in_colour(state: State, albedo: Float) -> Senders | None:
    """What diffuse surfaces send light on by, in the colours of albedo (V, 3), NaN where no view sees; None where inter-reflection is not
    modelled, and where lobes take part in it."""
    if not state.law.bounce or state.lobed or False not in state.gathers:
        return None
    return senders(state.gathers[False], state.surface, state.law, material_of(state, albedo).albedo, None)


def lit_by(state: State, views: list[ViewSamples], of: Capture, lights: Lights, sent: Senders | None) -> list[ViewSamples]:
    """The samples with what other surfaces send to them."""
    return views if sent is None else with_gathered(views, of, state.surface, sent, lights)


def reflectance_of(vertices: Vertices) -> tuple[Float, Float]:
    """Albedo (V,) and weights (V, lobes)."""
    values = vertices.reflectance.double().cpu().numpy()
    return values[:, 0], values[:, 1:]


def grey_albedo(vertices: Vertices) -> Float:
    """(V, 3) grey albedo, NaN where no sample says anything."""
    assert vertices.sigma is not None
    albedo = torch.where(vertices.sigma.isfinite(), vertices.reflectance[:, 0], torch.nan)
    return albedo.double().cpu().numpy()[:, None].repeat(3, axis=1)


def relative_residuals(views: list[ViewSamples], vertices: Vertices) -> torch.Tensor:
    """(V,) the residuals' standard deviation over the root mean square of the vertex's samples; NaN without samples."""
    square = torch.zeros_like(vertices.scale)
    weight = torch.zeros_like(vertices.scale)
    for samples in views:
        for part in samples.chunks():
            data = samples.data[part] * samples.weight[part, None]
            square.index_add_(0, samples.vertex[part], (data * samples.image[part] ** 2).sum(1))
            weight.index_add_(0, samples.vertex[part], data.sum(1))
    seen = weight > 0
    level = (square[seen] / weight[seen]).sqrt().clamp_min(1e-12)
    relative = torch.full_like(vertices.scale, torch.nan)
    relative[seen] = vertices.scale[seen] / level
    return relative


def material_of(state: State, albedo: Float, tint: Float | None = None) -> Material:
    """The material on all vertices; where no view sees one it takes the nearest seen vertex's reflectance and the mesh's normal.
    tint (V, 3): colours of the lobes, white if None."""
    assert state.vertices is not None
    vertices, known = state.vertices, np.isfinite(albedo).all(1)
    if not known.any():
        raise CaptureError("lights: wanted some that reach the object, given none under which a view sees it lit; check their directions")
    nearest = np.arange(len(albedo))
    nearest[~known] = np.flatnonzero(known)[neighbours(cKDTree(state.surface.vertices[known]), state.surface.vertices[~known])[1]]
    normal = normalise(vertices.normal.double().cpu().numpy())
    normal[~known] = vertex_normals(state.surface)[~known]
    weight = vertices.reflectance[:, 1:].double().cpu().numpy()
    weight = (weight if tint is None else weight[..., None] * tint[:, None])[nearest]
    certain = confidence(vertices).double().cpu().numpy()
    certain, law = np.where(known, certain, 0), state.law
    return Material(
        normal, albedo[nearest], weight, np.array(law.sharpness), certain, law.grazing, law.bounce, law.microfacet, law.shadows, law.gleam
    )
