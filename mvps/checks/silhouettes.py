"""Masks that do not fit their photographs, and views that do not fit the others.

In this order, each mended before the next is looked at:

mask    grown or shrunk as a whole: the edge of what the photographs show lit is not where the mask ends (lit.py)
point   silhouettes that disagree, and one shift of all principal points explains it (principal.py): moved
part    dark under all lights, at the mask's rim, and outside the hull of the other views or apart from the rest: taken out; lit, outside
        the mask or in a hole of it, where the other views leave room for it or show it: given back. A hole that shows the background,
        and what stands beside the object in all views, stay out
view    silhouettes that disagree (cones.py): where all others agree without a view, and without no other, that view's pose is not that of
        its photographs, and it is left out; so are two views of one pose and two silhouettes where nothing says which is wrong

Photographs speak of masks only where they tell object from background; silhouettes speak of views always.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy.ndimage import binary_opening, binary_propagation

from mvps.camera import project
from mvps.checks.coherence import Coherence, coherence
from mvps.checks.cones import ENOUGH, Cones, wrong_at_most
from mvps.checks.lit import BLOCK, Lit, lit_part, missing_parts, moved, steps, stray_parts
from mvps.checks.outlines import DOUBTFUL_PIXELS, fallen, misfit, outlines_of
from mvps.checks.principal import pointed
from mvps.cores import on_cores
from mvps.finding import Finding
from mvps.load import with_mask
from mvps.material import CERTAIN
from mvps.own_units import object_place
from mvps.scene import Bool, Capture, Float, View
from mvps.silhouette import mask_distances

FEWEST = 3
"""Views that can contradict one another: of two, either may be wrong."""

LINES = 400
"""Of sight through a part, at most: the share of them that meet something is known to a fortieth."""


def silhouettes(capture: Capture) -> tuple[Capture, list[Finding]]:
    """The capture with masks mended and wrong views left out, and what was found."""
    mended, shown, findings = _moved(capture)
    if len(mended.views) < FEWEST:
        return mended, findings
    cones = Cones(mended)
    body = cones.body()
    if body is not None and max(cones.uncovered(range(len(mended.views)))) > ENOUGH:
        mended, of_point = pointed(mended, body)
        cones = Cones(mended) if of_point else cones
        findings = [*findings, *of_point]
    mended, of_parts = _parted(cones, shown)
    left, of_views = _left_out(Cones(mended) if of_parts else cones)
    if len(left.views) < len(mended.views):
        # A wrong view hides what other masks lack.
        kept = {view.name for view in left.views}
        left, of_more = _parted(Cones(left), [found for found, view in zip(shown, mended.views, strict=True) if view.name in kept])
        of_views = [*of_views, *of_more]
    return left, [*findings, *of_parts, *of_views]


def _shown(capture: Capture) -> list[Lit | None]:
    """What the photographs show. A lens blurs all alike; in a single one shadows may look so."""
    found = on_cores(lambda view: lit_part(view, steps(view.mask)), capture.views)
    beyond = [one.beyond for one in found if one is not None and one.judged]
    blurred = bool(beyond) and np.median(beyond) > 1
    return [one.blurred() if blurred and one is not None else one for one in found]


def _moved(capture: Capture) -> tuple[Capture, list[Lit | None], list[Finding]]:
    """Masks that are off as a whole, with their boundary where the object ends; what the photographs show beside them; what was found."""
    shown = _shown(capture)
    views, edges = list(capture.views), {}
    for at, (view, found) in enumerate(zip(capture.views, shown, strict=True)):
        mask = moved(view, steps(view.mask), found) if found is not None and found.off and view.files else None
        if found is not None and mask is not None and mask.any():
            views[at] = with_mask(view, mask)
            again = lit_part(views[at], steps(mask))
            shown[at] = again.blurred() if again is not None and found.blur else again
            edges[view.name] = found.edge
    if not edges:
        return capture, shown, []
    where = "all views" if len(edges) == len(views) else ", ".join(edges)
    middle = float(np.median(list(edges.values())))
    way = "larger" if middle < 0 else "smaller"
    text = (
        f"{'masks are' if len(edges) > 1 else 'the mask is'} {way} than the object: in the photographs it ends"
        f" {abs(middle):.1f} pixels {'inside' if middle < 0 else 'outside'} the boundary (median), more than the pixels' staircase"
        " explains; moved to where it ends"
    )
    return Capture(capture.name, tuple(views)), shown, [Finding("mask", where, text, True)]


def _parted(cones: Cones, shown: list[Lit | None]) -> tuple[Capture, list[Finding]]:
    """The capture, its masks without what is none of the object and with what they lack of it, by what the photographs show."""
    capture = cones.capture

    def parts_of(view: View, found: Lit | None) -> tuple[list[Bool], list[Bool]]:
        if found is None or not found.judged or not view.files:
            return [], []
        return stray_parts(view.mask, found), missing_parts(view.mask, found) if found.dark else []

    parts = on_cores(parts_of, capture.views, shown)
    if not any(stray or missing for stray, missing in parts):
        return capture, []
    views, lacking = list(capture.views), _lacking(cones, [missing for _, missing in parts])
    gone, back = dict[str, int](), dict[str, int]()
    for at, (stray, _) in enumerate(parts):
        view = views[at]
        out = _sum([part for part in stray if _needless(cones, at, part)], view.mask)
        added = _sum(lacking[at], view.mask)
        gone |= {view.name: int(out.sum())} if out.any() else {}
        back |= {view.name: int(added.sum())} if added.any() else {}
        if out.any() or added.any():
            views[at] = with_mask(view, (view.mask | added) & ~out)
    if not gone and not back:
        return capture, []
    said = (
        (gone, "{} pixels of the mask are dark in all photographs and outside the other views' silhouettes: taken out"),
        (back, "the mask lacks {} pixels that are lit in the photographs and inside the other views' silhouettes: given back"),
    )
    findings = [Finding("mask", ", ".join(of), text.format(sum(of.values())), True) for of, text in said if of]
    return Capture(capture.name, tuple(views)), findings


def _sum(parts: Sequence[Bool], like: Bool) -> Bool:
    """All parts in one picture."""
    return np.asarray(np.logical_or.reduce([np.zeros_like(like), *parts]))


def _lacking(cones: Cones, missing: Sequence[Sequence[Bool]]) -> list[list[Bool]]:
    """Of lit parts (height, width) beside every view's mask those that are the object's. The hull of the other views, but for those that
    may be wrong, covers most of each with its slack. But slack covers what stands beside the object as well, a stand or light on a wall
    that all masks leave out. So the others have to leave room for it without slack, or to show it: have pixels that nothing else covers."""
    views = cones.capture.views
    everyone, dissent = range(len(views)), wrong_at_most(len(views)) - 1
    within = [[part for part in of_view if cones.covered(at, everyone, dissent)[part].mean() > 0.5] for at, of_view in enumerate(missing)]
    if not any(within):
        return within
    disagree = any(cones.uncovered(everyone))
    return [
        [part for part in of_view if _has_room(cones, at, part) or (disagree and _is_shown(cones, at, part, within))]
        for at, of_view in enumerate(within)
    ]


def _has_room(cones: Cones, view: int, part: Bool) -> bool:
    """Whether most lines of sight through a part meet what the other views leave of the object, as those along outlines do."""
    body = cones.body()
    if body is None:
        return False
    pixels = np.argwhere(part)
    some = pixels[:: -(-len(pixels) // LINES)]
    capture = cones.capture
    found = coherence([one.camera for one in capture.views], mask_distances(capture), body, view, some[:, ::-1] + 0.5)
    return bool(np.median(found.miss) <= DOUBTFUL_PIXELS)


def _is_shown(cones: Cones, view: int, part: Bool, parts: Sequence[Sequence[Bool]]) -> bool:
    """Whether other masks have a block of pixels that nothing covers if all of these parts of all views are the object's but this one."""
    masks, everyone = [one.mask for one in cones.capture.views], range(len(parts))
    whole = [_sum(of_view, mask) for of_view, mask in zip(parts, masks, strict=True)]
    without = [of_view & ~part if at == view else of_view for at, of_view in enumerate(whole)]
    more, less = (sum(cones.with_parts(given).uncovered(everyone)) for given in (without, whole))
    return more - less >= BLOCK.size


