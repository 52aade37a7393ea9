"""Photographs against renderings, and how alike two images are.

Photographs      PSNR = mean over images of 10 log10(peak^2 / mean squared error) inside the mask; peak is the radiance at which
                 the camera clips, the rendering is clipped there too; one scale for all images by least squares.
PSNR             of two images in [0, 1], -10 log10(mean squared error).
SSIM             structural similarity (Wang et al. 2004): Gaussian window of sigma 1.5, whole image, mean over pixels and channels.
LPIPS            learned perceptual similarity on AlexNet's features (Zhang et al. 2018), by the package `lpips`.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvps.measures.lights import Light, Photograph
from mvps.scene import Capture, CaptureError, Float, Material, Surface, View
from mvps.visibility import ray_caster

Perceptual = Callable[[Float, Float], float]
"""Distance of two images (height, width, 3) in [0, 1]."""


def rendered(
    surface: Surface, material: Material, lights: Mapping[Photograph, Light], capture: Capture
) -> Iterator[tuple[View, list[int], NDArray[np.float32]]]:
    """View by view: the view, the positions of its photographs that `lights` names, and their rendering (pixels, positions, 3)."""
    from mvps.rendering import RAYS_ACROSS, light_arriving, light_senders, photograph

    caster, senders = ray_caster(surface), light_senders(surface, material)
    for view in capture.views:
        # One that was left out shows nothing.
        kept = [k for k, number in enumerate(view.lights) if (view.name, number) in lights and view.shown[k]]
        if kept:
            direction, intensity = (np.stack(rows) for rows in zip(*(lights[view.name, view.lights[k]] for k in kept), strict=True))
            arriving = light_arriving(senders, direction, view.camera.centre)
            yield view, kept, photograph(caster, material, view.camera, view.pixels, direction, intensity, arriving, RAYS_ACROSS)


def photograph_errors(
    surface: Surface, material: Material, lights: Mapping[Photograph, Light], capture: Capture, held_out_views: Collection[str] = ()
) -> dict[str, float]:
    """PSNR in dB of re-rendered photographs that were held out, separately for held-out views and for held-out lights.

    lights: photograph -> its light as reconstructed, for the held-out photographs only. Those in `held_out_views` count as
    held-out views, the others as held-out lights. Photographs that the capture lacks are left out. One scale serves all of
    them and is reported as photograph_scale: intensities are relative, so it need not be 1.
    """
    renderings = list(rendered(surface, material, lights, capture))
    if not renderings:
        return {}
    products = np.zeros(2)
    for view, kept, image in renderings:
        # Clipped samples say nothing about the scale.
        usable = view.usable(kept)
        seen = image[usable].ravel()
        products += seen @ view.radiance(kept)[usable].ravel(), seen @ seen
    scale = float(products[0] / max(products[1], np.finfo(float).tiny))
    psnr: dict[str, list[float]] = {"held_out_views_psnr_db": [], "held_out_lights_psnr_db": []}
    for view, kept, image in renderings:
        # Below the variance of rounding to a code value nothing can be told apart.
        peak = view.scale * view.saturation
        mean_square = ((np.minimum(scale * image, peak) - np.minimum(view.radiance(kept), peak)) ** 2).mean((0, 2), dtype=np.float64)
        group = "held_out_views_psnr_db" if view.name in held_out_views else "held_out_lights_psnr_db"
        psnr[group] += (10 * np.log10(peak**2 / np.maximum(mean_square, view.scale**2 / 12))).tolist()
    return {name: float(np.mean(values)) for name, values in psnr.items() if values} | {"photograph_scale": scale}


def psnr_db(image: Float, truth: Float) -> float:
    """PSNR in dB of two arrays of the same shape in [0, 1]; 100 dB where they are equal, as in PS-NeRF's program."""
    mean_square = float(np.mean((np.asarray(image, np.float64) - truth) ** 2))
    return float(-10 * np.log10(max(mean_square, 1e-10)))


def similarity(image: Float, truth: Float) -> float:
    """SSIM of two images (height, width, 3) in [0, 1]: scikit-image's with the window of Wang et al. 2004."""
    from skimage.metrics import structural_similarity

    window: dict[str, Any] = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return float(structural_similarity(image, truth, data_range=1.0, channel_axis=2, **window))


def perceptual_distance(weights: Path) -> Perceptual:
    """LPIPS on AlexNet; `weights` is torchvision's file of AlexNet (alexnet-owt-7be5be79.pth). The package has the weights of the layers.

    Nothing is downloaded. CaptureError where the package is missing or the file is another.
    """
    try:
        import lpips
    except ImportError as error:
        raise CaptureError(f"--lpips-weights: wanted the package lpips, given none ({error}); run pip install mvps[lpips]") from None
    import torch

    # pnet_rand keeps the package from looking for AlexNet's weights in the network.
    model = lpips.LPIPS(net="alex", pnet_rand=True, verbose=False)
    try:
        given = torch.load(weights, map_location="cpu", weights_only=True)
        # Both number the layers of AlexNet alike; the package cuts them into five slices.
        layers = {key: given[f"features.{key.split('.', 1)[1]}"] for key in model.net.state_dict()}
        model.net.load_state_dict(layers)
    except (RuntimeError, KeyError, TypeError, ValueError, pickle.UnpicklingError, EOFError) as error:
        wanted = "wanted torchvision's weights of AlexNet (alexnet-owt-7be5be79.pth)"
        raise CaptureError(f"{weights}: {wanted}, given another file ({type(error).__name__}); give that file") from None

    def distance(image: Float, truth: Float) -> float:
        a, b = (torch.tensor(np.asarray(x), dtype=torch.float32).permute(2, 0, 1)[None] * 2 - 1 for x in (image, truth))
        with torch.no_grad():
            return float(model(a, b))

    return distance
