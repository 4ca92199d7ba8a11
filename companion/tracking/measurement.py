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
_NO_VELOCITY = (0.0, 0.0, 0.0)


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


def is_finite(detection: Detection) -> bool:
    """Whether every number of ``detection`` is finite; the wire checks this too, a library user may not."""
    x, y, z = detection.p_enu.tolist()
    total = x + y + z + detection.radius_m + (detection.p_std_m or 0.0) + (detection.v_std_m_s or 0.0)
    if detection.v_enu is not None:
        total += sum(detection.v_enu.tolist())
    if detection.covariance is not None:
        total += sum(detection.covariance.ravel().tolist())
    return math.isfinite(total)  # one that is not makes the sum so, and finite ones as large do not fly


def measure(detections: Sequence[Detection], config: TrackingConfig) -> Measurements:
    """Arrays from detections. R: the stated covariance, else the stated standard deviations, else the configured ones.

    Variances (eigenvalues, for a covariance) are held within 1e-6 and 1e4, so R is always positive definite. With
    ``force_measurement_variance`` only the position counts, at the configured variance (Remark 1).
    """
    stated = not config.force_measurement_variance
    default_m2, default_m2_s2 = config.measurement_variance_m2, config.velocity_std_m_s**2
    z, diagonal = [], []
    for detection in detections:
        v = detection.v_enu if stated else None
        z.append([*detection.p_enu.tolist(), *(_NO_VELOCITY if v is None else v.tolist())])
        p_m2 = _held(detection.p_std_m**2 if stated and detection.p_std_m is not None else default_m2)
        v_m2_s2 = _held(detection.v_std_m_s**2 if detection.v_std_m_s is not None else default_m2_s2)
        diagonal.append([p_m2, p_m2, p_m2, v_m2_s2, v_m2_s2, v_m2_s2])
    count = len(detections)
    noise = np.zeros((count, 6, 6))
    noise.reshape(count, 36)[:, ::7] = np.array(diagonal).reshape(count, 6)
    for row, detection in enumerate(detections):
        if detection.covariance is not None and stated:
            noise[row] = _bounded(detection.covariance)
    full = np.array([stated and d.v_enu is not None for d in detections], dtype=np.bool_)
    return Measurements(np.array(z).reshape(count, 6), noise, full, np.array([d.radius_m for d in detections]))


def _held(variance: float) -> float:
    return min(max(variance, VARIANCE_MIN), VARIANCE_MAX)


def _bounded(covariance: FloatArray) -> FloatArray:
    """The nearest symmetric matrix whose eigenvalues lie within the bounds."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    bounded: FloatArray = (vectors * np.clip(values, VARIANCE_MIN, VARIANCE_MAX)) @ vectors.T
    return bounded
