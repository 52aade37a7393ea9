"""mvps.texture and mvps.gltf: known colours, normals and roughness come back from the baked pictures."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from references import linear_from_srgb
from sphere_scene import RADIUS, SphereScene, colours, make_sphere

from mvps.atlas import Atlas, build_atlas, rasterise
from mvps.gltf import glb_bytes, metallic_roughness
from mvps.joint.stated import icosahedron
from mvps.mesh import decimated, nearest, normalise, vertex_normals
from mvps.pbr import glossy
from mvps.rendering import photograph, points_under
from mvps.scene import Capture, Lights, Material, Surface, View
from mvps.texture import Textures, _charted, _robust_albedo, bake, pixel_albedo, png_bytes
from mvps.visibility import RayCaster


@pytest.fixture(scope="module")
def scene() -> SphereScene:
    return make_sphere()


@pytest.fixture(scope="module")
def baked(scene: SphereScene) -> Textures:
    """From a material whose albedo is grey: the colours can only come from the photographs."""
    r = scene.reconstruction
    grey = replace(r.material, albedo=np.full_like(r.material.albedo, 0.6))
    return bake(r.surface, grey, r.lights, scene.capture, 2)[0]


def albedo_of(textures: Textures) -> np.ndarray:
    """(h, w, 3) as the model's extras tell: albedo_scale * base colour * (1 - max F0)."""
    f0 = linear_from_srgb(textures.specular_color) * textures.specular_level
    return linear_from_srgb(textures.base_color) * (1 - f0.max(-1, keepdims=True)) * textures.scale


def texel_positions(scene: SphereScene, atlas: Atlas) -> tuple[np.ndarray, ...]:
    t = rasterise(atlas.uv, atlas.faces, atlas.height, atlas.width)
    corners = scene.reconstruction.surface.vertices[scene.reconstruction.surface.faces[t.face]]
    return t.row, t.column, (corners * t.barycentric[..., None]).sum(1)


def test_base_colour_comes_from_the_photographs(scene: SphereScene, baked: Textures) -> None:
    row, column, position = texel_positions(scene, baked.atlas)
    colour = albedo_of(baked)[row, column]
    # Two pixels (2 x 1 mm) around the border of the colours may be mixed.
    clear = np.abs(position[:, 0]) > 2.5
    error = np.abs(colour - colours(position))[clear].max(1)
    assert baked.from_photographs == 1
    assert np.median(error) < 0.01 and np.percentile(error, 99) < 0.05


def test_texels_without_a_photograph_keep_the_vertices_albedo(scene: SphereScene) -> None:
    r = scene.reconstruction
    one = Capture("one", scene.capture.views[:1])
    lights = Lights(r.lights.direction[:1], r.lights.intensity[:1], True)
    grey = replace(r.material, albedo=np.full_like(r.material.albedo, 0.6))
    textures = bake(r.surface, grey, lights, one, 2)[0]
    row, column, position = texel_positions(scene, textures.atlas)
    colour = albedo_of(textures)[row, column]
    np.testing.assert_allclose(colour[position[:, 0] < 0], 0.6, atol=0.01)
    assert np.median(np.abs(colour - RIGHT_SIDE)[position[:, 0] > 0.5 * RADIUS]) < 0.01
    assert 0.2 < textures.from_photographs < 0.5


RIGHT_SIDE = colours(np.array([1.0, 0, 0]))


