"""Masks and outlines: where they are, and how an outline moves with the mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from sphere_scene import RADIUS, camera_at, make_sphere

from mvps.camera import project, rays
from mvps.hull import hull_grid, masks_box
from mvps.joint.agreement import Agreement
from mvps.joint.refine import POSITION_FLOOR_PIXELS
from mvps.joint.vertices import with_masks
from mvps.mesh import normalise, unbiased
from mvps.scene import Camera, Capture, Surface, View
from mvps.silhouette import mask_distance, mask_distances, outline, sampled
from mvps.visibility import RayCaster

BALL = make_sphere(5).reconstruction.surface
CAMERA = camera_at(np.array([1.0, 0.3, 0.2]), 200)


def traced(surface: Surface, camera: Camera, image: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """(n,) how far from image points along `outward` rays still meet the mesh, pixels, by bisection."""
    caster = RayCaster(surface)
    low, high = np.full(len(image), -2.0), np.full(len(image), 2.0)
    for _ in range(22):
        middle = (low + high) / 2
        met = caster.occluded(*rays(camera, image + middle[:, None] * outward))
        low, high = np.where(met, middle, low), np.where(met, high, middle)
    return low


def test_the_outline_lies_where_rays_begin_to_miss() -> None:
    line = outline(RayCaster(BALL), CAMERA)
    assert np.abs(traced(BALL, CAMERA, line.image, line.outward)).max() < 0.1
    assert np.allclose(line.barycentric.sum(1), 1) and (line.barycentric >= 0).all()
    centres = project(CAMERA, np.einsum("nk,nkc->nc", line.barycentric, BALL.vertices[BALL.faces[line.face]]))[0]
    # Beside the segment, farther out by what its face cuts off the ball.
    away = line.image - centres
    out = (away * line.outward).sum(1)
    assert np.abs(away - out[:, None] * line.outward).max() < 0.01 and out.min() >= 0 and out.max() < 0.03
    # A circle, once around; its zigzag over the faces makes it a little longer.
    radius = np.linalg.norm(centres - 100, axis=1).mean()
    assert 1 < line.length.sum() / (2 * np.pi * radius) < 1.1


def test_the_outline_of_coarse_faces_is_the_smooth_surfaces() -> None:
    """Faces cut off 0.26 pixels of a ball whose edges are of 12."""
    ball = make_sphere(3).reconstruction.surface
    line = outline(RayCaster(ball), CAMERA)
    origin, along = rays(CAMERA, line.image)
    beyond = (np.linalg.norm(np.cross(origin, along), axis=1) - RADIUS) * line.rate
    corners = np.einsum("nk,nkc->nc", line.barycentric, ball.vertices[ball.faces[line.face]])
    cut = (RADIUS - np.linalg.norm(corners, axis=1)) * line.rate
    assert np.average(cut, weights=line.length) > 0.2 and np.abs(beyond).max() < 0.02


def test_gradient_of_silhouette_edge() -> None:
    """Vertices move along their normals by a smooth field: the outline moves as its derivative says, against central differences of
    the traced silhouette."""
    line, normal = outline(RayCaster(BALL), CAMERA), normalise(BALL.vertices)
    by = np.sin(BALL.vertices @ np.array([0.05, 0.08, -0.06]))
    step = 0.2
    ends = [traced(Surface(BALL.vertices + s * step * by[:, None] * normal, BALL.faces), CAMERA, line.image, line.outward) for s in (1, -1)]
    measured = (ends[0] - ends[1]) / (2 * step)
    said = line.rate * (line.barycentric * by[BALL.faces[line.face]]).sum(1)
    assert np.abs(measured - said).max() < 0.05 * line.rate.max()
    assert np.corrcoef(measured, said)[0, 1] > 0.999


def test_an_outline_hidden_or_in_front_of_the_object_is_none() -> None:
    """A small ball in front of a large one, and one behind it."""
    toward = normalise(CAMERA.centre)
    parts = [BALL.vertices, 0.2 * BALL.vertices + 70 * toward, 0.2 * BALL.vertices - 70 * toward]
    n = len(BALL.vertices)
    three = Surface(np.concatenate(parts), np.concatenate([BALL.faces + k * n for k in range(3)]))
    line = outline(RayCaster(three), CAMERA)
    assert len(line.face) > 100 and line.face.max() < len(BALL.faces)


def test_masks_bring_a_ball_to_its_size() -> None:
    scene = make_sphere(5)
    for factor in (0.98, 1.02):
        wrong = Surface(factor * BALL.vertices, BALL.faces)
        nothing = Agreement(np.zeros(len(BALL.vertices)), np.full(len(BALL.vertices), np.inf))
        told = with_masks(nothing, scene.capture, wrong, mask_distances(scene.capture), POSITION_FLOOR_PIXELS)
        known = np.isfinite(told.sigma)
        assert known.sum() > 300 and abs(told.offset[known].mean() - (1 - factor) * RADIUS) < 0.1
        assert np.abs(told.offset[known] - (1 - factor) * RADIUS).max() < 0.6


def test_masks_say_nothing_of_outlines_beyond_the_frame() -> None:
    """A view's right third is cut off: no vertex is told to go there, and those that are seen keep their places."""
    view = make_sphere(5).capture.views[0]
    camera = view.camera
    right = camera.width * 2 // 3
    cut = Camera(camera.K, camera.rotation, camera.translation, camera.height, right)
    mask = view.mask[:, :right]
    part = View(view.name, cut, mask, np.zeros((int(mask.sum()), 1, 3), np.uint16), view.scale, view.saturation, (1,))
    nothing = Agreement(np.zeros(len(BALL.vertices)), np.full(len(BALL.vertices), np.inf))
    capture = Capture("cut", (part,))
    told = with_masks(nothing, capture, BALL, mask_distances(capture), POSITION_FLOOR_PIXELS)
    known = np.isfinite(told.sigma)
    assert known.sum() > 50 and np.abs(told.offset[known]).max() < 0.02 * RADIUS
    assert project(camera, BALL.vertices[known])[0][:, 0].max() < right + 1


