"""A solver block of your own: a rough sheen for every vertex, fitted to what its photographs leave, with the solvers' batched steps.

For each of many points, unknowns x = (albedo, sheen) explain samples I_j = albedo c_j + sheen (1 - c_j)^3, c_j the cosine to light j, with
neither below zero. Points are independent, so their normal equations are tiny, and one call solves all of them.

python examples/07_own_solver_block.py picture.png
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from mvps.command import run
from mvps.scene import CaptureError
from mvps.texture import png_bytes
from solvers.least_squares import bounded_step

POINTS, SAMPLES, NOISE = 4000, 24, 0.01


def main(argv: Sequence[str]) -> None:
    if len(argv) != 1:
        raise CaptureError(f"wanted picture.png, given {len(argv)} arguments")
    (out,) = argv
    generator = torch.Generator().manual_seed(0)
    cosine = torch.rand(POINTS, SAMPLES, generator=generator)
    truth = torch.rand(POINTS, 2, generator=generator) * torch.tensor([1.0, 0.5])
    columns = torch.stack([cosine, (1 - cosine) ** 3], -1)
    image = (columns @ truth[..., None])[..., 0] + NOISE * torch.randn(POINTS, SAMPLES, generator=generator)
    image[:, :2] += 1.0  # two highlights in every point's samples, which no term explains

    x = torch.zeros(POINTS, 2)
    for _ in range(12):
        residual = (columns @ x[..., None])[..., 0] - image
        scale = 1.4826 * residual.abs().median(1, keepdim=True).values.clamp_min(1e-3)
        weight = 1 / (1 + (residual / (2.4 * scale)) ** 2)  # Cauchy: far samples count little
        hessian = columns.mT @ (weight[..., None] * columns)
        gradient = (columns.mT @ (weight * residual)[..., None])[..., 0]
        x = x + bounded_step(hessian, gradient, -x)

    error = (x - truth).abs().mean(0)
    print(f"mean error of albedo {error[0]:.4f}, of sheen {error[1]:.4f}, with noise {NOISE} and two outliers of {SAMPLES}")

    # True against found: albedo left, sheen right.
    picture = np.full((300, 600, 3), 255, np.uint8)
    for k, span in enumerate((1.0, 0.5)):
        place = (300 * torch.stack([truth[:, k], x[:, k]], 1) / span).clamp(0, 299).long().numpy()
        picture[299 - place[:, 1], 300 * k + place[:, 0]] = (30, 80, 180)
    Path(out).write_bytes(png_bytes(picture))


if __name__ == "__main__":
    sys.exit(run(main))