def test_a_hidden_part_takes_no_colour_from_what_hides_it() -> None:
    """A small ball in front of the large one: where it hides the large one, the view says nothing of that."""
    scene = make_sphere(3)
    r = scene.reconstruction
    small = trimesh.creation.icosphere(subdivisions=3, radius=8)
    n, m = len(r.surface.vertices), len(small.vertices)
    surface = Surface(
        np.concatenate([r.surface.vertices, small.vertices + np.array([60, 0, 0])]),
        np.concatenate([r.surface.faces, np.array(small.faces) + n]),
    )
    albedo = np.concatenate([np.full((n, 3), 0.6), np.full((m, 3), 0.3)])
    material = Material(vertex_normals(surface), albedo, np.zeros((n + m, 0)), np.zeros(0), np.ones(n + m))
    view = scene.capture.views[0]
    lights = Lights(r.lights.direction[:1], r.lights.intensity[:1], True)
    radiance = photograph(RayCaster(surface), material, view.camera, view.pixels, lights.direction[0], lights.intensity[0])
    samples = np.rint(radiance / 2 * 65535).astype(np.uint16)
    wrong = replace(material, albedo=np.full_like(albedo, 0.1))
    textures = bake(surface, wrong, lights, Capture("two", (replace(view, samples=samples),)), 2)[0]
    t = rasterise(textures.atlas.uv, textures.atlas.faces, textures.atlas.height, textures.atlas.width)
    x = (surface.vertices[surface.faces[t.face]] * t.barycentric[..., None]).sum(1)
    colour = albedo_of(textures)[t.row, t.column].mean(1)
    big = np.linalg.norm(x, axis=1) < RADIUS + 1
    behind = big & (np.linalg.norm(x[:, 1:], axis=1) < 6) & (x[:, 0] > 0)
    beside = big & (np.linalg.norm(x[:, 1:], axis=1) > 12) & (x[:, 0] > 0.7 * RADIUS)
    front = ~big & (x[:, 0] > 65)
    assert min(behind.sum(), beside.sum(), front.sum()) > 100
    np.testing.assert_allclose(colour[behind], 0.1, atol=0.01)
    assert np.median(np.abs(colour[beside] - 0.6)) < 0.02 and np.median(np.abs(colour[front] - 0.3)) < 0.02


def glb_of(textures: Textures) -> bytes:
    pictures = {
        "base_color": textures.base_color,
        "normal": textures.normal_map,
        "metallic_roughness": metallic_roughness(textures),
        "specular": textures.specular_color,
    }
    return glb_bytes(textures, {name: png_bytes(picture) for name, picture in pictures.items()})


