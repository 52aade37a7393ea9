"""Edits of a material: a small JSON file that says what becomes of albedo and highlights, on the whole object or on a region.

    {"edits": [{"region": ..., "albedo": ..., "specular": ..., "preset": ...}, ...]}      applied one after the other

    region    left out: everything;  {"view": "view_04", "mask": "painted.png"}: what that camera sees of the mask's white;
              {"cluster": 1, "of": 3}: a kind of material, kinds being found from the shares of the lobes, 1 the least glossy
    albedo    {"colour": [r, g, b]} linear, instead of the object's own;  {"factor": 0.8} or a factor per channel;  {"hue_deg": 30};
              {"painted": "view_04.png", "view": "view_04"}: what that camera sees takes the picture's colours, but for its clear parts
    specular  {"factor": 2} of the weights,  {"sharpness_factor": 4} of the lobes' sharpness, highlights keeping their energy
    preset    "matte", "satin", "glossy", "polished", "gold": a whole material (PRESETS)

The energy of a lobe is 8 w / s (pbr.py), so a preset of reflectance F0 at normal incidence has w = g F0 s / 8, g the material's white.
"""

from __future__ import annotations

import colorsys
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.cluster.vq import kmeans2

from mvps.camera import project
from mvps.load.images import read_mask, read_painting
from mvps.mesh import edges
from mvps.pbr import linear_of_srgb, reflectance_scale
from mvps.scene import Bool, Camera, CaptureError, Float, Int, Material, Surface
from mvps.silhouette import sampled
from mvps.visibility import ray_caster, visible_vertices

PRESETS: Mapping[str, tuple[float, tuple[float, float, float] | None, bool]] = {
    "matte": (1.0, None, False),
    "satin": (20.0, (0.04, 0.04, 0.04), False),
    "glossy": (150.0, (0.04, 0.04, 0.04), False),
    "polished": (1000.0, (0.04, 0.04, 0.04), False),
    "gold": (100.0, (1.0, 0.78, 0.34), True),
}
"""Sharpness; F0, None without highlights; whether it is a metal, without diffuse light. 0.04 is glass and plastics, of index 1.5; gold as
in Hoffman's notes for the course on physically based shading, SIGGRAPH 2010."""

VOTES = 3
"""Votes of neighbours on a vertex's kind: noise of single vertices and of pairs goes, what is three edges wide stays."""

KEYS = {"region", "albedo", "specular", "preset"}
REGION_KEYS = ({"view", "mask"}, {"cluster", "of"})

LARGEST = 1e6
"""Of a factor: the brightest light has as many times the radiance of the darkest shadow that photographs tell."""


def read_edits(path: Path) -> list[dict[str, Any]]:
    """The edits of a file, masks' paths made absolute. CaptureError where it holds anything else."""
    try:
        given = json.loads(path.read_bytes())
        edits = given["edits"]
        if set(given) != {"edits"}:
            raise ValueError(f"beside edits also {', '.join(sorted(set(given) - {'edits'}))}")
        if not isinstance(edits, list) or not all(isinstance(one, dict) and set(one) <= KEYS for one in edits):
            raise ValueError(f"each edit has some of {', '.join(sorted(KEYS))}")
    except OSError as error:
        raise CaptureError(f"{path}: wanted a file of edits, given {error.strerror}; check the path") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CaptureError(f'{path}: wanted {{"edits": [...]}}, given something else ({error}); see docs/edits.md') from error
    for one in edits:
        for part, key in (("region", "mask"), ("albedo", "painted")):
            named = one.get(part)
            if isinstance(named, dict) and isinstance(named.get(key), str):
                one[part] = named | {key: str(path.parent / named[key])}
    return edits


