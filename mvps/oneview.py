"""One view: photometric stereo whose surface comes from its normals alone.

factorisation -> 3 x 3 ambiguity (relief/ambiguity.py) -> photometric stereo -> rounds of bas-relief, integration and Stage II
(joint/one_view.py), each but the first from the ambiguity on, without highlights -> the same result as of many views.
Where nothing resolves the ambiguity, lights are those under which an object of two materials explains most (two_materials.py), found from
those under the inflated silhouette's normals. There, and on metals under given lights, rounds start from the normals of exemplars of these
materials (exemplars.py), and leave the lights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mvps.finding import Finding
from mvps.progress import Progress
from mvps.scene import Capture, CaptureError, Float, Lights, NormalMap, Reconstruction, Surface, View, less_confident

if TYPE_CHECKING:
    from mvps.device import Device
    from mvps.joint.refine import Refined
    from mvps.plan import Parts
    from mvps.reconstruct import Settings
    from mvps.relief.ambiguity import Resolved

WORDS = (
    "One view: the surface is what its normals integrate to, open, of what this camera sees; its distance {distance} and heights of steps"
    " are not known from photographs under distant lights."
)
UNTOLD = (
    " Lambert's law does not tell its lights, which are those under which two materials explain most of the photographs (where no pixel has"
    " five values, what the silhouette tells): three to ten degrees off, or twenty."
)
OF_ORIGIN = "is the world origin's"
FEWEST_LIGHTS = 12
"""From which on trimmed photographs leave enough for normals: nine."""

KEPT, CONCENTRATIONS = 0.75, 10
"""Part of the photographs that is believed in the search for wrong ones, as is usual for least trimmed squares; its steps, of which two or
three are needed."""

OUTLYING = 3.0
"""Times what photographs leave in the median: highlights alone make 2.4 (ball, bunny), photographs that are wrong 5 and more (bear)."""

LIT, FEWEST_PIXELS = 0.3, 30
"""Cosine from which a pixel is well lit; pixels that must be."""

OF_UNIT = "is such that a pixel covers one unit of length (the world's origin is not in the picture): its size is not known either,"


def distance_of(view: View) -> tuple[float, str]:
    """Depth of the surface along the camera's axis, world units, and where it is from, in words: the world origin's, where it lies
    in front of the camera inside the mask's bounding box; else the focal length."""
    from mvps.camera import project

    depth = float(view.camera.translation[2])
    if depth > 0:
        image = project(view.camera, np.zeros(3))[0]
        low, high = view.pixels.min(0)[::-1], view.pixels.max(0)[::-1] + 1
        if ((image >= low) & (image <= high)).all():
            return depth, OF_ORIGIN
    return view.camera.focal_length, OF_UNIT


def surface_of(view: View, normal: Float, confidence: Float, distance: float) -> Surface:
    """The open mesh that normals (pixels, 3), world frame, with confidence (pixels,) integrate to."""
    from mvps.relief.integrate import integrate
    from mvps.relief.surface import pixel_surface

    local = np.asarray(normal, np.float64) @ view.camera.rotation.T
    depth = integrate(view.camera, view.mask, local, np.asarray(confidence, np.float64))
    return pixel_surface(view.camera, view.pixels, local, depth, distance)


def first_lights(capture: Capture, rough: Float, under: Float, seed: int) -> tuple[Lights, Resolved | None]:
    """Lights of the capture's only view by factorisation, with its ambiguity resolved up to what lobes say later, and what resolved it;
    those `under` (lights, 3) the rough normals (pixels, 3) of its inflated silhouette where nothing did (None)."""
    from mvps.calibrate import MINIMUM_LIGHTS, solve_ambiguity
    from mvps.relief.ambiguity import factors, first_resolved

    view = capture.views[0]
    if len(view.lights) < MINIMUM_LIGHTS:
        raise CaptureError(
            f"{capture.name}: wanted at least {MINIMUM_LIGHTS} photographs of the one view to solve its lights, given"
            f" {len(view.lights)}; add photographs, views or --calibrated-lights"
        )
    generator = np.random.default_rng(seed)
    pseudo = factors(view, generator)
    try:
        found = first_resolved(view, pseudo, rough, solve_ambiguity(pseudo.left, rough, pseudo.weight), under, generator)
    except np.linalg.LinAlgError as error:
        raise CaptureError(
            f"{capture.name}: wanted photographs whose lights span three directions, given ones where {error};"
            " use other lights or --calibrated-lights"
        ) from error
    return _lights(view, under if found is None else found.lights), found


