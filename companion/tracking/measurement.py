"""Detections of one frame as arrays that the bank can use: z, R, and which of them carry a velocity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.config import TrackingConfig
from companion.types import Detection, FloatArray

# A sensor that claims a perfect fix would take the last digit out of the filter; one that claims 100 m says nothing.
VARIANCE_MIN = 1e-6  # [m^2], [m^2/s^2]
VARIANCE_MAX = 1e4


@dataclass(frozen=True, slots=True)
class Measurements:
    """D measurements. Where ``full`` is False only the position blocks of ``z`` and ``noise`` count."""

    z: FloatArray  # (D, 6) position [m] and velocity [m/s]
    noise: FloatArray  # (D, 6, 6)
    full: np.ndarray  # (D,) bool
    radius_m: FloatArray  # (D,)

    def take(self, rows: np.ndarray) -> Measurements:
        return Measurements(self.z[rows], self.noise[rows], self.full[rows], self.radius_m[rows])

    def parts(self, full: bool) -> tuple[FloatArray, FloatArray]:
        """(z, R) of dimension 6 or 3."""
        return (self.z, self.noise) if full else (self.z[:, :3], self.noise[:, :3, :3])


def finite(detections: Sequence[Detection]) -> list[bool]:
    """Of each detection whether all its numbers are finite; the wire checks this too, a library user may not."""
    if math.isfinite(sum([_total(detection) for detection in detections])):
        return [True] * len(detections)  # one that is not makes the sum so, the common case
    return [math.isfinite(_total(detection)) for detection in detections]


def _total(detection: Detection) -> float:
    """The sum of all numbers, finite if they are: finite ones large enough to overflow do not fly."""
    x, y, z = detection.p_enu.tolist()
    total: float = x + y + z + detection.radius_m + (detection.p_std_m or 0.0) + (detection.v_std_m_s or 0.0)
    if detection.v_enu is not None:
        total += sum(detection.v_enu.tolist())
    if detection.covariance is not None:
        total += sum(detection.covariance.ravel().tolist())
    return total


def measure(detections: Sequence[Detection], config: TrackingConfig) -> Measurements:
    """Arrays from detections. R: the stated covariance, else the stated standard deviations, else the configured ones.

    Variances (eigenvalues, for a covariance) are held within 1e-6 and 1e4, so R is always positive definite. With
    ``force_measurement_variance`` only the position counts, at the configured variance (Remark 1).
    """
    count, stated = len(detections), not config.force_measurement_variance
    default_m, default_m_s = math.sqrt(config.measurement_variance_m2), config.velocity_std_m_s
    z, noise = np.zeros((count, 6)), np.zeros((count, 6, 6))
    z[:, :3] = [detection.p_enu.tolist() for detection in detections] or z[:, :3]
    full = np.array([stated and detection.v_enu is not None for detection in detections], dtype=np.bool_)
    p_std = [d.p_std_m if stated and d.p_std_m is not None else default_m for d in detections]
    diagonal = noise.reshape(count, 36)[:, ::7]
    diagonal[:, :3] = _held(p_std)
    diagonal[:, 3:] = _held([default_m_s if d.v_std_m_s is None else d.v_std_m_s for d in detections])
    if stated:
        for row, detection in enumerate(detections):
            if detection.v_enu is not None:
                z[row, 3:] = detection.v_enu
            if detection.covariance is not None:
                noise[row] = _bounded(detection.covariance)
    return Measurements(z, noise, full, np.array([detection.radius_m for detection in detections]))


def _held(std: list[float]) -> FloatArray:
    """(D, 1) variances within their bounds."""
    squared = np.array(std, dtype=np.float64) ** 2
    return np.asarray(np.minimum(np.maximum(squared, VARIANCE_MIN), VARIANCE_MAX)[:, None])


def _bounded(covariance: FloatArray) -> FloatArray:
    """The nearest symmetric matrix whose eigenvalues lie within the bounds."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    bounded: FloatArray = (vectors * np.clip(values, VARIANCE_MIN, VARIANCE_MAX)) @ vectors.T
    return bounded