def edited(surface: Surface, material: Material, edits: Sequence[Mapping[str, Any]], cameras: Mapping[str, Camera]) -> Material:
    """The material after the edits. cameras: by the names that regions give as views. CaptureError about what an edit gets wrong."""
    for number, edit in enumerate(edits, 1):
        try:
            chosen = region_of(surface, material, edit.get("region"), cameras)
            if "preset" in edit:
                material = with_preset(material, chosen, edit["preset"])
            if "painted" in edit.get("albedo", {}):
                material = with_painted(surface, material, chosen, cameras, **edit["albedo"])
            elif "albedo" in edit:
                material = with_albedo(material, chosen, **edit["albedo"])
            if "specular" in edit:
                material = with_specular(material, chosen, **edit["specular"])
        except (TypeError, ValueError, KeyError) as error:
            if isinstance(error, CaptureError):
                raise
            raise CaptureError(
                f"edit {number}: wanted what docs/edits.md lists, given something else ({error}); correct the file"
            ) from error
    return material


def region_of(surface: Surface, material: Material, region: Any, cameras: Mapping[str, Camera]) -> Bool:
    """(V,) which vertices a region has."""
    if region is None:
        return np.ones(len(surface.vertices), bool)
    if set(region) not in REGION_KEYS:
        raise ValueError(f"a region of {' and '.join(sorted(region)) or 'nothing'}")
    if "cluster" in region:
        kind, of = int(region["cluster"]), int(region["of"])
        if not 1 <= kind <= of:
            raise ValueError(f"cluster {kind} of {of}")
        return np.asarray(clusters(surface, material, of) == kind - 1)
    camera, mask = _camera(cameras, region["view"]), read_mask(Path(region["mask"]))
    if mask.shape != (camera.height, camera.width):
        raise CaptureError(f"{region['mask']}: wanted {camera.width} x {camera.height} pixels, given {mask.shape[1]} x {mask.shape[0]}")
    seen = np.flatnonzero(visible_vertices(ray_caster(surface), camera))
    column, row = np.floor(project(camera, surface.vertices[seen])[0]).astype(int).T
    chosen = np.zeros(len(surface.vertices), bool)
    chosen[seen[mask[row, column]]] = True
    return chosen


def _camera(cameras: Mapping[str, Camera], name: Any) -> Camera:
    if name not in cameras:
        known = f"among {', '.join(cameras)}" if cameras else "of the photographs"
        raise CaptureError(f"edit: wanted a view {known}, given {name!r}; give --capture for its views")
    return cameras[name]


def clusters(surface: Surface, material: Material, count: int) -> Int:
    """(V,) kind of material, 0 the least glossy of `count`: k-means of the lobes' shares in albedo and weights, then VOTES votes of every
    vertex with its neighbours, which leave no specks."""
    if not 1 <= count <= 16:
        raise ValueError(f"1 to 16 clusters, not {count}")
    weight = material.specular_weight.mean(2) if material.specular_weight.ndim == 3 else material.specular_weight
    total = material.albedo.mean(1) + weight.sum(1)
    share = weight / np.maximum(total, 1e-12)[:, None]
    if not share.shape[1]:
        return np.zeros(len(share), int)
    # Starting at quantiles of the gloss, the same answer comes out every time.
    order = np.argsort(share.sum(1), kind="stable")
    start = share[order[((np.arange(count) + 0.5) / count * len(order)).astype(int)]]
    centres, kind = kmeans2(share, start, minit="matrix")
    rank = np.argsort(np.argsort(centres.sum(1)))
    of_vertices: Int = rank[kind]
    one_way = edges(surface)
    ends = np.concatenate([one_way, one_way[:, ::-1]])
    for _ in range(VOTES):
        counts = np.zeros((len(share), count))
        # A vertex keeps its kind where its neighbours are divided.
        counts[np.arange(len(share)), of_vertices] = 0.5
        np.add.at(counts, (ends[:, 0], of_vertices[ends[:, 1]]), 1)
        of_vertices = counts.argmax(1)
    return of_vertices


def with_albedo(
    material: Material, chosen: Bool, colour: Sequence[float] | None = None, factor: float | Sequence[float] = 1.0, hue_deg: float = 0.0
) -> Material:
    """The material with another albedo on the chosen vertices."""
    albedo = material.albedo.copy()
    if colour is not None:
        albedo[chosen] = _colour(colour) * reflectance_scale(material)
    albedo[chosen] *= _colour(factor)
    if hue_deg:
        albedo[chosen] = turned_hue(albedo[chosen], hue_deg)
    return replace(material, albedo=albedo, residual=None)


