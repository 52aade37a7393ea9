"""Edits of a material: a small JSON file that says what becomes of albedo and highlights, on the whole object or on a region.

    {"edits": [{"region": ..., "albedo": ..., "specular": ..., "preset": ...}, ...]}      applied one after the other

    region    left out: everything;  {"view": "view_04", "mask": "painted.png"}: what that camera sees of the mask's white;
              {"cluster": 1, "of": 3}: a kind of material, 1 the least glossy, kinds being found from the lobes' shares before any edit
    albedo    {"colour": [r, g, b]} linear, instead of the object's own;  {"factor": 0.8} or a factor per channel;  {"hue_deg": 30};
              {"painted": "view_04.png", "view": "view_04"}: what that camera sees takes the picture's colours, but for its clear parts
    specular  {"factor": 2} of the weights,  {"sharpness_factor": 4} of the lobes' sharpness, highlights keeping their energy
    preset    "matte", "satin", "glossy", "polished", "gold": a whole material (PRESETS)

The energy of a lobe is 8 w / s (pbr.py), so a preset of reflectance F0 at normal incidence has w = g F0 s / 8. Its g, and what colours are
times, is the white of the material before any edit: the same edit again changes nothing, and their order does not make colours darker.
"""

from __future__ import annotations

import colorsys
import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.cluster.vq import kmeans2

from mvps.camera import project
from mvps.inputs import JSON_LIMIT, parsed_json, read_file
from mvps.load.images import read_painting
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
EITHER: Mapping[str, Sequence[set[str]]] = {"region": ({"view", "mask"}, {"cluster", "of"}), "albedo": ({"painted", "view"},)}
SOME_OF: Mapping[str, set[str]] = {"albedo": {"colour", "factor", "hue_deg"}, "specular": {"factor", "sharpness_factor"}}
"""What a part of an edit has: all of one of these sets, or some of that set."""

LARGEST = 1e6
"""Of a factor: the brightest light has as many times the radiance of the darkest shadow that photographs tell."""

MOST_KINDS = 16
"""Of material, that edits may tell apart."""


def read_edits(path: Path) -> list[dict[str, Any]]:
    """The edits of a file, pictures' paths made absolute, each with the path as "file". CaptureError where it holds anything else."""
    try:
        given = parsed_json(read_file(path, JSON_LIMIT))
    except OSError as error:
        raise CaptureError(f"{path}: wanted a file of edits, given one that cannot be read ({error.strerror}); check the path") from None
    except ValueError as error:
        raise CaptureError(f"{path}: wanted JSON, given text that is none ({error}); see docs/edits.md") from None
    if not isinstance(given, dict) or set(given) != {"edits"} or not isinstance(given["edits"], list):
        raise CaptureError(f'{path}: wanted {{"edits": [...]}}, given {_said(given)}; see docs/edits.md')
    edits = []
    for number, one in enumerate(given["edits"], 1):
        if not isinstance(one, dict) or not set(one) <= KEYS:
            raise CaptureError(f"{path}: edit {number}: wanted some of {', '.join(sorted(KEYS))}, given {_said(one)}; see docs/edits.md")
        edits.append(one | {"file": str(path)})
        for part, key in (("region", "mask"), ("albedo", "painted")):
            named = one.get(part)
            if isinstance(named, dict) and isinstance(named.get(key), str):
                edits[-1][part] = named | {key: str(path.parent / named[key])}
    return edits


def edited(surface: Surface, material: Material, edits: Sequence[Mapping[str, Any]], cameras: Mapping[str, Camera]) -> Material:
    """The material after the edits. cameras: by the names that regions give as views. CaptureError about what an edit gets wrong."""
    # What an edit has made of a kind of material, or of the brightest, must not decide what the next one takes for that kind, or for white.
    reconstructed, white = material, reflectance_scale(material)
    for number, edit in enumerate(edits, 1):
        where = f"{edit['file']}: edit {number}" if "file" in edit else f"edit {number}"
        try:
            chosen = region_of(surface, reconstructed, _part(edit, "region"), cameras)
            material = _changed(surface, material, white, chosen, edit, cameras)
        except CaptureError as error:
            # About a picture, with what to try.
            raise CaptureError(f"{where}: {error}") from error
        except ValueError as error:
            raise CaptureError(f"{where}: {error}; see docs/edits.md") from error
    return material


