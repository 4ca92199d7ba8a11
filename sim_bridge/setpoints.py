"""External setpoints as PX4 takes them: which are flown, what they mean, and why others are refused.

SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME_LOCAL_NED or BODY_NED (velocities turned by the heading alone, accelerations
by the whole attitude, no positions), SET_POSITION_TARGET_GLOBAL_INT with altitudes above sea level or above home, and
SET_ATTITUDE_TARGET. A field that the mask ignores is free; every axis needs one that is not.
"""

from __future__ import annotations

import math

from sim_bridge.controller import AttitudeSetpoint
from sim_bridge.messages import HOME_ALTITUDE_AMSL_M, AttitudeTarget, LocalSetpoint, Vec3
from sim_bridge.physics import BodyState
from sim_bridge.px4.position import FREE, Trajectory
from sim_bridge.rotation import from_body, yaw_of

FRAME_LOCAL_NED, FRAME_BODY_NED = 1, 8
FRAME_GLOBAL_INT, FRAME_GLOBAL_RELATIVE_ALT_INT = 5, 6
FORCE_BIT = 0x0200
YAW_IGNORED = 0x0400
YAW_RATE_IGNORED = 0x0800
POSITION_IGNORED, VELOCITY_IGNORED, ACCELERATION_IGNORED = 0x0007, 0x0038, 0x01C0

ROLL_RATE_IGNORED, PITCH_RATE_IGNORED, YAW_TURN_IGNORED = 0x01, 0x02, 0x04
THRUST_IGNORED, ATTITUDE_IGNORED = 0x40, 0x80


def refusal(setpoint: LocalSetpoint) -> str:
    """Why a position, velocity or acceleration setpoint cannot be flown, or nothing."""
    mask = setpoint.type_mask
    frames = (
        (FRAME_GLOBAL_INT, FRAME_GLOBAL_RELATIVE_ALT_INT) if setpoint.is_global else (FRAME_LOCAL_NED, FRAME_BODY_NED)
    )
    if setpoint.frame not in frames:
        return f"frame {setpoint.frame}"
    if mask & FORCE_BIT and mask & ACCELERATION_IGNORED != ACCELERATION_IGNORED:
        return f"type_mask 0x{mask:04X} FORCE"
    if not all(map(math.isfinite, _used(setpoint))):
        return "not a finite number"
    wanted = _given(setpoint)
    if wanted.follows_nothing or any(
        math.isnan(v[0]) != math.isnan(v[1]) for v in (wanted.p_enu, wanted.v_enu, wanted.a_enu)
    ):
        return f"type_mask 0x{mask:04X}"
    return ""


def trajectory(setpoint: LocalSetpoint, state: BodyState, home_z_m: float) -> Trajectory:
    """What an accepted setpoint asks for, ENU, from where the vehicle is."""
    given = _given(setpoint)
    p_enu, v_enu, a_enu = given.p_enu, given.v_enu, given.a_enu
    if setpoint.frame == FRAME_BODY_NED:
        yaw_rad = yaw_of(state.q_wxyz)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        forward, left, up = v_enu
        v_enu = (cos * forward - sin * left, sin * forward + cos * left, up)
        a_enu = from_body(state.q_wxyz, a_enu)
    elif setpoint.frame == FRAME_GLOBAL_INT:
        p_enu = (p_enu[0], p_enu[1], p_enu[2] - HOME_ALTITUDE_AMSL_M)
    elif setpoint.frame == FRAME_GLOBAL_RELATIVE_ALT_INT:
        p_enu = (p_enu[0], p_enu[1], p_enu[2] + home_z_m)
    return Trajectory(p_enu, v_enu, a_enu, given.yaw_rad, given.yaw_rate_rad_s)


