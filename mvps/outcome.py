"""From what Stage II ends with to a result: lights of all photographs, normals of all views, the verdict, the account."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from mvps import __version__
from mvps.finding import Finding
from mvps.progress import Progress
from mvps.scene import Capture, Lights, Reconstruction, View

if TYPE_CHECKING:
    from mvps.device import Device
    from mvps.joint.refine import Refined
    from mvps.scene import Material, Surface


def lights_of(lights: Lights, names: Sequence[str], numbers: Sequence[Sequence[int]], part: Capture) -> Lights:
    """The lights of just the photographs of `part`, from those of the views `names`, which have these numbers."""
    directions, intensities = [], []
    for view in part.views:
        at = names.index(view.name)
        rows = [numbers[at].index(n) for n in view.lights]
        directions.append(lights.direction[at][rows])
        intensities.append(lights.intensity[at][rows])
    return replace(lights, direction=tuple(directions), intensity=tuple(intensities))


def lights_in(lights: Lights, capture: Capture, part: Capture) -> Lights:
    """The lights of a part of a capture, from those of all of it."""
    return lights_of(lights, [view.name for view in capture.views], [view.lights for view in capture.views], part)


def all_lights(
    capture: Capture,
    used: Capture,
    held: Capture | None,
    lights: Lights,
    surface: Surface,
    material: Material,
    device: Device,
    given: Lights | None = None,
) -> Lights:
    """Lights of every photograph of `capture`, in its order: `lights` where used, else carried over from the rig or fitted; where lights
    were `given`, of all of `capture`, these, as strong as those that were used came out."""
    import numpy as np

    if given is not None:
        came, went = (np.concatenate(of.intensity).mean() for of in (lights, lights_in(given, capture, used)))
        return replace(given, intensity=tuple(of_view * (came / went) for of_view in given.intensity))
    from mvps.joint.held_out import carried_over, fit_lights
    from mvps.joint.strengths import strengths_of

    strengths = strengths_of(lights) if len({view.lights for view in used.views}) == 1 else None
    known: dict[tuple[str, int], tuple[Any, Any]] = {}
    for view, directions, intensities in zip(used.views, lights.direction, lights.intensity, strict=True):
        known.update({(view.name, n): pair for n, pair in zip(view.lights, zip(directions, intensities, strict=True), strict=True)})
    if held is not None and lights.one_rig:
        for view in held.views:
            directions, intensities = carried_over(lights, used.views[0].camera, view.camera)
            # How bright photographs are that were not used, nothing says.
            intensities = intensities if strengths is None else intensities / strengths[0][:, None]
            rig = dict(zip(used.views[0].lights, zip(directions, intensities, strict=True), strict=True))
            known.update({(view.name, n): rig[n] for n in view.lights if n in rig})
    if held is not None:
        unknown = {view.name: [n for n in view.lights if (view.name, n) not in known] for view in held.views}
        rest = held.select({name: numbers for name, numbers in unknown.items() if numbers}) if any(unknown.values()) else None
        if rest is not None:
            shared = lights.one_rig and strengths is None and len({view.lights for view in rest.views}) == 1
            fitted = fit_lights(rest, surface, material, shared, device, shared and lights.fixed)
            for view, directions, intensities in zip(rest.views, fitted.direction, fitted.intensity, strict=True):
                known.update({(view.name, n): pair for n, pair in zip(view.lights, zip(directions, intensities, strict=True), strict=True)})
    direction = tuple(np.array([known[view.name, n][0] for n in view.lights]) for view in capture.views)
    intensity = tuple(np.array([known[view.name, n][1] for n in view.lights]) for view in capture.views)
    return replace(lights, direction=direction, intensity=intensity)


def normal_pictures(capture: Capture, used: Capture, refined: Refined) -> tuple[Any, ...]:
    """Refined normals (height, width, 3) of every view, NaN outside the mask.

    Views that were used show their own pixels' normals, as far as they were solved (`filled`); held-out ones the vertices' normals. A pixel
    that misses the mesh takes its nearest neighbour's.
    """
    import numpy as np
    from scipy.ndimage import distance_transform_edt

    from mvps.cores import on_cores
    from mvps.joint.pixels import filled
    from mvps.mesh import normalise
    from mvps.visibility import interpolate, ray_caster, view_hits

    caster = ray_caster(refined.surface)
    own = {view.name: maps for view, maps in zip(used.views, refined.maps, strict=True)}
    # What a view's pixels hit is kept for the view: the verdict asks for those that were used.
    same = {view.name: view for view in used.views}

    def one(view: View) -> Any:
        hits = view_hits(caster, same.get(view.name, view))
        normal, hit = normalise(interpolate(refined.surface, hits, refined.material.normal)), hits.face >= 0
        normal = filled(view, own[view.name], normal) if view.name in own else normal
        picture = np.full((*view.mask.shape, 3), np.nan, np.float32)
        picture[view.mask] = np.where(hit[:, None], normal, np.nan)
        if hit.any():
            nearest = distance_transform_edt(np.isnan(picture[..., 0]), return_distances=False, return_indices=True)
            picture = picture[tuple(nearest)]
        picture[~view.mask] = np.nan
        return picture

    return tuple(on_cores(one, capture.views))


def versions() -> dict[str, str]:
    """Versions of the program and of the libraries that its figures depend on."""
    import platform
    from importlib.metadata import version

    names = ("torch", "numpy", "scipy", "libigl", "embreex", "scikit-image", "gpytoolbox", "opencv-python-headless")
    return {"mvps": __version__, "python": platform.python_version(), **{name: version(name) for name in names}}


def told(
    capture: Capture,
    used: Capture,
    settings: Mapping[str, Any],
    refined: Refined,
    complete: Lights,
    pictures: tuple[Any, ...],
    rounds: list[dict[str, float]],
    progress: Progress,
    findings: Sequence[Finding],
    words: str = "",
) -> Reconstruction:
    """The result with the account of how it came about, and whether it is to be trusted.

    used: what it was made from; settings: plain values; complete, pictures: lights and normals of all views, of those used their pixels'
    own, which the verdict compares and the result draws to the surface; findings: of the capture's checks; words: to end the verdict with.
    """
    from mvps.joint.strengths import strengths_of, unknown_in
    from mvps.measures import held_out_photographs, held_out_views, photograph_errors
    from mvps.nearness import nearness
    from mvps.verdict import signs, verdict
    from mvps.view_normals import drawn_to_surface

    with progress.stage("verdict") as stage:
        names = [view.name for view in capture.views]
        of_used = [pictures[names.index(view.name)] for view in used.views]
        found = signs(used, refined.surface, refined.material, of_used, refined.unexplained)
        status, text = verdict(found, (refined.status, refined.text), findings)
        # Normals of one view may be right, and heights wrong all the same.
        status = "one view" if words and status == "converged" else status
        near = nearness(used, refined.surface, refined.material, refined.lights)
        if near.near:
            said = "brightness falls off across the object as it does under near lights, which are taken for directional ones: normals lean"
            findings = [*findings, Finding("lights", "all views", f"{said} ({near.slope:.3f}, far lights 0)", False)]
            text = f"{text} But {said}."
        strengths = strengths_of(refined.lights)
        if strengths is not None and not settings.get("calibrated_lights"):
            by_view = unknown_in(strengths) == 1
            least, most = strengths.min(), strengths.max()
            said = f"photographs are{', view by view,' if by_view else ''} {least:.2f} to {most:.2f} times as bright as one rig makes them:"
            said += f" exposures that differ{'' if by_view else ', or lamps that flicker'}, which were solved; intensities of the lights"
            said += " hold them"
            findings = [*findings, Finding("lights", "all views", said, True)]
        drawn = dict(zip((view.name for view in used.views), drawn_to_surface(used, refined.surface, of_used), strict=True))
        stage.status(status)
    metrics = {"stages": progress.stages, "rounds": rounds, "status": {"name": status, "text": f"{text} {words}".strip(), **found}}
    metrics["findings"] = [asdict(one) for one in findings]
    metrics["model"] = {
        "components": [asdict(trial) for trial in refined.trials],
        "sharpness": list(refined.law.sharpness),
        "grazing": refined.law.grazing,
        "bounce": refined.law.bounce,
        "gleam": refined.law.gleam,
        "share_with_neural_residual": 0.0 if refined.material.residual is None else float(refined.material.residual.share.mean()),
    }
    result = Reconstruction(
        refined.surface,
        refined.material,
        complete,
        tuple(names),
        tuple(view.lights for view in capture.views),
        tuple(drawn.get(name, picture) for name, picture in zip(names, pictures, strict=True)),
        metrics,
        {**settings, "versions": versions()},
        pictures,
    )
    photographs = held_out_photographs(result)
    if not photographs:
        return result
    errors = photograph_errors(result.surface, result.material, photographs, capture, held_out_views(result))
    return replace(result, metrics={**metrics, "held_out": errors})
