"""Parts thinner than grids and meshes hold are found from the masks, taken out of them beforehand, and joined with the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import igl
import numpy as np
import pytest
import trimesh

from mvps.camera import surface_pixel
from mvps.hull import hull_grid, hull_of_masks
from mvps.joint.refine import Refined
from mvps.mesh import normalise, vertex_normals
from mvps.progress import Progress
from mvps.scene import Capture, Float, Law, Lights, Material, NormalMap, Surface, View
from mvps.synthetic.scene import make_cameras
from mvps.synthetic.settings import SceneSettings
from mvps.thin import _Bare, _found, _needed, _Piece, joined, with_thin_parts, without_thin_parts
from mvps.visibility import RayCaster, camera_hits

SETTINGS = SceneSettings(views=8, size=96, extent=2.0)
RADIUS = 0.6
DIRECTIONS = normalise(np.array([[1, 0.2, -0.4], [-0.8, 1, 0.3], [-0.3, -1, 0.5], [0.5, -0.7, -0.5]]))
PIXEL = 2 / (0.9 * SETTINGS.size)
"""Of an object that reaches to 1 from the origin, about."""


def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)


def rods(width: float) -> list[trimesh.Trimesh]:
    """Width in pixels, from within the ball to 1."""
    return [trimesh.creation.cylinder(width * PIXEL / 2, sections=24, segment=(0.5 * d, d)) for d in DIRECTIONS]


def sheets(width: float) -> list[trimesh.Trimesh]:
    """Two plates that stand on the ball, this many pixels thick."""
    made = []
    for side in (1, -1):
        plate = trimesh.creation.box((0.5, width * PIXEL, 0.6))
        plate.apply_translation((0.7 * side, 0, 0))
        made.append(plate)
    return made


def photographed(parts: Sequence[trimesh.Trimesh]) -> Capture:
    """Masks of the parts together; photographs are black."""
    whole = trimesh.util.concatenate(list(parts))
    surface = Surface(np.array(whole.vertices), np.array(whole.faces))
    caster, views = RayCaster(surface), []
    for i, camera in enumerate(make_cameras(SETTINGS, surface.vertices)):
        everywhere = np.argwhere(np.ones((camera.height, camera.width), bool))
        mask = (camera_hits(caster, camera, everywhere).face >= 0).reshape(camera.height, camera.width)
        views.append(View(f"view_{i + 1:02d}", camera, mask, np.zeros((int(mask.sum()), 1, 3), np.uint16), 1.0, 65535, (1,)))
    return Capture("thin", tuple(views))


def as_surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.array(mesh.vertices), np.array(mesh.faces))


def solved(surface: Surface, capture: Capture) -> Refined:
    """What Stage II might have ended with: white above, black below."""
    n = len(surface.vertices)
    albedo = np.where(surface.vertices[:, 2:] > 0, 1.0, 0.1).repeat(3, 1)
    material = Material(vertex_normals(surface), albedo, np.full((n, 1), 0.2), np.array([20.0]), np.full(n, 0.9))
    pixels = [len(view.pixels) for view in capture.views]
    towards = [np.tile(-view.camera.rotation[2], (count, 1)) for view, count in zip(capture.views, pixels, strict=True)]
    maps = tuple(NormalMap(t, np.ones((len(t), 3)), np.full(len(t), 0.8)) for t in towards)
    lights = Lights(tuple(t[:1] for t in towards), (np.ones((1, 3)),) * len(towards), False)
    return Refined(surface, material, lights, maps, Law((20.0,)), [], [], "converged", "", *np.full((2, n), 0.01))


def away(points: Float, surface: Surface) -> Float:
    """Distance (n,) of points (n, 3) from a surface, pixels."""
    found: Float = np.sqrt(igl.point_mesh_squared_distance(points, surface.vertices, surface.faces)[0]) / PIXEL
    return found


def lost(before: Capture, after: Capture) -> int:
    return sum(int(a.mask.sum() - b.mask.sum()) for a, b in zip(before.views, after.views, strict=True))


@pytest.mark.parametrize("width", [1.0, 1.5, 2.0])
def test_rods_are_found_and_nothing_else(width: float) -> None:
    capture = photographed([ball(), *rods(width)])
    assert surface_pixel(capture, as_surface(ball())) == pytest.approx(PIXEL, rel=0.1)
    surface = hull_of_masks(capture, hull_grid(capture))
    _, pieces = _found(capture, surface)
    assert len(pieces) == len(DIRECTIONS)
    of_rods = as_surface(trimesh.util.concatenate(rods(width)))
    for piece in pieces:
        # Beside the ball pieces hold what masks leave of the corner there.
        reach = np.linalg.norm(piece.surface.vertices, axis=1)
        assert away(piece.surface.vertices[reach > RADIUS + 3 * PIXEL], of_rods).max() < 1 and reach.max() > 1 - 2 * PIXEL


@pytest.mark.parametrize("width", [1.0, 2.0])
def test_masks_lose_rods_and_what_is_left_is_the_ball(width: float) -> None:
    capture = photographed([ball(), *rods(width)])
    rest, alone = without_thin_parts(capture, Progress()), photographed([ball()])
    of_rods = lost(capture, alone_under(capture))
    assert 0.6 * of_rods < lost(capture, rest) <= of_rods
    for view in rest.views:
        assert len(view.samples) == view.mask.sum()
    assert without_thin_parts(alone, Progress()) is alone


def alone_under(capture: Capture) -> Capture:
    """The ball alone, by the cameras of a capture."""
    caster, views = RayCaster(as_surface(ball())), []
    for view in capture.views:
        mask = np.zeros_like(view.mask)
        mask[view.mask] = camera_hits(caster, view.camera, view.pixels).face >= 0
        views.append(replace(view, mask=mask, samples=view.samples[mask[view.mask]]))
    return Capture(capture.name, tuple(views))


def test_sides_of_sheets_stay() -> None:
    """Of what is wide in a mask photographs tell."""
    capture = photographed([ball(), *sheets(1.5)])
    rest = without_thin_parts(capture, Progress())
    assert lost(capture, rest) < 0.2 * lost(capture, alone_under(capture))


@pytest.mark.parametrize("width", [1.0, 2.0, 3.0])
def test_a_result_has_the_rods_that_it_lacked(width: float) -> None:
    capture = photographed([ball(), *rods(width)])
    rest = without_thin_parts(capture, Progress())
    before = solved(as_surface(ball()), rest)
    found, said = with_thin_parts(before, rest, capture)
    assert len(said) == 1 and said[0].mended and "thinner" in said[0].text
    mesh = trimesh.Trimesh(found.surface.vertices, found.surface.faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    ends, _ = trimesh.sample.sample_surface(trimesh.util.concatenate(rods(width)), 2000, seed=0)
    outside = np.linalg.norm(ends, axis=1) > RADIUS + 2 * PIXEL
    assert np.quantile(away(ends[outside], found.surface), 0.95) < 1 < np.median(away(ends[outside], before.surface))
    # Away from the rods all is as it was.
    distance = np.linalg.norm(found.surface.vertices[:, None] - before.surface.vertices[None], axis=2).min(1)
    old = distance == 0
    assert old.sum() > 0.9 * len(before.surface.vertices)
    assert np.allclose(found.material.confidence[old], 0.9) and not found.material.confidence[~old].any()
    for left in (found.unexplained, found.in_light):
        assert np.isnan(left[~old]).all() and np.allclose(left[old], 0.01)
    for maps, view, less in zip(found.maps, capture.views, rest.views, strict=True):
        assert len(maps.normal) == len(view.pixels)
        assert np.allclose(maps.confidence, np.where(less.mask[view.mask], 0.8, 0))


def test_a_result_that_lacks_nothing_stays() -> None:
    capture = photographed([ball(), *rods(2.0)])
    whole = joined(as_surface(ball()), [as_surface(rod) for rod in rods(2.0)])
    assert whole is not None
    before = solved(whole, capture)
    found, said = with_thin_parts(before, capture, capture)
    assert not said and found.surface is whole and found.material is before.material
    alone = photographed([ball()])
    as_it_is = solved(as_surface(ball()), alone)
    assert with_thin_parts(as_it_is, alone, alone) == (as_it_is, [])


def test_a_torn_result_stays_and_says_what_it_lacks() -> None:
    capture, closed = photographed([ball(), *rods(2.0)]), as_surface(ball())
    torn = solved(replace(closed, faces=closed.faces[1:]), capture)
    found, said = with_thin_parts(torn, capture, capture)
    assert found.surface is torn.surface and [one.mended for one in said] == [False] and "missing" in said[0].text


def test_a_ghost_that_no_second_view_asks_for_ends_no_search() -> None:
    def bare(n: int) -> _Bare:
        return _Bare(None, np.zeros((n, 2), int), np.ones(n, bool), None, None, None)  # type: ignore[arg-type]

    def covering(*ranges: range) -> _Piece:
        return _Piece(None, [np.isin(np.arange(200), of) for of in ranges])  # type: ignore[arg-type]

    nothing = range(0)
    one, two = covering(range(50), range(50), nothing), covering(nothing, range(100, 120), range(100, 120))
    ghost = covering(range(45, 105), range(20), nothing)
    for given in ([one, two], [one, two, ghost], [ghost, two, one]):
        assert [id(piece) for piece in _needed([bare(200)] * 3, given)] == [id(one), id(two)]