def words_of(found: Resolved | None) -> str:
    """How the lights of one view were found."""
    if found is None:
        return "one view, whose lights Lambert's law does not tell: from the silhouette's normals at first"
    return f"one view; three factors leave {100 * found.pseudo.residual:.1f} % of the images"


def of_silhouette(maps: NormalMap, rough: Float, view: View) -> NormalMap:
    """The view's maps with the rough normals (pixels, 3), camera frame, of its inflated silhouette."""
    return replace(maps, normal=(rough @ view.camera.rotation).astype(np.float32))


def lights_again(view: View, lights: Lights, rough: Float, seed: int) -> tuple[Lights, Resolved]:
    """The lights with their 3 x 3 ambiguity resolved anew by photographs without highlights, and what resolved it; rough (pixels, 3): the
    inflated silhouette's normals."""
    from mvps.relief.ambiguity import Resolved, factors_under, resolved

    strength = lights.intensity[0].mean(1, keepdims=True)
    colour = lights.intensity[0] / strength
    pseudo = factors_under(view, lights.direction[0] @ view.camera.rotation.T * strength, colour)
    found = Resolved(pseudo, rough, resolved(view, pseudo, rough, np.eye(3), np.random.default_rng(seed)))
    return _lights(view, found.lights, colour), found


def _lights(view: View, scaled: Float, colour: Float | None = None) -> Lights:
    """Lights of intensity times direction (lights, 3), camera frame; colour (lights, 3) of their intensities, mean one, that of the view as
    a whole if None."""
    from mvps.calibrate import normalised, without_gaps
    from mvps.pixel_samples import lamp_colours

    scaled, colour = without_gaps(scaled), lamp_colours(view) if colour is None else colour
    strength = np.linalg.norm(scaled, axis=1, keepdims=True)
    return normalised([scaled / strength @ view.camera.rotation], [strength * colour], True)


def residuals(view: View, maps: NormalMap, lights: Lights) -> Float:
    """(lights,) of each photograph the median residual of Lambert's law over its median value, at its well lit pixels; NaN where these are
    too few."""
    from mvps.pixel_samples import grey_under

    cosine = maps.normal.astype(np.float64) @ lights.direction[0].T
    strength = lights.intensity[0].mean(1)
    predicted = maps.albedo.mean(1)[:, None] * cosine * strength
    image = grey_under(view.samples, lights.intensity[0] / strength[:, None]) * view.scale
    lit = view.usable() & (cosine > LIT) & (maps.confidence > 0)[:, None]
    enough = [np.flatnonzero(lit[:, k]) if lit[:, k].sum() >= FEWEST_PIXELS else None for k in range(lit.shape[1])]
    found = [
        np.nan if rows is None else np.median(np.abs(image[rows, k] - predicted[rows, k])) / max(np.median(image[rows, k]), 1e-12)
        for k, rows in enumerate(enough)
    ]
    return np.array(found)


