"""Atlas, baking and the physically based material: laws of the charts, known colours, normals and roughness."""

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

from mvps.atlas import AXES, PADDING, STEEPEST, Atlas, build_atlas, padded, rasterise, vertex_tangents
from mvps.gltf import glb_bytes, metallic_roughness
from mvps.mesh import decimated, face_areas, face_normals, nearest, normalise, vertex_normals
from mvps.pbr import glossy, reflectance_scale, specular_energy, srgb_bytes
from mvps.rendering import photograph
from mvps.scene import Capture, Law, Lights, Material, Surface, View
from mvps.texture import Textures, _robust_albedo, bake, pixel_albedo, png_bytes
from mvps.visibility import RayCaster


def surface_of(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.array(mesh.vertices), np.array(mesh.faces))


def spring() -> Surface:
    """A tube around a helix: every projection along the helix' axis covers itself."""
    angle, around = np.meshgrid(np.linspace(0, 6 * np.pi, 160), np.linspace(0, 2 * np.pi, 12, endpoint=False), indexing="ij")
    radius = 10 + 2 * np.cos(around)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 2 * angle + 2 * np.sin(around)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(159), np.arange(12), indexing="ij")
    a, b, c, d = i * 12 + j, (i + 1) * 12 + j, i * 12 + (j + 1) % 12, (i + 1) * 12 + (j + 1) % 12
    return Surface(points, np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)]))


def crossed() -> Surface:
    """Two sheets that pass through each other and share one edge: each is above the other somewhere."""
    x, y = np.meshgrid(np.arange(-10.0, 11), np.arange(-10.0, 11), indexing="ij")
    i, j = np.meshgrid(np.arange(20), np.arange(20), indexing="ij")
    a = i * 21 + j
    faces = np.concatenate([np.stack([a, a + 21, a + 1], -1).reshape(-1, 3), np.stack([a + 21, a + 22, a + 1], -1).reshape(-1, 3)])
    sheets = [np.stack([x, y, slope * x], -1).reshape(-1, 3) for slope in (0.3, -0.3)]
    joined = faces + 441
    # The sheets meet along x = 0 in space; joining those vertices makes them one component.
    middle = 10 * 21 + np.arange(21)
    renamed = np.arange(882)
    renamed[middle + 441] = middle
    return Surface(np.concatenate(sheets), np.concatenate([faces, renamed[joined]]))


SHAPES = {
    "ball": surface_of(trimesh.creation.icosphere(subdivisions=4, radius=20)),
    "box": surface_of(trimesh.creation.box((20, 30, 5))),
    "ring": surface_of(trimesh.creation.torus(20, 6, major_sections=64, minor_sections=24)),
    "spring": spring(),
    "crossed": crossed(),
    "triangle": Surface(np.array([[0.0, 0, 0], [30, 0, 0], [0, 20, 5]]), np.array([[0, 1, 2]])),
    "with a flat face": Surface(np.array([[0.0, 0, 0], [30, 0, 0], [0, 20, 0], [15, 0, 0]]), np.array([[0, 1, 2], [0, 3, 1]])),
}


@pytest.fixture(params=SHAPES)
def shape(request: pytest.FixtureRequest) -> Surface:
    return SHAPES[request.param]


def on_texels(atlas: Atlas) -> np.ndarray:
    return (atlas.uv * (atlas.width, atlas.height))[atlas.faces]


def test_an_atlas_is_the_same_surface(shape: Surface) -> None:
    atlas = build_atlas(shape, 0.5)
    np.testing.assert_array_equal(atlas.vertex[atlas.faces], shape.faces)
    assert (atlas.uv > 0).all() and (atlas.uv < 1).all()


