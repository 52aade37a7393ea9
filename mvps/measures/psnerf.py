"""What PS-NeRF measures on pixels (Yang et al., ECCV 2022; its evaluation.py, light_avg.py and stage2/utils/metrics.py).

Normals    mean angle of each view, then the mean over the views that were held out (all, where none was), inside the intersection of
           the capture's mask and the result's. The program's normals are those of its second stage: here the refined normal maps, and
           as a second figure the mesh's own.
Lights     mean angle of each view and the mean over the fitted views; intensities relative, with one scale per view.
Images     of held-out views, of each photograph and of the mean over all of a view's lights (light-averaged). On both sides:

               divided by the light's true intensity over that of the view's fourth light (its last, where it
               has fewer; no division where intensities are unknown)
               rendering times one number, the mean over the channels of (r . p) / (r . r) in the intersection of the masks
               clipped to [0, 1], rounded to 8 bits, white outside the intersection of the masks
               PSNR inside the intersection; SSIM and 100 LPIPS of the whole image
               mean over all images

           Photographs of 612 x 512 pixels are cut to 400 x 400, as the paper did with DiLiGenT-MV, here about the middle of the mask's
           bounding box (theirs is not said; only background is cut). Others stay whole.

What differs from the program: photographs keep their 16 bits until the last step. Photographs are rendered under the lights that the
reconstruction found for them, intensities too, while the program renders held-out views under the true directions with intensity 1.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from mvps.measures.images import Perceptual, psnr_db, rendered, similarity
from mvps.measures.lights import Light, Photograph, by_photograph, held_out_views, light_errors, true_lights
from mvps.measures.ours import mesh_normals, normal_errors
from mvps.scene import Bool, Capture, Float, Material, Reconstruction, Surface, Truth, View
from mvps.visibility import camera_hits, ray_caster

REFERENCE_LIGHT = 4
"""Number of the light whose photographs keep their brightness."""

DILIGENT_SIZE, WINDOW = (512, 612), 400
"""Height and width of DiLiGenT-MV's photographs; side of what the paper cut out of them. Pixels."""


def psnerf_errors(reconstruction: Reconstruction, capture: Capture, truth: Truth, perceptual: Perceptual | None = None) -> dict[str, float]:
    """Normals, lights and images of a reconstruction; what cannot be said is left out. capture: with the photographs of held-out views."""
    held_out = held_out_views(reconstruction)
    maps = dict(zip(reconstruction.views, reconstruction.normal_maps, strict=True))
    lights = by_photograph(reconstruction.lights, reconstruction.views, reconstruction.light_names)
    fitted = [view for view in reconstruction.views if view not in held_out]
    errors = psnerf_normal_errors(maps, reconstruction.surface, truth, capture, held_out)
    errors |= psnerf_light_errors(lights, true_lights(truth), fitted)
    unseen = {photograph: light for photograph, light in lights.items() if photograph[0] in held_out}
    return errors | psnerf_image_errors(reconstruction.surface, reconstruction.material, unseen, truth.intensity, capture, perceptual)


def psnerf_normal_errors(
    maps: Mapping[str, Float], surface: Surface, truth: Truth, capture: Capture, held_out: Collection[str]
) -> dict[str, float]:
    """Mean over views of their mean angle, deg, of the normal maps and of the mesh; maps: view name -> (height, width, 3), world frame."""
    caster = ray_caster(surface)
    found: dict[str, list[float]] = {"psnerf_normal_error_deg": [], "psnerf_mesh_normal_error_deg": []}
    for view in capture.views:
        if held_out and view.name not in held_out:
            continue
        of_mesh, alone = mesh_normals(caster, view), Capture(capture.name, (view,))
        covered = np.isfinite(of_mesh).all(-1, keepdims=True)
        estimates = {"psnerf_mesh_normal_error_deg": of_mesh}
        if view.name in maps:
            estimates["psnerf_normal_error_deg"] = np.where(covered, maps[view.name], np.nan)
        for key, normal in estimates.items():
            errors = normal_errors({view.name: normal}, truth.normals, alone)
            found[key] += [errors["normal_error_deg"]] if "normal_error_deg" in errors else []
    return {key: float(np.mean(values)) for key, values in found.items() if values}


