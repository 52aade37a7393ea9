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

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mvps.joint.agreement import Agreement, Swept, lowest_of, swept
from mvps.joint.blocks import evaluate
from mvps.joint.observe import channel_ratio, interior
from mvps.joint.pixels import OWN_LIGHTS
from mvps.joint.reflectance import Observed
from mvps.mesh import vertex_normals
from mvps.scene import Float, Lights, Surface, View

MOST = OWN_LIGHTS - 1
"""Photographs of a view that take part, spread over its lights: as many as a view may have without telling a normal."""

FAINTEST_LIGHT = 0.05
"""Of a light's mean intensity: with less on a vertex (87 degrees) a photograph would weigh a four-hundredth of one in full light."""


def radiance_image(view: View, light: int, ratio: Float) -> NDArray[np.float32]:
    """(height, width, 4) radiance of a photograph over its light's colour (3,), and 1; 0 where it is saturated or not inside the object."""
    image = np.zeros((*view.mask.shape, 4), np.float32)
    usable = interior(view) * view.usable()[:, light]
    image[view.mask, :3] = view.samples[:, light] * (view.scale / ratio) * usable[:, None]
    image[view.mask, 3] = usable
    return image


def photoconsistency(of: Observed, lights: Lights, surface: Surface, offsets: Float) -> Agreement:
    """Where along its normal each vertex shows one albedo. lights: of the photographs of `of`; surface: that of `of`, perhaps moved since;
    offsets (n,) evenly spaced, world units."""
    normal, seen = vertex_normals(surface), [samples.vertex.cpu().numpy() for samples in of.views]
    chosen = [np.unique(np.arange(MOST) * len(view.lights) // MOST) for view in of.capture.views]
    images = [
        [radiance_image(view, k, channel_ratio(intensity)[k]) for k in some]
        for view, intensity, some in zip(of.capture.views, lights.intensity, chosen, strict=True)
    ]

    def reports(i: int, some: slice) -> list[Swept]:
        samples, vertex = of.views[i], seen[i][some]
        index = samples.vertex[some]
        reflectance = of.vertices.reflectance[index]
        shaded = evaluate(of.vertices.normal[index], reflectance, samples.towards[some], of.lights[i], of.law, samples.gathered_of(some))
        lobes = (shaded.predicted - reflectance[:, :1] * shaded.basis[0]).cpu().numpy()
        q, level = (a.cpu().numpy() for a in (shaded.basis[0], of.lights[i].intensity))
        lit = (q > FAINTEST_LIGHT * level) & samples.data[some].cpu().numpy()
        weight, safe = np.where(lit, (q / level) ** 2, 0), np.where(lit, q, 1)
        found = swept(of.capture.views[i], images[i], surface.vertices[vertex], normal[vertex], offsets, vertex)
        return [
            replace(
                one,
                facing=one.facing * weight[:, k],
                weight=one.weight * weight[:, k, None],
                b=lit[:, k, None] * (one.b - lobes[:, k, None]) / safe[:, k, None],
            )
            for k, one in zip(chosen[i], found, strict=True)
        ]

    return lowest_of(len(normal), reports, seen, offsets)