def _needless(cones: Cones, view: int, part: Bool) -> bool:
    """Whether a dark part of a mask is none of the object: the others' hull leaves most of it out, or more than
    errors of poses can, or it hangs together with nothing lit. Elsewhere darkness may be the object's own shadow."""
    outside = ~cones.covered(view, range(len(cones.capture.views)))[part]
    if outside.mean() >= 0.5 or outside.sum() > ENOUGH:
        return True
    mask = cones.capture.views[view].mask
    return bool((binary_propagation(part, BLOCK, mask) == part).all())


def _left_out(cones: Cones) -> tuple[Capture, list[Finding]]:
    """The capture without views whose silhouettes contradict the others'."""
    capture = cones.capture
    among = list(range(len(capture.views)))
    if len(among) <= FEWEST:
        return capture, []
    names, most = [view.name for view in capture.views], wrong_at_most(len(capture.views))
    counts = at_first = cones.uncovered(among)
    findings: list[Finding] = []
    while max(counts) > ENOUGH and len(findings) < most and len(among) > FEWEST:
        left = [cones.uncovered([j for j in among if j != k]) for k in among]
        sums = np.array([sum(one) for one in left])
        best = int(sums.argmin())
        alike = [among[k] for k in np.flatnonzero(sums <= sums[best] + ENOUGH)]
        # Where without either of two views the others' hulls cover masks as well, lines of sight along outlines say more.
        wrong = _wrong(cones, among, alike) if len(alike) > 1 else among[best]
        if wrong is None:
            break
        best = among.index(wrong)
        text = (
            f"its silhouette contradicts the others' ({sum(counts)} pixels of the masks outside the other views' hull with it,"
            f" {sums[best]} without): its pose is not that of its photographs; left out"
        )
        findings.append(Finding("pose", names[among.pop(best)], text, True))
        counts = left[best]
    for pair in _twins([capture.views[at] for at in among], *object_place(capture)):
        both = [names.index(view.name) for view in pair]
        if not {*both} <= {*among}:
            continue
        wrong = _wrong(cones, among, both)
        if wrong is not None and len(findings) < most:
            right = names[both[both[0] == wrong]]
            text = f"it has the pose of {right}, and the others' silhouettes agree with that of {right}, not with its own: left out"
            findings.append(Finding("pose", names[wrong], text, True))
            among.remove(wrong)
            continue
        out = len(findings) + len(both) <= most
        among = [at for at in among if at not in both] if out else among
        for view, other in (pair, pair[::-1]):
            done = "both left out" if out else "correct it, or leave it out"
            text = f"it has the pose of {other.name} and another silhouette: one of the two is wrong; {done}"
            findings.append(Finding("pose", view.name, text, out))
        counts = cones.uncovered(among)
    if max(counts) > ENOUGH:
        text = (
            f"silhouettes disagree: {sum(at_first)} pixels of the masks are outside the other views' hull, most in"
            f" {names[int(np.argmax(at_first))]}, and no view alone explains it; check poses and masks"
        )
        return capture, [Finding("pose", "all views", text, False)]
    return (Capture(capture.name, tuple(capture.views[at] for at in among)) if len(among) < len(names) else capture), findings