def attitude_refusal(setpoint: AttitudeTarget) -> str:
    """Why an attitude or rate setpoint cannot be flown, or nothing."""
    mask = setpoint.type_mask
    if mask & ATTITUDE_IGNORED and mask & (ROLL_RATE_IGNORED | PITCH_RATE_IGNORED):
        return f"attitude type_mask 0x{mask:02X}"
    used = [] if mask & THRUST_IGNORED else [setpoint.thrust]
    used += [] if mask & ATTITUDE_IGNORED else setpoint.q_wxyz
    rates = (ROLL_RATE_IGNORED, PITCH_RATE_IGNORED, YAW_TURN_IGNORED)
    used += [rate for rate, bit in zip(setpoint.omega_flu, rates, strict=True) if not mask & bit]
    if not all(map(math.isfinite, used)):
        return "not a finite number"
    norm = math.hypot(*setpoint.q_wxyz)
    return "" if mask & ATTITUDE_IGNORED or abs(norm - 1.0) < 0.1 else "no unit quaternion"


def flown_attitude(wanted: AttitudeTarget) -> AttitudeSetpoint:
    """What an accepted attitude or rate setpoint asks of the controller; an ignored thrust is none, as on PX4."""
    mask = wanted.type_mask
    thrust = 0.0 if mask & THRUST_IGNORED else wanted.thrust
    turn = 0.0 if mask & YAW_TURN_IGNORED else wanted.omega_flu[2]
    if mask & ATTITUDE_IGNORED:
        return AttitudeSetpoint(None, thrust, (wanted.omega_flu[0], wanted.omega_flu[1], turn))
    return AttitudeSetpoint(wanted.q_wxyz, thrust, (0.0, 0.0, turn))


def echo(p_enu: Vec3, v_enu: Vec3, a_enu: Vec3, yaw_rad: float, yaw_rate_rad_s: float) -> LocalSetpoint:
    """What is flown as POSITION_TARGET_LOCAL_NED: NaN and a bit of the mask for what is free."""
    # the mask's bits are north, east, down; ENU is east, north, up: horizontally both are free, or neither
    mask = sum(1 << i for i, x in enumerate((*p_enu, *v_enu, *a_enu)) if math.isnan(x))
    return LocalSetpoint(0, 1, mask, p_enu, v_enu, a_enu, yaw_rad, yaw_rate_rad_s)


def _given(setpoint: LocalSetpoint) -> Trajectory:
    """The fields that the mask does not ignore, in the setpoint's own frame."""
    mask, nan = setpoint.type_mask, math.nan
    # PX4 takes whole vectors or none of a global position and of what is in the body frame
    if setpoint.is_global and mask & POSITION_IGNORED:
        mask |= POSITION_IGNORED
    if setpoint.frame == FRAME_BODY_NED:
        mask |= POSITION_IGNORED
        mask |= VELOCITY_IGNORED if mask & VELOCITY_IGNORED else 0
        mask |= ACCELERATION_IGNORED if mask & ACCELERATION_IGNORED else 0
    return Trajectory(
        _masked(setpoint.p_enu, mask),
        _masked(setpoint.v_enu, mask >> 3),
        _masked(setpoint.a_enu, mask >> 6),
        nan if mask & YAW_IGNORED else setpoint.yaw_rad,
        nan if mask & YAW_RATE_IGNORED else setpoint.yaw_rate_rad_s,
    )


def _masked(v: Vec3, bits: int) -> Vec3:
    """``v`` with NaN where one of the three low bits is set; the bits are MAVLink's: north, east, down."""
    if not bits & 7:
        return v
    if bits & 7 == 7:
        return FREE
    north, east, down = bits & 1, bits & 2, bits & 4
    return (math.nan if east else v[0], math.nan if north else v[1], math.nan if down else v[2])


def _used(setpoint: LocalSetpoint) -> list[float]:
    """The numbers that must be finite."""
    mask = setpoint.type_mask | (POSITION_IGNORED if setpoint.frame == FRAME_BODY_NED else 0)
    used = _unmasked(setpoint.p_enu, mask) + _unmasked(setpoint.v_enu, mask >> 3) + _unmasked(setpoint.a_enu, mask >> 6)
    used += [] if mask & YAW_IGNORED else [setpoint.yaw_rad]
    return used + ([] if mask & YAW_RATE_IGNORED else [setpoint.yaw_rate_rad_s])


def _unmasked(v: Vec3, bits: int) -> list[float]:
    return [x for x, ignored in zip(v, (bits & 2, bits & 1, bits & 4), strict=True) if not ignored]
