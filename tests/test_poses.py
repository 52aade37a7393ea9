"""Cameras: motions and misses have the stated derivatives, small errors of poses and of the principal point are found and undone, right
cameras stay."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation
from sphere_scene import RADIUS, make_sphere

import mvps.checks.poses
from mvps.camera import project
from mvps.checks.coherence import coherence, jacobian, outline_points
from mvps.checks.outlines import Motions, Unknowns, after, by_other_half, outlines_of
from mvps.checks.photographed import by_photographs, confirmed
from mvps.checks.poses import by_silhouettes, poses
from mvps.checks.principal import Shared, pointed
from mvps.checks.silhouettes import silhouettes
from mvps.joint.blocks import Vertices
from mvps.joint.bundle import Model, aligned
from mvps.mesh import isotropic_remesh, vertex_normals
from mvps.motions import UNKNOWNS, Object, derivatives, gauge, image_derivatives, moved, with_motions, without_gauge
from mvps.scene import Capture, Float, Law, Material, Surface, View
from mvps.silhouette import mask_distances
from mvps.synthetic.scene import Scene, make_scene, render_capture
from mvps.synthetic.settings import SceneSettings

VIEWS = 8


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(SceneSettings(views=VIEWS, lights=6, size=96, strength=0.0))


@pytest.fixture(scope="module")
def clean(scene: Scene) -> Capture:
    return render_capture(SceneSettings(views=VIEWS, lights=6, size=96, strength=0.0), scene)[0]


def shifts(pixels: float) -> Float:
    """Motions of all cameras whose unknowns have this standard deviation."""
    return np.random.default_rng(3).normal(0, pixels, (VIEWS, UNKNOWNS))


def left(clean: Capture, body: Object, motions: Float) -> float:
    """Root mean square of motions, pixels, less what a similarity of the world does."""
    basis = gauge([view.camera for view in clean.views], body)
    return float(np.sqrt((without_gauge(motions, basis) ** 2).mean()))


def test_projections_move_as_the_derivatives_say(clean: Capture) -> None:
    camera, body = clean.views[1].camera, Object(np.array([1.0, -2.0, 3.0]), 70.0)
    points = body.centre + np.random.default_rng(0).normal(0, 30, (20, 3))
    local = points @ camera.rotation.T + camera.translation
    said = image_derivatives(camera, points) @ derivatives(camera, body, local)
    for k, unit in enumerate(np.eye(UNKNOWNS)):
        ends = [project(moved(camera, body, side * 1e-3 * unit), points)[0] for side in (-1, 1)]
        np.testing.assert_allclose(said[..., k], (ends[1] - ends[0]) / 2e-3, atol=1e-6)
    # A unit moves the object's rim by about a pixel.
    rim = body.centre + body.radius * camera.rotation[0]
    at = image_derivatives(camera, rim[None]) @ derivatives(camera, body, (rim @ camera.rotation.T + camera.translation)[None])
    np.testing.assert_allclose(np.abs(at[0]).max(0)[[2, 3, 4, 5]], 1, atol=0.1)


def test_gauge_is_what_similarities_of_the_world_undo(clean: Capture) -> None:
    body = Object(np.zeros(3), 70.0)
    cameras = [view.camera for view in clean.views]
    basis = gauge(cameras, body)
    points = np.random.default_rng(0).normal(0, 30, (50, 3))
    slopes = [image_derivatives(c, points) @ derivatives(c, body, points @ c.rotation.T + c.translation) for c in cameras]
    for motion in basis.T.reshape(-1, VIEWS, UNKNOWNS):
        moves = np.concatenate([(s @ m).ravel() for s, m in zip(slopes, motion, strict=True)])
        # A field of a turn, a shift and a growth about the origin.
        fields = [np.cross(axis, points) for axis in np.eye(3)] + [np.tile(axis, (50, 1)) for axis in np.eye(3)] + [points]
        seen = np.stack(
            [
                np.concatenate([np.einsum("nic,nc->ni", image_derivatives(c, points), f @ c.rotation.T).ravel() for c in cameras])
                for f in fields
            ]
        )
        rest = moves - seen.T @ np.linalg.lstsq(seen.T, moves, rcond=None)[0]
        assert np.abs(rest).max() < 1e-9 + 1e-6 * np.abs(moves).max()


@pytest.mark.parametrize("of", [Motions(), Shared(np.eye(2)[::-1])], ids=["poses", "principal point"])
def test_misses_change_as_the_jacobian_says(clean: Capture, of: Unknowns) -> None:
    outlines = outlines_of(with_motions(clean, outlines_of(clean).body, shifts(1.0)))
    found = coherence(outlines.cameras, outlines.fields, outlines.body, 2, outlines.points[2])
    said = jacobian(outlines.cameras, outlines.fields, 2, found, partial(of.derivatives, outlines.body))
    zero = of.zero(outlines.cameras)
    x = np.random.default_rng(5).normal(0, 0.1, zero.shape)
    moves = [after(outlines, of, side * x).cameras for side in (-1, 1)]
    ends = [coherence(cameras, outlines.fields, outlines.body, 2, outlines.points[2]).miss for cameras in moves]
    # What every camera does of a change that all share is gathered as its equations are.
    each = x if x.ndim == 2 else np.tile(x @ np.eye(2)[::-1], (VIEWS, 1))
    true, expected = (ends[1] - ends[0]) / 2, np.einsum("njk,jk->n", said, each)
    hit = np.abs(found.miss) < 5
    assert hit.sum() > 30
    assert np.median(np.abs(true - expected)[hit]) < 0.1 * np.median(np.abs(true)[hit])
    # Where other views decide from one moment to the next there is no derivative.
    assert np.corrcoef(true[hit], expected[hit])[0, 1] > 0.9


def shifted(capture: Capture, shift: tuple[float, float]) -> Capture:
    """The capture with the principal point of all views moved."""
    cameras = Shared(np.eye(2)).applied([view.camera for view in capture.views], outlines_of(capture).body, np.array(shift))
    return Capture(capture.name, tuple(view.taken_by(camera) for view, camera in zip(capture.views, cameras, strict=True)))


@pytest.mark.parametrize("shift", [(1.5, -1.0), (-4.0, 5.0)])
def test_a_principal_point_that_is_off_is_moved_and_the_world_stays(clean: Capture, shift: tuple[float, float]) -> None:
    mended, (finding,) = poses(shifted(clean, shift))
    assert (finding.about, finding.where, finding.mended) == ("pose", "all views", True)
    assert "principal point" in finding.text
    for one, view in zip(clean.views, mended.views, strict=True):
        np.testing.assert_array_equal(view.camera.rotation, one.camera.rotation)
        np.testing.assert_array_equal(view.camera.translation, one.camera.translation)
        np.testing.assert_allclose(view.camera.K, one.camera.K, atol=0.3)


def test_of_silhouettes_that_disagree_the_principal_point_is_mended_first(clean: Capture) -> None:
    mended, findings = silhouettes(shifted(clean, (7.0, 3.0)))
    assert [(one.about, one.mended) for one in findings] == [("pose", True)]
    assert len(mended.views) == VIEWS


def test_what_cameras_do_each_on_its_own_is_not_the_principal_point(clean: Capture) -> None:
    body = outlines_of(clean).body
    for pixels in (0.3, 1.0, 3.0):
        wrong = with_motions(clean, body, shifts(pixels))
        assert pointed(wrong) == (wrong, [])
    assert pointed(clean) == (clean, [])


def test_what_cameras_on_one_ring_do_not_tell_is_in_doubt(clean: Capture) -> None:
    """Cameras at one height all around: along the ring's axis the world may have moved as well as the principal point."""
    ring = Capture("ring", tuple(view for k, view in enumerate(clean.views) if k % 2 == 0))
    _, findings = pointed(shifted(ring, (3.0, 0.0)))
    assert [(one.about, one.mended) for one in findings] == [("pose", True), ("pose", False)]


