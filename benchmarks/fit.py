"""Power laws fitted to measurements."""

import math
from collections.abc import Sequence

import numpy as np


def exponent(x: Sequence[float], y: Sequence[float]) -> tuple[float, float]:
    """p of y ~ x^p by least squares in the logarithms, and how far the farthest point lies off the fit, as a share of y.

    Not numbers for fewer than two x, or where some y is 0.
    """
    if len(set(x)) < 2 or min(y) <= 0.0:
        return math.nan, math.nan
    a, b = np.log(np.asarray(x, float)), np.log(np.asarray(y, float))
    p, c = np.polyfit(a, b, 1)
    return float(p), float(np.expm1(np.abs(b - (p * a + c)).max()))
