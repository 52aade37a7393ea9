"""Which values of a table, a row a view and a column a light, chance does not explain.

Median polish (Tukey 1977) takes out what a view and what a light have in common; what is left counts as an outlier beyond the normal
quantile for FALSE_ALARMS in a table of that many values, in units of the MAD of all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtri

from mvps.scene import Bool, Float
from solvers.low_rank import MAD_TO_SIGMA

FALSE_ALARMS = 0.01
"""Expected in a whole capture without faults, of normal residuals."""

POLISHED_VIEWS = 5
"""Views from which the median over the views of a light says what is the light's own."""


def _without_median(values: Float) -> Float:
    known = np.isfinite(values)
    return values - np.median(values[known]) if known.any() else values


def outliers(values: Sequence[Float], same_lights: bool) -> list[Bool]:
    """Per view (lights,), whether a value lies above what chance does; values (lights,) per view, NaN where unknown.

    same_lights: columns of all views are the same lights.
    """
    polished = [_without_median(v) for v in values]
    if same_lights and len(values) >= POLISHED_VIEWS:
        columns = np.stack(polished, 1)
        polished = list(np.stack([_without_median(of_light) for of_light in columns], 1))
        polished = [_without_median(v) for v in polished]
    known = np.concatenate([v[np.isfinite(v)] for v in polished])
    if not len(known):
        return [np.zeros(len(v), bool) for v in values]
    limit = float(-ndtri(FALSE_ALARMS / len(known)) * MAD_TO_SIGMA * np.median(np.abs(known)))
    return [np.nan_to_num(v, nan=-np.inf) > limit for v in polished]