def test_right_poses_stay(clean: Capture) -> None:
    same, findings = poses(clean)
    assert same is clean
    assert findings == []


def silhouettes_of(corners: Float, views: int, size: int) -> Capture:
    """Masks of the convex hull of corners (n, 3), seen from all around."""
    cameras = [view.camera for view in render_capture(SceneSettings(views=views, lights=1, size=size))[0].views]
    centres = np.stack(np.meshgrid(*[np.arange(size) + 0.5] * 2), -1).reshape(-1, 2)
    masks = [Delaunay(project(camera, corners)[0]).find_simplex(centres).reshape(size, size) >= 0 for camera in cameras]
    found = (
        View(str(k), camera, mask, np.zeros((int(mask.sum()), 1, 3), np.uint16), 1.0, 1, ("1",))
        for k, (camera, mask) in enumerate(zip(cameras, masks, strict=True))
    )
    return Capture("solid", tuple(found))


def test_right_poses_of_most_blocks_stay() -> None:
    """All along a straight edge a mask is off by the same part of a pixel, which points beside each other share."""
    found = 0
    for seed in range(6):
        corners = np.array(list(product((-1, 1), repeat=3))) * [38.0, 26.0, 30.0] @ Rotation.random(random_state=seed).as_matrix().T
        fall, noise = by_other_half(outlines_of(silhouettes_of(corners, 10, 160)))
        found += fall > 3 * noise
    # Where halves are every other point, six.
    assert found <= 2