def without_misfits(capture: Capture, lights: Lights, device: Device) -> tuple[Capture, list[Finding]]:
    """The capture without photographs that fit no surface under the given lights: they, or their lights, are wrong.

    Least trimmed squares: normals from the KEPT part of the photographs that fits best, all photographs ranked anew by what these normals
    leave of them, until the part stays the same (Rousseeuw and Van Driessen 2006). Then those are left out that leave more than POOR_FIT
    and OUTLYING times what is usual.
    """
    from mvps.material import POOR_FIT
    from mvps.photometric import normal_maps

    view = capture.views[0]
    if len(view.lights) < FEWEST_LIGHTS:
        return capture, []
    dropped: list[int] = []
    found: Float = np.zeros(len(view.lights))
    for _ in range(CONCENTRATIONS):
        found = residuals(view, normal_maps(capture.without({view.name: dropped}), lights, device)[0], lights)
        order = np.argsort(np.nan_to_num(found, nan=np.inf), kind="stable")
        worst = sorted(view.lights[k] for k in order[int(np.ceil(KEPT * len(order))) :])
        if worst == dropped:
            break
        dropped = worst
    most = max(POOR_FIT, OUTLYING * float(np.median(found[np.isfinite(found)]))) if np.isfinite(found).any() else np.inf
    wrong = [n for n, r in zip(view.lights, found, strict=True) if r > most]
    words = "fits no surface under its light as the others do; left out"
    return capture.without({view.name: wrong}), [Finding("photograph", f"{view.name}/{n:03d}", words, True) for n in wrong]


class Beginning(NamedTuple):
    """What rounds begin with: used, the capture less photographs that were left out (misfits); lights, and maps, photometric stereo of its
    view under them, shiny: by exemplars, for it is of metal or the like; scatter: variance of lights by two materials along a tangent."""

    used: Capture
    lights: Lights
    maps: NormalMap
    misfits: list[Finding]
    shiny: bool
    scatter: float = 0.0


def beginning(used: Capture, lights: Lights, resolved: bool, given: bool, rough: Float, device: Device, seed: int) -> Beginning:
    """Lights of the capture's only view and its normals under them, from its first lights: given ones, ones that Lambert's law resolved, or
    its silhouette's, from which those of two materials are found where that law says nothing of the photographs. rough (pixels, 3): the
    silhouette's normals, for pixels of too few values."""
    from mvps.exemplars import is_shiny, with_exemplars
    from mvps.photometric import normal_maps
    from mvps.relief.ambiguity import outer_band
    from mvps.two_materials import lights_by_materials, materials_under

    view = used.views[0]
    # No photograph of metals can be told to be wrong by Lambert's law.
    if not (resolved or given):
        scaled = lights.direction[0] @ view.camera.rotation.T * lights.intensity[0].mean(1, keepdims=True)
        scaled, scatter = lights_by_materials(view, scaled, rough, outer_band(view), device, seed)
        lights = _lights(view, scaled)
        maps = of_silhouette(normal_maps(used, lights, device)[0], rough, view)
        under = view, lights.direction[0], lights.intensity[0]
        return Beginning(used, lights, with_exemplars(*under, materials_under(*under, device), maps, device, True), [], True, scatter)
    maps, under = normal_maps(used, lights, device)[0], (view, lights.direction[0], lights.intensity[0])
    if given and is_shiny(*under, device):
        return Beginning(used, lights, with_exemplars(*under, materials_under(*under, device), maps, device, False), [], True)
    kept, misfits = without_misfits(used, lights, device)
    return Beginning(kept, lights, normal_maps(kept, lights, device)[0] if misfits else maps, misfits, False)