def with_painted(surface: Surface, material: Material, chosen: Bool, cameras: Mapping[str, Camera], painted: str, view: str) -> Material:
    """The material with the colours of a picture, sRGB, of the view's size, on the chosen vertices that the view's camera sees; what the
    picture has clear stays."""
    camera = _camera(cameras, view)
    picture = read_painting(Path(painted), camera.height, camera.width)
    seen = np.flatnonzero(visible_vertices(ray_caster(surface), camera) & chosen)
    at = project(camera, surface.vertices[seen])[0]
    opacity = picture[..., 3:]
    # A clear pixel has no colour of its own to mix into its neighbours'.
    mixed = sampled(np.concatenate([linear_of_srgb(picture[..., :3]) * opacity, opacity], 2).astype(np.float32), at)
    albedo = material.albedo.copy()
    albedo[seen] += mixed[:, :3] * reflectance_scale(material) - mixed[:, 3:] * albedo[seen]
    return replace(material, albedo=albedo, residual=None)


def turned_hue(colours: Float, degrees: float) -> Float:
    """Colours (n, 3) with another hue; saturation and value as they were."""
    turned = [colorsys.hsv_to_rgb((h + degrees / 360) % 1, s, v) for h, s, v in (colorsys.rgb_to_hsv(*c) for c in colours.tolist())]
    return np.array(turned).reshape(-1, 3)


def with_specular(material: Material, chosen: Bool, factor: float = 1.0, sharpness_factor: float = 1.0) -> Material:
    """The material with other highlights on the chosen vertices; lobes of another sharpness are added to those there are."""
    if not (0 <= factor <= LARGEST and 1 / LARGEST <= sharpness_factor <= LARGEST):
        limits = f"a factor of 0 to {LARGEST:g} and a sharpness_factor above 0, {1 / LARGEST:g} to {LARGEST:g}"
        raise ValueError(f"{limits}, not {factor} and {sharpness_factor}")
    weight = material.specular_weight.copy()
    weight[chosen] *= factor
    if sharpness_factor == 1:
        return replace(material, specular_weight=weight, residual=None)
    moved = np.zeros_like(weight)
    moved[chosen] = sharpness_factor * weight[chosen]
    weight[chosen] = 0
    sharpness = np.concatenate([material.sharpness, sharpness_factor * material.sharpness])
    return replace(material, specular_weight=np.concatenate([weight, moved], axis=1), sharpness=sharpness, residual=None)


def with_preset(material: Material, chosen: Bool, name: str) -> Material:
    """The material with a preset's highlights on the chosen vertices."""
    if name not in PRESETS:
        raise ValueError(f"preset one of {', '.join(PRESETS)}, not {name!r}")
    sharpness, at_normal, metal = PRESETS[name]
    white = reflectance_scale(material)
    weight = material.specular_weight
    weight = weight.copy() if weight.ndim == 3 else weight[..., None].repeat(3, axis=2)
    weight[chosen] = 0
    albedo = material.albedo.copy()
    if metal:
        albedo[chosen] = 0
    if at_normal is None:
        return replace(material, albedo=albedo, specular_weight=weight, residual=None)
    own = np.zeros((len(weight), 1, 3))
    own[chosen] = white * np.array(at_normal) * sharpness / 8
    lobes = np.append(material.sharpness, sharpness)
    return replace(material, albedo=albedo, specular_weight=np.concatenate([weight, own], axis=1), sharpness=lobes, residual=None)


def _colour(value: float | Sequence[float]) -> Float:
    colour = np.broadcast_to(np.asarray(value, float), 3)
    if not ((colour >= 0) & (colour <= LARGEST)).all():
        raise ValueError(f"numbers of 0 and more, up to {LARGEST:g}, not {value}")
    return colour