def test_charts_are_projections_and_never_mirrored(shape: Surface) -> None:
    """A face's area on the atlas, in texels, is its projected area: cosine to the axis times area, positive in the order of its corners."""
    texel = 0.5
    atlas = build_atlas(shape, texel)
    a, b, c = np.moveaxis(on_texels(atlas), 1, 0)
    u, v = b - a, c - a
    # v grows downwards, so a counter-clockwise face runs clockwise in (u, v).
    on_atlas = -(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    share = on_atlas * texel**2 / np.maximum(face_areas(shape), 1e-12)
    solid = face_areas(shape) > 1e-9
    assert share[solid].min() > STEEPEST - 1e-6 and share.max() < 1 + 1e-6
    assert (share[solid] > 0.8 * (face_normals(shape) @ AXES.T).max(1)[solid] - 0.55).all()


def test_no_texel_has_two_owners(shape: Surface) -> None:
    """Slow twin of the rasteriser: count, face by face, the texel centres strictly inside."""
    atlas = build_atlas(shape, 0.5)
    count = np.zeros((atlas.height, atlas.width), int)
    for corners in on_texels(atlas):
        low, high = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int)
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        sides = []
        for k in range(3):
            p, q = corners[k], corners[(k + 1) % 3]
            sides.append((q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]))
        inside = (np.array(sides) < -1e-6).all(0)
        count[low[1] : high[1], low[0] : high[0]] += inside
    assert count.max() == 1
    owned = rasterise(atlas.uv, atlas.faces, atlas.height, atlas.width)
    filled = np.zeros_like(count)
    filled[owned.row, owned.column] += 1
    assert filled.max() == 1 and (filled >= count).all()


def test_texels_lie_where_their_face_says(shape: Surface) -> None:
    atlas = build_atlas(shape, 0.5)
    t = rasterise(atlas.uv, atlas.faces, atlas.height, atlas.width)
    uv = (atlas.uv[atlas.faces[t.face]] * t.barycentric[..., None]).sum(1)
    np.testing.assert_allclose(uv * (atlas.width, atlas.height), np.stack([t.column, t.row], -1) + 0.5, atol=1e-5)


def test_charts_keep_their_distance() -> None:
    """No two charts come nearer than the padding."""
    atlas = build_atlas(SHAPES["spring"], 0.5)
    t = rasterise(atlas.uv, atlas.faces, atlas.height, atlas.width)
    owner = np.full((atlas.height, atlas.width), -1)
    owner[t.row, t.column] = atlas.chart[t.face]
    for shift in [(0, k) for k in range(1, PADDING)] + [(k, 0) for k in range(1, PADDING)]:
        moved = np.roll(owner, shift, (0, 1))
        assert ((owner == moved) | (owner < 0) | (moved < 0)).all()


def test_texel_size_scales_with_the_world() -> None:
    small = build_atlas(SHAPES["ring"], 0.5)
    large = build_atlas(Surface(SHAPES["ring"].vertices * 1024, SHAPES["ring"].faces), 512.0)
    assert (small.height, small.width) == (large.height, large.width)
    np.testing.assert_allclose(small.uv, large.uv, atol=1e-9)
    with pytest.raises(ValueError, match="texel: wanted a positive length in world units, given 0"):
        build_atlas(SHAPES["ring"], 0)


def test_tangents_follow_u() -> None:
    """The tangent is the direction in which u alone grows on the surface, made perpendicular to the normal."""
    shape = SHAPES["ring"]
    atlas = build_atlas(shape, 0.5)
    normal = vertex_normals(shape)
    tangent = vertex_tangents(atlas, normal)
    np.testing.assert_allclose((tangent * normal[atlas.vertex]).sum(-1), 0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(tangent, axis=-1), 1)
    x, uv = shape.vertices[shape.faces], on_texels(atlas)
    du, dx = uv[:, 1:] - uv[:, :1], x[:, 1:] - x[:, :1]
    along_u, along_v = np.moveaxis(np.linalg.solve(du, dx), 1, 0)
    faces = atlas.faces[:, 0]
    n = normal[atlas.vertex][faces]
    own = normalise(along_u - (along_u * n).sum(-1, keepdims=True) * n)
    # Faces are up to half their bend off the vertices' planes: 7 degrees here.
    assert np.degrees(np.arccos(np.clip((tangent[faces] * own).sum(-1), -1, 1))).mean() < 1.5
    assert ((tangent[faces] * own).sum(-1) > 0.9).all()
    # glTF: the bitangent normal x tangent points up in the image.
    assert ((np.cross(normal[atlas.vertex], tangent)[faces] * along_v).sum(-1) < 0).all()