def glb_parts(data: bytes) -> tuple[dict[str, object], dict[str, np.ndarray]]:
    """The JSON and the arrays of a GLB file, read by its specification."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    document = json.loads(data[20 : 20 + size])
    binary = data[28 + size :]
    arrays = {}
    primitive = document["meshes"][0]["primitives"][0]
    for name, k in [*primitive["attributes"].items(), ("indices", primitive["indices"])]:
        accessor = document["accessors"][k]
        columns = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        arrays[name] = np.frombuffer(binary, kind, accessor["count"] * columns, start).reshape(-1, columns)
    return document, arrays


def shown_by_a_viewer(textures: Textures) -> tuple[np.ndarray, ...]:
    """Row, column, position, mesh normal, decoded normal of texels, from the GLB alone: interpolate NORMAL and TANGENT, bitangent
    = cross(n, t) w, decode 2 c / 255 - 1."""
    _, arrays = glb_parts(glb_of(textures))
    faces = arrays["indices"].reshape(-1, 3).astype(int)
    t = rasterise(arrays["TEXCOORD_0"].astype(float), faces, textures.atlas.height, textures.atlas.width)
    assert (arrays["TANGENT"][:, 3] == 1).all()
    attributes = [arrays[k][faces[t.face], :3].astype(float) for k in ("POSITION", "NORMAL", "TANGENT")]
    position, n, tangent = ((a * t.barycentric[..., None]).sum(1) for a in attributes)
    n, tangent = normalise(n), normalise(tangent)
    x, y, z = np.moveaxis(textures.normal_map[t.row, t.column] / 127.5 - 1, -1, 0)[..., None]
    return t.row, t.column, position, n, normalise(x * tangent + y * normalise(np.cross(n, tangent)) + z * n)


def test_a_shell_shows_the_full_surface_by_its_pictures(scene: SphereScene) -> None:
    """A twentieth of the faces: normals and colours of the nearest points of the full sphere, at its exposure."""
    r = scene.reconstruction
    shell = decimated(r.surface, len(r.surface.faces) // 20)
    full, level = bake(r.surface, r.material, r.lights, scene.capture, 2, [shell])
    assert len(level.surface.faces) <= len(r.surface.faces) // 20 and level.scale == full.scale
    row, column, position, n, decoded = shown_by_a_viewer(level)
    found = nearest(r.surface, position)
    expected = normalise(np.einsum("nk,nkc->nc", found.barycentric, r.material.normal[r.surface.faces[found.face]]))
    angle, plain = (np.degrees(np.arccos(np.clip((a * expected).sum(1), -1, 1))) for a in (decoded, n))
    assert np.percentile(angle, 99) < 1 and plain.max() > 5
    clear = np.abs(found.point[:, 0]) > 2.5
    error = np.abs(albedo_of(level)[row, column] - colours(found.point))[clear].max(1)
    assert np.median(error) < 0.01 and np.percentile(error, 99) < 0.05


@pytest.mark.parametrize("largest", [64, 128, 256])
@pytest.mark.parametrize("seed", [None, 0])
def test_no_atlas_is_larger_than_graphics_cards_load(monkeypatch: pytest.MonkeyPatch, largest: int, seed: int | None) -> None:
    """Of a ball and of a rough one, whose charts are many and small: coarser than asked for, by no more than it must."""
    surface = make_sphere(4).reconstruction.surface
    if seed is not None:
        roughness = np.random.default_rng(seed).normal(size=(len(surface.vertices), 1))
        surface = replace(surface, vertices=surface.vertices * (1 + 0.02 * roughness))
    monkeypatch.setattr("mvps.texture.LARGEST_SIDE", largest)
    atlas, texels, _ = _charted(surface, surface, 1e-3)
    assert 0.8 * largest < max(atlas.height, atlas.width) <= largest and len(texels.face)
    fits = 4 * np.ptp(surface.vertices) / largest
    np.testing.assert_array_equal(_charted(surface, surface, fits)[0].uv, build_atlas(surface, fits).uv)


def test_normal_map_decodes_to_the_refined_normals(scene: SphereScene, baked: Textures) -> None:
    surface = scene.reconstruction.surface
    _, _, _, n, decoded = shown_by_a_viewer(baked)
    t = rasterise(baked.atlas.uv, baked.atlas.faces, baked.atlas.height, baked.atlas.width)
    expected = normalise((scene.reconstruction.material.normal[surface.faces[t.face]] * t.barycentric[..., None]).sum(1))
    angle = np.degrees(np.arccos(np.clip((decoded * expected).sum(1), -1, 1)))
    assert angle.max() < 1
    plain = np.degrees(np.arccos(np.clip((n * expected).sum(1), -1, 1)))
    assert plain.max() > 5


def test_roughness_and_specular_textures(scene: SphereScene, baked: Textures) -> None:
    row, column, _ = texel_positions(scene, baked.atlas)
    material = scene.reconstruction.material
    expected, reflected = glossy(material.specular_weight[:1], material.law)
    np.testing.assert_allclose(baked.roughness[row, column] / 255, expected[0], atol=0.5 / 255)
    f0 = linear_from_srgb(baked.specular_color[row, column]) * baked.specular_level
    assert np.abs(f0 / (reflected / baked.scale) - 1).max() < 0.01
    document, _ = glb_parts(glb_of(baked))
    extension = document["materials"][0]["extensions"]["KHR_materials_specular"]  # type: ignore[index]
    assert extension["specularColorFactor"][0] * 0.04 == pytest.approx(baked.specular_level)


def test_a_matt_surface_says_so(scene: SphereScene) -> None:
    r = scene.reconstruction
    n = len(r.material.albedo)
    matt = replace(r.material, specular_weight=np.zeros((n, 0)), sharpness=np.zeros(0))
    textures = bake(r.surface, matt, r.lights, scene.capture, 2)[0]
    document, _ = glb_parts(glb_of(textures))
    material = document["materials"][0]  # type: ignore[index]
    assert material["extensions"]["KHR_materials_specular"] == {"specularFactor": 0.0}
    assert material["extras"]["albedo_scale"] == textures.scale


def test_the_normal_map_shows_what_pixels_tell_beyond_vertices() -> None:
    """Vertices without waves, and pixels that show them in three views or four."""
    r, capture = make_sphere(seen_from=icosahedron().tolist())
    smooth = replace(r.material, normal=vertex_normals(r.surface))
    caster = RayCaster(r.surface)
    maps = []
    for view in capture.views:
        picture = np.full((*view.mask.shape, 3), np.nan, np.float32)
        picture[view.mask] = points_under(caster, r.material, view.camera, view.pixels).normal
        maps.append(picture)
    wanted, without, found = (
        bake(r.surface, material, r.lights, capture, 2, maps=of)[0].normal_map.astype(float)
        for material, of in ((r.material, []), (smooth, []), (smooth, maps))
    )
    assert np.abs(found - wanted).mean() < 0.1 * np.abs(without - wanted).mean()


def test_saturated_samples_and_outliers_do_not_count(scene: SphereScene) -> None:
    """A third of the samples of every pixel saturated, one more of them wrong: the albedo is still right."""
    r, view = scene.reconstruction, scene.capture.views[0]
    samples = view.samples.copy()
    samples[:, ::3] = 65535
    samples[:, 1] = 30000
    changed: View = replace(view, samples=samples)
    caster = RayCaster(r.surface)
    hit, albedo, known = pixel_albedo(caster, r.material, changed, r.lights.direction[0], r.lights.intensity[0])
    frontal = known & (hit[:, 0] > 0.7 * RADIUS)
    assert frontal.sum() > 1000
    assert np.median(np.abs(albedo[frontal] - RIGHT_SIDE)) < 0.01
    nothing = replace(view, samples=np.full_like(samples, 65535))
    assert not pixel_albedo(caster, r.material, nothing, r.lights.direction[0], r.lights.intensity[0])[2].any()


@given(st.integers(0, 1000))
def test_a_minority_of_outliers_is_ignored(seed: int) -> None:
    rng = np.random.default_rng(seed)
    diffuse = rng.uniform(0.2, 1, (3, 4, 12)).astype(np.float32)
    truth = rng.uniform(0.1, 1, (3, 4)).astype(np.float32)
    measured = truth[..., None] * diffuse
    usable = np.ones((4, 12), bool)
    measured[..., :2] += 0.5
    usable[:, 5], measured[..., 5] = False, 9
    np.testing.assert_allclose(_robust_albedo(measured, diffuse, usable), truth, rtol=0.05, atol=0.02)
    assert (_robust_albedo(measured, diffuse, np.zeros_like(usable)) == 0).all()


def test_photographs_that_say_nothing_of_a_pixel_change_nothing() -> None:
    """Its noise was averaged less well the more of them there were: 10 % more of it beside ninety."""
    rng = np.random.default_rng(0)
    diffuse = np.broadcast_to(rng.uniform(0.3, 1, (1000, 6)), (3, 1000, 6)).astype(np.float32)
    measured = (0.5 * diffuse + rng.normal(0, 0.02, diffuse.shape)).astype(np.float32)
    usable, silent = np.ones((1000, 6), bool), np.ones((3, 1000, 90), np.float32)
    alone = _robust_albedo(measured, diffuse, usable)
    among = np.concatenate([measured, 9 * silent], 2), np.concatenate([diffuse, silent], 2)
    beside = _robust_albedo(*among, np.concatenate([usable, np.zeros((1000, 90), bool)], 1))
    np.testing.assert_allclose(beside, alone, atol=1e-5)


def test_messages(scene: SphereScene) -> None:
    r = scene.reconstruction
    few = Lights(r.lights.direction[:2], r.lights.intensity[:2], True)
    with pytest.raises(ValueError, match=r"lights: wanted one per photograph of every view \(\[10, 10, .*given \[10, 10\]"):
        bake(r.surface, r.material, few, scene.capture, 2)
    for image in (np.zeros((2, 2, 5), np.uint8), np.zeros((2, 2), np.int64), np.zeros((0, 2), np.uint8)):
        with pytest.raises(ValueError, match="image: wanted"):
            png_bytes(image)
