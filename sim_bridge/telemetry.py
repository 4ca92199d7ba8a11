"""What the autopilot streams: which message, built from which values, how often on which link.

Intervals count vehicle time on the grid of their own multiples, so that 20 Hz falls on the control period. A link's
rates change by SET_MESSAGE_INTERVAL; they are as fast as the physics at most.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.mavlink import Encoder, q_ned_from_frd, swap_ned_enu
from sim_bridge.messages import HOME_ALTITUDE_AMSL_M
from sim_bridge.personality import Personality
from sim_bridge.physics import BodyState

HEARTBEAT, SYS_STATUS, GPS_RAW_INT, LOCAL_POSITION_NED, GLOBAL_POSITION_INT = 0, 1, 24, 32, 33
ATTITUDE_QUATERNION, GPS_GLOBAL_ORIGIN, POSITION_TARGET_LOCAL_NED = 31, 49, 85
BATTERY_STATUS, AUTOPILOT_VERSION, HOME_POSITION, EXTENDED_SYS_STATE = 147, 148, 242, 245

Message: TypeAlias = Any  # dialect.MAVLink_message; pymavlink is untyped

# gyro, accelerometer, magnetometer, pressure, GPS, attitude, yaw, altitude, position, motors, battery, PREARM_CHECK
_HEALTH = 0b1111 | 1 << 5 | 0b11111 << 11 | 1 << 25 | 1 << 28
_LAT0_DEG, _LON0_DEG = 47.397742, 8.545594  # PX4 SITL's home, Zurich
_M_PER_DEG = 6371000.0 * math.pi / 180.0
_MV_FULL = 4100
_UNKNOWN = 65535


@dataclass(frozen=True, slots=True)
class Moment:
    """What a message is built from."""

    t_ns: int
    state: BodyState
    autopilot: Personality
    system: int = 1

    @property
    def t_ms(self) -> int:
        return self.t_ns // 1_000_000


def heartbeat(now: Moment) -> Message:
    autopilot = now.autopilot
    return dialect.MAVLink_heartbeat_message(
        2, autopilot.kind, autopilot.base_mode, autopilot.custom_mode, autopilot.system_status, 3
    )


def attitude_quaternion(now: Moment) -> Message:
    w, x, y, z = q_ned_from_frd(now.state.q_wxyz)
    p, q, r = now.state.omega_flu
    return dialect.MAVLink_attitude_quaternion_message(now.t_ms, w, x, y, z, p, -q, -r)


def local_position_ned(now: Moment) -> Message:
    return dialect.MAVLink_local_position_ned_message(
        now.t_ms, *swap_ned_enu(now.state.p_enu), *swap_ned_enu(now.state.v_enu)
    )


def extended_sys_state(now: Moment) -> Message:
    return dialect.MAVLink_extended_sys_state_message(0, int(now.autopilot.landed))


def sys_status(now: Moment) -> Message:
    return dialect.MAVLink_sys_status_message(_HEALTH, _HEALTH, _HEALTH, 100, _MV_FULL, -1, 100, 0, 0, 0, 0, 0, 0)


def battery_status(now: Moment) -> Message:
    cells = [_MV_FULL] + [_UNKNOWN] * 9
    return dialect.MAVLink_battery_status_message(0, 0, 1, 32767, cells, -1, -1, -1, 100)


def home_position(now: Moment) -> Message:
    x, y, z = now.autopilot.home_enu
    lat, lon = geodetic(x, y)
    north, east, down = swap_ned_enu((x, y, z))
    altitude_mm = round((HOME_ALTITUDE_AMSL_M + z) * 1e3)
    level = [1.0, 0.0, 0.0, 0.0]
    return dialect.MAVLink_home_position_message(lat, lon, altitude_mm, north, east, down, level, 0.0, 0.0, 0.0)


def gps_global_origin(now: Moment) -> Message:
    return dialect.MAVLink_gps_global_origin_message(*geodetic(0.0, 0.0), round(HOME_ALTITUDE_AMSL_M * 1e3))


def global_position_int(now: Moment) -> Message:
    (x, y, z), (vx, vy, vz) = now.state.p_enu, now.state.v_enu
    amsl_mm, above_home_mm = round((HOME_ALTITUDE_AMSL_M + z) * 1e3), round((z - now.autopilot.home_enu[2]) * 1e3)
    north, east, down = (round(max(-327.0, min(327.0, v)) * 100) for v in (vy, vx, -vz))
    w, _, _, qz = q_ned_from_frd(now.state.q_wxyz)
    heading_cdeg = round(math.degrees(2.0 * math.atan2(qz, w)) % 360.0 * 100.0) % 36000
    return dialect.MAVLink_global_position_int_message(
        now.t_ms, *geodetic(x, y), amsl_mm, above_home_mm, north, east, down, heading_cdeg
    )


def gps_raw_int(now: Moment) -> Message:
    x, y, z = now.state.p_enu
    vx, vy, _ = now.state.v_enu
    altitude_mm = round((HOME_ALTITUDE_AMSL_M + z) * 1e3)
    speed_cm_s = round(math.hypot(vx, vy) * 100.0)
    return dialect.MAVLink_gps_raw_int_message(
        now.t_ns // 1000, 3, *geodetic(x, y), altitude_mm, 80, 80, speed_cm_s, _UNKNOWN, 12
    )


def position_target(now: Moment) -> Message:
    """What is flown, None where there is nothing to tell."""
    setpoint = now.autopilot.position_target()
    if setpoint is None:
        return None
    return dialect.MAVLink_position_target_local_ned_message(
        setpoint.time_boot_ms,
        setpoint.frame,
        setpoint.type_mask,
        *swap_ned_enu(setpoint.p_enu),
        *swap_ned_enu(setpoint.v_enu),
        *swap_ned_enu(setpoint.a_enu),
        0.5 * math.pi - setpoint.yaw_rad,
        -setpoint.yaw_rate_rad_s,
    )


def autopilot_version(now: Moment) -> Message:
    version = now.autopilot.version
    blank = [0] * 8
    return dialect.MAVLink_autopilot_version_message(
        now.autopilot.capabilities, version, version, 0, 0, blank, blank, blank, 0x26AC, 1, now.system
    )


def geodetic(x_m: float, y_m: float) -> tuple[int, int]:
    """Latitude and longitude [1e-7 deg] of a local point: flat earth about PX4 SITL's home."""
    lat = _LAT0_DEG + y_m / _M_PER_DEG
    lon = _LON0_DEG + x_m / (_M_PER_DEG * math.cos(math.radians(_LAT0_DEG)))
    return round(lat * 1e7), round(lon * 1e7)


