"""Photographs at half their size: large ones tell the rough shape no better, and take four times as long to do so.

Stage I's cells, band and rays, and the first rounds' sweeps, are so many pixels long. What they look for, hollows that a hull of few views
bulges over, is so much of the object. So the shape is found at the level of the pyramid (Burt and Adelson 1983) at which an object has
some hundred pixels across, and the last rounds, which move vertices by a pixel or two, see the photographs as they are.

A pixel of the next level is the mean of those of its four that the mask holds, in linear light, and no data where one of these is clipped;
it is in the mask where two of four are. Image coordinates halve, x' = x / 2, which is K' = diag(1/2, 1/2, 1) K.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mvps.cores import on_cores
from mvps.scene import Capture, View

ENOUGH_PIXELS = 10_000
"""Of a view's mask, median over the views, that a level has to hold: four captures with 10 to 17 thousand come out within 0.05 to 0.12 px
of the truth, and to the last rounds an error of half a pixel is one of a pixel."""


def for_shape(capture: Capture) -> Capture:
    """The capture at the smallest size that leaves its views ENOUGH_PIXELS: itself, or halved once or several times."""
    while np.median([len(view.pixels) for view in capture.views]) >= 4 * ENOUGH_PIXELS:
        capture = halved(capture)
    return capture


def halved(capture: Capture) -> Capture:
    """All views at half their height and width, rounded up."""
    return Capture(capture.name, tuple(on_cores(_halved, capture.views)))


def _halved(view: View) -> View:
    height, width = -(-view.camera.height // 2), -(-view.camera.width // 2)
    index = np.full((2 * height, 2 * width), -1, np.int32)
    index[: view.camera.height, : view.camera.width] = view.pixel_index
    # (height, width, 4): the four pixels of one of the next level.
    four = index.reshape(height, 2, width, 2).transpose(0, 2, 1, 3).reshape(height, width, 4)
    mask = (four >= 0).sum(2) >= 2
    samples, gain = _means(view, four[mask])
    camera = replace(view.camera, K=np.diag([0.5, 0.5, 1.0]) @ view.camera.K, height=height, width=width)
    return View(view.name, camera, mask, samples, view.scale / gain, view.saturation * gain, view.lights)


def _means(view: View, four: NDArray[np.int32]) -> tuple[NDArray[np.uint16], int]:
    """(n, lights, 3) means of the pixels at four (n, 4), -1 for none, as code values times a gain, and that: the mean of four has two bits
    more than each of them."""
    gain = max(1, min(4, np.iinfo(np.uint16).max // view.saturation))
    total = np.zeros((len(four), *view.samples.shape[1:]), np.uint32)
    clipped = np.zeros(total.shape[:2], bool)
    for positions in four.T:
        there = positions >= 0
        of = view.samples[positions[there]]
        total[there] += of
        clipped[there] |= (of >= view.saturation).any(2)
    count = (four >= 0).sum(1).astype(np.uint32)[:, None, None]
    samples = ((total * np.uint32(gain) + count // 2) // count).astype(np.uint16)
    samples[clipped] = view.saturation * gain
    return samples, gain
