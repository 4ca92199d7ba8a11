"""Vehicle profiles: what differs between autopilots, in one table (design 3.1, 4, 5.7, 5.11).

Mode numbers: PX4 custom_mode = main << 16 | sub << 24 (px4_custom_mode.h); ArduPilot Copter's are plain.

On the ground and during takeoff: PX4 is streamed "hold where I am" from READY on, because it grants offboard to a
running stream only; ArduPilot is sent nothing until EXTENDED_SYS_STATE says IN_AIR, because a setpoint during takeoff
cancels it and leaves the climb. Both are engaged only in the air.

Predictor: a setpoint acts ``actuation_lag_s`` after the state it answers, as dead time. ArduPilot shapes acceleration
setpoints with PSC_JERK_XY (5 m/s^3 of the level vector's length, so 3.5 of each axis): what changes faster is followed
late, so the profile's ``slew_m_s3`` keeps setpoints within it where ``limits.slew_m_s3`` is not set; the rest of its
answer (0.06 s level, 0.13 to 0.20 s vertical, first velocity 0.21 s after a step) is the dead time.

Confirmation: POSITION_TARGET_LOCAL_NED repeats what the autopilot follows, under a mask of its own making. ArduPilot
writes the mask of its guided submode, yaw always ignored; PX4 marks the numbers that are not finite after its position
controller, which may have filled the velocities and adds what its velocity loop asks to the accelerations.
``echo_bits`` are the bits that can be compared with what was sent.
"""

from __future__ import annotations

from dataclasses import dataclass

MASK_ACCELERATION = 0x0C3F  # yaw and yaw rate ignored
MASK_ACCELERATION_YAW_RATE = 0x043F  # acceleration and yaw rate; 0 rad/s keeps ArduPilot's nose where it is
IGNORE_VELOCITY = 0x0038  # POSITION_TARGET_TYPEMASK bits 4 to 6

AUTOPILOT_ARDUPILOT, AUTOPILOT_PX4 = 3, 12  # MAV_AUTOPILOT

ECHO_AXES = 0x01FF  # position, velocity, acceleration
ECHO_NO_VELOCITY = 0x01C7  # position, acceleration


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
    autopilot: int  # MAV_AUTOPILOT in its heartbeat
    tick_hz: int
    type_mask: int  # of an acceleration setpoint
    external: ModeRequest  # the mode in which setpoints are obeyed
    hold: ModeRequest  # asked for on release and on FAULT
    actuation_lag_s: float  # from a setpoint to its effect, used as dead time by the predictor
    response_lag_s: float  # first-order lag of the acceleration loop, used by the disturbance observer
    slew_m_s3: float | None  # default of limits.slew_m_s3: how fast the autopilot follows a changing setpoint
    streams_when_ready: bool  # PX4 wants a stream before it grants offboard
    engage_by: str  # default of engage.by: "command" or "mode_switch"
    echo_bits: int  # bits of POSITION_TARGET_LOCAL_NED's mask that repeat those sent
    echo_exact: bool  # whether its acceleration is the one sent, also beside a velocity

    def mask(self, setpoint: str) -> int:
        """POSITION_TARGET_TYPEMASK of ``vehicle.setpoint`` "acceleration" or "velocity+acceleration"."""
        return self.type_mask & ~IGNORE_VELOCITY if setpoint == "velocity+acceleration" else self.type_mask


def _px4(main: int, sub: int) -> ModeRequest:
    return ModeRequest(main, sub, main << 16 | sub << 24)


_PX4_OFFBOARD, _PX4_HOLD = _px4(6, 0), _px4(4, 3)
_ARDU_GUIDED, _ARDU_BRAKE = ModeRequest(4, 0, 4), ModeRequest(17, 0, 17)

PROFILES: dict[str, Profile] = {
    profile.name: profile
    for profile in (
        Profile(
            name="crazyflie-sim",
            autopilot=AUTOPILOT_PX4,
            tick_hz=20,
            type_mask=MASK_ACCELERATION,
            external=_PX4_OFFBOARD,
            hold=_PX4_HOLD,
            actuation_lag_s=0.08,
            response_lag_s=0.08,
            slew_m_s3=None,
            streams_when_ready=True,
            engage_by="command",
            echo_bits=ECHO_AXES,
            echo_exact=True,
        ),
        Profile(
            name="px4",
            autopilot=AUTOPILOT_PX4,
            tick_hz=50,
            type_mask=MASK_ACCELERATION,
            external=_PX4_OFFBOARD,
            hold=_PX4_HOLD,
            actuation_lag_s=0.15,
            response_lag_s=0.15,
            slew_m_s3=None,
            streams_when_ready=True,
            engage_by="mode_switch",
            echo_bits=ECHO_NO_VELOCITY,
            echo_exact=False,
        ),
        Profile(
            name="ardupilot",
            autopilot=AUTOPILOT_ARDUPILOT,
            tick_hz=50,
            type_mask=MASK_ACCELERATION_YAW_RATE,
            external=_ARDU_GUIDED,
            hold=_ARDU_BRAKE,
            actuation_lag_s=0.21,
            response_lag_s=0.13,
            slew_m_s3=3.5,
            streams_when_ready=False,
            engage_by="command",
            echo_bits=ECHO_AXES,
            echo_exact=True,
        ),
    )
}

BY_AUTOPILOT = {
    AUTOPILOT_PX4: PROFILES["px4"],
    AUTOPILOT_ARDUPILOT: PROFILES["ardupilot"],
}  # `vehicle.profile = "auto"`

# What stands in for `auto` until the autopilot is known: nothing is sent under it, no heartbeat shows its modes.
UNDECIDED = Profile(
    name="auto",
    autopilot=-1,
    tick_hz=50,
    type_mask=MASK_ACCELERATION,
    external=ModeRequest(0, 0, -1),
    hold=ModeRequest(0, 0, -1),
    actuation_lag_s=max(profile.actuation_lag_s for profile in PROFILES.values()),
    response_lag_s=max(profile.response_lag_s for profile in PROFILES.values()),
    slew_m_s3=None,
    streams_when_ready=False,
    engage_by="command",
    echo_bits=0,
    echo_exact=False,
)
