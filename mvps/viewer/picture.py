"""The picture of what the viewer shows, ray by ray: what the page lays over its own once hand and light rest.

The page says what it shows in one JSON object:

    {"eye", "forward", "above": 3 numbers each, world frame; "focal", "middle", "size": [across, down], pixels; "layer": one of LAYERS;
     "lights": [{"direction": [3], "colour": [3]}, ...]; "fill": a lamp at the eye, over the square of the object's distance;
     "environment": a name, or ""; "turn": whole degrees; "material": a name; "exposure": factor before sRGB}

The picture is that of mvps.render (layers.py): shadows where every ray meets the surface, smooth edges, inter-reflection. The layer of
shadows is that of the page's own lights, 0 to 1 as grey values.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.gleam import Senders
from mvps.illumination import Illumination, environment_lights, turned
from mvps.layers import rendered
from mvps.mesh import lengths, normalise
from mvps.once import once_for
from mvps.pbr import srgb_bytes
from mvps.scene import Camera, CaptureError, Float, Material
from mvps.viewpoints import ball_around
from mvps.visibility import RayCaster

LAYERS = ("image", "specular", "shadow")

LARGEST_SIDE = 4096
"""Pixels: of a screen."""

BACKGROUND = 33
"""Of 255: the page's own."""

ENVIRONMENT_LIGHTS = 32
"""Directional lights that stand for an environment: as many as a number of the graphics processor has bits."""


@dataclass(frozen=True, eq=False)
class Asked:
    """What the page shows. lights: its own, without the environment's; fill: strength of the lamp at the eye."""

    camera: Camera
    layer: str
    lights: Illumination
    fill: float
    environment: str
    turn: int
    material: str
    exposure: float


def asked(text: str) -> Asked:
    """What the page says. CaptureError where it is nothing that it could say."""
    try:
        said = json.loads(text)
        direction, colour = (np.array([_three(one[name]) for one in said["lights"]]).reshape(-1, 3) for name in ("direction", "colour"))
        fill, turn, exposure = (float(said[name]) for name in ("fill", "turn", "exposure"))
        lights = Illumination(normalise(direction), colour)
        around, material = str(said["environment"]), str(said["material"])
        found = Asked(_camera(said), str(said["layer"]), lights, fill, around, int(turn), material, exposure)
        if found.layer not in LAYERS or not np.isfinite([fill, exposure]).all() or min(fill, exposure, colour.min(initial=0)) < 0:
            raise ValueError("a layer or a number that is none")
        if (lengths(direction) == 0).any():
            raise ValueError("a light from nowhere")
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise CaptureError(f"scene: wanted what the viewer's page says of itself, given something else ({error})") from error
    return found


def _three(values: Any) -> Float:
    found = np.array(values, float)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ValueError("no three numbers")
    return found


def _camera(said: Mapping[str, Any]) -> Camera:
    """ValueError, TypeError or KeyError where it is none."""
    across, down = (int(side) for side in said["size"])
    if not (1 <= across <= LARGEST_SIDE and 1 <= down <= LARGEST_SIDE):
        raise ValueError(f"{across} x {down} pixels")
    eye, forward = _three(said["eye"]), normalise(_three(said["forward"]))
    right = normalise(np.cross(forward, _three(said["above"])))
    (fx, fy), (cx, cy) = ((float(x) for x in said[name]) for name in ("focal", "middle"))
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), rotation, -rotation @ eye, down, across)


def surroundings(environments: Mapping[str, NDArray[np.float32]], name: str, turn: int, up: Float) -> Illumination:
    """The lights that stand for an environment, turned by so many degrees about `up` (3,). CaptureError where there is none."""
    if name not in environments:
        raise CaptureError(f"of: wanted one of {', '.join(environments)}, given {name!r}")
    return turned(_cut(environments[name], tuple(np.asarray(up, float).tolist())), up, turn % 360)


@once_for
def _cut(environment: NDArray[np.float32], up: tuple[float, ...]) -> Illumination:
    """The lights of an environment (height, width, 3) that is not turned: a large one takes seconds, and every move asks for them."""
    return environment_lights(environment, ENVIRONMENT_LIGHTS, np.array(up))


def picture(caster: RayCaster, material: Material, senders: Senders | None, scene: Asked, around: Illumination) -> NDArray[np.uint8]:
    """sRGB (height, width, 3) of what is asked for, under the lights around it too, before the page's background."""
    if scene.layer == "shadow":
        found, coverage = rendered(caster, material, scene.camera, scene.lights, ["shadow"])
        return _before_background(255 * found["shadow"][..., None].repeat(3, axis=2), coverage)
    eye = scene.camera.centre
    away = lengths(eye - ball_around(caster.surface)[0])
    lamp = Illumination(position=eye[None], strength=np.full((1, 3), scene.fill * away**2)) if scene.fill else Illumination()
    light = scene.lights.with_also(around).with_also(lamp)
    found, coverage = rendered(caster, material, scene.camera, light, [scene.layer], senders)
    return _before_background(srgb_bytes(found[scene.layer] * np.float32(scene.exposure)), coverage)


def _before_background(shown: NDArray[Any], coverage: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Values of 0 to 255 (height, width, 3) where the object covers the page's background (height, width)."""
    part = coverage[..., None]
    pixels: NDArray[np.uint8] = np.rint(shown * part + BACKGROUND * (1 - part)).astype(np.uint8)
    return pixels
