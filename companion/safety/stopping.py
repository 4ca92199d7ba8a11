"""How fast a vehicle may move at what it must stop for: walls, and obstacles too large to swerve round.

With d the distance left after the coming step (which the acceleration a no longer changes), a_b the braking
acceleration and no slew limit, the largest speed that still stops on the grid is w(d): v^2 / (2 a_b) + v dt / 2 = d,
and the bound is v + a dt <= w(d). It is invariant: on the bound, the next bound asks for no more than a_b.

With a slew limit s the vehicle first has to turn its acceleration round. Then a is admissible if, held for dt and
thereafter lowered at the rate s to -a_b, it stops within d; what comes one tick later on that very path is admissible
again. The distance grows with a, so the greatest a is found by bisection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.types import FloatArray, Vec3

RETURN_RATE_HZ = 1.0  # speed back out of what should not have been entered, per metre
_HALVINGS = 24  # of an interval of some m/s^2: below 1e-6 m/s^2


@dataclass(frozen=True, slots=True)
class Braking:
    """What the vehicle can count on for stopping."""

    a_m_s2: float
    dt_s: float
    slew_m_s3: float | None = None

    def bound(self, distance_m: float, speed_m_s: float) -> float:
        """Largest acceleration towards something ``distance_m`` ahead, approached with ``speed_m_s`` [m/s^2]."""
        ahead = distance_m - speed_m_s * self.dt_s
        free = (self.speed(ahead) - speed_m_s) / self.dt_s
        if self.slew_m_s3 is None or ahead < 0.0:
            return free
        low, high = -self.a_m_s2, min(free, 10.0 * self.a_m_s2)
        if high <= low or self.stop_m(high, speed_m_s) <= ahead:
            return free
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.stop_m(middle, speed_m_s) <= ahead else (low, middle)
        return low

    def speed(self, distance_m: float) -> float:
        """w(d), negative where d < 0: then the speed at which to come back, no faster than what stops within |d|."""
        half = 0.5 * self.a_m_s2 * self.dt_s
        stops = math.sqrt(half * half + 2.0 * self.a_m_s2 * abs(distance_m)) - half
        return stops if distance_m >= 0.0 else -min(-RETURN_RATE_HZ * distance_m, stops)

    def stop_m(self, a_m_s2: float, speed_m_s: float) -> float:
        """Distance flown after the coming step if ``a_m_s2`` acts in it and is then slewed to -a_b."""
        slew = self.slew_m_s3 or math.inf
        v, a = speed_m_s + a_m_s2 * self.dt_s, a_m_s2
        turning = max(a + self.a_m_s2, 0.0) / slew
        after = v + a * turning - 0.5 * slew * turning * turning if turning else v
        if after > 0.0:
            flown = v * turning + 0.5 * a * turning**2 - (slew * turning**3 / 6.0 if turning else 0.0)
            return flown + after * after / (2.0 * self.a_m_s2) + 0.5 * after * self.dt_s
        peak = a * a + 2.0 * slew * v if turning else 0.0  # v + a t - slew t^2 / 2 = 0
        t = (a + math.sqrt(peak)) / slew if peak > 0.0 else 0.0
        return max(v * t + 0.5 * a * t * t - slew * t**3 / 6.0, 0.0) if t > 0.0 else 0.0


def swerve_m(a_m_s2: float, time_s: float, slew_m_s3: float | None) -> float:
    """How far a vehicle gets sideways within ``time_s`` from no sideways acceleration at all [m].

    a T^2 / 2; with a slew limit the acceleration first rises at that rate, for a / slew.
    """
    rise = min(a_m_s2 / slew_m_s3, time_s) if slew_m_s3 else 0.0
    held = time_s - rise
    jerk = slew_m_s3 or 0.0
    return jerk * rise**3 / 6.0 + 0.5 * jerk * rise**2 * held + 0.5 * a_m_s2 * held**2


@dataclass(frozen=True, slots=True)
class StopRows:
    """One row ``normal @ a >= floor`` an obstacle: no faster at it than what still stops, for those too large.

    With n from the obstacle to the vehicle and c the closing speed, a moving obstacle is a wall that moves:
    -n . a <= bound(|r| - D, c). The line of sight turns, but that only slows the approach (|v_t|^2 / |r| >= 0).
    """

    normal: FloatArray  # (M, 3) unit
    floor: FloatArray  # (M,) [m/s^2], -inf for what can be swerved round

    def slack(self, a: FloatArray) -> FloatArray:
        """Room left at ``a`` (C, 3), negative where broken, (C, M) [m/s^2]."""
        return np.asarray(a @ self.normal.T - self.floor)

    def beyond(self, low: Vec3, high: Vec3, by_m_s2: float) -> bool:
        """Whether some row is broken by more than ``by_m_s2`` at every acceleration of the box."""
        most = np.add.reduce(np.maximum(self.normal * low, self.normal * high), axis=-1)
        return bool(np.maximum.reduce(self.floor - most, initial=-math.inf) > by_m_s2)

    def select(self, taken: npt.NDArray[np.intp]) -> StopRows:
        """The rows of some obstacles only."""
        return StopRows(self.normal.take(taken, axis=0), self.floor.take(taken))


def stop_rows(
    r: FloatArray, v_rel: FloatArray, keep_out_m: FloatArray, braking: Braking, swerve: float
) -> StopRows | None:
    """Rows of the obstacles with D > ``swerve``, None where there is none.

    Args:
        r, v_rel: vehicle minus obstacle at the start of the grid, (M, 3) [m], [m/s].
        keep_out_m: D, (M,).
    """
    large = keep_out_m > swerve
    if not large.any():
        return None
    distance = np.maximum(np.sqrt(np.vecdot(r, r)), 1e-9)
    normal = r / distance[:, None]
    gap, closing = (distance - keep_out_m).tolist(), (-np.vecdot(normal, v_rel)).tolist()
    floor = [
        -braking.bound(d, c) if too_large else -math.inf
        for too_large, d, c in zip(large.tolist(), gap, closing, strict=True)
    ]
    return StopRows(normal, np.array(floor))
