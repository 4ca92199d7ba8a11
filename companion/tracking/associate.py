"""Anonymous detections to tracks: Mahalanobis gate, then the cheapest assignment of all (global nearest neighbour).

A track is a mixture of models, and a manoeuvre is what the unlikely one predicts: a detection is gated if any model
admits it, and priced by the likelihood of the mixture. A track that some source names gets its detections from there;
what another sees near it must lie within the gate of the fused covariance, and near its body,

    |z - p| <= 2 r + gate sqrt(tr R / 3)

or it could be carried off by another obstacle while its own source is between two frames. What is not taken begins a
track of its own, and the two are merged when they prove to be one.

    d_j^2 = (z - p_j)^T S_j^-1 (z - p_j) <= gate^2 for some j,   S_j = P_j + R
    cost = -2 log sum_j mu_j exp(-d_j^2 / 2) / sqrt(det S_j)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.types import FloatArray

CROWD = 32  # detections near a track that are weighed for it
_FORBIDDEN = 1e9
_MU_MIN = 1e-12


@dataclass(frozen=True, slots=True)
class Candidates:
    """M tracks that may have caused a detection, each predicted to its stamp by J models."""

    p_enu: FloatArray  # (M, J, 3) [m]
    covariance: FloatArray  # (M, J, 3, 3) [m^2]
    probabilities: FloatArray  # (M, J)
    reach_m: FloatArray  # (M,) 2 r of those that some source names, infinite else

    def __len__(self) -> int:
        return len(self.p_enu)

    def take(self, rows: npt.NDArray[np.intp]) -> Candidates:
        return Candidates(self.p_enu[rows], self.covariance[rows], self.probabilities[rows], self.reach_m[rows])


def associate(z: FloatArray, noise: FloatArray, tracks: Candidates, gate_sigma: float) -> npt.NDArray[np.intp]:
    """Row of the track of each detection ``z`` (D, 3) with ``noise`` (D, 3, 3), -1 where none lies within the gate.

    Each track is given to one detection at most.
    """
    rows = np.full(len(z), -1, dtype=np.intp)
    if not len(z) or not len(tracks):
        return rows
    from scipy.optimize import linear_sum_assignment  # slow to load and for anonymous detections only: not before READY

    detection, track = _near(z, noise, tracks, gate_sigma)
    innovation = z[detection, None] - tracks.p_enu[track]
    s = noise[detection, None] + tracks.covariance[track]
    squared = (innovation * np.linalg.solve(s, innovation[..., None])[..., 0]).sum(axis=-1)
    mu = np.maximum(tracks.probabilities[track], _MU_MIN)
    likelihood = np.logaddexp.reduce(np.log(mu) - 0.5 * (squared + np.linalg.slogdet(s)[1]), axis=-1)
    reach = tracks.reach_m[track] + gate_sigma * np.sqrt(np.trace(noise, axis1=1, axis2=2)[detection] / 3.0)
    gated = (squared <= gate_sigma**2).any(axis=-1)
    gated &= np.isinf(reach) | _near_body(innovation, s, tracks.probabilities[track], reach, gate_sigma)
    cost = np.full((len(z), len(tracks)), _FORBIDDEN)
    cost[detection[gated], track[gated]] = -2.0 * likelihood[gated]
    for found, row in zip(*linear_sum_assignment(cost), strict=True):
        if cost[found, row] < _FORBIDDEN:
            rows[found] = row
    return rows


def _near_body(
    innovation: FloatArray, s: FloatArray, probabilities: FloatArray, reach_m: FloatArray, gate_sigma: float
) -> npt.NDArray[np.bool_]:
    """Whether each pair is within reach, and passes the gate of one Gaussian with the mixture's moments."""
    weights = probabilities[..., None]
    mean = (weights * innovation).sum(axis=1)
    off = innovation - mean[:, None]
    fused = (weights[..., None] * (s + off[..., :, None] * off[..., None, :])).sum(axis=1)
    squared = (mean * np.linalg.solve(fused, mean[..., None])[..., 0]).sum(axis=-1)
    return np.asarray((squared <= gate_sigma**2) & (np.linalg.norm(mean, axis=-1) <= reach_m))


def _near(
    z: FloatArray, noise: FloatArray, tracks: Candidates, gate_sigma: float
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Pairs that can pass the gate: |z - p|^2 <= gate^2 tr S, because no eigenvalue of S exceeds its trace.

    Of a crowd each track is offered the `CROWD` nearest: no more than one of them is its own.
    """
    count, models = tracks.probabilities.shape
    p = tracks.p_enu.reshape(-1, 3)
    squared = np.maximum((z * z).sum(axis=1)[:, None] + (p * p).sum(axis=1) - 2.0 * (z @ p.T), 0.0)
    trace = np.trace(noise, axis1=1, axis2=2)[:, None] + np.trace(tracks.covariance, axis1=2, axis2=3).ravel()
    ratio = ((squared - 1e-6) / trace).reshape(len(z), count, models).min(axis=-1)
    within = ratio <= gate_sigma**2 * (1.0 + 1e-6)
    if np.count_nonzero(within) > CROWD * count:
        within &= ratio <= np.partition(ratio, CROWD - 1, axis=0)[CROWD - 1]
    detection, track = np.nonzero(within)
    return detection, track
