"""A GLB file's model in Mitsuba 3, of its own plugins alone; imported only where Mitsuba is there (pip install mvps[mitsuba]).

glTF 2.0 (appendix B, KHR_materials_specular) wants, with h half way between light and view,

    (1 - max F) base / pi + F D V,     F = F0 + (f90 - F0) (1 - v.h)^5,     D GGX of alpha = roughness^2, V Smith's

Mitsuba's `principled` has another diffuse term (Burley's), and one F0 for the whole object where it is not metallic. With `metallic` 1 its
specular term is the formula's, with F0 as base colour. So the material is half of `principled`, metallic, and half of `diffuse` with
(1 - max F0) base, under light twice as strong. What is left out is the fall of the diffuse part towards the mirror's grazing directions,
(1 - v.h)^5: 1/600 where light and view are 90 degrees apart.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from glb import Array, Model

from mvps.scene import Camera

mi.set_variant("scalar_rgb")
# Warnings of Mitsuba about textures that are not powers of two and the like would hide the table.
mi.set_log_level(mi.LogLevel.Error)

SAMPLES = 16
"""A pixel; the light has no extent, so that only outlines and textures vary within one."""


def texture(values: Array) -> dict[str, Any]:
    """A picture (height, width, 3) or (height, width) as it is, linear."""
    bitmap = mi.Bitmap(np.ascontiguousarray(values if values.ndim == 3 else values[..., None], np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}


def material(model: Model) -> Any:
    """The model's material; for light twice as strong."""
    matt = {"type": "diffuse", "reflectance": texture((1 - model.specular.max(-1, keepdims=True)) * model.base)}
    glossy: dict[str, Any] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    if model.f90 > 0:
        glossy = {
            "type": "principled",
            "base_color": texture(model.specular),
            "roughness": texture(model.roughness),
            "metallic": 1.0,
        }
    both = {"type": "blendbsdf", "weight": 0.5, "first": matt, "second": glossy}
    return mi.load_dict({"type": "normalmap", "normalmap": texture(model.bump), "bsdf": both})


def mesh(model: Model) -> Any:
    """The model's mesh with its material."""
    properties = mi.Properties()
    properties["mesh_bsdf"] = material(model)
    made = mi.Mesh("model", len(model.position), len(model.faces), has_vertex_normals=True, has_vertex_texcoords=True, props=properties)
    parameters = mi.traverse(made)
    for name, values in (("positions", model.position), ("normals", model.normal), ("texcoords", model.uv)):
        parameters[f"vertex_{name}"] = np.ascontiguousarray(values, np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(model.faces, np.uint32).ravel()
    parameters.update()
    return made


def sensor(camera: Camera) -> Any:
    """A camera; ValueError where its pixels are not square. Mitsuba's x points left and its y up, OpenCV's right and down."""
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    if abs(fx / fy - 1) > 1e-3 or abs(camera.K[0, 1]) > 1e-3 * fx:
        raise ValueError(f"K: wanted square pixels, given {camera.K.tolist()}")
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = camera.rotation.T @ np.diag([-1.0, -1.0, 1.0])
    world_from_camera[:3, 3] = camera.centre
    return mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(world_from_camera.tolist()),
            "fov_axis": "x",
            "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / fx))),
            "principal_point_offset_x": float((camera.K[0, 2] - camera.width / 2) / camera.width),
            "principal_point_offset_y": float((camera.K[1, 2] - camera.height / 2) / camera.height),
            "near_clip": 1e-3 * float(np.linalg.norm(camera.translation)),
            "far_clip": 1e3 * float(np.linalg.norm(camera.translation)),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "stratified", "sample_count": SAMPLES},
        }
    )


def render(model: Any, camera: Any, direction: Array, irradiance: Array) -> tuple[Array, Array]:
    """Radiance (height, width, 3) and coverage (height, width) of a mesh under a light towards direction (3,), by what falls (3,) on a
    surface across it; direct light, with shadows."""
    light = {
        "type": "directional",
        "direction": (-direction).tolist(),
        "irradiance": {"type": "rgb", "value": (2 * irradiance).tolist()},
    }
    integrator = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "model": model, "light": light})
    image = np.array(mi.render(scene, sensor=camera))
    return image[..., :3], image[..., 3]
