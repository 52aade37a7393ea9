"""A textured mesh as binary glTF 2.0 (GLB): one mesh, one metallic-roughness material, pictures inside.

    GLB = header, JSON chunk (padded with spaces), binary chunk (padded with zeros), all little-endian and on 4-byte borders.

Attributes POSITION, NORMAL (mesh normals), TANGENT (w = 1: bitangent = normal x tangent) and TEXCOORD_0. The specular
reflection at normal incidence F0 goes into KHR_materials_specular: F0 = 0.04 specularColorFactor specularColorTexture; glTF dims the
base colour by 1 - max F, for which it is divided by 1 - max F0 beforehand.
glTF's unit is the metre and its up axis is y; a capture has neither, so coordinates are kept as they are, and the
material's extras say how albedo follows from the base colour. Vertices far from the world's origin, which single precision would not
hold, are measured from their own place, and the node stands there.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.atlas import vertex_tangents
from mvps.mesh import normalise
from mvps.meshfile import place
from mvps.texture import Textures

DIELECTRIC = 0.04
"""F0 of glTF's default index of refraction 1.5."""
_FLOAT, _UNSIGNED, _VERTEX_DATA, _INDEX_DATA = 5126, 5125, 34962, 34963
_LINEAR_MIPMAP, _LINEAR, _CLAMP = 9987, 9729, 33071


def metallic_roughness(textures: Textures) -> NDArray[np.uint8]:
    """The picture (height, width, 3) that holds the roughness as glTF wants it, in the green channel."""
    zero = np.zeros_like(textures.roughness)
    return np.stack([zero, textures.roughness, zero], -1)


def glb_bytes(textures: Textures, pictures: Mapping[str, bytes]) -> bytes:
    """A surface with its textures as a GLB file.

    pictures: base_color, normal, metallic_roughness and specular as PNG files, in this order.
    """
    atlas, stands = textures.atlas, place(textures.surface.vertices)
    normal = normalise(textures.mesh_normal)
    tangent = vertex_tangents(atlas, normal)
    arrays = {
        "POSITION": (textures.surface.vertices - stands)[atlas.vertex],
        "NORMAL": normal[atlas.vertex],
        "TANGENT": np.concatenate([tangent, np.ones((len(tangent), 1))], 1),
        "TEXCOORD_0": atlas.uv,
    }
    binary = _Binary()
    attributes = {name: binary.accessor(values.astype("<f4"), _VERTEX_DATA, bounds=name == "POSITION") for name, values in arrays.items()}
    indices = binary.accessor(atlas.faces.astype("<u4").reshape(-1, 1), _INDEX_DATA)
    images = [{"name": name, "mimeType": "image/png", "bufferView": binary.view(picture)} for name, picture in pictures.items()]
    document = {
        "asset": {"version": "2.0", "generator": "mvps"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "model"} | ({"translation": stands.tolist()} if stands.any() else {})],
        "meshes": [{"name": "model", "primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [_material(textures)],
        "textures": [{"source": k, "sampler": 0} for k in range(len(images))],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP, "wrapS": _CLAMP, "wrapT": _CLAMP}],
        "images": images,
        "extensionsUsed": ["KHR_materials_specular"],
        "accessors": binary.accessors,
        "bufferViews": binary.views,
        "buffers": [{"byteLength": len(binary.data)}],
    }
    return _packed(document, bytes(binary.data))


def _material(textures: Textures) -> dict[str, Any]:
    level = textures.specular_level
    specular: dict[str, Any] = {"specularFactor": 0.0}
    if level > 0:
        specular = {"specularColorFactor": [level / DIELECTRIC] * 3, "specularColorTexture": {"index": 3}}
    return {
        "name": "model",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
            "metallicRoughnessTexture": {"index": 2},
        },
        "normalTexture": {"index": 1},
        "extensions": {"KHR_materials_specular": specular},
        "extras": {"albedo_scale": textures.scale, "albedo": "albedo = albedo_scale * base colour (linear) * (1 - max F0)"},
    }


class _Binary:
    """The binary chunk while it grows, with the views and accessors into it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, target: int | None = None) -> int:
        """Append a buffer view; its number."""
        self.data += b"\0" * (-len(self.data) % 4)
        entry = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.views.append(entry if target is None else entry | {"target": target})
        self.data += content
        return len(self.views) - 1

    def accessor(self, array: Any, target: int, bounds: bool = False) -> int:
        """Append an array (n, columns) of float32 or uint32; its number."""
        entry = {
            "bufferView": self.view(array.tobytes(), target),
            "componentType": _FLOAT if array.dtype.kind == "f" else _UNSIGNED,
            "count": len(array),
            "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[array.shape[1]],
        }
        if bounds:
            entry |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        self.accessors.append(entry)
        return len(self.accessors) - 1


def _packed(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document, sort_keys=True, allow_nan=False, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<4sII", b"glTF", 2, length) + chunks
