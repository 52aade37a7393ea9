"""Normals of a view's pixels, drawn towards the surface that all views made.

A pixel has a normal p of its own, one photometric stereo (joint/pixels.py), and the normal m of the surface that it shows, which all views'
normals, masks and smoothness made. Of the means p + a (m - p) the one nearest to the truth t has

    a = E[(p - t) . (p - m)] / E|p - m|^2

(James and Stein 1961; Stone 1974 for other data in the truth's place). The truth is not known, but other views' pixels err about it on
their own: in its place stands the mean r of what the nearest views show there. They show it between their pixels, blurred, and detail
that r has lost would count as p's error: so r is held against Bp, own normals blurred as much. Of each view's error, with the variance V,
m holds a part s where n views, effectively, show a place, n = (sum w)^2 / sum w^2. So (Bp - r) . (p - m) has b V in the mean, b the weight
of a pixel in its own blurred value, where (p - t) . (p - m) has V (1 - s), and

    a = (1 - s) E[(Bp - r) . (p - m)] / (b E|p - m|^2),      between 0 and 1,      s = 1 / n^2

with means over the vertices around. A surface that followed the mean of n normals at its place would hold 1 / n, one that is a mean over
many pixels around, and lies where views agree, next to nothing; the square of the former stands between (docs/findings/normals.md). Where
nothing but one view shows a place, p stays. What errs alike in all views, as lights do, shows in neither and stays as well.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mvps.camera import project, view_directions
from mvps.cores import on_cores
from mvps.mesh import dot, normalise
from mvps.scene import Bool, Capture, Float, Surface, View
from mvps.silhouette import sampled
from mvps.texel_normals import Places, around
from mvps.visibility import Hits, RayCaster, interpolate, interpolate_all, ray_caster, view_hits, visible_vertices

OTHERS = 4
"""Views beside a pixel's own that are asked: they show the same places, and r errs by little more than with all, of which far ones blur
more (docs/findings/normals.md)."""

ASLANT = 0.5
"""Least squared cosine at which another view shows a place, over the pixel's own: at a half its pixels are 1.4 times as long there."""

BETWEEN = np.array([1, 10, 1]) / 12
"""B along either axis: linear interpolation spreads by u (1 - u) square pixels a part u of the way to the next pixel, 1/6 in the mean."""

WHOLE = 0.99
"""Of a bilinear value, the part that must come from pixels with normals."""

Picture = NDArray[np.float32]


class _Shown(NamedTuple):
    """Of a view's n pixels: own (n, 3) normals, 0 where not known, and blurred by B; surface's (n, 3), and its points (n, 3), 0 where it
    is missed; hits. picture: the own ones with ones beside them (height, width, 4), 0 where not known. sees (V,): whether it sees a
    vertex."""

    view: View
    own: Float
    blurred: Float
    mesh: Float
    point: Float
    hits: Hits
    picture: Picture
    sees: Bool


def drawn_to_surface(capture: Capture, surface: Surface, pictures: list[Picture]) -> list[Picture]:
    """The views' normals (height, width, 3), NaN where not known, each with its part of the surface's."""
    caster = ray_caster(surface)
    views = on_cores(lambda view, picture: _shown(caster, view, picture), capture.views, pictures)
    towards = normalise(np.array([view.camera.centre for view in capture.views]) - surface.vertices.mean(0))
    alike = towards @ towards.T
    # Of two views from one side neither is the other, and none is its own.
    np.fill_diagonal(alike, -np.inf)
    nearest = np.argsort(-alike, axis=1, kind="stable")[:, : min(OTHERS, len(views) - 1)]
    told = on_cores(lambda i: _products(surface, views[i], [views[j] for j in nearest[i]]), range(len(views)))
    products, trust = (np.concatenate(parts) for parts in zip(*told, strict=True))
    hits = [one.hits for one in views]
    places = Places(np.concatenate([h.face for h in hits]).clip(0), np.concatenate([h.barycentric for h in hits]))
    common, apart = around(surface, places, products, trust).T
    weights = np.array([one.sees * _facing(one.view, caster.vertex_normals, surface.vertices) for one in views])
    count = weights.sum(0) ** 2 / np.maximum((weights**2).sum(0), np.finfo(float).tiny)
    alone = 1 / np.maximum(np.concatenate([interpolate(surface, h, count) for h in hits]), 1)
    part = ((1 - alone**2) * common / np.maximum(apart, np.finfo(float).tiny)).clip(0, 1)
    return on_cores(_drawn, views, pictures, np.split(part, np.cumsum([len(h.face) for h in hits])[:-1]))


def _facing(view: View, normal: Float, points: Float) -> Float:
    """(n,) squared cosines at which a view sees points with normals (n, 3)."""
    cosine: Float = dot(normal, view_directions(view.camera, points)).clip(0)
    return cosine**2


def _shown(caster: RayCaster, view: View, picture: Picture) -> _Shown:
    surface, known = caster.surface, np.isfinite(picture).all(-1)
    normals = np.zeros((*known.shape, 4), np.float32)
    normals[known] = np.column_stack([picture[known], np.ones(known.sum())])
    hits = view_hits(caster, view)
    normal, point = interpolate_all(surface, hits, caster.vertex_normals, surface.vertices)
    mesh = normalise(normal)
    own = normals[view.mask][:, :3].astype(float)
    around_it = cv2.sepFilter2D(normals, -1, BETWEEN, BETWEEN, borderType=cv2.BORDER_CONSTANT)[view.mask].astype(float)
    blurred = around_it[:, :3] / np.maximum(around_it[:, 3:], np.finfo(float).tiny)
    return _Shown(view, own, blurred, mesh, point, hits, normals, visible_vertices(caster, view.camera))


def _products(surface: Surface, of: _Shown, others: list[_Shown]) -> tuple[Float, Float]:
    """(n, 2) (Bp - r) . (p - m) / b and |p - m|^2 of a view's pixels, and (n,) their weight, 0 where no other view shows the place."""
    corners, total = np.take(surface.faces, of.hits.face.clip(0), axis=0).T, np.zeros_like(of.own)
    facing = _facing(of.view, of.mesh, of.point)
    for other in others:
        first, second, third = (np.take(other.sees, corner) for corner in corners)
        seen = np.flatnonzero((of.hits.face >= 0) & first & second & third)
        point, mesh = (np.take(values, seen, axis=0) for values in (of.point, of.mesh))
        found = sampled(other.picture, project(other.view.camera, point)[0], cv2.BORDER_CONSTANT)
        weight = _facing(other.view, mesh, point)
        weight *= (found[:, 3] > WHOLE) & (weight >= ASLANT * facing[seen])
        total[seen] += normalise(found[:, :3].astype(float)) * weight[:, None]
    away, told = of.own - of.mesh, (total != 0).any(1) & (of.own != 0).any(1)
    apart = (of.blurred - normalise(total)) / BETWEEN[1] ** 2
    return np.stack([dot(apart, away), dot(away, away)], 1), told * facing


def _drawn(of: _Shown, picture: Picture, part: Float) -> Picture:
    result, normal = picture.copy(), normalise(of.own + part[:, None] * (of.mesh - of.own))
    moved = (part > 0) & (of.own != 0).any(1)
    result[of.view.mask] = np.where(moved[:, None], normal, picture[of.view.mask])
    return result