def test_edges_along_rows_of_pixels_say_nothing_of_the_principal_point() -> None:
    """Half of the views see a pyramid's base as one row of pixels, all of them the same row: 2 px of shift explained where it ends."""
    corners = 45.0 * np.array([[1, 1, -0.45], [1, -1, -0.45], [-1, 1, -0.45], [-1, -1, -0.45], [0, 0, 0.85]])
    capture = silhouettes_of(corners, 8, 128)
    assert pointed(capture) == (capture, [])


def test_what_photographs_contradict_is_not_believed(clean: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = with_motions(clean, outlines_of(clean).body, shifts(1.0))
    monkeypatch.setattr(mvps.checks.poses, "confirmed", lambda capture, body, motions: False)
    monkeypatch.setattr(mvps.checks.poses, "by_photographs", lambda capture, body: (capture, []))
    # Misses that are more than rounding makes need no second witness.
    assert poses(wrong)[1][0].mended
    monkeypatch.setattr(mvps.checks.poses, "misfit", lambda found: 0.2)
    assert poses(wrong) == (wrong, [])


@pytest.mark.parametrize("undone", [True, False])
def test_photographs_tell_better_cameras_from_worse(undone: bool) -> None:
    capture = render_capture(SceneSettings(views=6, lights=8, size=96, strength=0.0))[0]
    body, error = outlines_of(capture).body, np.random.default_rng(3).normal(0, 1.0, (6, UNKNOWNS))
    assert confirmed(with_motions(capture, body, error) if undone else capture, body, -error if undone else error) == undone


def test_photographs_leave_right_cameras_of_plain_blocks() -> None:
    """The quick surface's edges are round, which other cameras explain better, those of one edge in another way than those of the next."""
    settings = SceneSettings(views=8, lights=10, size=96, strength=0.0)
    scene = make_scene(settings)
    box = trimesh.creation.box((80.0, 80.0, 80.0)).subdivide_to_size(3.0, max_iter=20)
    surface = Surface(np.asarray(box.vertices), np.asarray(box.faces))
    grey = np.full(surface.vertices.shape, 0.5)
    material = Material(vertex_normals(surface), grey, np.zeros((len(grey), 0)), np.zeros(0), np.ones(len(grey)))
    capture = render_capture(settings, replace(scene, surface=surface, material=material))[0]
    assert by_photographs(capture, outlines_of(capture).body) == (capture, [])


def test_one_view_has_no_say(clean: Capture) -> None:
    alone = Capture("alone", clean.views[:1])
    assert poses(alone) == (alone, [])


def test_pose_errors_of_a_pixel_are_found_and_undone(clean: Capture) -> None:
    body, error = outlines_of(clean).body, shifts(1.0)
    # Too few lights for the photographs to be asked.
    wrong = with_motions(clean.select({view.name: view.lights[:2] for view in clean.views}), body, error)
    mended, findings = poses(wrong)
    assert [(one.about, one.where, one.mended) for one in findings] == [("pose", "all views", True)]
    outlines = outlines_of(wrong)
    motions = by_silhouettes(outlines)
    assert motions is not None
    assert left(clean, body, error + motions) < 0.5 * left(clean, body, error)
    for view, camera in zip(mended.views, after(outlines, Motions(), motions).cameras, strict=True):
        np.testing.assert_array_equal(view.camera.rotation, camera.rotation)
        assert view.samples is not None and view.mask is clean.views[int(view.name[5:]) - 1].mask


def test_cameras_that_moved_by_pixels_leave_the_frame_of_the_world_in_doubt(clean: Capture) -> None:
    wrong = with_motions(clean.select({view.name: view.lights[:2] for view in clean.views}), outlines_of(clean).body, shifts(3.0))
    findings = poses(wrong)[1]
    assert [(one.about, one.where, one.mended) for one in findings] == [("pose", "all views", True), ("pose", "all views", False)]


def test_the_other_half_decides(clean: Capture) -> None:
    body = outlines_of(clean).body
    for error, found in ((0.0, False), (1.0, True)):
        fall, noise = by_other_half(outlines_of(with_motions(clean, body, shifts(error))))
        assert (fall > 3 * noise) == found


def test_what_cannot_be_mended_is_said(clean: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = with_motions(clean, outlines_of(clean).body, shifts(1.0))
    monkeypatch.setattr(mvps.checks.poses, "by_silhouettes", lambda outlines: None)
    same, (finding,) = poses(wrong)
    assert same is wrong and not finding.mended
    # Misses as small as the masks' noise makes them are no reason to doubt.
    monkeypatch.setattr(mvps.checks.poses, "misfit", lambda found: 0.2)
    assert poses(wrong) == (wrong, [])


def test_photographs_undo_what_silhouettes_leave(scene: Scene, clean: Capture) -> None:
    body, error = outlines_of(clean).body, shifts(0.3)
    surface = isotropic_remesh(scene.surface, 4.0)
    normal = torch.tensor(vertex_normals(surface), dtype=torch.float32)
    start = Vertices(normal, torch.full((len(normal), 1), 0.3), torch.full((len(normal),), 0.05))
    among = np.random.default_rng(0).permutation(len(normal)) < 1500
    model = Model(surface, scene.lights, start, Law((), shadows=True), among)
    lights = replace(scene.lights, one_rig=False)
    motions = aligned(with_motions(clean, body, error), lights, model, body)
    assert left(clean, body, error + motions) < 0.35 * left(clean, body, error)


def test_a_cut_view_says_nothing_of_what_lies_beside_its_image() -> None:
    """Lines of sight along the outline that pass there meet the object all the same."""
    whole, other = make_sphere(3).capture.views[:2]
    width = other.camera.width // 5
    camera = replace(other.camera, width=width)
    cut = View(other.name, camera, other.mask[:, :width], np.zeros((int(other.mask[:, :width].sum()), 1, 3), np.uint16), 1.0, 1, (1,))
    fields = mask_distances(Capture("cut", (whole, cut)))
    found = coherence((whole.camera, camera), fields, Object(np.zeros(3), 1.5 * RADIUS), 0, outline_points(fields[0], 2.0))
    assert len(found.miss) > 50 and found.miss.max() < 0.5
