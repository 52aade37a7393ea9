"""Whether photographs look as if a curve, I -> I^(1/e), had been left in them, though three factors alone do not prove it (radiometry.py).

With M = U V^T + r, robust factors of a view's lit samples over their bright levels, and H = U V^T, an exponent of 1 + d adds d M log M to
M, of which the factors take up all but a part p:

    p = H log H - A V^T - U B^T,  A, B by least squares;      d = - <r, p> / <p, p>

H stands for M, whose noise is in r as well, and tells which samples are lit: by themselves they would be those with noise upwards. So d is
free of noise to first order, where rho is not. Gloss makes d negative; light between matt walls makes it positive, and so may chance. A
positive d is therefore a suspicion and no more: what believes it is a solution (mvps/curves.py).
"""

from __future__ import annotations

import numpy as np

from mvps.checks.prediction import BRIGHT_QUANTILE
from mvps.checks.radiometry import SWEEPS, over_its_level, some_views
from mvps.cores import on_cores
from mvps.scene import Bool, Capture, View
from solvers.low_rank import factorise, solve_rows

FEWEST_LIGHTS = 5
"""Of a view: four that light a pixel leave one residual."""

PIXELS = 300
"""Of a view."""

LIT = 0.2
"""Of a pixel's bright level, by the factors: below lie penumbrae and what other surfaces send."""

ALTERNATIONS = 6
"""Of A and B; and twice the samples that are lit are told anew."""

SURE = 1.645
"""Standard errors from which d is above zero by less than one chance in twenty."""


def looks_curved(capture: Capture) -> bool:
    """Whether d is positive beyond its standard error, by the scatter of views (ratio estimator: Cochran 1977, section 6.4)."""
    views = some_views(capture, FEWEST_LIGHTS)
    if len(views) < 2:
        return False
    along, square = np.array(on_cores(_bend, views)).T
    if not square.sum() > 0:
        return False
    d = along.sum() / square.sum()
    error = np.sqrt(len(views) / (len(views) - 1) * ((along - d * square) ** 2).sum()) / square.sum()
    return bool(d > SURE * error)


def _bend(view: View) -> tuple[float, float]:
    """-<r, p> and <p, p> of a view."""
    chosen = np.sort(np.random.default_rng(0).permutation(len(view.pixels))[:PIXELS])
    codes = view.samples[chosen][:, view.shown]
    image = over_its_level((codes * view.scale).mean(-1))
    M = image / np.maximum(np.quantile(image, BRIGHT_QUANTILE, axis=1, keepdims=True), 1e-12)
    # Noise may clip lit samples to 0: without them those that are left would be too bright.
    usable: Bool = np.asarray((codes < view.saturation).all(-1))
    known = usable
    factors = factorise(M, known, 3, SWEEPS, floor=1e-4)
    for _ in range(2):
        known = usable & (factors.left @ factors.right.T > LIT)
        enough = known.sum(1) > 3
        M, known, usable = M[enough], known[enough], usable[enough]
        if len(M) < PIXELS // 10:
            return 0.0, 0.0
        factors = factorise(M, known, 3, SWEEPS, floor=1e-4)
    U, V, W = factors.left, factors.right, factors.weight * known
    H = U @ V.T
    bent = np.where(known, H * np.log(np.maximum(H, LIT / 2)), 0)
    B = np.zeros_like(V)
    for _ in range(ALTERNATIONS):
        A = solve_rows(bent - U @ B.T, W, V)
        B = solve_rows((bent - A @ V.T).T, W.T, U)
    p = bent - A @ V.T - U @ B.T
    return float(-(W * (M - H) * p).sum()), float((W * p * p).sum())
