"""Objects that the program's own renderer has no part in: other shapes, materials of Mitsuba 3, photographed by its path tracer.

Shapes are zero sets of functions f of x in the unit ball, negative inside; s(f, g) = -b log(exp(-f / b) + exp(-g / b)) melts two into one.

    statue    an upright column with a waist, its radius plus a cos(9 phi + 3 z), a growing downwards: folds; a head, an arm
    knot      a tube around the trefoil (sin t + 2 sin 2t, cos t - 2 cos 2t, -sin 3t)
    vessel    a solid of revolution, hollow from the top, with two rings for handles
    coral     tubes along bent branches that start in the middle, with ripples
    shell     a ball with spiral ridges
    cheese    a ball with round hollows
    bricks    three blocks on each other: all sides flat
    gear      fourteen teeth with upright sides, a hub with a bore
    mug       a cup with a handle, deeper than wide
    nut       six sides, chamfers, a bore with a thread
    coin      a disc with a rim, in it a net of low bumps
    steps     four discs on each other
    bolt      a head with six sides, a shaft with a thread
    gem       a stone with 26 flat sides

A photograph is the radiance of paths up to BOUNCES segments under one directional light, PATHS of them a sub-pixel; imported only where
Mitsuba is there (pip install mvps[mitsuba]).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from mitsuba_scene import sensor
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from mvps.mesh import vertex_normals
from mvps.scene import Camera, Float, Int, Material, Surface
from mvps.synthetic.scene import Photograph

BOUNCES, PATHS = 5, 32
CELLS = 200
"""Of the grid along each axis; 0.9 pixels in images of 160 pixels."""
BLEND = 0.04

RENDER: Any = mi.render
"""Whose types know no variant."""

Function = Callable[[Float], Float]


# ------------------------------------------------------------------------------------------------ shapes


def surface_of(function: Function) -> Surface:
    """The zero set, centred, in the ball of radius 1."""
    ticks = np.linspace(-1.2, 1.2, CELLS)
    grid = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1)
    values = np.stack([function(plane.reshape(-1, 3)).reshape(CELLS, CELLS) for plane in grid])
    vertices, faces, _, _ = marching_cubes(values, 0.0, gradient_direction="descent", allow_degenerate=False)
    vertices = -1.2 + vertices.astype(np.float64) * (ticks[1] - ticks[0])
    vertices -= (vertices.min(0) + vertices.max(0)) / 2
    return Surface(vertices / np.linalg.norm(vertices, axis=-1).max(), faces)


def melted(*parts: Float) -> Float:
    """One solid of several."""
    return np.asarray(-BLEND * np.logaddexp.reduce([-part / BLEND for part in parts], axis=0))


def ball(x: Float, centre: tuple[float, float, float], radii: tuple[float, float, float]) -> Float:
    """About the distance to an ellipsoid."""
    return np.asarray((np.linalg.norm((x - np.array(centre)) / radii, axis=-1) - 1) * min(radii))


def ring(x: Float, centre: tuple[float, float, float], radius: float, thickness: float) -> Float:
    """The distance to a torus around the y axis through centre."""
    d = x - np.array(centre)
    return np.asarray(np.hypot(np.hypot(d[:, 0], d[:, 2]) - radius, d[:, 1]) - thickness)


def statue(x: Float) -> Float:
    """Folds around an upright body."""
    azimuth = np.arctan2(x[:, 1], x[:, 0])
    waist = 0.32 + 0.12 * np.cos(2.2 * (x[:, 2] + 0.5))
    folds = 0.09 * np.cos(9 * azimuth + 3 * x[:, 2]) * np.clip(0.6 - x[:, 2], 0, 1)
    body = np.maximum(np.hypot(x[:, 0], 1.2 * x[:, 1]) - waist * (1 + folds / waist), np.abs(x[:, 2] + 0.15) - 0.6) * 0.8
    return melted(body, ball(x, (0.0, 0.05, 0.68), (0.22, 0.2, 0.26)), ball(x, (0.33, -0.12, 0.2), (0.14, 0.14, 0.34)))


def curve(points: Float, thickness: float) -> Function:
    """A tube around points that lie close."""
    tree = cKDTree(points)
    return lambda x: np.asarray(tree.query(x)[0] - thickness)


def knot() -> Function:
    """A trefoil."""
    t = np.linspace(0, 2 * np.pi, 4000)
    points = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], -1) / 4
    # Upright, so that cameras around z see through it.
    return curve(points[:, [0, 2, 1]], 0.17)


def vessel(x: Float) -> Float:
    """A vase whose inside is seen from above, with handles."""
    radius = 0.42 + 0.16 * np.sin(3.2 * (x[:, 2] + 0.7))
    away = np.hypot(x[:, 0], x[:, 1]) - radius
    outside = np.maximum(away, np.abs(x[:, 2]) - 0.8) * 0.85
    inside = np.maximum(away + 0.09, -0.6 - x[:, 2]) * 0.85
    hollow = np.maximum(outside, -inside)
    return melted(hollow, *(np.maximum(ring(x, (0.52 * side, 0, 0.15), 0.22, 0.06), -inside) for side in (-1, 1)))


def coral() -> Function:
    """Seven branches."""
    rng = np.random.default_rng(3)
    points = [np.zeros((1, 3))]
    for k in range(7):
        height = 1 - 2 * (k + 0.5) / 7
        azimuth = 2.4 * k
        towards = np.array([np.sqrt(1 - height**2) * np.cos(azimuth), np.sqrt(1 - height**2) * np.sin(azimuth), height])
        bend = 0.25 * rng.normal(size=3)
        t = np.linspace(0, 0.75, 200)[:, None]
        points.append(t * towards + t**2 * bend)
    tree = cKDTree(np.concatenate(points))

    def function(x: Float) -> Float:
        distance, nearest = tree.query(x)
        return np.asarray(distance - 0.17 - 0.02 * np.sin(25 * tree.data[nearest][:, 0]))

    return function


def shell(x: Float) -> Float:
    """A ball with ridges."""
    distance = np.linalg.norm(x, axis=-1)
    azimuth = np.arctan2(x[:, 1], x[:, 0])
    return np.asarray((distance - 0.8 - 0.05 * np.cos(2 * azimuth + 16 * x[:, 2] / 0.8)) * 0.7)


def cheese(x: Float) -> Float:
    """Six hollows, each the inside of a ball, as deep as they are wide at most."""
    hollows = [(0.8, 0.0, 0.0), (-0.5, 0.6, 0.2), (0.0, -0.8, 0.2), (0.2, 0.3, 0.75), (-0.4, -0.4, -0.6), (-0.6, -0.3, 0.5)]
    away = np.min([np.linalg.norm(x - np.array(centre), axis=-1) for centre in hollows], axis=0)
    return np.asarray(np.maximum(np.linalg.norm(x, axis=-1) - 0.8, 0.32 - away))


def block(x: Float, centre: tuple[float, float, float], half: tuple[float, float, float]) -> Float:
    """The distance to a box around centre."""
    beyond = np.abs(x - np.array(centre)) - np.array(half)
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0))


def bricks(x: Float) -> Float:
    """A pile that overhangs."""
    blocks = [((0.0, 0.0, -0.45), (0.6, 0.4, 0.2)), ((0.1, 0.05, -0.05), (0.35, 0.35, 0.2)), ((-0.05, 0.0, 0.4), (0.2, 0.5, 0.25))]
    return np.asarray(np.min([block(x, *one) for one in blocks], axis=0))


def round_z(x: Float) -> Float:
    """Distance (n,) to the z axis."""
    return np.asarray(np.hypot(x[:, 0], x[:, 1]))


def disc(x: Float, radius: float, middle: float, half: float) -> Float:
    """A cylinder around the z axis, 2 half high about `middle`."""
    return np.asarray(np.maximum(round_z(x) - radius, np.abs(x[:, 2] - middle) - half))


def gear(x: Float) -> Float:
    """A wheel whose teeth have flanks as steep as the grid lets them be."""
    rim = 0.62 + 0.11 * np.clip(3 * np.cos(14 * np.arctan2(x[:, 1], x[:, 0])), -1, 1)
    wheel = np.maximum((round_z(x) - rim) * 0.6, np.abs(x[:, 2]) - 0.18)
    return np.asarray(np.maximum(np.minimum(wheel, disc(x, 0.3, 0, 0.36)), 0.14 - round_z(x)))


def mug(x: Float) -> Float:
    """A cup, its handle a ring in the plane of the x and z axes."""
    d = x - np.array([0.55, 0, 0])
    handle = np.hypot(np.hypot(d[:, 0], d[:, 2]) - 0.28, d[:, 1]) - 0.07
    inside = np.maximum(round_z(x) - 0.42, -0.5 - x[:, 2])
    return np.asarray(np.maximum(np.minimum(disc(x, 0.5, 0, 0.6), handle), -inside))


def windows(x: Float) -> Float:
    """A hollow ball, its wall a fifth of its radius thick, with a round window to either side along every axis."""
    wall = np.abs(np.linalg.norm(x, axis=-1) - 0.71) - 0.09
    pipes = np.min([np.linalg.norm(np.delete(x, axis, -1), axis=-1) - 0.3 for axis in range(3)], axis=0)
    return np.asarray(np.maximum(wall, -pipes))


def six_sides(x: Float) -> Float:
    """Distance (n,) to the z axis across the nearest side of a hexagon around it."""
    towards = np.array([0, 1, 2]) * np.pi / 3
    return np.asarray(np.abs(x[:, 0, None] * np.cos(towards) + x[:, 1, None] * np.sin(towards)).max(1))


def nut(x: Float) -> Float:
    """A hexagonal nut."""
    radius = round_z(x)
    sides = six_sides(x) - 0.6
    thread = 0.3 + 0.03 * np.sin(2 * np.pi * x[:, 2] / 0.16 + np.arctan2(x[:, 1], x[:, 0]))
    chamfer = (radius + np.abs(x[:, 2]) * 1.7 - 1.25) * 0.5
    return np.asarray(np.max([sides, np.abs(x[:, 2]) - 0.4, chamfer, (thread - radius) * 0.7], axis=0))


def coin(x: Float) -> Float:
    """A thick coin."""
    rim = np.maximum(np.abs(round_z(x) - 0.74) - 0.05, np.abs(x[:, 2]) - 0.12)
    net = 0.09 - 0.2 * np.abs(np.sin(9 * x[:, 0]) * np.sin(9 * x[:, 1]))
    bumps = np.maximum(net, np.maximum(np.abs(x[:, 2]) - 0.11, round_z(x) - 0.6))
    return np.asarray(np.min([disc(x, 0.8, 0, 0.08), rim, bumps], axis=0))


def steps(x: Float) -> Float:
    """A turned piece."""
    return np.asarray(
        np.min([disc(x, *of) for of in ((0.6, -0.6, 0.15), (0.45, -0.35, 0.15), (0.22, 0.1, 0.45), (0.42, 0.55, 0.1))], axis=0)
    )


def bolt(x: Float) -> Float:
    """Head up."""
    radius = round_z(x)
    thread = 0.22 + 0.03 * np.sin(2 * np.pi * x[:, 2] / 0.12 + np.arctan2(x[:, 1], x[:, 0]))
    shaft = np.maximum((radius - thread) * 0.7, np.abs(x[:, 2] + 0.2) - 0.6)
    head = np.maximum(six_sides(x) - 0.42, np.abs(x[:, 2] - 0.6) - 0.18)
    return np.asarray(np.minimum(shaft, head))


def gem(x: Float) -> Float:
    """Sides by chance."""
    rng = np.random.default_rng(8)
    towards = rng.normal(size=(26, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return np.asarray((x @ towards.T - rng.uniform(0.55, 0.7, 26)).max(1))


SHAPES: dict[str, Callable[[], Function]] = {
    "statue": lambda: statue,
    "knot": knot,
    "vessel": lambda: vessel,
    "coral": coral,
    "shell": lambda: shell,
    "cheese": lambda: cheese,
    "bricks": lambda: bricks,
    "gear": lambda: gear,
    "mug": lambda: mug,
    "windows": lambda: windows,
    "nut": lambda: nut,
    "coin": lambda: coin,
    "steps": lambda: steps,
    "bolt": lambda: bolt,
    "gem": lambda: gem,
}


# ------------------------------------------------------------------------------------------------ materials


def patches(surface: Surface, colours: list[list[float]]) -> NDArray[np.float32]:
    """A colour (V, 3) at every vertex, of the nearest of 14 places."""
    rng = np.random.default_rng(5)
    sites = rng.uniform(-0.8, 0.8, (14, 3))
    nearest = ((surface.vertices[:, None] - sites) ** 2).sum(-1).argmin(1)
    found: NDArray[np.float32] = np.array(colours, np.float32)[nearest % len(colours)]
    return found


def inlay(local: Float) -> NDArray[np.float32]:
    """Share (V,) of the second material of two at points of the unit ball: bands with edges a tenth as wide as they are."""
    rng = np.random.default_rng(77)
    waves, phase = 4 * rng.normal(size=(3, 3)), rng.uniform(0, 6, 3)
    return np.asarray(1 / (1 + np.exp(-np.sin(local @ waves.T + phase).sum(1) / 0.1)), np.float32)


PAINT = [[0.55, 0.32, 0.2], [0.3, 0.4, 0.25], [0.6, 0.58, 0.5], [0.2, 0.28, 0.45]]
COLOURED: dict[str, Any] = {"type": "mesh_attribute", "name": "vertex_colour"}
INLAID: dict[str, Any] = {"type": "mesh_attribute", "name": "vertex_inlay"}
MATT: dict[str, Any] = {"type": "diffuse", "reflectance": COLOURED}
MATERIALS: dict[str, tuple[dict[str, Any], list[list[float]]]] = {
    "copper": ({"type": "roughconductor", "material": "Cu", "alpha": 0.3, "distribution": "ggx"}, PAINT),
    "aluminium": ({"type": "roughconductor", "material": "Al", "alpha": 0.4, "distribution": "beckmann"}, PAINT),
    "gold": ({"type": "roughconductor", "material": "Au", "alpha": 0.2, "distribution": "ggx"}, PAINT),
    "lacquer": ({"type": "principled", "base_color": COLOURED, "roughness": 0.35, "specular": 0.8, "clearcoat": 0.6}, PAINT),
    "patina": (
        {
            "type": "blendbsdf",
            "weight": {"type": "mesh_attribute", "name": "vertex_worn"},
            "matt": MATT,
            "metal": {"type": "roughconductor", "material": "Cu", "alpha": 0.35, "distribution": "ggx"},
        },
        [[0.25, 0.45, 0.38], [0.3, 0.5, 0.45], [0.35, 0.3, 0.25]],
    ),
    "gilded": (
        {
            "type": "blendbsdf",
            "weight": {"type": "mesh_attribute", "name": "vertex_worn"},
            "paint": {"type": "principled", "base_color": COLOURED, "roughness": 0.4, "specular": 0.5},
            "metal": {"type": "roughconductor", "material": "Au", "alpha": 0.25, "distribution": "ggx"},
        },
        [[0.1, 0.12, 0.3], [0.3, 0.08, 0.08]],
    ),
    "chalk": ({"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.8, 0.75]}}, PAINT),
    "dark": (
        {"type": "principled", "base_color": COLOURED, "roughness": 0.25, "specular": 0.6},
        [[0.06, 0.05, 0.05], [0.1, 0.08, 0.06], [0.04, 0.05, 0.07]],
    ),
    "plastic": ({"type": "principled", "base_color": COLOURED, "roughness": 0.3, "specular": 0.5}, PAINT),
    "inlaid": (
        {
            "type": "blendbsdf",
            "weight": INLAID,
            "a": {"type": "principled", "base_color": COLOURED, "roughness": 0.3, "specular": 0.5},
            "b": {"type": "roughconductor", "material": "Au", "alpha": 0.25, "distribution": "ggx"},
        },
        PAINT,
    ),
    "enamel": (
        {
            "type": "blendbsdf",
            "weight": INLAID,
            "a": {"type": "principled", "base_color": COLOURED, "roughness": 0.7, "specular": 0.3},
            "b": {"type": "roughconductor", "material": "Cr", "alpha": 0.35, "distribution": "ggx"},
        },
        [[0.5, 0.1, 0.08], [0.1, 0.12, 0.4]],
    ),
    "contrast": (
        {"type": "principled", "base_color": COLOURED, "roughness": 0.5, "specular": 0.5},
        [[0.03, 0.03, 0.03], [0.75, 0.73, 0.7]],
    ),
    "bronze": (
        {"type": "principled", "base_color": COLOURED, "metallic": 0.7, "roughness": 0.4, "specular": 0.5},
        [[0.45, 0.3, 0.15], [0.3, 0.22, 0.12], [0.2, 0.3, 0.22]],
    ),
    "brushed": (
        {
            "type": "principled",
            "base_color": COLOURED,
            "metallic": 0.3,
            "roughness": 0.35,
            "anisotropic": 0.7,
            "specular": 0.5,
        },
        PAINT,
    ),
    "bright": (
        {"type": "principled", "base_color": COLOURED, "roughness": 0.35, "specular": 0.5},
        [[0.7, 0.03, 0.03], [0.03, 0.5, 0.05], [0.04, 0.06, 0.6], [0.7, 0.65, 0.05]],
    ),
    "cloth": ({"type": "principled", "base_color": COLOURED, "roughness": 0.9, "specular": 0.2, "sheen": 1.0}, PAINT),
}
"""BSDF and colours of patches."""


def traced(surface: Surface, material: str, bounces: int = BOUNCES) -> Photograph:
    """Photographs of a surface (world units) made of one of MATERIALS, by paths of so many segments."""
    bsdf, colours = MATERIALS[material]
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    made = mi.Mesh("object", len(surface.vertices), len(surface.faces), has_vertex_normals=True, props=properties)
    local = Surface(surface.vertices / np.linalg.norm(surface.vertices, axis=-1).max(), surface.faces)
    colour = patches(local, colours)
    worn = 1 / (1 + np.exp(-(local.vertices @ np.array([0.3, 0.5, 0.81])) / 0.1))
    made.add_attribute("vertex_colour", 3, colour.ravel().tolist())
    made.add_attribute("vertex_worn", 1, worn.tolist())
    made.add_attribute("vertex_inlay", 1, inlay(local.vertices).tolist())
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.ascontiguousarray(surface.vertices, np.float32).ravel()
    parameters["vertex_normals"] = np.ascontiguousarray(vertex_normals(surface), np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(surface.faces, np.uint32).ravel()
    parameters.update()

    def take(_: Any, __: Material, camera: Camera, pixels: Int, direction: Float, intensity: Float) -> NDArray[np.float32]:
        seen, image = sensor(camera), np.zeros((len(pixels), len(direction), 3), np.float32)
        for k, (towards, strength) in enumerate(zip(direction, intensity, strict=True)):
            light = {
                "type": "directional",
                "direction": (-towards).tolist(),
                "irradiance": {"type": "rgb", "value": strength.tolist()},
            }
            scene = mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": bounces}, "object": made, "light": light})
            whole = np.array(RENDER(scene, sensor=seen, spp=PATHS, seed=k))
            image[:, k] = whole[pixels[:, 0], pixels[:, 1], :3]
        return image

    return take
