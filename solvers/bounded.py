"""Problems of a few bounded variables whose derivatives nobody wants to write: COBYLA (Powell 1994), from nlopt.

A linear model through n + 1 points is minimised within a region of trust that shrinks from `step` to `tolerance`.
"""

from __future__ import annotations

from collections.abc import Callable

import nlopt
import numpy as np
from numpy.typing import NDArray


def minimise(
    function: Callable[[NDArray[np.float64]], float],
    start: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    step: float,
    tolerance: float,
    most: int,
) -> tuple[NDArray[np.float64], float]:
    """The best point (n,) that was tried within low <= x <= high (n,), and its value; never worse than the start.

    step, tolerance: first and last size of the steps, in the unit of x; most: calls of the function. Values that are not finite count as
    worse than any other.
    """
    best = (np.array(start, dtype=np.float64), np.inf)

    def tried(x: NDArray[np.float64], _: object) -> float:
        nonlocal best
        value = function(x.copy())
        value = value if np.isfinite(value) else np.finfo(np.float64).max
        if value < best[1]:
            best = (x.copy(), value)
        return value

    tried(best[0], None)
    problem = nlopt.opt(nlopt.LN_COBYLA, len(start))
    problem.set_min_objective(tried)
    problem.set_lower_bounds(low)
    problem.set_upper_bounds(high)
    problem.set_initial_step(step)
    problem.set_xtol_abs(tolerance)
    problem.set_maxeval(most - 1)
    problem.optimize(best[0])
    return best
