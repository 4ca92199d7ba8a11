"""What PX4 streams unasked on its two links: message id to rate [Hz].

The rates are those of PX4's "onboard" and "normal" instances where they are not faster than this simulation needs.
"""

from __future__ import annotations

ATTITUDE_QUATERNION, LOCAL_POSITION_NED = 31, 32

_SLOW_HZ: dict[int, float] = {
    0: 1.0,  # HEARTBEAT
    245: 5.0,  # EXTENDED_SYS_STATE
    1: 1.0,  # SYS_STATUS
    242: 1.0,  # HOME_POSITION
    49: 0.2,  # GPS_GLOBAL_ORIGIN
    24: 1.0,  # GPS_RAW_INT
    147: 0.5,  # BATTERY_STATUS
}
_GROUND_HZ: dict[int, float] = {
    30: 10.0,  # ATTITUDE
    33: 5.0,  # GLOBAL_POSITION_INT
    74: 4.0,  # VFR_HUD
    141: 1.0,  # ALTITUDE
    331: 5.0,  # ODOMETRY
    2: 1.0,  # SYSTEM_TIME
}


def onboard_rates_hz(control_hz: float) -> dict[int, float]:
    """The state at the control rate."""
    return {**_SLOW_HZ, ATTITUDE_QUATERNION: control_hz, LOCAL_POSITION_NED: control_hz}


def ground_rates_hz() -> dict[int, float]:
    return {**_SLOW_HZ, **_GROUND_HZ, ATTITUDE_QUATERNION: 10.0, LOCAL_POSITION_NED: 10.0}
