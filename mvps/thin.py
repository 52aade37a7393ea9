"""Thin parts, which no grid and no mesh of two pixels' cells holds, from the masks alone.

A rod of two pixels passes between the nodes of the hull's grid, and one of three is shorter around than edges of meshes are long, and
crumbles on the way. Masks show both all the same. With S_i the pixels of view i that a surface covers, and b_i those of its mask that lie
farther from S_i than outlines err,

    T = points in all masks that show in b_i of two views or more

is what the surface lacks. T is found on a grid as fine as masks are, from distances that are not smoothed, in which a rod of a pixel would
vanish. Where the cones of several rods meet, T has ghosts as well, which explain no pixel that rods do not: of its pieces those stay that
cover most of what is bare, each those that others left, if it is thin in the masks: of the wide side of a sheet photographs tell, and masks
of few views leave more of it than there is. They are joined with the surface (Boolean operations in exact arithmetic: Zhou et al. 2016).

What the hull lacks is taken out of the masks beforehand, for half a rod is worse than none: a mesh is torn where it ends. What
the result lacks is found at the end. Colours of thin parts are photographed, and textures have them. Of their normals photographs say
nothing that is not mixed with what is beside them: they are the surface's own, and no confidence is in them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, label
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from mvps.camera import project
from mvps.cores import neighbours, on_cores
from mvps.finding import Finding
from mvps.hull import hull_grid, hull_of_masks
from mvps.mesh import decimated, pieces_of, vertex_normals
from mvps.once import once_for
from mvps.progress import Progress
from mvps.pyramid import halvings
from mvps.scene import Bool, Capture, Float, Int, NormalMap, SignedDistanceGrid, Surface, View
from mvps.silhouette import beyond_mask
from mvps.visibility import camera_hits, ray_caster

if TYPE_CHECKING:
    from mvps.joint.refine import Refined

BEYOND = 2.0
"""Pixels from what a surface covers, from which pixels of a mask are bare: less is an error of its outline, whose cells are two pixels."""

FINER = 4
"""Cells of the fine grid to one of the hull's: half a pixel each, more where the hull's are of more than two (hull.py)."""

MOST_NODES = 1 << 25
"""Of a fine grid, 0.2 GB; half as fine where a piece's would have more."""

SLACK = 0.15
"""Pixels by which T may lie outside of a mask: half of what its border errs by. Between pixels that touch at corners alone, as those of a
slanting line do, is 0."""

EVIDENCE = 4
"""Bare pixels in each of two views that a piece has to itself."""

ROOT = 1.5
"""Pixels that pieces reach beyond what is bare, towards the rest: the last one before it is bare in no view, and half of one for the
grid."""

SHRINK, GROW, STEPS = 0.5, 0.525, 30
"""Of Taubin's smoothing, in turn: waves of two pixels, four edges, are gone after so many, of those of four 0.8 are left."""

KEPT = 4
"""One of so many faces of pieces stays: smoothed, edges of half a pixel tell no more than those of one."""

AROUND = np.ones((3, 3, 3), bool)


class _Bare(NamedTuple):
    """Of a view: pixels (n, 2), rows and columns of b_i; thin (n,), whether no disc fits into the mask there; pictures (height, width):
    bare, b_i; near, b_i with half as much distance, and the pixels beside it; distance to the mask's boundary, pixels, negative inside."""

    view: View
    pixels: Int
    thin: Bool
    bare: Bool
    near: Bool
    distance: NDArray[np.float32]


class _Piece(NamedTuple):
    """A part of T, closed, and which of the views' bare pixels it covers, (n,) of each."""

    surface: Surface
    covers: list[Bool]


