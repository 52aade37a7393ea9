"""Where photographs agree: offsets of vertices along their normals, where the views' own normals do not tell.

As agreement.py, but what a view reports of a vertex x that slides along its normal is the albedo that single photographs show there:

    b_c(d) = (J_c(x + d n) - P) / q

J is radiance over the light's colour, P what the vertex's lobes reflect and q = dI/da the light on it (blocks.py): both are of the vertex
as it is, and do not slide. Weights are the squared cosine of the viewing angle times q^2, the inverse variance of b under image noise.
On the surface all photographs show one albedo; beside it they show texture and shading of other places (photo-consistency: Seitz and Dyer
1999). Normals are none where a view has too few lights, and in a hollow that is too shallow they agree where the surface already is, as
they were solved there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from mvps.cores import on_cores
from mvps.joint.agreement import Agreement, Swept, lowest_of, swept
from mvps.joint.blocks import DirectionalLights, evaluate
from mvps.joint.observe import ViewSamples, channel_ratio, interior
from mvps.joint.pixels import OWN_LIGHTS
from mvps.joint.reflectance import Observed
from mvps.mesh import vertex_normals
from mvps.pixel_samples import DARK
from mvps.scene import Float, Int, Lights, Surface, View

MOST = OWN_LIGHTS - 1
"""Photographs of a view that take part, spread over its lights: as many as a view may have without telling a normal."""

FAINTEST_LIGHT = 0.05
"""Of a light's mean intensity: with less on a vertex (87 degrees) a photograph would weigh a four-hundredth of one in full light."""


def radiance_image(view: View, light: int, ratio: Float) -> NDArray[np.float32]:
    """(height, width, 4) radiance of a photograph over its light's colour (3,), DARK at least, and 1; 0 where it is saturated or not inside
    the object."""
    image = np.zeros((*view.mask.shape, 4), np.float32)
    usable = interior(view) * view.usable()[:, light]
    image[view.mask, :3] = view.samples[:, light] * (view.scale / np.maximum(ratio, DARK)) * usable[:, None]
    image[view.mask, 3] = usable
    return image


@dataclass(frozen=True, eq=False)
class Shown:
    """What m photographs of a view show of the n vertices that it sees, in order of their numbers: (n, m) the vertices' lobes P, the light
    q on them (1 where a photograph is no data) and its weight q^2 over the light's, 0 where there is none."""

    view: View
    vertex: Int
    images: list[NDArray[np.float32]]
    lobes: NDArray[np.float32]
    light: NDArray[np.float32]
    weight: NDArray[np.float32]


def shown_in(of: Observed, lights: Lights) -> list[Shown]:
    """Of every view a few photographs, as shown of the vertices as they are; lights: of all photographs of `of`."""

    def in_view(view: View, samples: ViewSamples, grey: DirectionalLights, intensity: Float) -> Shown:
        shown = np.flatnonzero(view.shown) if view.shown.any() else np.arange(len(view.lights))
        some = shown[np.unique(np.arange(MOST) * len(shown) // MOST)]
        rows = torch.as_tensor(some, device=samples.vertex.device)
        few, grey = samples.of_lights(rows), grey.of(rows)
        reflectance = of.vertices.reflectance[few.vertex]
        shaded = evaluate(of.vertices.normal[few.vertex], reflectance, few.towards, grey, of.law, few.gathered)
        q, level = (a.cpu().numpy() for a in (shaded.basis[0], grey.intensity))
        lit = (q > FAINTEST_LIGHT * level) & few.data.cpu().numpy()
        lobes = (shaded.predicted - reflectance[:, :1] * shaded.basis[0]).cpu().numpy()
        ratio = channel_ratio(intensity)
        images = [radiance_image(view, k, ratio[k]) for k in some]
        return Shown(view, few.vertex.cpu().numpy(), images, lobes, np.where(lit, q, 1), np.where(lit, (q / level) ** 2, 0))

    return on_cores(in_view, of.capture.views, of.views, of.lights, lights.intensity)


def photoconsistency(photographs: Sequence[Shown], surface: Surface, offsets: Float) -> Agreement:
    """Where along its normal each vertex of the surface, which may have moved since, shows one albedo; offsets (n,) evenly spaced, world
    units."""
    normal = vertex_normals(surface)

    def reports(i: int, some: slice) -> list[Swept]:
        of, vertex = photographs[i], photographs[i].vertex[some]
        lobes, light, weight = (a[some] for a in (of.lobes, of.light, of.weight))
        found = swept(of.view, of.images, surface.vertices[vertex], normal[vertex], offsets, vertex)
        return [
            replace(
                one,
                facing=one.facing * weight[:, k],
                weight=one.weight * weight[:, k, None],
                b=np.where(weight[:, k, None] > 0, (one.b - lobes[:, k, None]) / light[:, k, None], 0),
            )
            for k, one in enumerate(found)
        ]

    return lowest_of(len(normal), reports, [of.vertex for of in photographs], offsets)
