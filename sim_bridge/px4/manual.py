"""Position, Altitude and Stabilized mode: the sticks as setpoints.

Position: the sticks are a velocity in the heading's frame, reached with MPC_ACC_HOR; centred, the place is held.
Altitude: roll and pitch stick tilt, the throttle stick climbs, centred it holds the height. Stabilized: the throttle
stick is thrust. Source: PX4 user guide, "Position Mode", "Altitude Mode", "Stabilized Mode (Multicopter)".
"""

from __future__ import annotations

import math

from sim_bridge.controller import AttitudeSetpoint
from sim_bridge.messages import Mode, Vec3
from sim_bridge.personality import ParameterTable
from sim_bridge.physics import BodyState
from sim_bridge.px4.position import PositionControl, Trajectory
from sim_bridge.px4.sticks import ManualControl
from sim_bridge.rotation import from_euler

_STILL_M_S = 0.2
_G_M_S2 = 9.8


class ManualFlight:
    """What the manual modes make of the sticks; `enter` at a change of mode, `advance` once a physics step."""

    def __init__(self, parameters: ParameterTable, sticks: ManualControl, control: PositionControl) -> None:
        self._parameters = parameters
        self._sticks = sticks
        self._control = control
        self._v_enu: Vec3 = (0.0, 0.0, 0.0)  # asked for, as far as the acceleration limit lets it
        self._lock_enu: Vec3 | None = None  # horizontally where the sticks were centred
        self._lock_z_m: float | None = None
        self._wanted: Vec3 = (0.0, 0.0, 0.0)
        self._a_enu: Vec3 = (0.0, 0.0, 0.0)  # of the velocity asked for

    def enter(self, state: BodyState) -> None:
        self._v_enu, self._a_enu = state.v_enu, (0.0, 0.0, 0.0)
        self._lock_enu = self._lock_z_m = None
        self._control.reset()

    def trajectory(self, state: BodyState, yaw_rad: float) -> Trajectory:
        """Position mode."""
        wanted = self._wanted = self._sticks.velocity(yaw_rad)
        vx, vy, _ = self._v_enu
        if any(wanted[:2]) or math.hypot(vx, vy) > 0.0 or math.hypot(*state.v_enu[:2]) > _STILL_M_S:
            self._lock_enu = None
        elif self._lock_enu is None:
            self._lock_enu = state.p_enu
        lock = self._lock_enu
        level = (math.nan, math.nan) if lock is None else (lock[0], lock[1])
        return Trajectory((*level, self._height(state, wanted[2])), (vx, vy, wanted[2]), self._a_enu, yaw_rad)

    def attitude(self, mode: Mode, state: BodyState, yaw_rad: float) -> AttitudeSetpoint:
        """Altitude and Stabilized mode."""
        roll_rad, pitch_rad = self._sticks.tilt()
        thrust = self._sticks.thrust()
        if mode is Mode.ALTITUDE:
            climb = self._sticks.velocity(yaw_rad)[2]
            wanted = Trajectory((math.nan, math.nan, self._height(state, climb)), (math.nan, math.nan, climb))
            up = self._control.update(wanted, state)[2]
            tilt = math.cos(roll_rad) * math.cos(pitch_rad)
            thrust = float(self._parameters["MPC_THR_HOVER"]) * max(0.0, 1.0 + up / _G_M_S2) / tilt
        turn = (0.0, 0.0, self._sticks.turn_rad_s())
        return AttitudeSetpoint(from_euler(roll_rad, pitch_rad, yaw_rad), thrust, turn)

    def advance(self, dt_s: float) -> None:
        """The velocity asked for follows the sticks with MPC_ACC_HOR at most."""
        most = float(self._parameters["MPC_ACC_HOR"]) * dt_s
        dx, dy = self._wanted[0] - self._v_enu[0], self._wanted[1] - self._v_enu[1]
        length = math.hypot(dx, dy)
        share = 1.0 if length <= most else most / length
        self._a_enu = (share * dx / dt_s, share * dy / dt_s, 0.0)
        self._v_enu = (self._v_enu[0] + share * dx, self._v_enu[1] + share * dy, self._wanted[2])

    def _height(self, state: BodyState, climb_m_s: float) -> float:
        """The height to hold, NaN while the throttle stick asks for another."""
        if climb_m_s:
            self._lock_z_m = None
        elif self._lock_z_m is None and abs(state.v_enu[2]) < _STILL_M_S:
            self._lock_z_m = state.p_enu[2]
        return math.nan if self._lock_z_m is None else self._lock_z_m
