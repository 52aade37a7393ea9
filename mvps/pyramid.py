"""Photographs at half their size, and at half of that: large ones tell the rough shape no better, and take four times as long to do so.

Stage I's cells, band and rays, and the first rounds' sweeps, are so many pixels long. What they look for, hollows that a hull of few views
bulges over, is so much of the object. So the shape is found at the level of the pyramid (Burt and Adelson 1983) at which an object has
some hundred pixels across, and pulled to what larger photographs show from level to level.

A pixel of the next level is the mean of those of its four that the mask holds and that are not clipped, in linear light, and no data where
more than half of them are; it is in the mask where three of four are, or two and the lot falls on it, so that masks neither grow nor
shrink. Image coordinates halve, x' = x / 2, which is K' = diag(1/2, 1/2, 1) K.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mvps.cores import on_cores
from mvps.scene import Bool, Capture, View

ENOUGH_PIXELS = 10_000
"""Of a view's mask, median over the views, that the smallest level has to hold: four captures with 10 to 17 thousand come out within 0.05
to 0.12 px of the truth, buddha's gold within 0.7."""

LEAST_PART = 4
"""No view's mask may hold less than this part of ENOUGH_PIXELS there: of an object that one view shows a corner of."""


def halvings(capture: Capture) -> int:
    """How often all views may be halved."""
    sizes = [len(view.pixels) for view in capture.views]
    spare = min(float(np.median(sizes)), LEAST_PART * min(sizes)) / ENOUGH_PIXELS
    return int(np.log(spare) / np.log(4)) if spare > 1 else 0


def levels(capture: Capture) -> list[Capture]:
    """The capture, at half its size, and so on: `halvings` levels after the first."""
    found = [capture]
    for _ in range(halvings(capture)):
        found.append(halved(found[-1]))
    return found


def halved(capture: Capture) -> Capture:
    """All views at half their height and width, rounded up."""
    return Capture(capture.name, tuple(on_cores(_halved, capture.views)))


def _halved(view: View) -> View:
    height, width = -(-view.camera.height // 2), -(-view.camera.width // 2)
    index = np.full((2 * height, 2 * width), -1, np.int32)
    index[: view.camera.height, : view.camera.width] = view.pixel_index
    # (height, width, 4): the four pixels of one of the next level.
    four = index.reshape(height, 2, width, 2).transpose(0, 2, 1, 3).reshape(height, width, 4)
    mask = (four >= 0).sum(2) + drawn(height, width) > 2
    samples, gain = _means(view, four[mask])
    camera = replace(view.camera, K=np.diag([0.5, 0.5, 1.0]) @ view.camera.K, height=height, width=width)
    return View(view.name, camera, mask, samples, view.scale / gain, view.saturation * gain, view.lights)


def drawn(height: int, width: int) -> Bool:
    """(height, width) True on half of the pixels of every row, column and diagonal."""
    rows, columns = np.indices((height, width))
    half: Bool = (rows + 2 * columns) % 4 < 2
    return half


def _means(view: View, four: NDArray[np.int32]) -> tuple[NDArray[np.uint16], int]:
    """(n, lights, 3) means of the pixels at four (n, 4), -1 for none, as code values times a gain, and that: the mean of four has two bits
    more than each of them."""
    gain = max(1, min(4, np.iinfo(np.uint16).max // view.saturation))
    total = np.zeros((len(four), *view.samples.shape[1:]), np.uint32)
    count = np.zeros(total.shape[:2], np.uint32)
    for positions in four.T:
        there = positions >= 0
        of, usable = view.samples[positions[there]], view.usable()[positions[there]]
        total[there] += of * usable[..., None]
        count[there] += usable
    clipped = 2 * count < (four >= 0).sum(1)[:, None]
    least = np.maximum(count, 1)[..., None]
    samples = ((total * np.uint32(gain) + least // 2) // least).astype(np.uint16)
    samples[clipped] = view.saturation * gain
    return samples, gain
