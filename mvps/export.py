"""A reconstruction as a folder of files, and back.

    mesh.ply                 vertices (world frame, units of the capture), refined normals, albedo as sRGB vertex colour
    model.glb                textured physically based model;  model.obj, .mtl and textures likewise   (where textures are given)
    model_N.glb              the same with N faces;  model_N.obj, .mtl, textures and mesh_N.ply likewise   (for each N that is given)
    cameras.json             of the views, as they were used (viewpoints.py)   (where cameras are given)
    lights.json              {"one_rig": bool, "fixed": bool, "views": {name: {"lights": [numbers],
                                 "direction": [[x, y, z], ...], "intensity": [[r, g, b], ...]}}}
    material.npz             albedo (V, 3), specular_weight (V, lobes[, 3]), sharpness (lobes,), confidence (V,),
                             grazing, bounce, gleam (numbers), microfacet, shadows (truth values); with a neural residual also
                             residual_share (V,), residual_code (V, codes), residual_weight_K (out, in) and residual_bias_K (out,) of its
                             layers K = 0, 1, ...
    normals/NAME.npy, .png   (height, width, 3) float32 world frame, NaN outside the mask; the picture shows (normal + 1) / 2
    report.html              where one is given
    metrics.json, settings.json

Numbers are stored exactly (doubles in the PLY and NPZ files, shortest exact decimals in JSON), so reading gives back what
was written, and writing the same reconstruction twice gives the same bytes. The folder appears whole: it is written
beside its place, on the same file system, and renamed.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from mvps.cores import at_a_time, on_cores
from mvps.folders import CHECKPOINT, RESULT_MARKS, appearing_whole
from mvps.gltf import glb_bytes, metallic_roughness
from mvps.inputs import DAMAGED, JSON_LIMIT, check_npy, check_npz, parsed_json, read_file
from mvps.mesh import nearest, normalise
from mvps.meshfile import PlyMesh, obj_bytes, ply_bytes, read_ply
from mvps.pbr import reflectance_scale, srgb_bytes
from mvps.scene import Camera, CaptureError, Float, Lights, Material, Reconstruction, Residual, Surface
from mvps.texture import Textures, png_bytes
from mvps.viewpoints import cameras_record


def write_reconstruction(
    reconstruction: Reconstruction,
    folder: Path,
    textures: Textures | None = None,
    report: str = "",
    levels: Mapping[int, Textures] = MappingProxyType({}),
    cameras: Mapping[str, Camera] = MappingProxyType({}),
) -> None:
    """Write a result folder, whole or not at all.

    An empty folder or an earlier result at the same place is replaced; CaptureError where something else is there. Without
    `textures` (see mvps.texture.bake) the textured models are left out, without a `report` (HTML) report.html is.
    levels: textures of models with fewer faces, by the numbers in their names. cameras: by the views' names, for other programs.
    ValueError where metrics or settings are not plain JSON values.
    """
    files = {
        "lights.json": _json("lights", _lights_record(reconstruction), sort=False),
        "metrics.json": _json("metrics", reconstruction.metrics),
        "settings.json": _json("settings", reconstruction.settings),
    }
    if cameras:
        files["cameras.json"] = _json("cameras", cameras_record(cameras), sort=False)
    with appearing_whole(folder, RESULT_MARKS, CHECKPOINT) as writing:
        files |= _mesh_files(reconstruction)
        if textures is not None:
            files |= _model_files("model", textures)
        for faces, of_level in levels.items():
            files |= _model_files(f"model_{faces}", of_level)
            files[f"mesh_{faces}.ply"] = _level_ply(reconstruction, of_level.surface)
        if report:
            files["report.html"] = report.encode("utf-8")
        for name, content in files.items():
            (writing / name).write_bytes(content)
        (writing / "normals").mkdir()

        def write_normals(view: str, normals: Float) -> None:
            np.save(writing / "normals" / f"{view}.npy", np.asarray(normals, np.float32))
            (writing / "normals" / f"{view}.png").write_bytes(png_bytes(normal_picture(normals)))

        on_cores(write_normals, reconstruction.views, reconstruction.normal_maps)


def read_reconstruction(folder: Path) -> Reconstruction:
    """The reconstruction in a result folder. CaptureError where a file is missing, damaged or does not fit the others."""
    folder = Path(folder)
    wanted = ("mesh.ply", "material.npz", "lights.json", "metrics.json", "settings.json")
    missing = [name for name in wanted if not (folder / name).is_file()]
    if missing:
        raise CaptureError(
            f"{folder}: wanted a result folder, given one without {', '.join(missing)}; give the folder that mvps.reconstruct --out wrote"
        )
    mesh = read_ply(folder / "mesh.ply")
    record, metrics, settings = (_read_json(folder / f"{name}.json") for name in ("lights", "metrics", "settings"))
    try:
        views = tuple(_view_name(view) for view in record["views"])
        check_account(metrics, settings)
        check_npz(folder / "material.npz")
        with np.load(folder / "material.npz", allow_pickle=False) as arrays:
            # A result without gleam is one whose lobes send each other nothing.
            of_all = {name: kind(arrays[name]) for name, kind in _OF_ALL.items() if name in arrays or name != "gleam"}
            values = {name: arrays[name] for name in _MATERIAL} | of_all
            material = Material(normal=mesh.normals, **values, residual=_residual(arrays))
        # Results of before there were fixed rigs have none.
        fixed = bool(record.get("fixed", False))
        return Reconstruction(
            surface=Surface(mesh.vertices, mesh.faces),
            material=material,
            lights=Lights(
                direction=tuple(_rows(record, view, "direction") for view in views),
                intensity=tuple(_rows(record, view, "intensity") for view in views),
                one_rig=bool(record["one_rig"]) or fixed,
                fixed=fixed,
            ),
            views=views,
            light_names=tuple(_light_numbers(record["views"][view]["lights"]) for view in views),
            normal_maps=tuple(_normal_map(folder / "normals" / f"{view}.npy") for view in views),
            metrics=metrics,
            settings=settings,
        )
    except DAMAGED as error:
        raise CaptureError(f"{folder}: wanted a whole result, given a damaged one ({error}); run mvps.reconstruct again") from error


def _view_name(name: str) -> str:
    if not re.fullmatch(r"\w+", name):
        raise ValueError(f"lights.json: wanted names of views such as view_01, given {name[:40]!r}")
    return name


def _light_numbers(numbers: Any) -> tuple[int, ...]:
    if not isinstance(numbers, list) or not all(type(n) is int and 1 <= n < 1 << 31 for n in numbers) or len(set(numbers)) != len(numbers):
        raise ValueError(f"lights.json: wanted distinct numbers from 1 as lights, given {str(numbers)[:40]}")
    return tuple(numbers)


def _normal_map(path: Path) -> Any:
    """(height, width, 3) float32."""
    check_npy(path)
    normals = np.load(path, allow_pickle=False)
    if normals.ndim != 3 or normals.shape[2] != 3 or normals.dtype != np.float32:
        raise ValueError(f"{path.name}: wanted float32 of shape (height, width, 3), given {normals.dtype} of shape {normals.shape}")
    return normals


def check_account(metrics: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """ValueError where metrics or settings hold other kinds of values than the commands that read them take."""
    model = metrics.get("model") or {}
    records = [metrics.get(name) or [] for name in ("stages", "rounds", "findings")] + [model.get("components") or []]
    texts = [metrics.get("status") or {}, metrics.get("held_out") or {}, model]
    truth = metrics.get("truth") or {}
    if not all(isinstance(rows, list) and all(isinstance(row, dict) for row in rows) for rows in records) or not all(
        isinstance(value, dict) for value in texts
    ):
        raise ValueError("metrics.json: wanted stages, rounds, findings and components as lists of objects, given other values")
    if not isinstance(truth, dict) or not all(isinstance(value, int | float) and abs(value) < 1e300 for value in truth.values()):
        raise ValueError("metrics.json: wanted numbers as truth, given other values")
    held = [settings.get(name) or [] for name in ("hold_out_views", "hold_out_lights")]
    if not all(isinstance(numbers, list) and all(type(n) is int for n in numbers) for numbers in held):
        raise ValueError("settings.json: wanted lists of numbers as hold_out_views and hold_out_lights, given other values")


_MATERIAL = ("albedo", "specular_weight", "sharpness", "confidence")
_OF_ALL = {"grazing": float, "bounce": float, "gleam": float, "microfacet": bool, "shadows": bool}


def _residual(arrays: Mapping[str, Any]) -> Residual | None:
    """The neural residual in material.npz; None where there is none."""
    if "residual_share" not in arrays:
        return None
    layers = range(sum(name.startswith("residual_weight_") for name in arrays))
    pairs = tuple((arrays[f"residual_weight_{k}"], arrays[f"residual_bias_{k}"]) for k in layers)
    return Residual(arrays["residual_share"], arrays["residual_code"], pairs)


def _residual_arrays(residual: Residual | None) -> dict[str, Any]:
    if residual is None:
        return {}
    arrays: dict[str, Any] = {"residual_share": residual.share, "residual_code": residual.code}
    for k, (weight, bias) in enumerate(residual.layers):
        arrays |= {f"residual_weight_{k}": weight, f"residual_bias_{k}": bias}
    return arrays


def normal_picture(normals: Float) -> Any:
    """(height, width, 3) uint8 picture of normals (height, width, 3): (normal + 1) / 2; black where NaN."""
    return np.nan_to_num(np.rint((np.asarray(normals, np.float64) + 1) * 127.5), nan=0).clip(0, 255).astype(np.uint8)


def _lights_record(reconstruction: Reconstruction) -> dict[str, Any]:
    lights = reconstruction.lights
    rows = zip(reconstruction.views, reconstruction.light_names, lights.direction, lights.intensity, strict=True)
    views = {
        view: {"lights": [int(n) for n in numbers], "direction": direction.tolist(), "intensity": intensity.tolist()}
        for view, numbers, direction, intensity in rows
    }
    # Not sorted by name: the order is that of the views.
    return {"one_rig": lights.one_rig and not lights.fixed, "fixed": lights.fixed, "views": views}


def _rows(record: dict[str, Any], view: str, name: str) -> Float:
    rows = np.array(record["views"][view][name], dtype=np.float64).reshape(-1, 3)
    if len(rows) != len(record["views"][view]["lights"]):
        raise ValueError(f"lights.json: wanted {len(record['views'][view]['lights'])} rows of {name} for {view}, given {len(rows)}")
    return rows


def _json(name: str, value: Any, sort: bool = True) -> bytes:
    try:
        text = json.dumps(value, indent=1, sort_keys=sort, allow_nan=False, ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: wanted plain JSON values (finite numbers, text, lists, dicts with text keys), given {error}") from error
    return (text + "\n").encode("utf-8")


def _read_json(path: Path) -> dict[str, Any]:
    try:
        value = parsed_json(read_file(path, JSON_LIMIT))
    except (OSError, ValueError) as error:
        raise CaptureError(f"{path}: wanted JSON, given something else ({error}); run mvps.reconstruct again") from error
    if not isinstance(value, dict) or (path.name == "lights.json" and not isinstance(value.get("views"), dict)):
        raise CaptureError(f"{path}: wanted a JSON object as mvps.reconstruct writes it, given another; run mvps.reconstruct again")
    return value


def _mesh_files(reconstruction: Reconstruction) -> dict[str, bytes]:
    material = reconstruction.material
    arrays = io.BytesIO()
    values = {name: getattr(material, name) for name in (*_MATERIAL, *_OF_ALL)} | _residual_arrays(material.residual)
    np.savez(arrays, allow_pickle=False, **values)
    scale = reflectance_scale(material)
    return {"mesh.ply": _ply(reconstruction.surface, material.normal, material.albedo, scale), "material.npz": arrays.getvalue()}


def _level_ply(reconstruction: Reconstruction, shell: Surface) -> bytes:
    """A mesh of fewer faces, each vertex with the normal and the albedo of the full one's nearest point."""
    full, material = reconstruction.surface, reconstruction.material
    found = nearest(full, shell.vertices)
    normal, albedo = (np.einsum("nk,nkc->nc", found.barycentric, a[full.faces[found.face]]) for a in (material.normal, material.albedo))
    return _ply(shell, normalise(normal), albedo, reflectance_scale(material))


