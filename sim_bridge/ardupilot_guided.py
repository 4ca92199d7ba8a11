"""ArduCopter's GUIDED mode: which setpoints it takes, its submode, its nose, and what it tells it follows.

A group of fields (position, velocity, acceleration) counts as ignored where any bit of it is set. What then is left
chooses the submode; what it does not like (another frame, FORCE, position with acceleration, one axis ignored out of
the only group, nothing) stops it without a word: velocity and acceleration zero.
Sources: ArduPilot GCS_MAVLink_Copter.cpp and mode_guided.cpp; behaviour as measured on 4.7-dev.
"""

from __future__ import annotations

import math
from enum import Enum, auto

from sim_bridge.messages import HOME_ALTITUDE_AMSL_M, LocalSetpoint, Vec3

LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED = 1, 7, 8, 9  # MAV_FRAME
_FRAMES = (LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED)
_BODY = (BODY_NED, BODY_OFFSET_NED)
_OFFSET = (LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED)
_ABOVE_HOME = (3, 6)  # MAV_FRAME_GLOBAL_RELATIVE_ALT, and _INT
_GLOBAL = (0, 5, *_ABOVE_HOME)  # the others are above terrain, of which there is no map
_POSITION, _VELOCITY, _ACCELERATION, _FORCE, _YAW, _YAW_RATE = 0x007, 0x038, 0x1C0, 0x200, 0x400, 0x800
_NOSE_AHEAD_M_S = 0.7  # slower, the nose stays
_NOSE_RAD_S = math.radians(60.0)  # ATC_SLEW_YAW
_ZERO: Vec3 = (0.0, 0.0, 0.0)


class Submode(Enum):
    """What is controlled."""

    TAKEOFF = auto()
    POSITION = auto()
    POSITION_VELOCITY = auto()
    VELOCITY = auto()
    ACCELERATION = auto()


MASKS = {  # under which POSITION_TARGET_LOCAL_NED tells each
    Submode.TAKEOFF: 0x0DF8,
    Submode.POSITION: 0x0DF8,
    Submode.POSITION_VELOCITY: 0x0C00,
    Submode.VELOCITY: 0x0C07,
    Submode.ACCELERATION: 0x0C3F,
}


class Nose:
    """Heading in GUIDED: into the flight direction, held, at an angle, or turning."""

    def __init__(self, yaw_rad: float) -> None:
        self.yaw_rad = yaw_rad  # counter-clockwise from east
        self.rate_rad_s: float | None = 0.0  # a turn, 0 holds; None: towards ``goal_rad``, or ahead
        self.goal_rad: float | None = None

    def hold(self) -> None:
        self.rate_rad_s, self.goal_rad = 0.0, None

    def ahead(self) -> None:
        self.rate_rad_s, self.goal_rad = None, None

    def stop_turning(self) -> None:
        """What a setpoint stream that ended leaves of a yaw or a yaw rate."""
        if self.rate_rad_s is not None or self.goal_rad is not None:
            self.hold()

    def take(self, setpoint: LocalSetpoint) -> None:
        """A setpoint's yaw, yaw rate, or neither; angles in body frames count from the nose."""
        mask = setpoint.type_mask
        if not mask & _YAW:
            relative = setpoint.frame in _BODY
            turn = setpoint.yaw_rad - 0.5 * math.pi  # the decoder takes the wire's zero for north; here it is ahead
            self.rate_rad_s, self.goal_rad = None, self.yaw_rad + turn if relative else setpoint.yaw_rad
        elif not mask & _YAW_RATE:
            self.rate_rad_s, self.goal_rad = setpoint.yaw_rate_rad_s, None
        else:
            self.ahead()

    def turn(self, v_enu: Vec3, dt_s: float) -> None:
        """One physics step; ``v_enu``: the reference's velocity."""
        if self.rate_rad_s is not None:
            self.yaw_rad = math.remainder(self.yaw_rad + self.rate_rad_s * dt_s, math.tau)
            return
        goal_rad = self.goal_rad
        if goal_rad is None:
            if math.hypot(v_enu[0], v_enu[1]) < _NOSE_AHEAD_M_S:
                return
            goal_rad = math.atan2(v_enu[1], v_enu[0])
        error = math.remainder(goal_rad - self.yaw_rad, math.tau)
        most = _NOSE_RAD_S * dt_s
        self.yaw_rad = math.remainder(self.yaw_rad + min(max(error, -most), most), math.tau)


