"""Rays against known shapes, a slow twin, and an independent ray caster."""

import numpy as np
import pytest
import trimesh

from mvps.mesh import normalise, vertex_normals
from mvps.scene import Camera, Surface
from mvps.visibility import RayCaster, cast_shadow, distances_to_shade, interpolate, shade_of, visible_vertices


def sphere(radius: float = 1.0, centre: tuple[float, float, float] = (0, 0, 0)) -> Surface:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return Surface(np.array(ball.vertices) + centre, np.array(ball.faces))


def random_rays(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    origins = 3 * normalise(rng.normal(size=(n, 3)))
    # Aimed past the centre by about the sphere's radius: some hit, some miss.
    return origins, normalise(rng.normal(0, 0.8, (n, 3)) - origins)


def brute_force(surface: Surface, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance of the first hit by solving every ray against every face."""
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    first = np.full(len(origins), np.inf)
    for i, (o, d) in enumerate(zip(origins, directions, strict=True)):
        A = np.stack([b - a, c - a, np.broadcast_to(-d, a.shape)], -1)
        with np.errstate(all="ignore"):
            u, v, t = np.linalg.solve(A, (o - a)[..., None])[..., 0].T
        ok = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        first[i] = t[ok].min() if ok.any() else np.inf
    return first


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_first_hits_agree_with_a_slow_twin_in_any_unit(unit: float) -> None:
    ball = sphere()
    origins, directions = random_rays(200, 0)
    slow = brute_force(ball, origins, directions)
    hits = RayCaster(Surface(unit * ball.vertices, ball.faces)).first_hits(unit * origins, directions)
    assert np.array_equal(np.isfinite(slow), hits.face >= 0) and 5 < (hits.face >= 0).sum() < 195
    assert np.allclose(hits.distance[hits.face >= 0] / unit, slow[np.isfinite(slow)], atol=1e-5)


def test_interpolating_the_vertices_gives_the_hit_point() -> None:
    ball = sphere()
    origins, directions = random_rays(500, 1)
    caster = RayCaster(ball)
    hits = caster.first_hits(origins, directions)
    on = hits.face >= 0
    points = origins[on] + hits.distance[on, None] * directions[on]
    assert np.allclose(interpolate(ball, hits, ball.vertices)[on], points, atol=1e-5)
    assert np.array_equal(caster.occluded(origins, directions), on)


def test_a_small_sphere_casts_its_round_shadow_on_a_big_one() -> None:
    big, small = sphere(), sphere(0.3, (0, 0, 2))
    both = Surface(np.concatenate([big.vertices, small.vertices]), np.concatenate([big.faces, small.faces + len(big.vertices)]))
    light = np.array([[0.0, 0.0, 1.0]])
    shadow = cast_shadow(RayCaster(both), np.arange(len(big.vertices)), light)[:, 0]
    facing = big.vertices[:, 2] > 0.2
    distance = np.linalg.norm(big.vertices[:, :2], axis=1)
    assert shadow[facing & (distance < 0.28)].all() and not shadow[facing & (distance > 0.32)].any()
    # Below the horizon the shadow is attached, not cast.
    assert not shadow[big.vertices[:, 2] < -0.1].any()


def test_beside_a_shadow_and_deep_in_it_are_some_edges_from_its_border() -> None:
    big, small = sphere(), sphere(0.3, (0, 0, 2))
    both = Surface(np.concatenate([big.vertices, small.vertices]), np.concatenate([big.faces, small.faces + len(big.vertices)]))
    light = np.array([[0.0, 0.0, 1.0]])
    caster, chosen = RayCaster(both), np.arange(0, len(big.vertices), 3)
    shade = shade_of(caster, chosen, light, 2)
    distance = np.linalg.norm(big.vertices[chosen, :2], axis=1)
    facing = big.vertices[chosen, 2] > 0.2
    # An edge of the big one is 0.07 long, a row of them 0.06 wide.
    assert shade.beside[facing & (distance < 0.4), 0].all() and not shade.beside[facing & (distance > 0.47), 0].any()
    assert shade.deep[facing & (distance < 0.13), 0].all() and not shade.deep[facing & (distance > 0.2), 0].any()
    assert not shade.deep[~facing].any()


def test_what_is_beside_hidden_vertices_is_seen_only_without_a_margin() -> None:
    big, small = sphere(), sphere(0.3, (0, 0, 2))
    both = Surface(np.concatenate([big.vertices, small.vertices]), np.concatenate([big.faces, small.faces + len(big.vertices)]))
    camera = Camera(np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]), np.diag([1.0, -1, -1]), np.array([0, 0, 1000.0]), 100, 100)
    caster, count = RayCaster(both), len(big.vertices)
    # From so far away rays are parallel.
    seen, clear = (visible_vertices(caster, camera, margin)[:count] for margin in (0, 1))
    distance = np.linalg.norm(big.vertices[:, :2], axis=1)
    facing = big.vertices[:, 2] > 0.2
    lost = seen & ~clear
    assert seen[facing & (distance > 0.32)].all() and not seen[facing & (distance < 0.28)].any()
    assert lost.sum() > 10 and distance[lost].max() < 0.4 and not clear[facing & (distance < 0.32)].any()
    # What only turns away hides nothing beside it.
    assert np.array_equal(visible_vertices(RayCaster(big), camera, 0), visible_vertices(RayCaster(big), camera, 2))


@pytest.mark.parametrize("tilt", [10, 25, 45, 70])
def test_shadows_begin_where_they_do_under_grazing_light(tilt: float) -> None:
    """A wall on a floor: its shadow ends height / tan(elevation) away, to within the mesh's edges."""
    edge, height = 0.1, 1.0
    x, y = np.meshgrid(np.arange(0, 8, edge), np.arange(0, 1, edge), indexing="ij")
    floor = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    n, rows = y.shape[1], len(x)
    corner = (np.arange(rows - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([corner, corner + n, corner + 1], 1), np.stack([corner + 1, corner + n, corner + n + 1], 1)])
    wall = np.array([[-0.05, -9, -1], [-0.05, 9, -1], [-0.05, 9, height], [-0.05, -9, height]])
    k = len(floor)
    surface = Surface(np.concatenate([floor, wall]), np.concatenate([faces, [[k, k + 1, k + 2], [k, k + 2, k + 3]]]))
    light = np.array([[-np.cos(np.radians(tilt)), 0, np.sin(np.radians(tilt))]])
    shadow = cast_shadow(RayCaster(surface), np.arange(k), light)[:, 0]
    end = floor[shadow, 0].max() + 0.05
    assert abs(end - height / np.tan(np.radians(tilt))) < (1 + 0.4 / np.tan(np.radians(tilt))) * edge


def test_a_convex_shape_casts_no_shadow_on_itself() -> None:
    ball = sphere()
    lights = normalise(np.random.default_rng(2).normal(size=(20, 3)))
    normal = vertex_normals(ball)
    shadow = cast_shadow(RayCaster(ball), np.arange(len(normal)), lights)
    assert shadow.mean() < 0.002


@pytest.mark.independent
def test_open3d_sees_the_same() -> None:
    import open3d

    ball = sphere()
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(ball.vertices.astype(np.float32), ball.faces.astype(np.uint32))
    origins, directions = random_rays(20000, 3)
    theirs = scene.cast_rays(open3d.core.Tensor(np.column_stack([origins, directions]).astype(np.float32)))["t_hit"].numpy()
    ours = RayCaster(ball).first_hits(origins, directions).distance
    same = np.isfinite(theirs) == np.isfinite(ours)
    both = np.isfinite(theirs) & np.isfinite(ours)
    assert same.mean() > 0.9995 and np.abs(theirs[both] - ours[both]).max() < 1e-3


def test_distances_to_what_hides_a_light() -> None:
    """Under a ball that floats over another, from the lower one's top: where the ray enters the upper one, and nothing elsewhere."""
    low, high = sphere(), sphere(0.5, (0, 0, 3))
    both = Surface(np.concatenate([low.vertices, high.vertices]), np.concatenate([low.faces, high.faces + len(low.vertices)]))
    lights = normalise(np.array([[0, 0, 1.0], [0.05, 0, 1.0], [1.0, 0, 1.0], [0, 0, -1.0]]))
    caster, top = RayCaster(both), np.array([int(low.vertices[:, 2].argmax())])
    found = distances_to_shade(caster, top, lights)[0]
    start = both.vertices[top[0]] + caster.offset * caster.vertex_normals[top[0]]
    along = lights[:2] @ ((0, 0, 3) - start)
    entered = along - np.sqrt(0.25 - (((0, 0, 3) - start) ** 2).sum() + along**2)
    assert np.allclose(found[:2], entered, atol=5e-3) and np.isinf(found[2:]).all()
    assert np.array_equal(np.isfinite(found), cast_shadow(caster, top, lights)[0])
