"""PX4's position controller: position, velocity and acceleration setpoints, each axis of each free or given.

    v* = v_sp + P (p_sp - p),    a = a_sp + K (v* - v) + I integral(v* - v)

A free component (NaN) adds nothing; an axis without position and velocity is flown by its acceleration alone. v* is
limited to MPC_XY_VEL_MAX, MPC_Z_VEL_MAX_UP and _DN; the integral only runs where there is a velocity to follow.

Source: PX4 user guide, "Controller Diagrams", and mc_pos_control's parameters MPC_*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim_bridge.messages import Vec3
from sim_bridge.personality import ParameterTable
from sim_bridge.physics import BodyState

_NAN = math.nan
FREE: Vec3 = (_NAN, _NAN, _NAN)
_INTEGRAL_MAX_M_S2 = 4.0


@dataclass(frozen=True, slots=True)
class Trajectory:
    """What to follow, ENU; NaN where it is free."""

    p_enu: Vec3 = FREE  # [m]
    v_enu: Vec3 = FREE  # [m/s]
    a_enu: Vec3 = FREE  # [m/s^2]
    yaw_rad: float = _NAN
    yaw_rate_rad_s: float = _NAN

    @property
    def accelerates_only(self) -> bool:
        return all(map(math.isnan, (*self.p_enu, *self.v_enu)))

    @property
    def follows_nothing(self) -> bool:
        """An axis has neither position, velocity nor acceleration: cannot be flown."""
        axes = zip(self.p_enu, self.v_enu, self.a_enu, strict=True)
        return any(math.isnan(p) and math.isnan(v) and math.isnan(a) for p, v, a in axes)


class PositionControl:
    """Accelerations that follow a trajectory; its hidden state is the integral. `integrate` once a physics step."""

    def __init__(self, parameters: ParameterTable) -> None:
        self._parameters = parameters
        self._integral = [0.0, 0.0, 0.0]  # [m/s^2]
        self._error = [0.0, 0.0, 0.0]
        self._runs = False  # there is an error to integrate
        self._wanted: Trajectory | None = None  # the last, and whether it is an acceleration alone
        self._accelerates = False
        self.v_enu: Vec3 = FREE  # what was last asked for
        self.a_enu: Vec3 = (0.0, 0.0, 0.0)

    def reset(self) -> None:
        """Forget the integral and what was asked for."""
        self._stop()
        self.v_enu = FREE
        self.a_enu = (0.0, 0.0, 0.0)

    def relax(self) -> None:
        """It stands on the ground: errors are no disturbances."""
        self._integral = [0.0, 0.0, 0.0]

    def _stop(self) -> None:
        self._integral = [0.0, 0.0, 0.0]
        self._error = [0.0, 0.0, 0.0]
        self._runs = False

    def update(self, wanted: Trajectory, state: BodyState) -> Vec3:
        """The acceleration that follows ``wanted`` from ``state``, ENU [m/s^2]."""
        if wanted is not self._wanted:
            self._wanted, self._accelerates = wanted, wanted.accelerates_only
        if self._accelerates:
            if self._runs:
                self._stop()
            self.v_enu, self.a_enu = FREE, wanted.a_enu
            return wanted.a_enu
        self._runs = True
        get = self._parameters.__getitem__
        self.v_enu = v_enu = self._velocity(wanted, state)
        a = [0.0, 0.0, 0.0]
        for i in range(3):
            gain = float(get("MPC_XY_VEL_P_ACC" if i < 2 else "MPC_Z_VEL_P_ACC"))
            feed = wanted.a_enu[i]
            a[i] = 0.0 if math.isnan(feed) else feed
            self._error[i] = 0.0
            if not math.isnan(v_enu[i]):
                self._error[i] = v_enu[i] - state.v_enu[i]
                a[i] += gain * self._error[i] + self._integral[i]
            else:
                self._integral[i] = 0.0
        self.a_enu = (a[0], a[1], a[2])
        return self.a_enu

    def integrate(self, dt_s: float) -> None:
        """The error of the last `update` has stood for ``dt_s``; the integral is bounded."""
        if not self._runs:
            return
        for i, error in enumerate(self._error):
            if error:
                gain = float(self._parameters["MPC_XY_VEL_I_ACC" if i < 2 else "MPC_Z_VEL_I_ACC"])
                # an error this large is a manoeuvre that saturates, not a disturbance: it must not wind up
                if abs(error) < 1.0:
                    total = self._integral[i] + gain * error * dt_s
                    self._integral[i] = min(max(total, -_INTEGRAL_MAX_M_S2), _INTEGRAL_MAX_M_S2)

    def _velocity(self, wanted: Trajectory, state: BodyState) -> Vec3:
        get = self._parameters.__getitem__
        gains = (float(get("MPC_XY_P")),) * 2 + (float(get("MPC_Z_P")),)
        v = [_NAN, _NAN, _NAN]
        for i in range(3):
            p, feed = wanted.p_enu[i], wanted.v_enu[i]
            v[i] = feed
            if not math.isnan(p):
                v[i] = gains[i] * (p - state.p_enu[i]) + (0.0 if math.isnan(feed) else feed)
        fastest = float(get("MPC_XY_VEL_MAX"))
        level = math.hypot(*(x for x in v[:2] if not math.isnan(x)))
        shrink = min(1.0, fastest / level) if level > 0.0 else 1.0
        up, down = float(get("MPC_Z_VEL_MAX_UP")), float(get("MPC_Z_VEL_MAX_DN"))
        z = v[2] if math.isnan(v[2]) else min(max(v[2], -down), up)
        return (v[0] * shrink, v[1] * shrink, z)