def test_a_normal_along_the_bitangent_still_has_a_tangent() -> None:
    shape = SHAPES["triangle"]
    atlas = build_atlas(shape, 0.5)
    normal = atlas.bitangent[np.argsort(atlas.vertex)]
    tangent = vertex_tangents(atlas, normal)
    np.testing.assert_allclose(np.linalg.norm(tangent, axis=-1), 1)
    np.testing.assert_allclose((tangent * normal[atlas.vertex]).sum(-1), 0, atol=1e-9)


def test_padding_repeats_the_nearest_texel() -> None:
    image, filled = np.zeros((1, 20), np.uint8), np.zeros((1, 20), bool)
    image[0, 5], filled[0, 5] = 7, True
    expected = np.where(np.abs(np.arange(20) - 5) <= PADDING, 7, 0)
    np.testing.assert_array_equal(padded(image, filled)[0], expected)


# ------------------------------------------------------------------------------------------------ material


@pytest.mark.parametrize("weight", [0.01, 3.0])
@pytest.mark.parametrize("sharpness", [8.0, 32.0, 128.0, 1000.0, 1e4])
def test_roughness_and_strength_of_one_lobe(sharpness: float, weight: float) -> None:
    """A narrow lobe of microfacets is GGX of its alpha; a Gaussian one has about that of one peak and one integral."""
    rough, reflected = glossy(np.array([[weight]]), Law((sharpness,)))
    assert rough[0] ** 2 == pytest.approx(np.sqrt(2 / sharpness), rel=0.2)
    assert reflected[0] == pytest.approx(specular_energy(np.array([[weight]]), np.array([sharpness]))[0], rel=0.3)
    if sharpness > 100:
        rough, _ = glossy(np.array([[weight]]), Law((sharpness,), microfacet=True))
        assert rough[0] ** 2 == pytest.approx(np.sqrt(4 / (4 + sharpness)), rel=0.05)


def gltf_times_pi(light: np.ndarray, view: np.ndarray, normal: np.ndarray, rough: float, f0: float) -> np.ndarray:
    """pi F0 D V of glTF 2.0, appendix B.3, word by word, times n . l, for lights (n, 3)."""
    half = normalise(light + view)
    alpha = rough**2
    n_dot_h, n_dot_l, n_dot_v = half @ normal, light @ normal, view @ normal
    D = alpha**2 / (np.pi * (n_dot_h**2 * (alpha**2 - 1) + 1) ** 2)
    V = 1 / (n_dot_l + np.sqrt(alpha**2 + (1 - alpha**2) * n_dot_l**2)) / (n_dot_v + np.sqrt(alpha**2 + (1 - alpha**2) * n_dot_v**2))
    product: np.ndarray = np.pi * f0 * D * V * n_dot_l
    return product