def _ply(surface: Surface, normal: Float, albedo: Float, scale: float) -> bytes:
    comment = f"colour = sRGB of albedo / {scale:.9g}; the normal is the refined shading normal"
    return ply_bytes(PlyMesh(surface.vertices, normal, srgb_bytes(albedo / scale), surface.faces), comment)


def _model_files(name: str, textures: Textures) -> dict[str, bytes]:
    surface, atlas = textures.surface, textures.atlas
    pictures = [textures.base_color, textures.normal_map, textures.roughness, textures.specular_color, metallic_roughness(textures)]
    with ThreadPoolExecutor(at_a_time()) as pool:
        # Text is formatted under the interpreter's lock, pictures are compressed without it.
        encoded = pool.map(png_bytes, pictures)
        obj = obj_bytes(surface.vertices, textures.mesh_normal, atlas.uv, surface.faces, atlas.faces, name)
        base_color, normal, roughness, specular, of_glb = encoded
    return {
        f"{name}_base_color.png": base_color,
        f"{name}_normal.png": normal,
        f"{name}_roughness.png": roughness,
        f"{name}_specular.png": specular,
        f"{name}.glb": glb_bytes(
            textures, {"base_color": base_color, "normal": normal, "metallic_roughness": of_glb, "specular": specular}
        ),
        f"{name}.obj": obj,
        f"{name}.mtl": _mtl(name, textures),
    }


def _mtl(name: str, textures: Textures) -> bytes:
    """Wavefront material with the physically based extension of Clara.io (Pr: roughness, Pm: metallic, norm: normal map)."""
    lines = [
        f"newmtl {name}",
        "Kd 1 1 1",
        f"map_Kd {name}_base_color.png",
        "Ks" + f" {textures.specular_level:.6g}" * 3,
        f"map_Ks {name}_specular.png",
        "Pm 0",
        f"map_Pr {name}_roughness.png",
        f"norm {name}_normal.png",
        "",
    ]
    return "\n".join(lines).encode("ascii")