def _changed(
    surface: Surface, material: Material, white: float, chosen: Bool, edit: Mapping[str, Any], cameras: Mapping[str, Camera]
) -> Material:
    """The material after one edit of the chosen vertices. white: the reflectance that colours and presets are over."""
    albedo, specular = _part(edit, "albedo"), _part(edit, "specular")
    if "preset" in edit:
        material = with_preset(material, white, chosen, edit["preset"])
    if albedo is not None:
        if "painted" in albedo:
            material = with_painted(surface, material, white, chosen, cameras, **albedo)
        else:
            material = with_albedo(material, white, chosen, **albedo)
    return material if specular is None else with_specular(material, chosen, **specular)


def _part(edit: Mapping[str, Any], name: str) -> Mapping[str, Any] | None:
    """A part of an edit, None where it is left out. ValueError where it has not the keys that it should."""
    if name not in edit or (name == "region" and edit[name] is None):
        return None
    part, either, some = edit[name], EITHER.get(name, ()), SOME_OF.get(name, set())
    if isinstance(part, Mapping) and part and (set(part) in either or set(part) <= some):
        return part
    ways = [" and ".join(sorted(keys)) for keys in either] + ([f"some of {', '.join(sorted(some))}"] if some else [])
    raise ValueError(f"wanted {', or '.join(ways)} as {name}, given {_said(part)}")


def region_of(surface: Surface, material: Material, region: Mapping[str, Any] | None, cameras: Mapping[str, Camera]) -> Bool:
    """(V,) which vertices a region has."""
    if region is None:
        return np.ones(len(surface.vertices), bool)
    if "cluster" in region:
        kind, of = region["cluster"], region["of"]
        if type(kind) is not int or type(of) is not int or not 1 <= kind <= of <= MOST_KINDS:
            wanted = f"whole numbers, of from 1 to {MOST_KINDS} and cluster from 1 to of"
            raise ValueError(f"wanted {wanted}, given cluster {_said(kind)} of {_said(of)}")
        of_kind = np.asarray(clusters(surface, material, of) == kind - 1)
        if not of_kind.any():
            raise ValueError(f"wanted a kind that is somewhere on the object, given cluster {kind} of {of}, which is nowhere")
        return of_kind
    camera = _camera(cameras, region["view"])
    painting = read_painting(_picture(region["mask"], "mask"), camera.height, camera.width)
    # As of the object's mask: a pixel belongs to it where a channel is above half of full scale.
    mask = np.asarray(painting[..., :3].max(2) > 0.5)
    if not mask.any():
        raise ValueError(f"wanted a mask with some white, given {_said(region['mask'])}, which has none")
    seen = np.flatnonzero(visible_vertices(ray_caster(surface), camera))
    column, row = np.floor(project(camera, surface.vertices[seen])[0]).astype(int).T
    chosen = np.zeros(len(surface.vertices), bool)
    chosen[seen[mask[row, column]]] = True
    return chosen


def _camera(cameras: Mapping[str, Camera], name: Any) -> Camera:
    if not isinstance(name, str) or name not in cameras:
        known = f"among {', '.join(cameras)}" if cameras else "of the photographs"
        raise ValueError(f"wanted a view {known}, given {_said(name)} (--capture gives a capture's views)")
    return cameras[name]


def _picture(name: Any, key: str) -> Path:
    if not isinstance(name, str) or not Path(name).exists():
        raise ValueError(f"wanted a PNG file as {key}, given {_said(name)}, which is not there")
    return Path(name)