def _wrong(cones: Cones, among: Sequence[int], suspects: Sequence[int]) -> int | None:
    """The one of some suspect views without which lines of sight along the outlines of all others, `among` these, meet what other views
    leave of the object; None where there is none, or without another they do as well."""
    body = cones.body()
    if body is None:
        return None
    outlines = outlines_of(cones.capture, body)
    rest = {k: [j for j in among if j != k] for k in suspects}
    misses = {k: outlines.among(rest[k]).misses() for k in suspects}
    best, second = sorted(suspects, key=lambda k: misfit(misses[k]))[:2]

    def of_others(without: int) -> list[Coherence]:
        return [one for j, one in zip(rest[without], misses[without], strict=True) if j not in (best, second)]

    fall, error = fallen(of_others(second), of_others(best))
    return best if misfit(misses[best]) <= DOUBTFUL_PIXELS and fall > CERTAIN * error else None


def _twins(views: Sequence[View], place: Float, size: float) -> list[tuple[View, View]]:
    """Pairs of views whose cameras show a cube of the object's place (3,) and size at the same pixels, and whose masks differ by more than
    their outlines' staircase."""
    pairs, cube = [], place + size / 2 * np.array(list(product((-1, 1), repeat=3)))
    shown = {view.name: project(view.camera, cube)[0] for view in views}
    for at, one in enumerate(views):
        for other in views[at + 1 :]:
            moved = np.abs(shown[one.name] - shown[other.name]).max()
            if moved < 1 and one.mask.shape == other.mask.shape and binary_opening(one.mask ^ other.mask, BLOCK).sum() > ENOUGH:
                pairs.append((one, other))
    return pairs
