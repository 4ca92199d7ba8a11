"""What the autopilot streams: which message, how often on which link.

Intervals count vehicle time on the grid of their own multiples, so that 20 Hz falls on the control period. A link's
rates change by SET_MESSAGE_INTERVAL; they are as fast as the physics at most.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from sim_bridge import reports
from sim_bridge.mavlink import Encoder
from sim_bridge.reports import Message, Moment

HEARTBEAT, SYS_STATUS, SYSTEM_TIME, GPS_RAW_INT, LOCAL_POSITION_NED, GLOBAL_POSITION_INT = 0, 1, 2, 24, 32, 33
ATTITUDE, ATTITUDE_QUATERNION, GPS_GLOBAL_ORIGIN, VFR_HUD = 30, 31, 49, 74
ATTITUDE_TARGET, POSITION_TARGET_LOCAL_NED, ALTITUDE, ODOMETRY = 83, 85, 141, 331
BATTERY_STATUS, AUTOPILOT_VERSION, HOME_POSITION, EXTENDED_SYS_STATE = 147, 148, 242, 245

BUILDERS: Mapping[int, Callable[[Moment], Message]] = {
    HEARTBEAT: reports.heartbeat,
    EXTENDED_SYS_STATE: reports.extended_sys_state,
    SYS_STATUS: reports.sys_status,
    SYSTEM_TIME: reports.system_time,
    HOME_POSITION: reports.home_position,
    GPS_GLOBAL_ORIGIN: reports.gps_global_origin,
    GPS_RAW_INT: reports.gps_raw_int,
    GLOBAL_POSITION_INT: reports.global_position_int,
    ALTITUDE: reports.altitude,
    VFR_HUD: reports.vfr_hud,
    BATTERY_STATUS: reports.battery_status,
    POSITION_TARGET_LOCAL_NED: reports.position_target,
    ATTITUDE_TARGET: reports.attitude_target,
    AUTOPILOT_VERSION: reports.autopilot_version,
    ATTITUDE: reports.attitude,
    ODOMETRY: reports.odometry,
    ATTITUDE_QUATERNION: reports.attitude_quaternion,
    LOCAL_POSITION_NED: reports.local_position_ned,  # last: it is what a companion answers
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
        self.least_us = 1e6 / max_hz
        self._pinned = pinned

    def interval_us(self, message_id: int) -> int:
        """MESSAGE_INTERVAL's value: microseconds, -1 off, 0 for a message that does not exist here."""
        return self._interval_us.get(message_id, 0)

    def too_fast(self, interval_us: float) -> bool:
        return 0.0 < interval_us < self.least_us * 0.999

    def request(self, message_id: int, interval_us: float, t_ns: int) -> bool:
        """SET_MESSAGE_INTERVAL at ``t_ns``: microseconds, -1 off, 0 the default rate; False where it cannot be had."""
        if message_id not in BUILDERS or not math.isfinite(interval_us):
            return False
        if self.too_fast(interval_us):
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
