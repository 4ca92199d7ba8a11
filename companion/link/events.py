"""What the MAVLink wire says, as values: local ENU, SI, integer nanoseconds of the vehicle's clock.

`companion.link.mavlink.MavlinkCodec.receive` makes them. ``system`` and ``component`` are the sender's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from companion.link.params import ParamRequest
from companion.link.traffic_events import TrafficEvent
from companion.types import FloatArray, Vec3


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """HEARTBEAT. An autopilot is a sender whose ``autopilot`` is not 8 (INVALID)."""

    system: int
    component: int
    autopilot: int  # MAV_AUTOPILOT: 3 ArduPilot, 12 PX4
    vehicle_type: int  # MAV_TYPE
    custom_mode: int
    armed: bool
    system_status: int  # MAV_STATE


@dataclass(frozen=True, slots=True)
class Position:
    """LOCAL_POSITION_NED or ODOMETRY."""

    system: int
    component: int
    stamp_ns: int
    p_enu: Vec3  # [m]
    v_enu: Vec3  # [m/s]
    p_std_m: float = 0.0  # largest 1-sigma axis, 0 where unknown
    reset_counter: int | None = None  # ODOMETRY only: changes when the estimator's origin jumps


@dataclass(frozen=True, slots=True)
class Attitude:
    """ATTITUDE_QUATERNION or ODOMETRY."""

    system: int
    component: int
    stamp_ns: int
    q_enu_from_flu: FloatArray  # (w, x, y, z), unit


@dataclass(frozen=True, slots=True)
class LandedState:
    """EXTENDED_SYS_STATE. During takeoff setpoints would cancel it, so ``airborne`` waits for IN_AIR."""

    system: int
    component: int
    airborne: bool | None  # None: the autopilot does not know
    in_takeoff: bool
    in_landing: bool


@dataclass(frozen=True, slots=True)
class CommandAck:
    """COMMAND_ACK: ``result`` is a MAV_RESULT."""

    command: int
    result: int
    from_system: int
    from_component: int
    target_system: int  # 0: nobody in particular
    target_component: int


@dataclass(frozen=True, slots=True)
class Command:
    """COMMAND_LONG or COMMAND_INT addressed to this component.

    ``params`` are the seven of COMMAND_LONG; of a COMMAND_INT the first four, then x, y (as sent) and z.
    """

    command: int
    params: tuple[float, float, float, float, float, float, float]
    is_int: bool
    frame: int  # MAV_FRAME of a COMMAND_INT, 0 otherwise
    x: int  # COMMAND_INT only: 1e-4 m in local frames, 1e-7 degrees in global ones
    y: int
    z: float
    from_system: int
    from_component: int
    target_system: int
    target_component: int


@dataclass(frozen=True, slots=True)
class TimesyncRequest:
    """TIMESYNC with tc1 = 0: someone asks for our time."""

    system: int
    component: int
    ts1_ns: int


@dataclass(frozen=True, slots=True)
class TimesyncReply:
    """TIMESYNC answered: the sender's clock stood at ``tc1_ns``; ``ts1_ns`` mirrors the request."""

    system: int
    component: int
    tc1_ns: int
    ts1_ns: int


@dataclass(frozen=True, slots=True)
class SystemTime:
    """SYSTEM_TIME: ``unix_ns`` is 0 where the autopilot does not know."""

    system: int
    component: int
    unix_ns: int
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class SetpointEcho:
    """POSITION_TARGET_LOCAL_NED: what the autopilot says it follows.

    ``type_mask`` also ignores the fields that are not finite: not every autopilot marks them.
    """

    system: int
    component: int
    stamp_ns: int
    type_mask: int
    frame: int
    a_enu: Vec3  # [m/s^2]
    v_enu: Vec3  # [m/s]


@dataclass(frozen=True, slots=True)
class SetpointHeard:
    """A setpoint that another component sends to an autopilot: SET_POSITION_TARGET_* or SET_ATTITUDE_TARGET."""

    system: int
    component: int
    message: int  # its id
    target_system: int  # 0: any
    target_component: int


@dataclass(frozen=True, slots=True)
class StatusText:
    """STATUSTEXT, chunks joined. ``severity`` is a MAV_SEVERITY: 0 emergency .. 7 debug."""

    system: int
    component: int
    severity: int
    text: str


Event: TypeAlias = (
    Heartbeat
    | Position
    | Attitude
    | LandedState
    | CommandAck
    | Command
    | TimesyncRequest
    | TimesyncReply
    | SystemTime
    | SetpointEcho
    | SetpointHeard
    | StatusText
    | ParamRequest
    | TrafficEvent
)