def psnerf_light_errors(
    estimated: Mapping[Photograph, Light], truth: Mapping[Photograph, Light], fitted: Collection[str]
) -> dict[str, float]:
    """Mean over the fitted views of their mean angle, deg, and relative error of intensity; no figure of what the truth lacks."""
    of_views = [light_errors({p: light for p, light in estimated.items() if p[0] == view}, truth) for view in fitted]
    found = {key: [errors[key] for errors in of_views if key in errors] for key in ("light_error_deg", "intensity_error")}
    return {f"psnerf_{key}": float(np.mean(values)) for key, values in found.items() if values}


def psnerf_image_errors(
    surface: Surface,
    material: Material,
    lights: Mapping[Photograph, Light],
    intensity: Mapping[str, Float],
    capture: Capture,
    perceptual: Perceptual | None = None,
) -> dict[str, float]:
    """PSNR in dB, SSIM and 100 LPIPS of photographs against renderings, light by light and averaged over a view's lights.

    lights: photograph -> its light as reconstructed, for the photographs to compare (those of the held-out views). intensity: view
    name -> (all lights, 3), true. Without `perceptual` there is no LPIPS; without photographs there are no figures.
    """
    found: dict[str, list[float]] = {}
    for view, kept, rendering in rendered(surface, material, lights, capture):
        hit = camera_hits(ray_caster(surface), view.camera, view.pixels).face >= 0
        if not hit.any():
            continue
        relative = relative_intensity(view, kept, intensity)
        photographs, renderings = view.radiance(kept) / relative, rendering / relative
        pairs = [("average_", renderings.mean(1), photographs.mean(1))]
        pairs += [("", renderings[:, k], photographs[:, k]) for k in range(len(kept))]
        for name, of_light, photograph in pairs:
            image, true, both = comparable(of_light, photograph, view.mask, hit)
            figures = {"psnr_db": psnr_db(image[both], true[both]), "ssim": similarity(image, true)}
            if perceptual is not None:
                figures["lpips_x100"] = 100 * perceptual(image, true)
            for key, value in figures.items():
                found.setdefault(f"psnerf_{name}{key}", []).append(value)
    return {key: float(np.mean(values)) for key, values in found.items()}


def relative_intensity(view: View, positions: Sequence[int], intensity: Mapping[str, Float]) -> Float:
    """(positions, 3) intensities of these of the view's lights over that of its fourth (of its last, where it has fewer); 1 if unknown."""
    true = intensity.get(view.name, np.zeros((0, 3)))
    if len(true) < max(view.lights[k] for k in positions):
        return np.ones((len(positions), 3))
    relative: Float = true[[view.lights[k] - 1 for k in positions]] / true[min(REFERENCE_LIGHT, len(true)) - 1]
    return relative


def comparable(rendering: Float, photograph: Float, mask: Bool, hit: Bool) -> tuple[Float, Float, Bool]:
    """Two images (height, width, 3) of 8 bits in [0, 1], the rendering scaled to the photograph, white outside; and where they are not.

    rendering, photograph (pixels, 3) at the pixels of mask (height, width), whole; hit (pixels,) where the rendering shows the surface.
    """
    r, p = rendering[hit].astype(np.float64), photograph[hit].astype(np.float64)
    scale = float(((r * p).sum(0) / np.maximum((r * r).sum(0), np.finfo(float).tiny)).mean())
    window, both = _window(mask), np.zeros(mask.shape, bool)
    both[mask] = hit
    images = []
    for values in (scale * r, p):
        image = np.ones((*mask.shape, 3))
        image[both] = np.rint(np.clip(values, 0, 1) * 255) / 255
        images.append(image[window])
    return images[0], images[1], both[window]


def _window(mask: Bool) -> tuple[slice, slice]:
    """Rows and columns that are kept of an image with this mask."""
    if mask.shape != DILIGENT_SIZE:
        return slice(None), slice(None)
    middle = [(int(on.min()) + int(on.max()) + 1) // 2 for on in np.nonzero(mask)]
    rows, columns = (min(max(m - WINDOW // 2, 0), size - WINDOW) for m, size in zip(middle, mask.shape, strict=True))
    return slice(rows, rows + WINDOW), slice(columns, columns + WINDOW)