def refined_from(
    used: Capture, lights: Lights, found: Resolved | None, solved: bool, rough: Float, settings: Settings, parts: Parts, progress: Progress
) -> tuple[Refined, Capture, list[Finding]]:
    """Stage II of the only view of `used` under its first lights, what it was made from, and photographs that were left out.

    found: what resolved the lights; None where they are those under the rough normals (pixels, 3) of its silhouette, from which better ones
    are found (solved), or given ones (not solved).
    """
    from mvps.device import chosen_device
    from mvps.exemplars import BY_EXEMPLARS, BY_MATERIALS
    from mvps.jackknife import at_corners, either, shared_variance
    from mvps.joint.one_view import ROUNDS, Start, refine_view
    from mvps.joint.refine import RefineSettings
    from mvps.photometric import normal_maps

    device, view, rounds = chosen_device(settings.device), used.views[0], ROUNDS[settings.preset]
    distance = distance_of(view)[0]
    with progress.stage("photometric stereo") as stage:
        used, lights, maps, misfits, shiny, scatter = beginning(used, lights, found is not None, not solved, rough, device, settings.seed)
        start = Start(lights, maps, found)
        said = [f"{len(misfits)} photographs left out"] * bool(misfits) + [BY_MATERIALS] * (scatter > 0) + [BY_EXEMPLARS] * shiny
        stage.status("; ".join(said))
    # Rounds bring lights by two materials no nearer.
    plan = parts.of(RefineSettings((), found is not None, solved, final=True))
    with progress.stage("joint refinement", total=rounds) as stage:

        def on_round(_: int, changes: dict[str, float]) -> None:
            stage.advance(1, **{k: v for k, v in changes.items() if k in ("residual", "light_change_deg")})

        def integrated(normal: Float, confidence: Float) -> Surface:
            return surface_of(view, normal, confidence, distance)

        def again(matt: View, before: Lights, maps: NormalMap) -> Start[Resolved | None]:
            if shiny:
                return Start(before, maps, None)
            lights, anew = (before, None) if found is None else lights_again(matt, before, rough, settings.seed)
            return Start(lights, normal_maps(replace(used, views=(matt,)), lights, device)[0], anew)

        refined, start = refine_view(used, start, again, parts.law(), plan, rounds, settings.seed, device, integrated, on_round)
        own, resolved, shared = refined.maps[0].normal.astype(np.float64), start.resolved, None
        if resolved is not None:
            shared = shared_variance(used.views[0], start.lights, start.maps, resolved, parts.law(), settings.seed, device)
        elif shiny:
            # No other view contradicts what is taken for lobes.
            shared = either(own, maps.normal) + scatter
        if shared is not None:
            confidence = less_confident(refined.material.confidence, at_corners(shared, refined.surface))
            refined = replace(refined, material=replace(refined.material, confidence=confidence))
        undone = len(refined.rounds) + 1
        stage.status(refined.status + (f"; round {undone} fitted much worse and was undone" if undone <= rounds else ""))
    return refined, used, misfits


def reconstruct_view(
    capture: Capture,
    used: Capture,
    held: Capture | None,
    settings: Settings,
    given: Lights | None,
    parts: Parts,
    progress: Progress,
    findings: Sequence[Finding],
) -> Reconstruction:
    """A reconstruction from the only view of `used`; the rest as in reconstruct.reconstruct. given: lights of all of `capture`."""
    from mvps.device import chosen_device
    from mvps.outcome import all_lights, lights_in, normal_pictures, told
    from mvps.relief.ambiguity import FAR_DEG, away_deg, lights_under
    from mvps.relief.silhouette import inflated_normals

    device, view = chosen_device(settings.device), used.views[0]
    rough = inflated_normals(view.mask)
    under = lights_under(view, rough)
    with progress.stage("lights") as stage:
        own = given and lights_in(given, capture, used)
        lights, found = (own, None) if own is not None else first_lights(used, rough, under, settings.seed)
        stage.status("given with the capture" if given is not None else words_of(found))
    refined, part, misfits = refined_from(used, lights, found, given is None, rough, settings, parts, progress)
    away = 0.0 if found is None else away_deg(refined.lights.direction[0] @ view.camera.rotation.T, under)
    if away > FAR_DEG:
        with progress.stage("lights") as stage:
            lights, found = _lights(view, under), None
            stage.status(f"rounds turned them {away:.0f} deg from what the silhouette tells: from its normals")
        refined, part, misfits = refined_from(used, lights, found, True, rough, settings, parts, progress)
    with progress.stage("lights and normals of all views"):
        complete = all_lights(capture, part, held, refined.lights, refined.surface, refined.material, device, given)
        pictures = normal_pictures(capture, part, refined)
    said = WORDS.format(distance=distance_of(view)[1]) + (UNTOLD if given is None and found is None else "")
    return told(capture, part, asdict(settings), refined, complete, pictures, refined.rounds, progress, [*findings, *misfits], said)