def without_thin_parts(capture: Capture, progress: Progress) -> Capture:
    """The capture without pixels of rods that the hull's grid does not hold; itself where there are none."""
    if not _may_have_thin(capture):
        return capture
    with progress.stage("thin parts") as stage:
        views, pieces = _found(capture, hull_of_masks(capture, hull_grid(capture)))
        stage.status(f"{len(pieces)} that the hull does not hold")
        return Capture(capture.name, tuple(_without(*one) for one in zip(views, _covered(pieces), strict=True))) if pieces else capture


def with_thin_parts(refined: Refined, rest: Capture, capture: Capture) -> tuple[Refined, list[Finding]]:
    """What Stage II made of the rest of a capture, with what it lacks of the masks, and what to say of that. The reflectance of thin parts
    is the nearest vertex's; of their pixels nothing is known."""
    if not _may_have_thin(capture):
        return refined, []
    if rest is not capture:
        refined = replace(refined, maps=tuple(map(_widened, refined.maps, rest.views, capture.views)))
    pieces = _found(capture, refined.surface)[1]
    if not pieces:
        return refined, []
    said = f"{f'{len(pieces)} parts are' if len(pieces) > 1 else 'a part is'} thinner than meshes hold"
    surface = joined(refined.surface, [piece.surface for piece in pieces])
    if surface is None:
        return refined, [Finding("mask", "all views", f"{said}, and missing: the mesh is not closed", False)]
    told = Finding("mask", "all views", f"{said}: the shape is what masks leave of it, without normals of its own", True)
    return _carried_over(refined, surface), [told]


def joined(surface: Surface, pieces: Sequence[Surface]) -> Surface | None:
    """The union of a closed surface and closed pieces; None where the surface is not closed."""
    from igl.copyleft.cgal import mesh_boolean

    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    vertices = np.concatenate([piece.vertices for piece in pieces])
    faces = np.concatenate([piece.faces + start for piece, start in zip(pieces, starts[:-1], strict=True)])
    try:
        vertices, faces, *_ = mesh_boolean(surface.vertices, surface.faces.astype(np.int64), vertices, faces, "union")
    except RuntimeError:
        return None
    return Surface(np.ascontiguousarray(vertices), np.ascontiguousarray(faces))


def _carried_over(refined: Refined, surface: Surface) -> Refined:
    """The same on a surface of which some vertices are new."""
    from mvps.joint.detail import Detailed, interpolated

    distance, same = neighbours(cKDTree(refined.surface.vertices), surface.vertices)
    n, there = len(surface.vertices), distance == 0
    share = sp.csr_matrix((np.ones(n), same, np.arange(n + 1)), (n, len(refined.surface.vertices)))
    material = interpolated(refined.material, Detailed(surface, share))
    normal = np.where(there[:, None], material.normal, vertex_normals(surface))
    material = replace(material, normal=normal, confidence=np.where(there, material.confidence, 0))
    unexplained, in_light = (np.where(there, left[same], np.nan) for left in (refined.unexplained, refined.in_light))
    return replace(refined, surface=surface, material=material, unexplained=unexplained, in_light=in_light)


def _widened(maps: NormalMap, rest: View, whole: View) -> NormalMap:
    """A view's normal map at all its pixels, with no confidence where the rest has none."""
    there = rest.mask[whole.mask]
    normal = np.tile(-whole.camera.rotation[2].astype(maps.normal.dtype), (len(there), 1))
    albedo, confidence = np.zeros((len(there), 3), maps.albedo.dtype), np.zeros(len(there), maps.confidence.dtype)
    normal[there], albedo[there], confidence[there] = maps.normal, maps.albedo, maps.confidence
    return NormalMap(normal, albedo, confidence)


def _wide(view: View, radius: int) -> Bool:
    """(height, width) what of a mask discs of this radius, pixels, fit into."""
    x, y = np.indices((2 * radius + 1,) * 2) - radius
    disc = (x**2 + y**2 <= radius**2).astype(np.uint8)
    wide: Bool = cv2.morphologyEx(view.mask.astype(np.uint8), cv2.MORPH_OPEN, disc) > 0
    return wide