def test_no_other_roughness_comes_nearer_to_the_lobes() -> None:
    """Pictures of a ball under lights around its camera: an independent sampling of what the fit is made for."""
    rng = np.random.default_rng(0)
    weight, law = np.array([[0.4, 0.7]]), Law((20.0, 120.0))
    rough, reflected = glossy(weight, law)
    disk = rng.uniform(-1, 1, (4000, 2))
    disk = disk[(disk**2).sum(1) < 0.97]
    normals = np.column_stack([disk, np.sqrt(1 - (disk**2).sum(1))])
    view = np.array([0.0, 0, 1])
    tilt, turn = np.arccos(rng.uniform(np.cos(np.radians(50)), 1, len(normals))), rng.uniform(0, 2 * np.pi, len(normals))
    lights = np.column_stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    lit = (lights * normals).sum(1) > 0
    lights, normals = lights[lit], normals[lit]
    h_dot_n = (normalise(lights + view) * normals).sum(1)
    lobes = np.exp(np.array(law.sharpness) * (h_dot_n[:, None] - 1)) @ weight[0] * (lights * normals).sum(1)

    def error(roughness: float, f0: float) -> float:
        theirs = np.array([gltf_times_pi(light[None], view, n, roughness, f0)[0] for light, n in zip(lights, normals, strict=True)])
        return float(np.sqrt(((theirs - lobes) ** 2).mean() / (lobes**2).mean()))

    best = error(rough[0], reflected[0, 0])
    assert best < 0.15
    for change in (0.9, 1.1):
        assert error(change * rough[0], reflected[0, 0]) > best and error(rough[0], change * reflected[0, 0]) > best


def test_no_gloss_is_rough_and_broad_lobes_stay_in_range() -> None:
    assert glossy(np.zeros((1, 2)), Law((3.0, 30.0)))[0] == 1
    rough, reflected = glossy(np.zeros((1, 0)), Law(()))
    assert rough == 1 and not reflected.any()
    assert 0.8 < glossy(np.ones((1, 1)), Law((0.1,)))[0][0] <= 1
    assert 0.1 <= glossy(np.ones((1, 1)), Law((1e9,)))[0][0] < 0.2


def test_colour_weights_tint_the_reflection() -> None:
    law = Law((16.0, 64.0))
    weight = np.array([[[1.0, 0.5, 0.25], [2.0, 1.0, 0.5]], [[0.0, 0, 0], [0.0, 0, 0]]])
    rough, reflected = glossy(weight, law)
    np.testing.assert_allclose(reflected / reflected[0, 0], [[1, 0.5, 0.25], [0, 0, 0]])
    plain, grey = glossy(weight[:, :, 0] * 7 / 12, law)
    np.testing.assert_allclose(plain, rough)
    np.testing.assert_allclose(grey.mean(1), reflected.mean(1))


@given(st.floats(1e-6, 1e6))
def test_exposure_does_not_change_the_colours(factor: float) -> None:
    rng = np.random.default_rng(0)
    n = 50
    normal = np.tile([0.0, 0, 1], (n, 1))
    a = Material(normal, rng.uniform(0, 1, (n, 3)), rng.uniform(0, 1, (n, 1)), np.array([20.0]), np.ones(n))
    b = replace(a, albedo=a.albedo * factor, specular_weight=a.specular_weight * factor)
    assert reflectance_scale(b) == pytest.approx(factor * reflectance_scale(a))
    black = replace(a, albedo=np.zeros((n, 3)), specular_weight=np.zeros((n, 1)))
    assert reflectance_scale(black) == 1


def test_srgb_round_trip_and_known_values() -> None:
    codes = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(srgb_bytes(linear_from_srgb(codes)), codes)
    # IEC 61966-2-1: middle grey of 18 % and 21.4 %; out of range is clipped.
    np.testing.assert_array_equal(srgb_bytes(np.array([-1, 0, 0.18, 0.214041, 1, 7])), [0, 0, 118, 127, 255, 255])


# ------------------------------------------------------------------------------------------------ baking


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


def test_messages(scene: SphereScene) -> None:
    r = scene.reconstruction
    few = Lights(r.lights.direction[:2], r.lights.intensity[:2], True)
    with pytest.raises(ValueError, match=r"lights: wanted one per photograph of every view \(\[10, 10, .*given \[10, 10\]"):
        bake(r.surface, r.material, few, scene.capture, 2)
    for image in (np.zeros((2, 2, 5), np.uint8), np.zeros((2, 2), np.int64), np.zeros((0, 2), np.uint8)):
        with pytest.raises(ValueError, match="image: wanted"):
            png_bytes(image)