def test_distances_between_pixel_centres() -> None:
    mask = np.zeros((40, 60), bool)
    mask[:, :30] = True
    image = np.column_stack([np.linspace(25, 35, 21), np.full(21, 20.0)])
    assert np.abs(sampled(mask_distance(mask), image) - (image[:, 0] - 30)).max() < 0.05


def test_unbiased_faces_lie_on_a_ball_in_the_mean() -> None:
    rng = np.random.default_rng(0)

    def mean_radius(surface: Surface) -> float:
        shares = rng.dirichlet(np.ones(3), len(surface.faces))
        return float(np.linalg.norm(np.einsum("fk,fkc->fc", shares, surface.vertices[surface.faces]), axis=1).mean())

    coarse = make_sphere(3).reconstruction.surface
    before, after = RADIUS - mean_radius(coarse), RADIUS - mean_radius(unbiased(coarse))
    assert before > 0.1 and abs(after) < 0.1 * before


def cropped(capture: Capture, at: int, rows: int) -> Capture:
    """The capture, of one view its first rows only."""
    view = capture.views[at]
    K = view.camera.K
    camera = Camera(K, view.camera.rotation, view.camera.translation, rows, view.camera.width)
    kept = view.pixels[:, 0] < rows
    part = replace(view, camera=camera, mask=view.mask[:rows], samples=view.samples[kept], frame=None)
    return Capture(capture.name, tuple(part if k == at else of for k, of in enumerate(capture.views)))


def test_a_view_that_cuts_the_object_off_says_nothing_of_the_rest() -> None:
    """The others enclose it: the hull is no smaller. Where all views cut it off along one side, it ends there."""
    whole = make_sphere(3).capture
    rows = whole.views[0].mask.shape[0] // 2
    one = cropped(whole, 0, rows)
    volumes = [float((hull_grid(of).values < 0).sum() * hull_grid(of).spacing ** 3) for of in (whole, one)]
    assert masks_box(one).frame_open and volumes[1] >= 0.99 * volumes[0]
    every = whole
    for k in range(len(whole.views)):
        every = cropped(every, k, rows)
    assert not masks_box(every).frame_open
    assert float((hull_grid(every).values < 0).sum() * hull_grid(every).spacing ** 3) < 0.8 * volumes[0]