def _thinnest(capture: Capture) -> int:
    """Radius, pixels, of what grids and meshes hold of a capture: of pixels of the size at which its shape is looked for, BEYOND."""
    radius: int = int(BEYOND) * 2 ** halvings(capture)
    return radius


@once_for
def _may_have_thin(capture: Capture) -> bool:
    """Whether masks of two views have parts that reach beyond what is wide by as much as that."""
    radius = _thinnest(capture)

    def one(view: View) -> bool:
        wide = _wide(view, radius)
        return bool(wide.any() and (view.mask & (distance_transform_edt(~wide) > radius)).any())

    return sum(on_cores(one, capture.views)) >= 2


def _bare(capture: Capture, surface: Surface) -> list[_Bare]:
    caster, radius = ray_caster(surface), _thinnest(capture)

    def one(view: View) -> _Bare:
        covered = np.zeros(view.mask.shape, bool)
        covered[view.mask] = camera_hits(caster, view.camera, view.pixels).face >= 0
        away = np.where(view.mask, distance_transform_edt(~covered), 0)
        inside, outside = distance_transform_edt(view.mask), distance_transform_edt(~view.mask)
        distance = np.where(view.mask, 0.5 - inside, outside - 0.5).astype(np.float32)
        bare = away > BEYOND
        thin = ~_wide(view, radius)[bare]
        return _Bare(view, np.argwhere(bare), thin, bare, binary_dilation(away > BEYOND / 2, AROUND[0]), distance)

    return on_cores(one, capture.views)


def _without(of: _Bare, covered: Bool) -> View:
    """The view without those of its bare pixels that are covered (n,) and thin."""
    view, stays = of.view, np.ones_like(of.bare)
    stays[tuple(of.pixels[covered & of.thin].T)] = False
    return replace(view, mask=view.mask & stays, samples=view.samples[stays[view.mask]])


def _covered(pieces: Sequence[_Piece]) -> list[Bool]:
    """(n,) of each view, which bare pixels some piece covers."""
    return [np.any(of_view, axis=0) for of_view in zip(*(piece.covers for piece in pieces), strict=True)]


def _found(capture: Capture, surface: Surface) -> tuple[list[_Bare], list[_Piece]]:
    """What of the masks a surface lacks, and the pieces of T that explain it."""
    hull, views = hull_grid(capture), _bare(capture, surface)
    pieces = [piece for nodes in _where(views, hull) for piece in _pieces(views, hull, nodes)]
    return views, [piece for piece in _needed(views, pieces) if _slender(piece, views)]


def _covering(surface: Surface, views: Sequence[_Bare]) -> _Piece:
    caster = ray_caster(surface)
    return _Piece(surface, [camera_hits(caster, of.view.camera, of.pixels).face >= 0 for of in views])


def _slender(piece: _Piece, views: Sequence[_Bare]) -> bool:
    """Whether most of the bare pixels that a piece covers are thin."""
    of_views = list(zip(piece.covers, views, strict=True))
    return 2 * sum(int((covers & of.thin).sum()) for covers, of in of_views) > sum(int(covers.sum()) for covers, _ in of_views)


def _outside(views: Sequence[_Bare], points: Float) -> tuple[Float, Int, Int]:
    """How far points (n, 3) lie outside of the masks, less SLACK, world units, negative inside; in how many views they show in bare pixels,
    and near them."""

    def one(of: _Bare) -> tuple[Float, Bool, Bool]:
        image, depth = project(of.view.camera, points)
        distance = (beyond_mask(of.view.camera, of.distance, image) - SLACK) * depth / of.view.camera.focal_length
        seen = depth > 0
        return np.where(seen, distance, np.inf), seen & _at(of.bare, image), seen & _at(of.near, image)

    outside, bare, near = zip(*on_cores(one, views), strict=True)
    return np.max(outside, 0), np.sum(bare, 0), np.sum(near, 0)


