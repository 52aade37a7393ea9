"""By how much the normals of one view may be wrong together.

Lights and normals of one view stand where integrability, few albedos, the outline and lobes put them. What these get wrong is shared by the
pixels of a region, and turns all lights and normals alike, which no photograph contradicts. So both steps, the ambiguity of the factors
(relief/ambiguity.py) and the bas-relief after it (joint/bas_relief.py), are done again without each ninth of the picture. The normals n_k
that come out have about their mean the variance

    sigma^2 = (K - 1) / K sum_k |n_k - mean n|^2 / 2,       K = 9,

of either tangential component (jackknife with a block left out: Efron 1982, Kuensch 1989).
"""

from __future__ import annotations

import numpy as np

from mvps.cores import on_cores
from mvps.device import Device
from mvps.joint.bas_relief import bas_relief, turned
from mvps.relief.ambiguity import Resolved, resolved_by
from mvps.scene import Bool, Float, Int, Law, Lights, NormalMap, Surface, View

ACROSS = 3
"""Parts of the picture along either axis. In quarters a ball is the same four times, and without one so much outline is missing that
answers under noise go astray; sixteen slices tell no more (docs/findings/one_view.md)."""


def without_parts(pixels: Int) -> list[Bool]:
    """(n,) for each ninth of the picture the pixels (n, 2) outside of it, of thirds of the rows and of the columns."""
    row, column = (np.searchsorted(np.quantile(of, np.arange(1, ACROSS) / ACROSS), of) for of in pixels.T)
    part = row * ACROSS + column
    return [part != k for k in range(ACROSS**2)]


def shared_variance(view: View, lights: Lights, maps: NormalMap, found: Resolved, law: Law, seed: int, device: Device) -> Float:
    """(pixels,) variance of a normal along a tangent, radians^2. lights, maps: of the view under the ambiguity as it was found; law: that
    resolves the bas-relief."""
    normal, albedo = maps.normal.astype(np.float64), maps.albedo.mean(1).astype(np.float64)
    direction, grey = lights.direction[0], lights.intensity[0].mean(1)
    colour, rotation = lights.intensity[0] / grey[:, None], view.camera.rotation

    def normals(among: Bool) -> Float:
        A = resolved_by(view, found, np.random.default_rng(seed), among)
        # b -> B b takes lights to B^-T s.
        B = rotation.T @ A @ np.linalg.inv(found.A) @ rotation
        n, a, towards, strength = turned(np.linalg.inv(B).T, normal, albedo, direction, grey)
        own = (towards, strength[:, None] * colour)
        G = bas_relief(view, n, a, own, law, np.random.default_rng(seed), device, among)
        return turned(G, n, a, towards, strength)[0]

    replicas = np.stack(on_cores(normals, without_parts(view.pixels)))
    scatter = ((replicas - replicas.mean(0)) ** 2).sum((0, 2))
    variance: Float = (1 - 1 / len(replicas)) * scatter / 2
    return variance


def either(normal: Float, other: Float) -> Float:
    """(pixels,) variance of a normal along a tangent, radians^2, of normals (pixels, 3) and other ones (pixels, 3) of which either may be
    right: of the square of their difference half is either's error, and half of that of either tangential component."""
    variance: Float = ((normal - other) ** 2).sum(1) / 4
    return variance


def at_corners(variance: Float, surface: Surface) -> Float:
    """(V,) values of the pixels (n,) at the corners of their quads (relief/surface.py): means over the faces around."""
    corners, of_faces = surface.faces.ravel(), np.repeat(np.tile(variance, 2), 3)
    mean: Float = np.bincount(corners, of_faces, len(surface.vertices)) / np.bincount(corners, minlength=len(surface.vertices))
    return mean
