"""Why PX4 would not arm, and the sensors' health as SYS_STATUS tells it.

Source: PX4 user guide, "Preflight Sensor/Estimator Checks" and "Safety Configuration"; MAV_SYS_STATUS_SENSOR.
"""

from __future__ import annotations

import math

from sim_bridge.messages import Mode
from sim_bridge.personality import ParameterTable
from sim_bridge.physics import BodyState
from sim_bridge.px4.conditions import Charge, Situation, outside_fence
from sim_bridge.rotation import to_euler

_GYRO, _ACCELEROMETER, _MAGNETOMETER, _PRESSURE, _GPS = 1 << 0, 1 << 1, 1 << 2, 1 << 3, 1 << 5
_CONTROL = 0b11111 << 10  # angular rate, attitude, yaw, altitude, position
_MOTORS, _STICKS, _FENCE, _AHRS = 1 << 15, 1 << 16, 1 << 20, 1 << 21
_BATTERY, _PREARM_CHECK = 1 << 25, 1 << 28
_ALWAYS = _GYRO | _ACCELEROMETER | _MAGNETOMETER | _PRESSURE | _GPS | _CONTROL | _MOTORS | _AHRS | _BATTERY
_NOT_TO_ARM_IN = (Mode.LAND, Mode.RETURN)


def refusals(now: Situation, state: BodyState, parameters: ParameterTable, *, terminated: bool) -> list[str]:
    """Why the vehicle cannot be armed now, each reason as PX4 words it; empty where it can."""
    found = []
    if terminated:
        found.append("Flight termination active")
    if now.mode in _NOT_TO_ARM_IN:
        found.append("Mode not suitable for takeoff")
    if not now.has_position:
        found.append("No valid local position estimate")
    roll_rad, pitch_rad, _ = to_euler(state.q_wxyz)
    if math.degrees(abs(roll_rad)) > parameters["FD_FAIL_R"]:
        found.append("Attitude failure (roll)")
    if math.degrees(abs(pitch_rad)) > parameters["FD_FAIL_P"]:
        found.append("Attitude failure (pitch)")
    if now.charge >= Charge.CRITICAL:
        found.append("Low battery")
    if parameters["NAV_DLL_ACT"] != 0 and now.station_lost:
        found.append("No connection to the GCS")
    if now.mode in (Mode.ALTITUDE, Mode.STABILIZED) and now.sticks_lost:
        found.append("No manual control input")
    if parameters["GF_ACTION"] != 0 and outside_fence(now.p_enu, now.home_enu, parameters):
        found.append("Geofence violation")
    if now.mode is Mode.OFFBOARD and now.stream_lost:
        found.append("No offboard signal")
    return found


def health(now: Situation, parameters: ParameterTable, *, can_arm: bool) -> tuple[int, int, int]:
    """SYS_STATUS's bit masks: present, enabled, healthy."""
    present = _ALWAYS | _PREARM_CHECK
    present |= 0 if now.sticks_lost else _STICKS
    fenced = parameters["GF_ACTION"] != 0 and (parameters["GF_MAX_HOR_DIST"] > 0 or parameters["GF_MAX_VER_DIST"] > 0)
    present |= _FENCE if fenced else 0
    healthy = present
    if not can_arm:
        healthy &= ~_PREARM_CHECK
    if not now.has_position:
        healthy &= ~(_GPS | _AHRS)
    if now.charge is not Charge.OK:
        healthy &= ~_BATTERY
    if outside_fence(now.p_enu, now.home_enu, parameters):
        healthy &= ~_FENCE
    return present, present, healthy
