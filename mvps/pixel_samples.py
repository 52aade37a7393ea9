"""Grey samples of pixels, with the normals that a rough surface has there.

Lambert's law holds of what is neither clipped, nor in shadow, nor a highlight. What is in shadow is told by each pixel's own bright level,
which a fifth of its samples exceed. Over that level pixels are looked at, so that dark ones count as bright ones do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from warnings import catch_warnings, simplefilter

import numpy as np
from numpy.typing import NDArray

from mvps.mesh import normalise
from mvps.scene import Bool, Capture, CaptureError, Float, View
from mvps.sharing import Frame
from mvps.values import channel_mean
from mvps.visibility import Hits, RayCaster, camera_hits, interpolate

PIXELS_PER_VIEW = 1000
"""Pixels drawn from a view: three unknowns a light against thousands of equations leave the error to the model, not to sampling."""

SHADOWED = 0.1
"""Samples below this part of a pixel's bright level are treated as shadowed: Lambert's law gives cos(84 deg) there, and penumbrae and
inter-reflections are as large."""

DARK = 0.1
"""Of a light's mean over the channels: in darker ones, as in a red lamp's blue, noise over the light would be over ten times that under
white lamps, and they count less, by the square. Lamps from 2700 to 6500 K have 0.3 there, seen beside each other (Planck's law at 610, 540
and 460 nm)."""

DARKEST = 1e-3
"""The same, that a channel has in which photographs show nothing: no sensor is better than 10 bits."""

BRIGHT_QUANTILE = 0.8
"""A pixel's bright level: above its shadows, below its highlights."""


@dataclass(frozen=True)
class PixelSamples:
    """Grey images of some pixels of one view: image (n, lights) over its bright level (n,); known (n, lights), neither clipped nor in
    shadow; normal (n, 3) in the camera's frame; noise: of a sample that is rounded, over the median bright level; shown (n, lights), False
    where the photograph was left out."""

    image: NDArray[np.float64]
    bright: Float
    known: Bool
    normal: Float
    noise: float
    shown: Bool

    @property
    def absolute(self) -> Float:
        """(n, lights) radiance."""
        absolute: Float = self.image * self.bright[:, None]
        return absolute

    def part(self, most: int) -> PixelSamples:
        """The first pixels of them."""
        few = slice(most)
        return replace(
            self, image=self.image[few], bright=self.bright[few], known=self.known[few], normal=self.normal[few], shown=self.shown[few]
        )

    @property
    def highlights(self) -> Float:
        """(n, lights) radiance, clipped or not, NaN where the photograph was left out."""
        return np.where(self.shown, self.absolute, np.nan)


FEWEST = 8
"""Pixels from which factors of four lights start (`FULLEST` in solvers/low_rank.py)."""


def pixel_samples(view: View, caster: RayCaster, normal: Float, generator: np.random.Generator) -> PixelSamples:
    """Of pixels of a view drawn among those that meet the surface of `caster`, whose vertices have these normals (V, 3), world frame.

    Raises CaptureError where fewer than FEWEST of them meet it.
    """
    chosen = generator.permutation(len(view.pixels))[:PIXELS_PER_VIEW]
    hits = camera_hits(caster, view.camera, view.pixels[chosen])
    on = hits.face >= 0
    if on.sum() < FEWEST:
        met = f"{on.sum()} of {len(on)} pixels of its mask meet" if on.any() else "no pixel of its mask meets"
        raise CaptureError(
            f"{view.name}: wanted a camera that sees what all masks enclose, given one from which {met} it;"
            " check this view's rotation, translation and mask, or leave it out with --views"
        )
    chosen, hits = chosen[on], Hits(hits.face[on], hits.barycentric[on], hits.distance[on])
    image = channel_mean(view.samples[chosen]) * view.scale
    bright = np.quantile(image if view.shown.all() else image[:, view.shown], BRIGHT_QUANTILE, axis=1, keepdims=True)
    bright = np.maximum(bright, view.scale)
    known = view.usable()[chosen] & (image > SHADOWED * bright)
    seen = normalise(interpolate(caster.surface, hits, normal)) @ view.camera.rotation.T
    shown = np.broadcast_to(view.shown, image.shape)
    return PixelSamples(image / bright, bright[:, 0], known, seen, view.scale / float(np.median(bright)), shown)


