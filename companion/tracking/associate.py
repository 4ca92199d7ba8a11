"""Anonymous detections to tracks: Mahalanobis gate, then the cheapest assignment of all (global nearest neighbour).

d^2 = (z - p)^T (P + R)^-1 (z - p) <= gate^2,   cost = d^2 + log det (P + R)
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from companion.types import FloatArray

_FORBIDDEN = 1e9


def associate(
    z: FloatArray, noise: FloatArray, p_enu: FloatArray, covariance: FloatArray, gate_sigma: float
) -> np.ndarray:
    """Track row of each detection, -1 where none lies within the gate.

    Args:
        z: (D, 3). noise: (D, 3, 3). p_enu: (M, 3) predicted to the stamp of z. covariance: (M, 3, 3).
    Returns:
        (D,) int; each track is given to one detection at most.
    """
    rows = np.full(z.shape[0], -1, dtype=np.intp)
    if not z.shape[0] or not p_enu.shape[0]:
        return rows
    innovation = z[:, None, :] - p_enu
    s = noise[:, None] + covariance
    squared = (innovation * np.linalg.solve(s, innovation[..., None])[..., 0]).sum(axis=-1)
    gated = squared <= gate_sigma**2
    cost = np.where(gated, squared + np.linalg.slogdet(s)[1], _FORBIDDEN)
    for detection, track in zip(*linear_sum_assignment(cost), strict=True):
        if gated[detection, track]:
            rows[detection] = track
    return rows
