"""Values that cross module borders: frozen, ENU, SI, integer nanoseconds of the vehicle's clock.

Arrays inside are read-only float64. Suffixes carry the frame (``p_enu``) or the unit (``radius_m``, ``t_ns``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
Vec3: TypeAlias = npt.NDArray[np.float64]  # shape (3,)

NS_PER_S = 1_000_000_000


def frozen(values: npt.ArrayLike) -> FloatArray:
    """A read-only float64 copy of ``values``."""
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


class DetectionKind(StrEnum):
    DETECTION = "detection"  # one measurement, errors independent in time
    TRACK = "track"  # already filtered elsewhere: errors correlated in time


class Verdict(StrEnum):
    """What the filter did with the reference in a tick."""

    NOMINAL = "nominal"  # passed unchanged
    ADJUSTED = "adjusted"  # changed, every row holds
    RELAXED = "relaxed"  # rows cannot all hold within the limits: least violation
    BRAKING = "braking"  # no usable answer from the solvers: braking along the safest direction
    SILENT = "silent"  # nothing was computed or sent


@dataclass(frozen=True, slots=True)
class VehicleState:
    """The vehicle at ``stamp_ns``: position and velocity in local ENU, attitude as enu_from_flu (w, x, y, z)."""

    stamp_ns: int
    p_enu: Vec3  # [m]
    v_enu: Vec3  # [m/s]
    q_enu_from_flu: FloatArray = field(default_factory=lambda: frozen([1.0, 0.0, 0.0, 0.0]))
    p_std_m: float = 0.0  # 1 sigma of each position axis, 0 where unknown
    reset_counter: int | None = None  # of the estimator (ODOMETRY): another value means another origin


@dataclass(frozen=True, slots=True)
class Detection:
    """One obstacle as one source saw it.

    ``id`` None marks an anonymous detection. ``covariance`` is 6x6 over (position, velocity) where known.
    """

    id: str | None
    p_enu: Vec3  # [m]
    radius_m: float
    p_std_m: float | None = None
    v_enu: Vec3 | None = None  # [m/s]
    v_std_m_s: float | None = None
    covariance: FloatArray | None = None  # (6, 6)


@dataclass(frozen=True, slots=True)
class DetectionFrame:
    """What one source saw at one instant. Frames are consumed in the order of ``order_key``."""

    stamp_ns: int  # vehicle clock
    source: str
    sequence: int  # arrival number within the source
    kind: DetectionKind
    detections: tuple[Detection, ...]
    arrived_unix_ns: int | None = field(default=None, compare=False)  # here, on this computer's clock: for the log only

    @property
    def order_key(self) -> tuple[int, str, int]:
        return (self.stamp_ns, self.source, self.sequence)


@dataclass(frozen=True, slots=True)
class TrackTable:
    """All tracks at one instant, batched: M tracks, three models (CV, CA, CT), common state [p, v, a]."""

    stamp_ns: int
    ids: tuple[str, ...]  # "source/id", "source/#n" if born from anonymous detections, "~2" behind it if that is taken
    p_enu: FloatArray  # (M, 3) [m]
    v_enu: FloatArray  # (M, 3) [m/s]
    a_enu: FloatArray  # (M, 3) [m/s^2]
    covariance: FloatArray  # (M, 9, 9) over [p, v, a], spread of means included
    mode_probabilities: FloatArray  # (M, 3)
    radius_m: FloatArray  # (M,)
    age_s: FloatArray  # (M,) time since the last update of each
    surprise: FloatArray  # (M,) root mean square of the innovations of its own predictions, 1 where its models are true
    growth: FloatArray  # (M,) how much faster than its models say its predicted covariance grows, 1 where they are true
    status: tuple[str, ...]  # "tentative", "confirmed", "coasting": the newest frame of none of its sources showed it
    sources: tuple[tuple[str, ...], ...]  # names of the sources that see each, sorted

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class Prediction:
    """Obstacles on the barrier grid: instants ``start_ns + k dt_s``, k = 0..K-1."""

    start_ns: int
    dt_s: float
    ids: tuple[str, ...]
    p_enu: FloatArray  # (M, K, 3) [m]
    sigma_m: FloatArray  # (M, K) largest 1-sigma axis of the predicted position, spread of means included
    v_enu: FloatArray  # (M, 3) at start [m/s]
    a_enu: FloatArray  # (M, 3) at start [m/s^2]
    radius_m: FloatArray  # (M,)

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class Margin:
    """The keep-out distance D of a row, part by part [m] (design 5.8)."""

    radii: float
    cushion: float
    sigma: float
    delay: float

    @property
    def total(self) -> float:
        return self.radii + self.cushion + self.sigma + self.delay


@dataclass(frozen=True, slots=True)
class RowRecord:
    """One row that shaped the answer. ``slack`` >= 0 where the true row holds, in m/s^2."""

    track: str  # track id, or "arena", "floor", "ceiling", "speed", "norm", "tilt"
    step: int  # horizon step i; -1 for vehicle limits, and for the braking distance to an obstacle
    slack: float
    margin: Margin | None
    epsilon: float
    epsilon_star: float


@dataclass(frozen=True, slots=True)
class FilterResult:
    """The safety filter's answer for one tick."""

    a_safe: Vec3  # net acceleration, ENU [m/s^2]
    verdict: Verdict
    worst: RowRecord | None  # the row with the least slack at the returned acceleration
    rows: tuple[RowRecord, ...]  # active rows: slack below 0.05 m/s^2, the worst of each obstacle always listed
    iterations: int  # QPs solved
    solver: str
    detour: bool = False  # the answer to a reference along the boundary, not to the one that was asked
