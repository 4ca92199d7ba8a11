"""Whether the vehicle's local frame is still the one it was: resets of the estimator.

ODOMETRY counts them (``reset_counter``). LOCAL_POSITION_NED does not, so a position that its own velocities do not
explain is taken for one too:

    |p(k) - p(k-1) - (v(k) + v(k-1)) dt / 2| > 1 m + 6 sigma,   dt <= 0.5 s

which 8 m/s^2 held for 0.5 s changes by nothing and a jerk of 40 m/s^3 by 0.4 m.
"""

from __future__ import annotations

import numpy as np

from companion.types import NS_PER_S, VehicleState

JUMP_M = 1.0
JUMP_SIGMAS = 6.0
GAP_NS = NS_PER_S // 2  # across a longer gap velocities say too little about the position


class OriginWatch:
    """Feed it every vehicle state, in order."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._last: VehicleState | None = None
        self._counter: int | None = None

    def moved_m(self, vehicle: VehicleState) -> float | None:
        """How far the position moved without flying there where the estimator was reset, else None [m]."""
        last, self._last = self._last, vehicle
        counter = self._counter
        if vehicle.reset_counter is not None:
            self._counter = vehicle.reset_counter
        if last is None:
            return None
        elapsed_ns = vehicle.stamp_ns - last.stamp_ns
        flown = (vehicle.v_enu + last.v_enu) * (0.5 * elapsed_ns / NS_PER_S)
        moved_m = float(np.linalg.norm(vehicle.p_enu - last.p_enu - flown))
        if counter is not None and self._counter != counter:
            return moved_m
        bound_m = JUMP_M + JUMP_SIGMAS * max(vehicle.p_std_m, last.p_std_m)
        return moved_m if elapsed_ns <= GAP_NS and moved_m > bound_m else None
