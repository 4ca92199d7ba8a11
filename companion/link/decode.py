"""pymavlink messages to events: NED to ENU, milliseconds to nanoseconds, every number checked.

Each decoder takes one message and returns the events in it; a message that cannot be believed is `Rejected` under
the name by which it is counted. Sources: MAVLink common.xml; ODOMETRY's velocity is in its child frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from companion.frames import rotate
from companion.link import mav
from companion.link.events import (
    Attitude,
    Command,
    CommandAck,
    Event,
    Heartbeat,
    LandedState,
    Position,
    SetpointEcho,
    SetpointHeard,
    StatusText,
    SystemTime,
    TimesyncReply,
    TimesyncRequest,
)
from companion.types import FloatArray, Vec3, frozen

MAX_POSITION_M = 1e5
MAX_SPEED_M_S = 1e3
_MS, _US = 1_000_000, 1_000  # in ns
_UNIX_US = 10**15  # boot times stay below (31 years), unix times lie above (since 2001)
_POSITION_VARIANCES = (0, 6, 11)  # x, y, z on the diagonal of the upper triangle of 6x6
_MAX_PARTIAL_TEXTS = 16


class Rejected(Exception):
    """A message dropped whole; its text is the name under which it is counted."""


def heartbeat(m: Any) -> list[Event]:
    system, component = _sender(m)
    armed = bool(m.base_mode & mav.MODE_FLAG_SAFETY_ARMED)
    return [Heartbeat(system, component, m.autopilot, m.type, m.custom_mode, armed, m.system_status)]


def local_position_ned(m: Any) -> list[Event]:
    p_enu = _enu((m.x, m.y, m.z), MAX_POSITION_M)
    v_enu = _enu((m.vx, m.vy, m.vz), MAX_SPEED_M_S)
    return [Position(*_sender(m), m.time_boot_ms * _MS, p_enu, v_enu)]


def attitude_quaternion(m: Any) -> list[Event]:
    return [Attitude(*_sender(m), m.time_boot_ms * _MS, _attitude((m.q1, m.q2, m.q3, m.q4)))]


def odometry(m: Any) -> list[Event]:
    """Position in MAV_FRAME_LOCAL_NED; velocity in BODY_FRD is rotated by the attitude, v_ned = R(q) v_frd."""
    if m.time_usec >= _UNIX_US:
        raise Rejected("unix_stamp")
    if m.frame_id != mav.FRAME_LOCAL_NED:
        raise Rejected("unknown_frame")
    q_enu_from_flu = _attitude(m.q)
    velocity = (m.vx, m.vy, m.vz)
    if m.child_frame_id in (mav.FRAME_BODY_FRD, mav.FRAME_BODY_NED):
        _check(velocity, MAX_SPEED_M_S)
        v_enu = frozen(rotate(q_enu_from_flu, (m.vx, -m.vy, -m.vz)))
    elif m.child_frame_id == mav.FRAME_LOCAL_NED:
        v_enu = _enu(velocity, MAX_SPEED_M_S)
    else:
        raise Rejected("unknown_frame")
    stamp_ns = m.time_usec * _US
    p_enu = _enu((m.x, m.y, m.z), MAX_POSITION_M)
    variances = [m.pose_covariance[i] for i in _POSITION_VARIANCES]
    known = all(math.isfinite(variance) and variance >= 0.0 for variance in variances)  # NaN marks unknown
    p_std_m = math.sqrt(max(variances)) if known else 0.0
    sender = _sender(m)
    return [
        Attitude(*sender, stamp_ns, q_enu_from_flu),
        Position(*sender, stamp_ns, p_enu, v_enu, p_std_m, m.reset_counter),
    ]


def extended_sys_state(m: Any) -> list[Event]:
    state = m.landed_state
    known = mav.LANDED_ON_GROUND <= state <= mav.LANDED_LANDING
    airborne = state in (mav.LANDED_IN_AIR, mav.LANDED_LANDING) if known else None
    return [LandedState(*_sender(m), airborne, state == mav.LANDED_TAKEOFF, state == mav.LANDED_LANDING)]


def command_ack(m: Any) -> list[Event]:
    return [CommandAck(m.command, m.result, *_sender(m), m.target_system, m.target_component)]


def timesync(m: Any) -> list[Event]:
    if m.tc1 == 0:
        return [TimesyncRequest(*_sender(m), m.ts1)]
    return [TimesyncReply(*_sender(m), m.tc1, m.ts1)]


def system_time(m: Any) -> list[Event]:
    return [SystemTime(*_sender(m), m.time_unix_usec * _US, m.time_boot_ms * _MS)]


def position_target_local_ned(m: Any) -> list[Event]:
    """Only what the mask uses is kept: autopilots fill the rest with NaN, and older PX4 without saying so."""
    values = (m.x, m.y, m.z, m.vx, m.vy, m.vz, m.afx, m.afy, m.afz)
    mask = m.type_mask | sum(1 << bit for bit, value in enumerate(values) if not math.isfinite(value))
    a_enu = v_enu = frozen([0.0, 0.0, 0.0])
    if not mask & mav.IGNORE_ACCELERATION:
        a_enu = _enu((m.afx, m.afy, m.afz), MAX_SPEED_M_S)
    if not mask & mav.IGNORE_VELOCITY:
        v_enu = _enu((m.vx, m.vy, m.vz), MAX_SPEED_M_S)
    return [SetpointEcho(*_sender(m), m.time_boot_ms * _MS, mask, m.coordinate_frame, a_enu, v_enu)]


def setpoint_heard(m: Any) -> list[Event]:
    return [SetpointHeard(*_sender(m), m.get_msgId(), m.target_system, m.target_component)]


def command(m: Any) -> Command:
    """COMMAND_LONG or COMMAND_INT, as sent."""
    to = (m.target_system, m.target_component)
    if m.get_msgId() == mav.MSG_COMMAND_LONG:
        params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
        return Command(m.command, params, False, 0, 0, 0, 0.0, *_sender(m), *to)
    params = (m.param1, m.param2, m.param3, m.param4, float(m.x), float(m.y), m.z)
    return Command(m.command, params, True, m.frame, m.x, m.y, m.z, *_sender(m), *to)


class TextAssembler:
    """Joins the chunks of STATUSTEXT; a lost chunk loses its text. Holds at most 16 unfinished ones."""

    def __init__(self) -> None:
        self._partial: dict[tuple[int, int, int], list[bytes]] = {}

    def push(self, m: Any) -> list[Event]:
        chunk: bytes = m._text_raw.split(b"\x00", 1)[0]
        if m.id == 0:
            return [self._text(m, chunk)]
        key = (*_sender(m), m.id)
        chunks = self._partial.pop(key, [])
        if m.chunk_seq == 0:
            chunks = []
        if m.chunk_seq != len(chunks):
            return []
        chunks.append(chunk)
        if len(chunk) < 50:
            return [self._text(m, b"".join(chunks))]
        self._partial[key] = chunks
        if len(self._partial) > _MAX_PARTIAL_TEXTS:
            del self._partial[next(iter(self._partial))]
        return []

    @staticmethod
    def _text(m: Any, data: bytes) -> StatusText:
        return StatusText(*_sender(m), m.severity, data.decode("utf-8", "replace"))


DECODERS: dict[int, Callable[[Any], list[Event]]] = {
    mav.MSG_HEARTBEAT: heartbeat,
    mav.MSG_LOCAL_POSITION_NED: local_position_ned,
    mav.MSG_ATTITUDE_QUATERNION: attitude_quaternion,
    mav.MSG_ODOMETRY: odometry,
    mav.MSG_EXTENDED_SYS_STATE: extended_sys_state,
    mav.MSG_COMMAND_ACK: command_ack,
    mav.MSG_TIMESYNC: timesync,
    mav.MSG_SYSTEM_TIME: system_time,
    mav.MSG_POSITION_TARGET_LOCAL_NED: position_target_local_ned,
    mav.MSG_SET_ATTITUDE_TARGET: setpoint_heard,
    mav.MSG_SET_POSITION_TARGET_LOCAL_NED: setpoint_heard,
    mav.MSG_SET_POSITION_TARGET_GLOBAL_INT: setpoint_heard,
}


def _sender(m: Any) -> tuple[int, int]:
    header = m._header  # get_srcSystem() and get_srcComponent() in one
    return header.srcSystem, header.srcComponent


def _check(values: Sequence[float], bound: float) -> None:
    for value in values:
        if not abs(value) <= bound:  # NaN fails this too
            raise Rejected("out_of_range" if math.isfinite(value) else "not_finite")


def _enu(ned: tuple[float, float, float], bound: float) -> Vec3:
    _check(ned, bound)
    north, east, down = ned
    return frozen([east + 0.0, north + 0.0, 0.0 - down])


def _attitude(q_ned_from_frd: Sequence[float]) -> FloatArray:
    """q_enu_from_flu, unit, w >= 0, from MAVLink's attitude; `frames.q_enu_from_flu` written out for speed.

    With s = sqrt(1/2): w' = s (w + z), x' = s (x + y), y' = s (x - y), z' = s (w - z).
    """
    _check(q_ned_from_frd, 1.1)
    w, x, y, z = q_ned_from_frd
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.9 < norm < 1.1:
        raise Rejected("out_of_range")
    s = math.sqrt(0.5) / norm
    q = (s * (w + z), s * (x + y), s * (x - y), s * (w - z))
    if q[0] < 0.0 or (q[0] == 0.0 and q[3] < 0.0):
        q = (-q[0], -q[1], -q[2], -q[3])
    return frozen([q[0] + 0.0, q[1] + 0.0, q[2] + 0.0, q[3] + 0.0])
