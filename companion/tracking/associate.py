"""Anonymous detections to tracks: Mahalanobis gate, then the cheapest assignment of all (global nearest neighbour).

A track is a mixture of models, and a manoeuvre is what the unlikely one predicts: a detection is gated if any model
admits it, and priced by the likelihood of the mixture,

    d_j^2 = (z - p_j)^T S_j^-1 (z - p_j) <= gate^2 for some j,   S_j = P_j + R
    cost = -2 log sum_j mu_j exp(-d_j^2 / 2) / sqrt(det S_j)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from companion.types import FloatArray

_FORBIDDEN = 1e9
_MU_MIN = 1e-12


@dataclass(frozen=True, slots=True)
class Candidates:
    """M tracks that may have caused a detection, each predicted to its stamp by J models."""

    p_enu: FloatArray  # (M, J, 3) [m]
    covariance: FloatArray  # (M, J, 3, 3) [m^2]
    probabilities: FloatArray  # (M, J)

    def __len__(self) -> int:
        return len(self.p_enu)

    def take(self, rows: npt.NDArray[np.intp]) -> Candidates:
        return Candidates(self.p_enu[rows], self.covariance[rows], self.probabilities[rows])


def associate(z: FloatArray, noise: FloatArray, tracks: Candidates, gate_sigma: float) -> npt.NDArray[np.intp]:
    """Row of the track of each detection ``z`` (D, 3) with ``noise`` (D, 3, 3), -1 where none lies within the gate.

    Each track is given to one detection at most.
    """
    rows = np.full(len(z), -1, dtype=np.intp)
    if not len(z) or not len(tracks):
        return rows
    detection, track = _near(z, noise, tracks, gate_sigma)
    innovation = z[detection, None] - tracks.p_enu[track]
    s = noise[detection, None] + tracks.covariance[track]
    squared = (innovation * np.linalg.solve(s, innovation[..., None])[..., 0]).sum(axis=-1)
    mu = np.maximum(tracks.probabilities[track], _MU_MIN)
    likelihood = np.logaddexp.reduce(np.log(mu) - 0.5 * (squared + np.linalg.slogdet(s)[1]), axis=-1)
    gated = (squared <= gate_sigma**2).any(axis=-1)
    cost = np.full((len(z), len(tracks)), _FORBIDDEN)
    cost[detection[gated], track[gated]] = -2.0 * likelihood[gated]
    for found, row in zip(*linear_sum_assignment(cost), strict=True):
        if cost[found, row] < _FORBIDDEN:
            rows[found] = row
    return rows


def _near(
    z: FloatArray, noise: FloatArray, tracks: Candidates, gate_sigma: float
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Pairs that can pass the gate: |z - p|^2 <= gate^2 tr S, because no eigenvalue of S exceeds its trace."""
    count, models = tracks.probabilities.shape
    p = tracks.p_enu.reshape(-1, 3)
    squared = np.maximum((z * z).sum(axis=1)[:, None] + (p * p).sum(axis=1) - 2.0 * (z @ p.T), 0.0)
    trace = np.trace(noise, axis1=1, axis2=2)[:, None] + np.trace(tracks.covariance, axis1=2, axis2=3).ravel()
    within = squared <= gate_sigma**2 * trace * (1.0 + 1e-6) + 1e-6
    detection, track = np.nonzero(within.reshape(len(z), count, models).any(axis=-1))
    return detection, track
