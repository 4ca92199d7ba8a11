"""What the autopilot is told and what it answers: ENU, SI, integer nanoseconds since boot; no MAVLink bytes.

Numbers are those of MAVLink's common dialect (MAV_CMD, MAV_RESULT, MAV_SEVERITY, MAV_LANDED_STATE).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import TypeAlias

Vec3: TypeAlias = tuple[float, float, float]

NS_PER_S = 1_000_000_000
HOME_ALTITUDE_AMSL_M = 488.0  # PX4 SITL's home, Zurich: the local origin


class LinkName(Enum):
    """The autopilot's two links."""

    ONBOARD = "onboard"
    GROUND = "ground station"


class Mode(IntEnum):
    """PX4's custom_mode: main << 16 | sub << 24 (px4_custom_mode.h)."""

    MANUAL = 1 << 16  # what PX4 reports of a terminated flight, too
    ALTITUDE = 2 << 16
    POSITION = 3 << 16
    TAKEOFF = 4 << 16 | 2 << 24
    HOLD = 4 << 16 | 3 << 24
    RETURN = 4 << 16 | 5 << 24
    LAND = 4 << 16 | 6 << 24
    OFFBOARD = 6 << 16
    STABILIZED = 7 << 16


class Landed(IntEnum):
    """MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class Severity(IntEnum):
    """MAV_SEVERITY."""

    EMERGENCY = 0
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    INFO = 6


class Cmd(IntEnum):
    """The MAV_CMDs that something here answers."""

    NAV_RETURN_TO_LAUNCH = 20
    NAV_LAND = 21
    NAV_TAKEOFF = 22
    NAV_GUIDED_ENABLE = 92
    DO_SET_MODE = 176
    DO_CHANGE_SPEED = 178
    DO_SET_HOME = 179
    DO_FLIGHTTERMINATION = 185
    DO_REPOSITION = 192
    PREFLIGHT_STORAGE = 245
    PREFLIGHT_REBOOT_SHUTDOWN = 246
    COMPONENT_ARM_DISARM = 400
    RUN_PREARM_CHECKS = 401
    GET_MESSAGE_INTERVAL = 510
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512
    REQUEST_PROTOCOL_VERSION = 519
    REQUEST_AUTOPILOT_CAPABILITIES = 520


FORCE = 21196.0  # param2 of COMPONENT_ARM_DISARM: without asking


@dataclass(frozen=True, slots=True)
class Sender:
    system: int
    component: int


@dataclass(frozen=True, slots=True)
class Command:
    """COMMAND_LONG, COMMAND_INT or SET_MODE, addressed to (``target_system``, ``target_component``).

    ``params`` are those of the message; a COMMAND_INT with a global frame has its latitude and longitude in degrees.
    """

    command: int
    params: tuple[float, float, float, float, float, float, float]
    sender: Sender
    target_system: int = 1
    target_component: int = 1
    frame: int = 0  # MAV_FRAME of a COMMAND_INT; a COMMAND_LONG means 0, global with altitudes above sea level
    custom_mode: int | None = field(default=None, compare=False)  # SET_MODE's, of which params hold PX4's parts


@dataclass(frozen=True, slots=True)
class LocalSetpoint:
    """SET_POSITION_TARGET_LOCAL_NED or _GLOBAL_INT turned into ENU. Fields that the mask ignores may hold anything.

    In a body frame the vectors are FLU; in a global one the position is local ENU horizontally and its third
    component the altitude that the frame means.
    """

    time_boot_ms: int
    frame: int  # MAV_FRAME
    type_mask: int  # POSITION_TARGET_TYPEMASK
    p_enu: Vec3  # [m]
    v_enu: Vec3  # [m/s]
    a_enu: Vec3  # [m/s^2], gravity excluded
    yaw_rad: float  # counter-clockwise from east
    yaw_rate_rad_s: float
    sender: Sender = Sender(0, 0)
    is_global: bool = False  # SET_POSITION_TARGET_GLOBAL_INT


@dataclass(frozen=True, slots=True)
class AttitudeTarget:
    """SET_ATTITUDE_TARGET turned into ENU and FLU. Fields that the mask ignores may hold anything."""

    time_boot_ms: int
    type_mask: int  # ATTITUDE_TARGET_TYPEMASK
    q_wxyz: tuple[float, float, float, float]  # enu_from_flu
    omega_flu: Vec3  # [rad/s]
    thrust: float  # collective, share of full thrust
    sender: Sender = Sender(0, 0)


@dataclass(frozen=True, slots=True)
class Sticks:
    """MANUAL_CONTROL or RC_CHANNELS_OVERRIDE: a pilot's sticks, each -1 to 1, centred at 0."""

    forward: float
    left: float
    up: float  # throttle stick
    turn_left: float  # yaw stick, counter-clockwise
    sender: Sender = Sender(0, 0)
    radio: bool = False  # RC_CHANNELS_OVERRIDE
    released: bool = False  # the sender gives its channels back


@dataclass(frozen=True, slots=True)
class StationHeartbeat:
    """A HEARTBEAT of a ground station (MAV_TYPE_GCS)."""

    sender: Sender


@dataclass(frozen=True, slots=True)
class Timesync:
    """A request (tc1 = 0) of a peer that wants our clock."""

    tc1: int
    ts1: int
    sender: Sender


@dataclass(frozen=True, slots=True)
class Ping:
    """A request (addressed to nobody) that is answered with its own sequence number and time."""

    time_usec: int
    seq: int
    sender: Sender


@dataclass(frozen=True, slots=True)
class MissionRequest:
    """MISSION_REQUEST_LIST, MISSION_CLEAR_ALL or MISSION_COUNT: there is no mission here, and none is taken."""

    message_id: int
    mission_type: int
    items: int  # announced by MISSION_COUNT
    sender: Sender


@dataclass(frozen=True, slots=True)
class ParamRead:
    """PARAM_REQUEST_READ by name, or by index where ``name`` is empty; ``index`` -1 with an empty name lists all."""

    name: str
    index: int


@dataclass(frozen=True, slots=True)
class ParamWrite:
    name: str
    value: float | int
    is_int: bool
    cast: float = field(default=math.nan, compare=False)  # as a plain float: the value under C_CAST


@dataclass(frozen=True, slots=True)
class StreamRequest:
    """REQUEST_DATA_STREAM: all messages of a MAV_DATA_STREAM at ``rate_hz``, 0 off."""

    stream: int
    rate_hz: int


Incoming: TypeAlias = (
    StreamRequest
    | Command
    | LocalSetpoint
    | AttitudeTarget
    | Sticks
    | StationHeartbeat
    | Timesync
    | Ping
    | MissionRequest
    | ParamRead
    | ParamWrite
)


@dataclass(frozen=True, slots=True)
class Ack:
    """COMMAND_ACK to ``receiver``."""

    command: int
    result: Result
    receiver: Sender


@dataclass(frozen=True, slots=True)
class Text:
    """STATUSTEXT to everybody."""

    severity: Severity
    text: str


Reply: TypeAlias = Ack | Text
