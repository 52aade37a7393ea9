"""Poses from photographs: Gauss-Newton steps of all cameras on the photometric residuals, with the vertices eliminated.

For vertex v seen in view i under light l, with offset d along the mesh's normal n, and I the photograph,

    r = I_il(q_i(x_v + d n)) - predicted(normal, reflectance),     dr/d(motion i) = grad I . dq/d(motion i),     dr/dd = grad I . dq/dx n

and -d predicted/d(normal, reflectance) as in blocks.py. With A_v the block of a vertex's own unknowns (offset, normal, reflectance), E_v
the block between them and all cameras, the cameras' equations are those of bundle adjustment (Triggs et al. 2000)

    S = sum_v (C_v - E_v A_v^-1 E_v^T),      s = sum_v (c_v - E_v A_v^-1 b_v).

Without the elimination views creep: every vertex already agrees with the wrong poses that it was solved from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from mvps.camera import bilinear, pixel_footprint, project
from mvps.joint.blocks import DirectionalLights, Vertices, evaluate, robust, tangents, vertex_derivatives
from mvps.joint.grey import grey_lights
from mvps.joint.observe import ViewSamples, grey_radiance, observe
from mvps.joint.photometry import WEAK_TIE
from mvps.joint.steps import CORRELATED, free_reflectance, vertex_steps
from mvps.mesh import vertex_normals
from mvps.motions import UNKNOWNS, Object, derivatives, gauge, image_derivatives, with_motions, without_gauge
from mvps.scene import Bool, Capture, Float, Int, Law, Lights, Surface, View

VERTEX_STEPS, CAMERA_STEPS = 2, 4
"""Steps of the vertices before each step of the cameras, and steps of the cameras: each leaves less than half of the last one's."""

SLOPE_PIXELS = 0.5
"""Half the step of the difference quotient that stands for an image's gradient: bilinear values are linear between pixel centres."""

REACH_PIXELS = 1.0
"""How far a photograph's gradient reaches: motions of a camera and offsets of a vertex are tied to 0 with this standard deviation, and
bound by it."""

SPREAD = 4
"""Vertices whose mean offset moves the mesh: a single one's is as noisy as its samples."""

RIDGE = 1e-4
"""Of the vertices' blocks, over their diagonals: what no sample tells (a lobe that no light excites) stays."""


@dataclass(frozen=True, eq=False)
class Model:
    """What predicts the photographs: surface, lights of all of them, vertices, law (without inter-reflection); among (V,): the vertices
    that are used."""

    surface: Surface
    lights: Lights
    vertices: Vertices
    law: Law
    among: Bool


def part(capture: Capture, lights: Lights, start: int, stride: int) -> tuple[Capture, Lights]:
    """Every stride-th light of each view from `start` on."""
    kept = capture.select({view.name: view.lights[start::stride] for view in capture.views})
    direction, intensity = (tuple(values[start::stride] for values in of_views) for of_views in (lights.direction, lights.intensity))
    return kept, replace(lights, direction=direction, intensity=intensity)


def _slopes(view: View, image: Float, intensity: Float) -> tuple[Float, Bool]:
    """(n, lights, 2) gradients of the grey photographs at image coordinates (n, 2), and where (n,) all pixels around are foreground."""
    grey, _ = grey_radiance(view, intensity)
    columns, known = [], np.ones(len(image), bool)
    for axis in SLOPE_PIXELS * np.eye(2):
        ends = []
        for side in (-1, 1):
            positions, weights = bilinear(view.pixel_index, image + side * axis)
            ends.append(np.einsum("nkl,nk->nl", grey[positions], weights))
            known &= (weights > 0).any(1)
        columns.append((ends[1] - ends[0]) / (2 * SLOPE_PIXELS))
    return np.stack(columns, -1), known


def _rows(
    view: View, samples: ViewSamples, model: Model, lights: DirectionalLights, intensity: Float, body: Object
) -> tuple[Float, Float, Float, Float]:
    """Of a view's pairs and lights: residuals (n, L), their weights, and derivatives by the camera (n, L, 6) and by the vertex's offset,
    normal and reflectance (n, L, 1 + 2 + 1 + lobes)."""
    index, vertices = samples.vertex, model.vertices
    normal, scale = vertices.normal[index], vertices.scale[index]
    shaded = evaluate(normal, vertices.reflectance[index], samples.towards, lights, model.law)
    residual = samples.image - shaded.predicted
    points, outward = (values[index.numpy()] for values in (model.surface.vertices, vertex_normals(model.surface)))
    slopes, known = _slopes(view, project(view.camera, points)[0], intensity)
    by_point = slopes @ image_derivatives(view.camera, points)
    local = points @ view.camera.rotation.T + view.camera.translation
    by_camera = by_point @ derivatives(view.camera, body, local)
    by_offset = by_point @ (outward @ view.camera.rotation.T)[..., None]
    predicted = torch.stack(vertex_derivatives(shaded, tangents(normal), samples.towards, lights), -1).double().numpy()
    weight = samples.weight[:, None] * samples.data * robust(residual, scale, shaded.unsure) / scale[:, None] ** 2
    return residual.double().numpy(), weight.double().numpy() * known[:, None], by_camera, np.concatenate([by_offset, -predicted], -1)


