"""Triangle meshes in files: binary PLY (Turk 1994) with normals and colours, and Wavefront OBJ with texture coordinates.

PLY  little-endian, one element `vertex` (x y z nx ny nz as double, red green blue as uchar) and one element `face`
     (list uchar int vertex_indices). Doubles, so that a mesh read back is the mesh written, bit for bit.
OBJ  text, nine significant digits (enough for float32; a double's seventeen where `place` is not 0); v, vt, vn lines, then faces as
     v/vt/vn, numbered from 1.
     vt has its origin at the bottom left, textures here (and glTF) at the top left: v_obj = 1 - v.
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mvps.inputs import file_size, read_file
from mvps.scene import CaptureError, Float, Int

_VERTEX = np.dtype([(n, "<f8") for n in ("x", "y", "z", "nx", "ny", "nz")] + [(n, "u1") for n in ("red", "green", "blue")])
_FACE = np.dtype([("count", "u1"), ("indices", "<i4", (3,))])


HEADER_LIMIT = 4096
"""Bytes that hold any header written here: 14 lines."""


class PlyMesh(NamedTuple):
    """vertices, normals (V, 3) float64; colours (V, 3) uint8; faces (F, 3)."""

    vertices: Float
    normals: Float
    colours: NDArray[np.uint8]
    faces: Int


def _header(vertices: int, faces: int, comment: str) -> bytes:
    kind = {"<f8": "double", "|u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"comment {comment}", f"element vertex {vertices}"]
    lines += [f"property {kind[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()]
    lines += [f"element face {faces}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(lines).encode("ascii")


def ply_bytes(mesh: PlyMesh, comment: str) -> bytes:
    """The mesh as a PLY file; `comment` is one line of ASCII for its header."""
    vertex = np.zeros(len(mesh.vertices), _VERTEX)
    columns = np.concatenate([mesh.vertices, mesh.normals], 1)
    for k, name in enumerate(("x", "y", "z", "nx", "ny", "nz")):
        vertex[name] = columns[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        vertex[name] = mesh.colours[:, k]
    face = np.zeros(len(mesh.faces), _FACE)
    face["count"], face["indices"] = 3, mesh.faces
    return _header(len(vertex), len(face), comment) + vertex.tobytes() + face.tobytes()


def read_ply(path: Path) -> PlyMesh:
    """A mesh written by `ply_bytes`. CaptureError where the file is another program's PLY or cut short."""
    size = file_size(path)
    head = read_file(path, size, HEADER_LIMIT)
    end = head.find(b"end_header\n")
    lines = head[:end].decode("ascii", "replace").split("\n")[:-1] if end >= 0 else []
    counts = {m[1]: int(m[2]) for m in (re.fullmatch(r"element (vertex|face) (\d{1,12})", line) for line in lines) if m}
    comment = next((line[len("comment ") :] for line in lines if line.startswith("comment ") and line.isascii()), "")
    vertices, faces = counts.get("vertex", 0), counts.get("face", 0)
    if not lines or head[: end + 11] != _header(vertices, faces, comment):
        raise CaptureError(
            f"{path}: wanted a PLY file with the properties that mvps writes, given another kind of file;"
            " restore the file or run mvps.reconstruct again"
        )
    given, wanted = size - end - 11, vertices * _VERTEX.itemsize + faces * _FACE.itemsize
    if given != wanted:
        raise CaptureError(
            f"{path}: wanted {wanted} bytes after the header, given {given}; the file is damaged, run mvps.reconstruct again"
        )
    body = memoryview(read_file(path, size))[end + 11 :]
    vertex = np.frombuffer(body, _VERTEX, vertices)
    face = np.frombuffer(body, _FACE, faces, offset=vertices * _VERTEX.itemsize)
    positions, normals, colours = (
        np.stack([vertex[name] for name in names], -1) for names in (("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue"))
    )
    return PlyMesh(positions, normals, colours, face["indices"].astype(np.int64))


FAR = 10.0
"""Sizes of a mesh from the world's origin to its middle, from which on single precision does not hold its shape any more: a hundred
thousandth of the size is left at 100."""


def place(vertices: Float) -> Float:
    """(3,) the middle of vertices (V, 3) that lie far from the world's origin; 0 of others."""
    low, high = vertices.min(0), vertices.max(0)
    middle: Float = (low + high) / 2
    return middle if np.linalg.norm(middle) > FAR * np.linalg.norm(high - low) else np.zeros(3)


def obj_bytes(vertices: Float, normals: Float, uv: Float, faces: Int, uv_faces: Int, material: str) -> bytes:
    """An OBJ file.

    vertices and normals (V, 3) are shared by faces (F, 3); uv (T, 2), origin at the top left, is indexed by uv_faces (F, 3);
    `material` is the name both of the .mtl file (without its ending) and of the material in it.
    """
    out = io.StringIO()
    out.write(f"mtllib {material}.mtl\no {material}\n")
    flipped = np.stack([uv[:, 0], 1 - uv[:, 1]], -1)
    digits = 17 if place(vertices).any() else 9
    for tag, rows in (("v", vertices), ("vt", flipped), ("vn", normals)):
        pattern = tag + f" %.{digits}g" * rows.shape[1] + "\n"
        out.write((pattern * len(rows)) % tuple(rows.ravel().tolist()))
    out.write(f"usemtl {material}\n")
    corners = np.stack([faces, uv_faces, faces], -1) + 1
    out.write(("f %d/%d/%d %d/%d/%d %d/%d/%d\n" * len(faces)) % tuple(corners.ravel().tolist()))
    return out.getvalue().encode("ascii")