class Guided:
    """Submode and targets, ENU; ``t_ns`` is when the last setpoint came, None before one."""

    def __init__(self) -> None:
        self.submode = Submode.VELOCITY
        self.p_enu: Vec3 = _ZERO
        self.v_enu: Vec3 = _ZERO
        self.a_enu: Vec3 = _ZERO
        self.took_off = False  # the takeoff has arrived
        self.followed = False  # a setpoint has been taken since the mode began
        self.t_ns: int | None = None

    def stop(self) -> None:
        """Velocity and acceleration zero: how the mode begins, and what it does about what it does not like."""
        self._set(Submode.VELOCITY, _ZERO, _ZERO, _ZERO)

    def begin(self) -> None:
        """The mode is entered."""
        self.followed = False
        self.t_ns = None
        self.stop()

    def take_off(self, p_enu: Vec3) -> None:
        self._set(Submode.TAKEOFF, p_enu, _ZERO, _ZERO)
        self.took_off = False

    def go_to(self, p_enu: Vec3) -> None:
        self._set(Submode.POSITION, p_enu, _ZERO, _ZERO)

    @property
    def taking_off(self) -> bool:
        return self.submode is Submode.TAKEOFF and not self.took_off

    def take(self, setpoint: LocalSetpoint, p_enu: Vec3, home_z_m: float, nose: Nose, t_ns: int) -> bool:
        """Take a setpoint at the vehicle's position; False where it is stopped by one that holds no number."""
        mask = setpoint.type_mask
        uses_p, uses_v, uses_a = (not mask & group for group in (_POSITION, _VELOCITY, _ACCELERATION))
        self.followed, self.t_ns = True, t_ns
        if not _finite(setpoint, uses_p, uses_v, uses_a):
            self.stop()
            return False
        submode = _submode(uses_p, uses_v, uses_a)
        frames = _GLOBAL if setpoint.is_global else _FRAMES
        if setpoint.frame not in frames or submode is None or (mask & _FORCE and uses_a):
            self.stop()
            return True
        ahead_rad = nose.yaw_rad if setpoint.frame in _BODY else 0.0  # body vectors are FLU
        offset = p_enu if setpoint.frame in _OFFSET else _ZERO
        if setpoint.is_global:
            offset = (0.0, 0.0, home_z_m if setpoint.frame in _ABOVE_HOME else -HOME_ALTITUDE_AMSL_M)
        nose.take(setpoint)
        x, y, z = turned(setpoint.p_enu, ahead_rad) if uses_p else _ZERO
        self._set(
            submode,
            (x + offset[0], y + offset[1], z + offset[2]) if uses_p else _ZERO,
            turned(setpoint.v_enu, ahead_rad) if uses_v else _ZERO,
            turned(setpoint.a_enu, ahead_rad) if uses_a else _ZERO,
        )
        return True

    def lost(self, t_ns: int, timeout_s: float) -> bool:
        """No setpoint for ``timeout_s``, 0.1 s at least; positions do not age."""
        ageing = self.submode in (Submode.ACCELERATION, Submode.VELOCITY, Submode.POSITION_VELOCITY)
        return ageing and self.t_ns is not None and (t_ns - self.t_ns) * 1e-9 > max(timeout_s, 0.1)

    def echo(self, time_boot_ms: int) -> LocalSetpoint:
        """POSITION_TARGET_LOCAL_NED: the submode's mask and targets; its yaw is always ignored, and 0."""
        return LocalSetpoint(
            time_boot_ms, LOCAL_NED, MASKS[self.submode], self.p_enu, self.v_enu, self.a_enu, 0.5 * math.pi, 0.0
        )

    def _set(self, submode: Submode, p_enu: Vec3, v_enu: Vec3, a_enu: Vec3) -> None:
        self.submode, self.p_enu, self.v_enu, self.a_enu = submode, p_enu, v_enu, a_enu


def turned(v: Vec3, yaw_rad: float) -> Vec3:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])


def _submode(uses_p: bool, uses_v: bool, uses_a: bool) -> Submode | None:
    if uses_v:
        return Submode.POSITION_VELOCITY if uses_p else Submode.VELOCITY
    if uses_p == uses_a:
        return None
    return Submode.POSITION if uses_p else Submode.ACCELERATION


def _finite(setpoint: LocalSetpoint, uses_p: bool, uses_v: bool, uses_a: bool) -> bool:
    used = [
        x for use, v in ((uses_p, setpoint.p_enu), (uses_v, setpoint.v_enu), (uses_a, setpoint.a_enu)) if use for x in v
    ]
    if not setpoint.type_mask & _YAW:
        used.append(setpoint.yaw_rad)
    if not setpoint.type_mask & _YAW_RATE:
        used.append(setpoint.yaw_rate_rad_s)
    return all(map(math.isfinite, used))
