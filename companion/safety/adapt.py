"""The adaptive coefficient epsilon: its target (27)-(28), its CLF (25)-(26), and what the rows leave it.

For a given acceleration a row rise + e psi >= 0 is affine in the decay e = alpha2 epsilon: it bounds e from below
where psi > 0 (the obstacle may be approached, no faster than e) and from above where psi < 0 (the vehicle is inside
the keep-out distance and leaves it no slower than e). Rows of one obstacle share one e. With psi < 0 and e = 0 a row
would ask only that psi does not fall further, and a vehicle at rest inside would be left there; so an obstacle with
psi_0 < 0 has a least decay, the configuration's ``recovery``.
"""

from __future__ import annotations

import numpy as np

from companion.config import SafetyConfig
from companion.types import FloatArray

CLF_PERIOD_S = 0.05  # eta of (26) is applied once per this time
_TINY = 1e-30  # stands for psi = 0: the row then asks for rise >= 0 alone


def epsilon_star(p_rel: FloatArray, v_rel: FloatArray, config: SafetyConfig) -> FloatArray:
    """epsilon_max |v_r| max(0, cos theta_r) / |p_r|, (27)-(28) as written, within its bounds.

    With p_r = p_o - p and v_r = v_o - v a positive cosine means separating, so epsilon* is 0 for whatever
    approaches. |v_r| cos theta_r is the separation speed p_r . v_r / |p_r|.

    Args:
        p_rel, v_rel: obstacle minus vehicle, (M, 3) [m], [m/s].
    Returns:
        (M,) in [0, 1 / alpha2].
    """
    separation = np.vecdot(p_rel, v_rel)  # times |p_rel|
    np.maximum(separation, 0.0, out=separation)
    separation *= config.epsilon_max
    separation /= np.maximum(np.vecdot(p_rel, p_rel), 1e-12)
    return np.asarray(np.minimum(separation, 1.0 / config.alpha2, out=separation))


def clf_budget(previous: FloatArray, star: FloatArray, elapsed_s: FloatArray, eta: float) -> FloatArray:
    """(1 - eta)^(elapsed / 0.05 s) (epsilon - epsilon*)^2: what (26) leaves V(epsilon(k+1)) without delta, (M,).

    Both V are about the current epsilon*; ``elapsed_s`` (M,) is 0 for an obstacle without history.
    """
    return np.asarray((1.0 - eta) ** (elapsed_s / CLF_PERIOD_S) * (previous - star) ** 2)


def decay_interval(values: FloatArray, least: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least and greatest decay in [least, 1] with rise + e psi >= 0 for all rows of an obstacle.

    Args:
        values: rise and psi, stacked, (2, ..., R) [m^2].
        least: broadcast to (...,), 0 or the recovery.
    Returns:
        (lower, upper), each (...,); lower > upper where no decay serves.
    """
    rise, psi = values
    if np.minimum.reduce(psi, axis=None, initial=0.0) >= 0.0:
        bound = rise / np.maximum(psi, _TINY)  # less the decay at which the row is zero
        lower = np.maximum(0.0 - np.minimum.reduce(bound, axis=-1), least)
        return lower, np.ones(lower.shape)
    opening = psi >= 0.0
    bound = rise / (psi + np.copysign(_TINY, psi))
    lower = np.maximum(0.0 - np.minimum.reduce(np.where(opening, bound, 0.0), axis=-1), least)
    upper = 0.0 - np.maximum.reduce(np.where(opening, -1.0, bound), axis=-1)
    return lower, np.minimum(upper, 1.0, out=upper)