def pooled(samples: list[PixelSamples]) -> PixelSamples:
    """The pixels of all views as if they were one's, each with the normal in its own view's frame."""
    names = ("image", "bright", "known", "normal", "shown")
    image, bright, known, normal, shown = (np.concatenate([getattr(s, name) for s in samples]) for name in names)
    return PixelSamples(image, bright, known, normal, float(np.median([s.noise for s in samples])), shown)


def in_frame(samples: list[PixelSamples], capture: Capture, frame: Frame) -> list[PixelSamples]:
    """The samples with normals in this frame."""
    if frame == "camera":
        return samples
    return [replace(s, normal=s.normal @ view.camera.rotation) for s, view in zip(samples, capture.views, strict=True)]


def colour_ratios(view: View) -> Float:
    """(lights, 3) intensity of each light's channels over their mean, from the colour of the whole view: the object's mean
    albedo is taken as the mean over all lights, so only differences between lights count."""
    total = np.maximum(view.samples.sum(0, dtype=np.float64), 1.0)
    chroma = total / total.mean(1, keepdims=True)
    usual = np.median(chroma[view.shown], axis=0) if view.shown.any() else np.ones(3)
    # A photograph that was left out says nothing: white.
    ratio = np.where(view.shown[:, None], chroma / usual, 1.0)
    of_mean_one: Float = ratio / ratio.mean(1, keepdims=True)
    return of_mean_one


def lamp_colours(view: View) -> Float:
    """(lights, 3) intensity of each light's channels over their mean, 1 for what is usual: the median over pixels of their colour under the
    light over their colour under most lights. Which part of the object a light shows does not matter, as it does to the view's sum."""
    some = np.sort(np.random.default_rng(0).permutation(len(view.pixels))[:PIXELS_PER_VIEW])
    samples = view.samples[some].astype(np.float64)
    grey = samples.mean(-1)
    shown = grey[:, view.shown] if view.shown.any() else grey
    known = view.usable()[some] & (grey > SHADOWED * np.maximum(np.quantile(shown, BRIGHT_QUANTILE, axis=1, keepdims=True), 1))
    chroma = np.where(known[..., None], samples / np.maximum(grey, 1)[..., None], np.nan)
    with catch_warnings():
        # Of pixels and lights without samples.
        simplefilter("ignore", RuntimeWarning)
        usual = np.nanmedian(chroma, axis=1, keepdims=True)
        ratio = np.nanmedian(chroma / np.where(usual > 0, usual, np.nan), axis=0)
    ratio = np.where(np.isfinite(ratio).all(1, keepdims=True), ratio, 1.0)
    ratio = np.maximum(ratio, DARKEST * ratio.mean(1, keepdims=True))
    of_mean_one: Float = ratio / ratio.mean(1, keepdims=True)
    return of_mean_one


def told_by_channels(colour: Float) -> Float:
    """(lights, 3) how much the channels of lights of colour (lights, 3), mean one, tell: 1, and less where they are DARK."""
    told: Float = np.minimum(colour / DARK, 1) ** 2
    return told


def channel_shares(colour: Float) -> Float:
    """(lights, 3) shares of the channels in what is grey under lights of colour (lights, 3), both mean one."""
    told = told_by_channels(colour)
    shares: Float = told / told.mean(1, keepdims=True)
    return shares


def light_shares(colour: Float) -> NDArray[np.float32]:
    """(lights, 3) shares of lights of colour (lights, 3), mean one, in what all of them show of a channel, of mean one."""
    told = told_by_channels(colour)
    shares: NDArray[np.float32] = (told / told.mean(0)).astype(np.float32)
    return shares


def grey_under(samples: NDArray[np.uint16], colour: Float) -> NDArray[np.float32]:
    """(n, lights) code values (n, lights, 3) under lights of colour (lights, 3), mean one, as white ones as strong would make them: what
    the channels' plain mean makes of a coloured lamp depends on the object's colour."""
    grey: NDArray[np.float32] = (samples * (channel_shares(colour) / colour).astype(np.float32)).mean(-1)
    return grey
