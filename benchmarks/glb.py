"""A GLB file's mesh and material as glTF 2.0 says they are to be read; nothing of the program that wrote it is used.

One mesh with one primitive, one metallic-roughness material with KHR_materials_specular, all with textures.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
KINDS = {5126: "<f4", 5125: "<u4", 5123: "<u2"}
DIELECTRIC = 0.04
"""F0 of an index of refraction of 1.5, what glTF assumes without KHR_materials_ior."""


class Model(NamedTuple):
    """position, normal (T, 3), tangent (T, 4), uv (T, 2); faces (F, 3); pictures (h, w[, 3]): base, specular (F0) linear in [0, 1],
    bump (the normal map as stored, in [0, 1]), roughness; f90; extras of the material."""

    position: Array
    normal: Array
    tangent: Array
    uv: Array
    faces: NDArray[np.integer[Any]]
    base: Array
    specular: Array
    bump: Array
    roughness: Array
    f90: float
    extras: dict[str, Any]


def linear(coded: Array) -> Array:
    """Linear values of sRGB ones in [0, 1] (IEC 61966-2-1)."""
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def read_glb(path: Path) -> Model:
    """The model in a GLB file; ValueError where it is another kind of model."""
    data = path.read_bytes()
    magic, version, _ = struct.unpack_from("<4sII", data)
    length = struct.unpack_from("<I", data, 12)[0]
    if (magic, version) != (b"glTF", 2):
        raise ValueError(f"{path}: wanted binary glTF 2.0, given something else")
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]

    def content(view: int) -> bytes:
        of = document["bufferViews"][view]
        return binary[of.get("byteOffset", 0) :][: of["byteLength"]]

    def array(number: int) -> Any:
        of = document["accessors"][number]
        return np.frombuffer(content(of["bufferView"]), KINDS[of["componentType"]]).reshape(of["count"], TYPES[of["type"]])

    def picture(texture: dict[str, Any]) -> Array:
        coded = content(document["images"][document["textures"][texture["index"]]["source"]]["bufferView"])
        return np.asarray(cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR))[..., ::-1].astype(np.float32) / 255

    (primitive,) = document["meshes"][0]["primitives"]
    material = document["materials"][primitive["material"]]
    position, normal, tangent, uv = (array(primitive["attributes"][n]) for n in ("POSITION", "NORMAL", "TANGENT", "TEXCOORD_0"))
    (node,) = document["nodes"]
    position = position + np.array(node.get("translation", [0.0] * 3))
    pbr, specular = material["pbrMetallicRoughness"], material["extensions"]["KHR_materials_specular"]
    if pbr["metallicFactor"] != 0:
        raise ValueError(f"{path}: wanted a material that is not metallic, given a metallicFactor of {pbr['metallicFactor']}")
    base = linear(picture(pbr["baseColorTexture"])) * pbr.get("baseColorFactor", [1.0] * 4)[:3]
    roughness = picture(pbr["metallicRoughnessTexture"])[..., 1] * pbr.get("roughnessFactor", 1.0)
    colour = np.array(specular.get("specularColorFactor", [1.0] * 3))
    if "specularColorTexture" in specular:
        colour = colour * linear(picture(specular["specularColorTexture"]))
    f90 = specular.get("specularFactor", 1.0)
    f0 = np.broadcast_to(np.minimum(DIELECTRIC * colour, 1) * f90, base.shape)
    faces = array(primitive["indices"]).reshape(-1, 3)
    extras = material.get("extras", {})
    return Model(position, normal, tangent, uv, faces, base, f0, picture(material["normalTexture"]), roughness, f90, extras)


def face_tangents(model: Model) -> Array:
    """(F, 3) unit directions along which u grows on the faces, v staying: what a reader makes who ignores the file's tangents."""
    p, q = model.position[model.faces].astype(float), model.uv[model.faces].astype(float)
    (a, b), (c, d) = (p[:, k] - p[:, 0] for k in (1, 2)), (q[:, k] - q[:, 0] for k in (1, 2))
    along = a * d[:, 1:] - b * c[:, 1:]
    along *= np.sign(c[:, :1] * d[:, 1:] - c[:, 1:] * d[:, :1])
    unit: Array = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-30)
    return unit


def tangent_gap_deg(model: Model) -> Array:
    """(F, 3) angles, degrees, between the file's tangents at the faces' corners and the faces' own, both perpendicular to the normal."""
    normal, tangent = (x[model.faces].astype(float) for x in (model.normal, model.tangent[:, :3]))
    own = face_tangents(model)[:, None] - (face_tangents(model)[:, None] * normal).sum(-1, keepdims=True) * normal
    own /= np.maximum(np.linalg.norm(own, axis=-1, keepdims=True), 1e-30)
    gap: Array = np.degrees(np.arctan2(np.linalg.norm(np.cross(own, tangent), axis=-1), (own * tangent).sum(-1)))
    return gap


def reflected(n_dot_l: Array, n_dot_v: Array, h_dot_n: Array, v_dot_h: Array, alpha: Array, f0: Array) -> tuple[Array, Array]:
    """pi times glTF's specular term F D V (n, 3), and F's largest channel (n, 1), for cosines and alpha (n,), f0 (n, 3), f90 of 1."""
    square = alpha**2
    D = square / (h_dot_n**2 * (square - 1) + 1) ** 2
    masked_l, masked_v = (cosine + np.sqrt(square + (1 - square) * cosine**2) for cosine in (n_dot_l, n_dot_v))
    F = f0 + (1 - f0) * (1 - v_dot_h[:, None]) ** 5
    return F * (D / (masked_l * masked_v))[:, None], F.max(1, keepdims=True)