BUILDERS: Mapping[int, Callable[[Moment], Message]] = {
    HEARTBEAT: heartbeat,
    EXTENDED_SYS_STATE: extended_sys_state,
    SYS_STATUS: sys_status,
    HOME_POSITION: home_position,
    GPS_GLOBAL_ORIGIN: gps_global_origin,
    GPS_RAW_INT: gps_raw_int,
    GLOBAL_POSITION_INT: global_position_int,
    BATTERY_STATUS: battery_status,
    POSITION_TARGET_LOCAL_NED: position_target,
    AUTOPILOT_VERSION: autopilot_version,
    ATTITUDE_QUATERNION: attitude_quaternion,
    LOCAL_POSITION_NED: local_position_ned,  # last: it is what a companion answers
}
_POSITIONS = frozenset({LOCAL_POSITION_NED, GLOBAL_POSITION_INT, HOME_POSITION, GPS_GLOBAL_ORIGIN})
ALIVE = (HEARTBEAT, EXTENDED_SYS_STATE, SYS_STATUS, HOME_POSITION)  # what a ground station needs to find us healthy


class Streams:
    """When each message of one link is due.

    Args:
        rates_hz: the defaults.
        max_hz: the highest rate that can be asked for.
        pinned: messages whose rate lockstep fixes; asking for another is accepted and changes nothing.
    """

    def __init__(self, rates_hz: Mapping[int, float], *, max_hz: float, pinned: frozenset[int] = frozenset()) -> None:
        self._defaults_us = {message_id: round(1e6 / hz) for message_id, hz in rates_hz.items()}
        self._interval_us = {i: self._defaults_us.get(i, -1) for i in BUILDERS}
        self._due_ns = dict.fromkeys(BUILDERS, 0)
        self._next_ns = 0
        self._min_us = 1e6 / max_hz
        self._pinned = pinned

    def interval_us(self, message_id: int) -> int:
        """MESSAGE_INTERVAL's value: microseconds, -1 off, 0 for a message that does not exist here."""
        return self._interval_us.get(message_id, 0)

    def request(self, message_id: int, interval_us: float, t_ns: int) -> bool:
        """SET_MESSAGE_INTERVAL at ``t_ns``: microseconds, -1 off, 0 the default rate; False where it cannot be had."""
        if message_id not in BUILDERS or not math.isfinite(interval_us):
            return False
        if interval_us > 0 and interval_us < self._min_us * 0.999:
            return False
        if message_id in self._pinned:
            return True
        default_us = self._defaults_us.get(message_id, -1)
        self._interval_us[message_id] = default_us if interval_us == 0 else max(-1, round(interval_us))
        self._schedule(message_id, t_ns)
        self._next_ns = min(self._next_ns, self._due_ns[message_id])
        return True

    def due(self, t_ns: int) -> list[int]:
        """Messages due by ``t_ns``, in BUILDERS' order; each is then scheduled anew."""
        if t_ns < self._next_ns:
            return []
        ready = []
        for message_id, interval_us in self._interval_us.items():
            if interval_us < 0 or t_ns < self._due_ns[message_id]:
                continue
            ready.append(message_id)
            self._schedule(message_id, t_ns)
        self._next_ns = min(due for i, due in self._due_ns.items() if self._interval_us[i] >= 0)
        return ready

    def _schedule(self, message_id: int, t_ns: int) -> None:
        """Due at the next multiple of its interval."""
        interval_ns = max(1, self._interval_us[message_id]) * 1000
        self._due_ns[message_id] = (t_ns // interval_ns + 1) * interval_ns


def build(message_id: int, now: Moment, encoder: Encoder) -> bytes:
    """Bytes of one message now, none where it has nothing to tell."""
    if message_id in _POSITIONS and not now.autopilot.position_valid:
        return b""
    message = BUILDERS[message_id](now)
    return b"" if message is None else encoder.pack(message)
