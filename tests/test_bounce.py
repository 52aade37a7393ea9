"""Inter-reflection: laws of light between surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from mvps.bounce import PATCH_EDGES, Gather, Sources, gather, gathered, interpolation, lit_by, sources_on
from mvps.gleam import Senders, terms_of_points
from mvps.mesh import mean_edge_length, vertex_normals
from mvps.scene import Law, Surface
from mvps.visibility import RayCaster, cast_shadow


def occupied(of: Gather) -> np.ndarray:
    """(n,) share of the hemisphere of each patch that other surfaces take up."""
    return np.asarray(of.S.sum(1))[:, 0]


def ball(radius: float = 10.0) -> Surface:
    made = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return Surface(np.array(made.vertices), np.array(made.faces))


def hollow() -> Surface:
    """The inside of a ball: faces turned inwards."""
    outside = ball()
    return Surface(outside.vertices, outside.faces[:, ::-1])


def coarse_sources(surface: Surface, albedo: np.ndarray) -> Sources:
    return sources_on(gather(surface, *(2 * [PATCH_EDGES * mean_edge_length(surface)])), surface, albedo)


def under(sources: Sources, direction: np.ndarray, bounce: float) -> np.ndarray:
    """G under lights direction (lights, 3)."""
    return gathered(sources, lit_by(sources.of, direction), bounce)


def test_a_convex_body_sends_itself_nothing() -> None:
    sources = coarse_sources(ball(), np.ones(2562))
    assert occupied(sources.of).max() == 0
    assert under(sources, np.array([[0, 0, 1.0]]), 1.0).max() == 0


def test_inside_a_closed_surface_other_surfaces_fill_every_hemisphere() -> None:
    # Rays start beside the surface and may leave between facets only there.
    assert np.abs(occupied(gather(hollow(), 3.0, 3.0)) - 1).max() < 0.02


def test_every_place_in_a_part_of_a_ball_sees_the_same_share_of_it_and_its_lit_parts() -> None:
    """Between two places of a ball's inside the form factor is that of their areas, wherever they are: h / 2 R for all of a cap of height
    h; and under any light the whole cap receives the same from its walls (the integrating sphere)."""
    inside = hollow()
    low = (inside.vertices[inside.faces][..., 2] < 0).all(1)
    used, number = np.unique(inside.faces[low], return_inverse=True)
    cap = Surface(inside.vertices[used], number.reshape(-1, 3))
    of = gather(cap, 1.0, 1.0)
    place = cap.vertices[of.vertex]
    deep = place[:, 2] < -1.0
    height = 10.0 + cap.vertices[:, 2].max()
    assert abs(occupied(of)[deep].mean() / (height / 20.0) - 1) < 0.03
    light = np.array([[0.6, 0.0, 0.8]])
    dark = cast_shadow(of.caster, of.vertex, light)[:, 0]
    received = under(sources_on(of, cap, np.ones(len(cap.vertices))), light, 0.0)[:, 0]
    assert (deep & dark).sum() > 50 and (deep & ~dark).sum() > 50
    assert abs(received[deep & dark].mean() / received[deep & ~dark].mean() - 1) < 0.04


def test_bounces_in_a_closed_white_furnace_add_up_to_the_geometric_series() -> None:
    room = hollow()
    sources = coarse_sources(room, np.full(len(room.vertices), 0.5))
    # Any first light L, the same everywhere, gives S (L + r L + r^2 L) for three bounces with reflectance r = bounce * albedo.
    L = np.ones(len(sources.albedo), np.float32)
    expected = L + 0.4 * L + 0.16 * L
    G = sources.of.S @ L
    for _ in range(2):
        G = sources.of.S @ (L + 0.4 * G)
    assert np.abs(G - expected).max() < 0.05
    assert under(sources, np.array([[0, 0, 1.0]]), 0.8).shape == (len(L), 1)


def test_two_plates_that_face_each_other_light_each_other_by_their_view_factor() -> None:
    """The middle of a square plate sees a parallel one of side 2 c at distance c with a view factor of 0.554 (Howell, B-3)."""
    plates = []
    for z in (-5.0, 5.0):
        plate = trimesh.creation.box((20, 20, 0.1))
        for _ in range(4):
            plate = plate.subdivide()
        plate.apply_translation([0, 0, z])
        plates.append(plate)
    both = trimesh.util.concatenate(plates)
    of = gather(Surface(np.array(both.vertices), np.array(both.faces)), 2.0, 2.0)
    place = of.caster.surface.vertices[of.vertex]
    inwards = (np.abs(place[:, :2]).max(1) < 1.5) & (of.normal[:, 2] * place[:, 2] < 0)
    # Ten apart: a side of 20 is twice the distance.
    assert inwards.sum() > 0 and abs(occupied(of)[inwards].mean() - 0.554) < 0.05


def test_colours_mix_channel_by_channel_and_interpolate_to_points() -> None:
    room = hollow()
    albedo = np.tile([0.2, 0.4, 0.8], (len(room.vertices), 1))
    sources = coarse_sources(room, albedo)
    # Lamps within: from without nothing lights a closed room.
    sent = terms_of_points(Senders(sources, Law(())), np.array([[0, 0, 1.0], [1.0, 0, 0]]), np.zeros(3))
    G = sent.on(np.arange(len(sources.albedo)))[:, :, 0]
    assert G.shape == (len(sources.albedo), 2, 3) and G.min() > 0
    assert np.allclose(G[..., 1], 2 * G[..., 0], rtol=1e-5) and np.allclose(G[..., 2], 4 * G[..., 0], rtol=1e-5)
    values = sent.at(room.vertices, vertex_normals(room))[:, :, 0]
    assert values.shape == (len(room.vertices), 2, 3)
    assert (values >= 0.999 * G.min((0, 1))).all() and (values <= 1.001 * G.max((0, 1))).all()


@pytest.mark.parametrize("patches", [1, 2, 3, 4])
def test_a_mesh_of_few_patches(patches: int) -> None:
    """Triangles side by side, each about as large as a patch: all have one albedo, and weights of every point sum to 1."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    vertices = np.concatenate([corners + np.array([10 * k, 0, 0]) for k in range(patches)])
    surface = Surface(vertices, np.arange(3 * patches).reshape(-1, 3))
    sources = sources_on(gather(surface, 10.0, 10.0), surface, np.full(3 * patches, 0.5))
    assert sources.albedo.shape == (patches,)
    np.testing.assert_allclose(sources.albedo, 0.5, rtol=1e-6)
    weights = interpolation(sources.of, vertices + 0.1, vertex_normals(surface))
    np.testing.assert_allclose(np.asarray(weights.sum(1)), 1, rtol=1e-6)
    assert (np.diff(weights.indptr) == patches).all()


