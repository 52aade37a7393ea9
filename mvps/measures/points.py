"""Point sets and meshes: nearest neighbours, samples, alignment, curvature, denser vertices.

Distances        nearest(P, Q)_i = min over j of |p_i - q_j|, Euclidean or in the L1 norm, |x| + |y| + |z|.
ICP              p -> R p + t, R and t by least squares to the nearest points, again and again (Besl and McKay 1992).
Mean curvature   |H| = |sum over the neighbours j of w_ij (x_i - x_j)| / (2 A_i), w cotangent weights, A Voronoi areas (Meyer et al. 2003):
                 1 / r on a ball of radius r.
"""

from __future__ import annotations

import igl
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mvps.cores import neighbours
from mvps.mesh import edges, lengths, split_edges
from mvps.scene import Float, Int, Surface

ICP_ROUNDS, ICP_TOLERANCE = 100, 1e-6
"""Largest number of rounds, and relative change of the root mean square distance that ends them: the defaults of PyTorch3D."""


def nearest(points: Float, others: Float, norm: int = 2) -> tuple[Float, Int]:
    """Distance (n,) of points (n, 3) to the nearest of others (m, 3), and its index (n,); norm 1 or 2."""
    distance, index = neighbours(cKDTree(others), points, p=norm)
    return distance, index


def two_way(points: Float, others: Float, norm: int = 2) -> tuple[Float, Float]:
    """Distances (n,) of points (n, 3) to the nearest of others (m, 3), and (m,) the other way round."""
    return nearest(points, others, norm)[0], nearest(others, points, norm)[0]


def f_score(to_truth: Float, to_result: Float, threshold: float) -> float:
    """Harmonic mean of the shares of both distances that are below the threshold (Knapitsch et al. 2017)."""
    precision, recall = float((to_truth < threshold).mean()), float((to_result < threshold).mean())
    return 2 * precision * recall / max(precision + recall, np.finfo(float).tiny)


def surface_samples(surface: Surface, count: int, seed: int) -> Float:
    """(count, 3) points on the surface, uniform by area; the same for the same seed."""
    import trimesh

    mesh = trimesh.Trimesh(np.array(surface.vertices), np.array(surface.faces), process=False)
    points: Float = np.asarray(trimesh.sample.sample_surface(mesh, count, seed=seed)[0], np.float64)
    return points


def icp(points: Float, target: Float) -> tuple[Float, Float]:
    """Rotation (3, 3) and shift (3,) that bring points (n, 3), rotation @ point + shift, onto target (m, 3), from where they are."""
    rotation, shift, before, tree = np.eye(3), np.zeros(3), np.inf, cKDTree(target)
    for _ in range(ICP_ROUNDS):
        distance, index = neighbours(tree, points @ rotation.T + shift)
        error = float(np.sqrt((distance**2).mean()))
        if error >= (1 - ICP_TOLERANCE) * before:
            break
        before, matched = error, target[index]
        centre, onto = points.mean(0), matched.mean(0)
        rotation = Rotation.align_vectors(matched - onto, points - centre)[0].as_matrix()
        shift = onto - rotation @ centre
    return rotation, shift


def mean_curvature(surface: Surface) -> Float:
    """(V,) absolute mean curvature, 1 / unit of the vertices; 0 at a vertex without area."""
    vertices, faces = np.array(surface.vertices), np.array(surface.faces)
    area = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    bent = lengths(igl.cotmatrix(vertices, faces) @ vertices)
    curvature: Float = np.divide(bent, 2 * area, out=np.zeros(len(area)), where=(area > 0) & np.isfinite(bent))
    return curvature


def split_to(surface: Surface, longest: float) -> Surface:
    """The same surface with its edges halved until none is longer than `longest`."""
    while True:
        pairs = edges(surface)
        marked = lengths(surface.vertices[pairs[:, 0]] - surface.vertices[pairs[:, 1]]) > longest
        if not marked.any():
            return surface
        surface = split_edges(surface, marked)