def _camera_step(capture: Capture, views: list[ViewSamples], model: Model, lights: Lights, body: Object) -> tuple[Float, Float]:
    """Motions (views, 6) of one step, and offsets (V,) in world units."""
    reach = REACH_PIXELS * pixel_footprint([view.camera for view in capture.views], body.centre)
    row = np.full(len(model.surface.vertices), -1)
    row[model.among] = np.arange(int(model.among.sum()))
    size, own = int(model.among.sum()), 1 + 2 + model.vertices.reflectance.shape[1]
    A, b = np.zeros((size, own, own)), np.zeros((size, own))
    E = np.zeros((size, len(views), UNKNOWNS, own))
    S, s = np.zeros((len(views), UNKNOWNS, len(views), UNKNOWNS)), np.zeros((len(views), UNKNOWNS))
    for i, (samples, grey) in enumerate(zip(views, grey_lights(lights, model.vertices.normal.device), strict=True)):
        residual, weight, by_camera, by_vertex = _rows(capture.views[i], samples, model, grey, lights.intensity[i], body)
        at = row[samples.vertex.numpy()]
        weighted, camera = weight[..., None] * by_vertex, (weight[..., None] * by_camera).reshape(-1, UNKNOWNS)
        A[at] += weighted.swapaxes(1, 2) @ by_vertex
        b[at] += np.einsum("nlk,nl->nk", weighted, residual)
        E[at, i] = (weight[..., None] * by_camera).swapaxes(1, 2) @ by_vertex
        S[i, :, i] = camera.T @ by_camera.reshape(-1, UNKNOWNS)
        s[i] = residual.ravel() @ camera
    diagonal = np.einsum("vkk->vk", A)
    A[:, range(own), range(own)] += RIDGE * (diagonal + diagonal.mean(0)) + np.finfo(float).tiny
    # Samples share the model's errors: together they weigh as few, and so a tie as many (steps.py).
    A[:, 0, 0] += CORRELATED / reach**2
    flat, unknowns = E.reshape(size, -1, own), s.size
    solved = flat @ np.linalg.inv(A)
    reduced = S.reshape(unknowns, unknowns) - np.tensordot(solved, flat, ((0, 2), (0, 2)))
    reduced[range(unknowns), range(unknowns)] += CORRELATED / REACH_PIXELS**2
    motions = -np.linalg.solve(reduced, s.ravel() - np.einsum("vpk,vk->p", solved, b))
    change = -np.linalg.solve(A, (b + np.einsum("vpk,p->vk", flat, motions))[..., None])[..., 0]
    offsets = np.zeros(len(row))
    offsets[model.among] = np.clip(change[:, 0], -reach, reach)
    return motions.reshape(s.shape), offsets


def _spread(model: Model, offsets: Float) -> Surface:
    """The surface moved along its normals by the mean offset of the nearest vertices that are used."""
    vertices = model.surface.vertices
    nearest = cKDTree(vertices[model.among]).query(vertices, k=min(SPREAD, int(model.among.sum())))[1].reshape(len(vertices), -1)
    return Surface(vertices + offsets[model.among][nearest].mean(1)[:, None] * vertex_normals(model.surface), model.surface.faces)


def solved(capture: Capture, lights: Lights, model: Model) -> tuple[list[ViewSamples], Model]:
    """The samples of these photographs, and the model with vertices solved from them."""
    device = model.vertices.normal.device
    views = observe(capture, model.surface, lights, device, model.among, model.law.shadows)
    anchor = torch.tensor(vertex_normals(model.surface), dtype=torch.float32, device=device)
    tie = free_reflectance(anchor, WEAK_TIE, model.vertices.reflectance.shape[1])
    vertices = vertex_steps(views, model.vertices, grey_lights(lights, device), model.law, tie, VERTEX_STEPS)
    return views, replace(model, vertices=vertices)


def aligned(capture: Capture, lights: Lights, model: Model, body: Object) -> Float:
    """Motions (views, 6) of the cameras, each unknown within +-REACH_PIXELS, by which these photographs agree best."""
    motions = np.zeros((len(capture.views), UNKNOWNS))
    for _ in range(CAMERA_STEPS):
        at = with_motions(capture, body, motions)
        views, model = solved(at, lights, model)
        step, offsets = _camera_step(at, views, model, lights, body)
        step = without_gauge(step, gauge([view.camera for view in at.views], body))
        motions = np.clip(motions + step, -REACH_PIXELS, REACH_PIXELS)
        model = replace(model, surface=_spread(model, offsets))
    return motions


def prediction_errors(capture: Capture, lights: Lights, model: Model, part_of: Int) -> Float:
    """(parts,) mean absolute error of these photographs' samples over their mean value, NaN for a part without any; part_of (V,): of the
    vertices."""
    views = observe(capture, model.surface, lights, model.vertices.normal.device, model.among, model.law.shadows)
    error, level = torch.zeros_like(model.vertices.scale), torch.zeros_like(model.vertices.scale)
    for samples, grey in zip(views, grey_lights(lights, error.device), strict=True):
        index, weight = samples.vertex, samples.weight[:, None] * samples.data
        shaded = evaluate(model.vertices.normal[index], model.vertices.reflectance[index], samples.towards, grey, model.law)
        error.index_add_(0, index, (weight * (shaded.predicted - samples.image).abs()).sum(1))
        level.index_add_(0, index, (weight * samples.image).sum(1))
    errors, levels = (np.bincount(part_of, of.double().cpu().numpy()) for of in (error, level))
    return np.where(levels > 0, errors / np.maximum(levels, np.finfo(float).tiny), np.nan)
