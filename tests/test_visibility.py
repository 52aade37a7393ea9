"""Rays against known shapes, a slow twin, and an independent ray caster."""

import numpy as np
import pytest
import trimesh

from mvps.mesh import normalise, vertex_normals
from mvps.scene import Surface
from mvps.visibility import RayCaster, cast_shadow, interpolate


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