def _at(picture: Bool, image: Float) -> Bool:
    """(n,) what a picture (height, width) has at image coordinates (n, 2), False beside it."""
    column, row = np.floor(image).astype(int).T
    there = (row >= 0) & (row < picture.shape[0]) & (column >= 0) & (column < picture.shape[1])
    found = np.zeros(len(image), bool)
    found[there] = picture[row[there], column[there]]
    return found


def _where(views: Sequence[_Bare], hull: SignedDistanceGrid) -> Iterator[Bool]:
    """Parts of the hull's grid, as nodes (x, y, z), around which T may lie."""
    if sum(int(of.bare.sum()) >= EVIDENCE for of in views) < 2:
        return
    nodes = np.argwhere(hull.values < hull.spacing)
    outside, bare, near = _outside(views, hull.origin + hull.spacing * nodes)
    may, shown = np.zeros((2, *hull.values.shape), bool)
    may[tuple(nodes[(near >= 2) & (outside < hull.spacing)].T)] = True
    shown[tuple(nodes[bare >= 2].T)] = True
    numbers, _ = label(may, AROUND)
    for k in np.unique(numbers[shown & may]):
        yield binary_dilation(numbers == k, AROUND)


def _pieces(views: Sequence[_Bare], hull: SignedDistanceGrid, nodes: Bool) -> list[_Piece]:
    """Connected parts of T, and of what masks hold for ROOT around, about some nodes (x, y, z) of the hull's grid."""
    where = np.argwhere(nodes)
    low, high = where.min(0), where.max(0) + 1
    cells = np.pad(nodes[tuple(map(slice, low, high))], 1)
    finer = FINER if cells.size * FINER**3 <= MOST_NODES else FINER // 2
    spacing, fine = hull.spacing / finer, np.argwhere(cells.repeat(finer, 0).repeat(finer, 1).repeat(finer, 2))
    # A node of the coarse grid stands in the middle of finer^3 of the fine one.
    origin = hull.origin + hull.spacing * (low - 1.5) + spacing / 2
    outside, _, near = _outside(views, origin + spacing * fine)
    inside = np.zeros(np.array(cells.shape) * finer, bool)
    inside[tuple(fine[(outside < 0) & (near >= 2)].T)] = True
    if not inside.any():
        return []
    reached = binary_dilation(inside, AROUND, iterations=round(ROOT * finer / 2))[tuple(fine.T)]
    values = np.full(inside.shape, spacing, np.float32)
    values[tuple(fine.T)] = np.where(reached, np.minimum(outside, spacing), spacing)
    vertices, faces, _, _ = marching_cubes(values, 0.0)
    whole = _smooth(Surface(origin + spacing * vertices.astype(np.float64), faces.astype(np.int64)))
    fewer = decimated(whole, len(whole.faces) // KEPT)
    return [_covering(piece, views) for piece in pieces_of(fewer or whole)]


def _smooth(surface: Surface) -> Surface:
    """Without the masks' staircases, but no thinner (Taubin 1995)."""
    import trimesh

    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    trimesh.smoothing.filter_taubin(mesh, SHRINK, GROW, STEPS)
    return Surface(np.array(mesh.vertices), surface.faces)


def _needed(views: Sequence[_Bare], pieces: Sequence[_Piece]) -> list[_Piece]:
    """Pieces that cover bare pixels in two views which those before them do not, the one that covers most of them first."""
    left, kept = [np.ones(len(of.pixels), bool) for of in views], list[_Piece]()
    while len(kept) < len(pieces):
        gains = [sorted(int((covers & free).sum()) for covers, free in zip(piece.covers, left, strict=True)) for piece in pieces]
        told = [sum(gain) if gain[-2] >= EVIDENCE else 0 for gain in gains]
        best = int(np.argmax(told))
        if not told[best]:
            break
        kept.append(pieces[best])
        left = [free & ~covers for covers, free in zip(pieces[best].covers, left, strict=True)]
    return kept
