"""Intervals for what is counted and what is averaged."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Z95 = 1.959963984540054


def wilson(successes: int, trials: int, z: float = Z95) -> tuple[float, float]:
    """Wilson score interval of a proportion: (p + z^2/2n -+ z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n).

    >>> [round(x, 4) for x in wilson(1000, 1000)]
    [0.9962, 1.0]
    """
    if trials <= 0:
        return (0.0, 1.0)
    p, n = successes / trials, float(trials)
    centre = p + z * z / (2 * n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low, high = (centre - half) / (1 + z * z / n), (centre + half) / (1 + z * z / n)
    return (max(0.0, low), min(1.0, high))


def mean_interval(values: npt.NDArray[np.float64], z: float = Z95) -> tuple[float, float, float]:
    """Mean and its normal interval, mean -+ z s / sqrt(n)."""
    mean = float(values.mean())
    half = z * float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.inf
    return (mean, mean - half, mean + half)
