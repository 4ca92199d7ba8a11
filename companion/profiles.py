"""Vehicle profiles: what differs between autopilots, in one table (design 3.1, 4, 5.7, 5.11).

Mode numbers: PX4 custom_mode = main << 16 | sub << 24 (px4_custom_mode.h); ArduPilot Copter's are plain.
"""

from __future__ import annotations

from dataclasses import dataclass

MASK_ACCELERATION = 0x0C3F  # yaw and yaw rate ignored
MASK_ACCELERATION_YAW_RATE = 0x043F  # acceleration and yaw rate


@dataclass(frozen=True, slots=True)
class ModeRequest:
    """MAV_CMD_DO_SET_MODE's parameters 2 and 3, and the custom_mode that the heartbeat then shows."""

    main: int
    sub: int
    custom_mode: int


@dataclass(frozen=True, slots=True)
class Profile:
    """One kind of autopilot."""

    name: str
    tick_hz: int
    type_mask: int
    external: ModeRequest  # the mode in which setpoints are obeyed
    hold: ModeRequest  # asked for on release and on FAULT
    actuation_lag_s: float  # lag of the acceleration loop, used as dead time by the predictor
    streams_when_ready: bool  # PX4 wants a stream before it grants offboard
    engage_by: str  # default of engage.by: "command" or "mode_switch"


def _px4(main: int, sub: int) -> ModeRequest:
    return ModeRequest(main, sub, main << 16 | sub << 24)


_PX4_OFFBOARD, _PX4_HOLD = _px4(6, 0), _px4(4, 3)
_ARDU_GUIDED, _ARDU_BRAKE = ModeRequest(4, 0, 4), ModeRequest(17, 0, 17)

PROFILES: dict[str, Profile] = {
    profile.name: profile
    for profile in (
        Profile(
            name="crazyflie-sim",
            tick_hz=20,
            type_mask=MASK_ACCELERATION,
            external=_PX4_OFFBOARD,
            hold=_PX4_HOLD,
            actuation_lag_s=0.08,
            streams_when_ready=True,
            engage_by="command",
        ),
        Profile(
            name="px4",
            tick_hz=50,
            type_mask=MASK_ACCELERATION,
            external=_PX4_OFFBOARD,
            hold=_PX4_HOLD,
            actuation_lag_s=0.15,
            streams_when_ready=True,
            engage_by="mode_switch",
        ),
        Profile(
            name="ardupilot",
            tick_hz=50,
            type_mask=MASK_ACCELERATION_YAW_RATE,
            external=_ARDU_GUIDED,
            hold=_ARDU_BRAKE,
            actuation_lag_s=0.21,
            streams_when_ready=False,
            engage_by="command",
        ),
    )
}
