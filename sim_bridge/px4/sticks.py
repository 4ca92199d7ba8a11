"""A pilot's sticks: whether there are any, whether they were moved, and what they ask for in the manual modes."""

from __future__ import annotations

import math

from sim_bridge.messages import NS_PER_S, Sticks, Vec3
from sim_bridge.personality import ParameterTable

_NOBODY = Sticks(0.0, 0.0, 0.0, 0.0)
_RADIO_ONLY, _JOYSTICK_ONLY, _NOTHING = 0, 1, 4  # COM_RC_IN_MODE


class ManualControl:
    """The newest sticks, from the radio (RC_CHANNELS_OVERRIDE) or MANUAL_CONTROL as COM_RC_IN_MODE allows."""

    def __init__(self, parameters: ParameterTable) -> None:
        self._parameters = parameters
        self._last = _NOBODY
        self._last_ns: int | None = None
        self._throttle_at_rest = 0.0

    def take(self, sticks: Sticks, t_ns: int) -> None:
        source = self._parameters["COM_RC_IN_MODE"]
        if source == _NOTHING or source == (_JOYSTICK_ONLY if sticks.radio else _RADIO_ONLY):
            return
        if self.lost(t_ns):
            self._throttle_at_rest = sticks.up
        self._last, self._last_ns = sticks, t_ns

    def release(self) -> None:
        """The radio gave its channels back."""
        self._last_ns = None

    def lost(self, t_ns: int) -> bool:
        """No sticks for longer than COM_RC_LOSS_T, or none ever."""
        last_ns = self._last_ns
        return last_ns is None or t_ns - last_ns > self._parameters["COM_RC_LOSS_T"] * NS_PER_S

    def settle(self) -> None:
        """The pilot flies: where the throttle stick stands now is its rest."""
        self._throttle_at_rest = self._last.up

    def moved(self) -> bool:
        """Out of the centre, the throttle stick from its rest, by more than COM_RC_STICK_OV."""
        least = float(self._parameters["COM_RC_STICK_OV"]) / 100.0
        sticks = self._last
        if max(abs(sticks.forward), abs(sticks.left), abs(sticks.turn_left)) > least:
            return True
        ignores_throttle = int(self._parameters["COM_RC_OVERRIDE"]) & 4
        return not ignores_throttle and abs(sticks.up - self._throttle_at_rest) > least

    def _dead(self, stick: float) -> float:
        """The stick beyond its dead zone MPC_HOLD_DZ, full at full deflection."""
        zone = float(self._parameters["MPC_HOLD_DZ"])
        beyond = max(0.0, abs(stick) - zone)
        return math.copysign(beyond / (1.0 - zone), stick) if beyond > 0.0 else 0.0

    def velocity(self, yaw_rad: float) -> Vec3:
        """Position mode: the velocity asked for, ENU [m/s]; the corner of a square gate is no faster than its side."""
        parameters = self._parameters
        forward, left, up = self._dead(self._last.forward), self._dead(self._last.left), self._dead(self._last.up)
        length = math.hypot(forward, left)
        speed = float(min(parameters["MPC_VEL_MANUAL"], parameters["MPC_XY_VEL_MAX"])) / max(1.0, length)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        climb = float(parameters["MPC_Z_VEL_MAX_UP" if up > 0.0 else "MPC_Z_VEL_MAX_DN"]) * up
        return (speed * (cos * forward - sin * left), speed * (sin * forward + cos * left), climb)

    def turn_rad_s(self) -> float:
        return math.radians(float(self._parameters["MPC_MAN_Y_MAX"])) * self._dead(self._last.turn_left)

    def tilt(self) -> tuple[float, float]:
        """Altitude and Stabilized: roll (left side up is positive) and pitch (nose down is positive), FLU [rad]."""
        most = math.radians(float(self._parameters["MPC_MAN_TILT_MAX"]))
        forward, left = self._last.forward, self._last.left
        scale = most / max(1.0, math.hypot(forward, left))
        return (-scale * left, scale * forward)

    def thrust(self) -> float:
        """Stabilized: the throttle stick as collective, hover at its centre, share of full thrust."""
        hover, up = float(self._parameters["MPC_THR_HOVER"]), self._last.up
        return hover * (1.0 + up) if up < 0.0 else hover + (1.0 - hover) * up