def clusters(surface: Surface, material: Material, count: int) -> Int:
    """(V,) kind of material, 0 the least glossy of `count`: k-means of the lobes' shares in albedo and weights, then VOTES votes of every
    vertex with its neighbours, which leave no specks. ValueError where there are fewer materials than that."""
    if count == 1:
        return np.zeros(len(surface.vertices), int)
    weight = material.specular_weight.mean(2) if material.specular_weight.ndim == 3 else material.specular_weight
    total = material.albedo.mean(1) + weight.sum(1)
    share = weight / np.maximum(total, 1e-12)[:, None]
    distinct = np.unique(share, axis=0) if share.shape[1] else share[:1]
    if len(distinct) < count:
        raise ValueError(f"wanted at most {len(distinct)} kinds of material, as many as there are, given of {count}")
    # Starting at quantiles of the gloss, the same answer comes out every time; of distinct materials, so that no two start alike.
    order = np.argsort(distinct.sum(1), kind="stable")
    start = distinct[order[((np.arange(count) + 0.5) / count * len(order)).astype(int)]]
    with warnings.catch_warnings():
        # A kind that loses all its vertices on the way stays, and is empty.
        warnings.simplefilter("ignore", UserWarning)
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
    material: Material,
    white: float,
    chosen: Bool,
    colour: Sequence[float] | None = None,
    factor: float | Sequence[float] = 1.0,
    hue_deg: float = 0.0,
) -> Material:
    """The material with another albedo on the chosen vertices; a colour of 1 is as bright as `white`."""
    albedo = material.albedo.copy()
    if colour is not None:
        albedo[chosen] = _colour(colour, "colour") * white
    albedo[chosen] *= _colour(factor, "factor")
    turn = _number(hue_deg, "hue_deg", -LARGEST)
    if turn:
        albedo[chosen] = turned_hue(albedo[chosen], turn)
    return replace(material, albedo=albedo, residual=None)


def with_painted(
    surface: Surface, material: Material, white: float, chosen: Bool, cameras: Mapping[str, Camera], painted: str, view: str
) -> Material:
    """The material with the colours of a picture, sRGB, its white as bright as `white`, of the view's size, on the chosen vertices that the
    view's camera sees; what the picture has clear stays."""
    camera = _camera(cameras, view)
    picture = read_painting(_picture(painted, "painted"), camera.height, camera.width)
    seen = np.flatnonzero(visible_vertices(ray_caster(surface), camera) & chosen)
    at = project(camera, surface.vertices[seen])[0]
    opacity = picture[..., 3:]
    # A clear pixel has no colour of its own to mix into its neighbours'.
    mixed = sampled(np.concatenate([linear_of_srgb(picture[..., :3]) * opacity, opacity], 2).astype(np.float32), at)
    albedo = material.albedo.copy()
    albedo[seen] += mixed[:, :3] * white - mixed[:, 3:] * albedo[seen]
    return replace(material, albedo=albedo, residual=None)


def turned_hue(colours: Float, degrees: float) -> Float:
    """Colours (n, 3) with another hue; saturation and value as they were."""
    turned = [colorsys.hsv_to_rgb((h + degrees / 360) % 1, s, v) for h, s, v in (colorsys.rgb_to_hsv(*c) for c in colours.tolist())]
    return np.array(turned).reshape(-1, 3)


def with_specular(material: Material, chosen: Bool, factor: float = 1.0, sharpness_factor: float = 1.0) -> Material:
    """The material with other highlights on the chosen vertices; lobes of another sharpness are added to those there are."""
    factor, sharpness_factor = _number(factor, "factor"), _number(sharpness_factor, "sharpness_factor", 1 / LARGEST)
    weight = material.specular_weight.copy()
    weight[chosen] *= factor
    if sharpness_factor == 1:
        return replace(material, specular_weight=weight, residual=None)
    moved = np.zeros_like(weight)
    moved[chosen] = sharpness_factor * weight[chosen]
    weight[chosen] = 0
    sharpness = np.concatenate([material.sharpness, sharpness_factor * material.sharpness])
    return replace(material, specular_weight=np.concatenate([weight, moved], axis=1), sharpness=sharpness, residual=None)


def with_preset(material: Material, white: float, chosen: Bool, name: str) -> Material:
    """The material with a preset's highlights on the chosen vertices, reflectances over `white`."""
    if not isinstance(name, str) or name not in PRESETS:
        raise ValueError(f"wanted one of {', '.join(PRESETS)} as preset, given {_said(name)}")
    sharpness, at_normal, metal = PRESETS[name]
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


def _colour(value: float | Sequence[float], name: str) -> Float:
    channels = value if isinstance(value, list | tuple | np.ndarray) else [value] * 3
    if len(channels) != 3:
        raise ValueError(f"wanted a number or three, one per channel, as {name}, given {_said(value)}")
    return np.array([_number(channel, name) for channel in channels])


def _number(value: Any, name: str, least: float = 0.0) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not least <= value <= LARGEST:
        raise ValueError(f"wanted numbers of {least:g} to {LARGEST:g} as {name}, given {_said(value)}")
    return float(value)


def _said(value: Any) -> str:
    """A value as files have it, its beginning where it is long."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 80 else f"{text[:80]}..."
