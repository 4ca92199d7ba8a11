"""What ArduCopter streams and reports of itself: little unasked, groups on REQUEST_DATA_STREAM, SYS_STATUS."""

from __future__ import annotations

from collections.abc import Mapping

from sim_bridge.messages import NS_PER_S, Severity, Text

PREARM_NS = 30 * NS_PER_S  # between the reasons that it tells by itself

_HEARTBEAT, _ATTITUDE_QUATERNION, _LOCAL_POSITION_NED = 0, 31, 32
LOOP_RATE_HZ = 320.0  # the fastest stream: 0.8 of its main loop
STREAMS: Mapping[int, tuple[int, ...]] = {  # MAV_DATA_STREAM
    0: (1, 24, 30, 31, 32, 33, 74, 147),
    2: (1, 24),
    6: (32, 33),
    10: (30,),
    11: (74,),
    12: (147,),
}

# gyro, accelerometer, magnetometer, pressure, GPS, attitude, yaw, altitude, position, motors, AHRS, battery, PREARM
_SENSORS = 0b1111 | 1 << 5 | 0b11111 << 11 | 1 << 21 | 1 << 25 | 1 << 28
_NEEDS_ESTIMATE, _PREARM = 1 << 5 | 1 << 14 | 1 << 21, 1 << 28


def rates_hz(state_hz: float | None) -> dict[int, float]:
    """Unasked: heartbeats; in lockstep also the state that the companion answers, at ``state_hz``."""
    if state_hz is None:
        return {_HEARTBEAT: 1.0}
    return {_HEARTBEAT: 1.0, _ATTITUDE_QUATERNION: state_hz, _LOCAL_POSITION_NED: state_hz}


def health(*, position_valid: bool, can_arm: bool) -> tuple[int, int, int]:
    """SYS_STATUS's sensors: present, enabled, healthy; the last knows of the estimate and of the arming checks."""
    unhealthy = (0 if position_valid else _NEEDS_ESTIMATE) | (0 if can_arm else _PREARM)
    return (_SENSORS, _SENSORS, _SENSORS & ~unhealthy)


class News:
    """What ArduCopter says by itself: that the EKF has a position, and twice a minute why it could not be armed."""

    def __init__(self, *, told: bool) -> None:
        self._told = told
        self._prearm_ns = 0

    def step(self, reasons: list[str], t_ns: int, *, position_valid: bool, armed: bool) -> list[Text]:
        if position_valid and not self._told:
            self._told = True
            return [Text(Severity.INFO, "EKF3 IMU0 is using GPS")]
        if armed or t_ns - self._prearm_ns < PREARM_NS:
            return []
        self._prearm_ns = t_ns
        return [Text(Severity.CRITICAL, reason) for reason in reasons if reason.startswith("PreArm")]
