"""The autopilot's messages, each built from the same moment: NED and FRD, as they go on the wire."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.geodesy import geodetic
from sim_bridge.mavlink import flip_frd_flu, q_ned_from_frd, swap_ned_enu
from sim_bridge.messages import HOME_ALTITUDE_AMSL_M
from sim_bridge.personality import BatteryReading, Personality
from sim_bridge.physics import BodyState, to_body
from sim_bridge.rotation import to_euler, yaw_of

Message: TypeAlias = Any  # dialect.MAVLink_message, or None: nothing to tell; pymavlink is untyped

_UNKNOWN = 65535
_FRAME_LOCAL_NED, _FRAME_BODY_FRD = 1, 12
_LEAST_STD = 1e-3  # no estimator is certain: a variance of 0 would be taken for unknown
_AUTOPILOT_ESTIMATOR = 8  # MAV_ESTIMATOR_TYPE_AUTOPILOT


@dataclass(frozen=True, slots=True)
class Moment:
    """What a message is built from."""

    t_ns: int
    state: BodyState
    autopilot: Personality
    battery: BatteryReading
    accuracy: tuple[float, float, float]  # standard deviations: position [m], velocity [m/s], attitude [rad]
    system: int = 1
    throttle: float = 0.0  # collective, share of full thrust
    unix_ns: int = 0  # 0: not known

    @property
    def t_ms(self) -> int:
        return self.t_ns // 1_000_000

    @property
    def t_us(self) -> int:
        return self.t_ns // 1000

    @property
    def has_position(self) -> bool:
        return all(map(math.isfinite, self.state.p_enu))

    @property
    def heading_rad(self) -> float:
        """Clockwise from north, 0 to 2 pi."""
        return (0.5 * math.pi - yaw_of(self.state.q_wxyz)) % math.tau


def heartbeat(now: Moment) -> Message:
    autopilot = now.autopilot
    return dialect.MAVLink_heartbeat_message(
        2, autopilot.kind, autopilot.base_mode, autopilot.custom_mode, autopilot.system_status, 3
    )


def attitude_quaternion(now: Moment) -> Message:
    w, x, y, z = q_ned_from_frd(now.state.q_wxyz)
    p, q, r = now.state.omega_flu
    return dialect.MAVLink_attitude_quaternion_message(now.t_ms, w, x, y, z, p, -q, -r)


def attitude(now: Moment) -> Message:
    roll_rad, pitch_rad, yaw_rad = to_euler(now.state.q_wxyz)
    heading_rad = math.remainder(0.5 * math.pi - yaw_rad, math.tau)
    p, q, r = now.state.omega_flu
    return dialect.MAVLink_attitude_message(now.t_ms, roll_rad, -pitch_rad, heading_rad, p, -q, -r)


def local_position_ned(now: Moment) -> Message:
    if not now.has_position:
        return None
    return dialect.MAVLink_local_position_ned_message(
        now.t_ms, *swap_ned_enu(now.state.p_enu), *swap_ned_enu(now.state.v_enu)
    )


def odometry(now: Moment) -> Message:
    """Position in NED, velocity in the child frame FRD; covariances are diagonal."""
    if not now.has_position:
        return None
    state = now.state
    position, velocity, attitude = (max(std, _LEAST_STD) ** 2 for std in now.accuracy)
    pose = _diagonal((position,) * 3 + (attitude,) * 3)
    twist = _diagonal((velocity,) * 3 + (0.0,) * 3)
    return dialect.MAVLink_odometry_message(
        now.t_us,
        _FRAME_LOCAL_NED,
        _FRAME_BODY_FRD,
        *swap_ned_enu(state.p_enu),
        list(q_ned_from_frd(state.q_wxyz)),
        *flip_frd_flu(to_body(state.q_wxyz, state.v_enu)),
        *flip_frd_flu(state.omega_flu),
        pose,
        twist,
        0,  # the estimate is never reset
        _AUTOPILOT_ESTIMATOR,
        100,
    )


def extended_sys_state(now: Moment) -> Message:
    return dialect.MAVLink_extended_sys_state_message(0, int(now.autopilot.landed))


def system_time(now: Moment) -> Message:
    return dialect.MAVLink_system_time_message(now.unix_ns // 1000, now.t_ms)


def sys_status(now: Moment) -> Message:
    battery = now.battery
    return dialect.MAVLink_sys_status_message(
        *now.autopilot.health,
        100,
        round(battery.voltage_v * 1e3),
        round(battery.current_a * 1e2),
        _percent(battery),
        *(0,) * 6,
    )


def battery_status(now: Moment) -> Message:
    battery = now.battery
    cells_mv = [round(battery.voltage_v * 1e3)] + [_UNKNOWN] * 9
    return dialect.MAVLink_battery_status_message(
        0,
        0,
        dialect.MAV_BATTERY_TYPE_LIPO,
        32767,
        cells_mv,
        round(battery.current_a * 1e2),
        round(battery.consumed_mah),
        -1,
        _percent(battery),
        0,
        now.autopilot.charge_state,
    )


def home_position(now: Moment) -> Message:
    x, y, z = now.autopilot.home_enu
    north, east, down = swap_ned_enu((x, y, z))
    level = [1.0, 0.0, 0.0, 0.0]
    return dialect.MAVLink_home_position_message(*_place(x, y), _amsl_mm(z), north, east, down, level, 0.0, 0.0, 0.0)


def gps_global_origin(now: Moment) -> Message:
    return dialect.MAVLink_gps_global_origin_message(*_place(0.0, 0.0), _amsl_mm(0.0))


def global_position_int(now: Moment) -> Message:
    if not now.has_position:
        return None
    (x, y, z), (vx, vy, vz) = now.state.p_enu, now.state.v_enu
    above_home_mm = round((z - now.autopilot.home_enu[2]) * 1e3)
    north, east, down = (round(max(-327.0, min(327.0, v)) * 100) for v in (vy, vx, -vz))
    heading_cdeg = round(math.degrees(now.heading_rad) * 100.0) % 36000
    return dialect.MAVLink_global_position_int_message(
        now.t_ms, *_place(x, y), _amsl_mm(z), above_home_mm, north, east, down, heading_cdeg
    )


def gps_raw_int(now: Moment) -> Message:
    if not now.has_position:
        return None
    x, y, z = now.state.p_enu
    vx, vy, _ = now.state.v_enu
    speed_cm_s = round(math.hypot(vx, vy) * 100.0)
    return dialect.MAVLink_gps_raw_int_message(
        now.t_us, 3, *_place(x, y), _amsl_mm(z), 80, 80, speed_cm_s, _UNKNOWN, 12
    )


def altitude(now: Moment) -> Message:
    if not now.has_position:
        return None
    z = now.state.p_enu[2]
    amsl_m = HOME_ALTITUDE_AMSL_M + z
    return dialect.MAVLink_altitude_message(
        now.t_us, amsl_m, amsl_m, z, z - now.autopilot.home_enu[2], HOME_ALTITUDE_AMSL_M, z
    )


def vfr_hud(now: Moment) -> Message:
    if not now.has_position:
        return None
    vx, vy, vz = now.state.v_enu
    heading_deg = round(math.degrees(now.heading_rad)) % 360
    return dialect.MAVLink_vfr_hud_message(
        math.hypot(vx, vy, vz),
        math.hypot(vx, vy),
        heading_deg,
        round(100.0 * now.throttle),
        HOME_ALTITUDE_AMSL_M + now.state.p_enu[2],
        vz,
    )


def position_target(now: Moment) -> Message:
    """What is flown, None where there is nothing to tell."""
    setpoint = now.autopilot.position_target()
    if setpoint is None:
        return None
    return dialect.MAVLink_position_target_local_ned_message(
        now.t_ms,
        setpoint.frame,
        setpoint.type_mask,
        *swap_ned_enu(setpoint.p_enu),
        *swap_ned_enu(setpoint.v_enu),
        *swap_ned_enu(setpoint.a_enu),
        math.remainder(0.5 * math.pi - setpoint.yaw_rad, math.tau),
        -setpoint.yaw_rate_rad_s,
    )


def attitude_target(now: Moment) -> Message:
    wanted = now.autopilot.attitude_target()
    if wanted is None:
        return None
    rates = flip_frd_flu(wanted.omega_flu)
    q = list(q_ned_from_frd(wanted.q_wxyz))
    return dialect.MAVLink_attitude_target_message(now.t_ms, wanted.type_mask, q, *rates, wanted.thrust)


def autopilot_version(now: Moment) -> Message:
    version = now.autopilot.version
    blank = [0] * 8
    return dialect.MAVLink_autopilot_version_message(
        now.autopilot.capabilities, version, version, 0, 0, blank, blank, blank, 0x26AC, 1, now.system
    )


def _place(x_m: float, y_m: float) -> tuple[int, int]:
    """Latitude and longitude of a local point [1e-7 deg]."""
    latitude_deg, longitude_deg = geodetic(x_m, y_m)
    return round(latitude_deg * 1e7), round(longitude_deg * 1e7)


def _amsl_mm(z_m: float) -> int:
    return round((HOME_ALTITUDE_AMSL_M + z_m) * 1e3)


def _percent(battery: BatteryReading) -> int:
    """Charge left, rounded up as PX4 does: 0 is empty."""
    return math.ceil(100.0 * min(max(battery.share, 0.0), 1.0) - 1e-9)


def _diagonal(values: tuple[float, ...]) -> list[float]:
    """Upper triangle, row by row, of a 6x6 matrix with ``values`` on its diagonal."""
    return [values[row] if row == column else 0.0 for row in range(6) for column in range(row, 6)]