def test_patches_are_the_same_traced_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = gather(hollow(), 2.0, 2.0)
    monkeypatch.setattr("mvps.bounce.PATCHES_AT_ONCE", 7)
    parts = gather(hollow(), 2.0, 2.0)
    assert len(whole.normal) > 70 and (whole.S != parts.S).nnz == 0
    for name in ("row", "start", "column", "along"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))


def test_patches_are_small_where_light_from_other_parts_counts() -> None:
    """A closed ball's outside sends itself nothing, its inside receives all."""
    size, small = 6.0, 3.0
    assert len(gather(ball(), size, small).vertex) == len(gather(ball(), size, size).vertex)
    assert (
        len(gather(hollow(), size, small).vertex) == len(gather(hollow(), small, small).vertex) > len(gather(hollow(), size, size).vertex)
    )


def test_shadows_are_traced_once_for_a_light_and_of_patches_that_send_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two balls: their far sides meet no ray. In whatever order lights are asked for, they say what rays say."""
    two = [trimesh.creation.icosphere(subdivisions=3, radius=1.0).apply_translation((x, 0, 0)) for x in (-1.5, 1.5)]
    both = trimesh.util.concatenate(two)
    of = gather(Surface(np.array(both.vertices), np.array(both.faces)), 0.3, 0.3)
    lights = np.array([[0.0, 0, 1], [0.8, 0, 0.6], [0, -0.6, 0.8], [-0.6, 0.64, 0.48]])
    wanted = (np.maximum(of.normal @ lights.T, 0) * ~cast_shadow(of.caster, of.vertex, lights)).astype(np.float32)
    traced: list[int] = []

    def counted(caster: RayCaster, vertices: np.ndarray, direction: np.ndarray) -> np.ndarray:
        traced.append(len(direction))
        assert len(vertices) == len(of.sending)
        return cast_shadow(caster, vertices, direction)

    monkeypatch.setattr("mvps.bounce.cast_shadow", counted)
    quiet = np.setdiff1d(np.arange(len(of.normal)), of.sending)
    assert len(quiet) > 0 and of.S[:, quiet].nnz == 0
    for some in ([2], [0, 2], [3, 1, 0], [0, 1, 2, 3]):
        lit = lit_by(of, lights[some])
        assert np.array_equal(lit[of.sending], wanted[of.sending][:, some]) and not lit[quiet].any()
    assert lit_by(of, lights[:0]).shape == (len(of.normal), 0)
    assert traced == [1, 1, 2] and wanted[of.sending].any() and not wanted[of.sending].all()
