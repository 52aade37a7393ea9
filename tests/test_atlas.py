"""mvps.atlas: laws of the charts on shapes that make them hard."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from mvps.atlas import AXES, PADDING, STEEPEST, Atlas, build_atlas, padded, rasterise, vertex_tangents
from mvps.mesh import face_areas, face_normals, normalise, vertex_normals
from mvps.scene import Surface


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
