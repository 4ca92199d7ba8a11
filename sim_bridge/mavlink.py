"""MAVLink 2 to the autopilot's values and back; the only place of the simulator where NED and FRD exist.

pymavlink's generated dialect is the codec, no socket and no ``mavutil``. A vector: (x, y, z) ENU <-> (y, x, -z) NED;
a heading: pi/2 - yaw. The autopilot is component 1 of its system.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.geodesy import enu_of
from sim_bridge.messages import (
    Ack,
    AttitudeTarget,
    Cmd,
    Command,
    Incoming,
    LocalSetpoint,
    MissionRequest,
    ParamRead,
    ParamWrite,
    Ping,
    Sender,
    StationHeartbeat,
    Sticks,
    StreamRequest,
    Text,
    Timesync,
    Vec3,
)

COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_V1, _V2, _SIGNED = 0xFE, 0xFD, 0x01
_INT_TYPES = range(1, 9)  # MAV_PARAM_TYPE UINT8 .. INT64
_PARAM_UINT32, _PARAM_INT32, _PARAM_REAL32 = 5, 6, 9
_GLOBAL_FRAMES = (0, 3, 5, 6, 10, 11)
_BODY_FRAMES = (8, 9, 12)
_NOT_GIVEN = (0x7FFFFFFF, 0x7FF80000)  # NaN of an integer field: the specification's, and PX4's
_TEXT = 50  # characters of a STATUSTEXT
_PROTOCOL_VERSION, _PROTOCOL_VERSION_EXTRA = 300, 217  # message id, CRC_EXTRA
_SQRT_HALF = math.sqrt(0.5)


@dataclass(frozen=True, slots=True)
class Packet:
    """One intact message as it came: its bytes for forwarding, its meaning where the autopilot knows it."""

    raw: bytes
    message_id: int
    sender: Sender
    target: Sender  # 0 where the message has no such field: everybody
    content: Incoming | None
    time_boot_ms: int | None = None  # of a setpoint, and command of a COMMAND_ACK below: what lockstep waits for
    ack_of: int | None = None


class Decoder:
    """Datagrams to packets. Damaged bytes are skipped and counted; nothing here raises on them."""

    def __init__(self) -> None:
        self._mav = dialect.MAVLink(None)
        self.damaged = 0

    def packets(self, datagram: bytes) -> Iterator[Packet]:
        """Every intact packet of one datagram; a packet never spans two datagrams."""
        at = 0
        while at < len(datagram):
            size = _packet_size(datagram, at)
            packet = self._decode(datagram[at : at + size]) if size else None
            if packet is None:
                self.damaged += 1
                at += 1 + _to_next_marker(datagram, at + 1)
                continue
            yield packet
            at += size

    def _decode(self, raw: bytes) -> Packet | None:
        try:
            message = self._mav.decode(bytearray(raw))
        except (dialect.MAVError, struct.error, ValueError):
            return None
        if isinstance(message, dialect.MAVLink_unknown):
            return None  # without its CRC_EXTRA nobody can tell it from rubbish
        sender = Sender(raw[5], raw[6]) if raw[0] == _V2 else Sender(raw[3], raw[4])
        kind = message.get_type()
        system = message.target if kind == "MANUAL_CONTROL" else getattr(message, "target_system", 0)
        target = Sender(system, getattr(message, "target_component", 0))
        read = _READERS.get(kind)
        return Packet(
            raw,
            message.get_msgId(),
            sender,
            target,
            read(message, sender) if read else None,
            getattr(message, "time_boot_ms", None),
            message.command if message.get_type() == "COMMAND_ACK" else None,
        )


def _packet_size(datagram: bytes, at: int) -> int:
    """Length of the packet that starts at ``at``, 0 where none does or it is cut short."""
    left = len(datagram) - at
    if left >= 12 and datagram[at] == _V2:
        size = 12 + datagram[at + 1] + (13 if datagram[at + 2] & _SIGNED else 0)
    elif left >= 8 and datagram[at] == _V1:
        size = 8 + datagram[at + 1]
    else:
        return 0
    return size if size <= left else 0


def _to_next_marker(datagram: bytes, start: int) -> int:
    for at in range(start, len(datagram)):
        if datagram[at] in (_V1, _V2):
            return at - start
    return len(datagram) - start


def _command_long(m: Any, sender: Sender) -> Command:
    params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
    return Command(m.command, params, sender, m.target_system, m.target_component)


def _command_int(m: Any, sender: Sender) -> Command:
    unit = 1e-7 if m.frame in _GLOBAL_FRAMES else 1.0
    x, y = (math.nan if value in _NOT_GIVEN else value * unit for value in (m.x, m.y))
    params = (m.param1, m.param2, m.param3, m.param4, x, y, m.z)
    return Command(m.command, params, sender, m.target_system, m.target_component, m.frame)


def _set_mode(m: Any, sender: Sender) -> Command:
    main, sub = float(m.custom_mode >> 16 & 0xFF), float(m.custom_mode >> 24)
    params = (float(m.base_mode), main, sub, 0.0, 0.0, 0.0, 0.0)
    return Command(Cmd.DO_SET_MODE, params, sender, m.target_system, COMPONENT, custom_mode=m.custom_mode)


def _setpoint(m: Any, sender: Sender) -> LocalSetpoint:
    turn = flip_frd_flu if m.coordinate_frame in _BODY_FRAMES else swap_ned_enu
    return LocalSetpoint(
        time_boot_ms=m.time_boot_ms,
        frame=m.coordinate_frame,
        type_mask=m.type_mask,
        p_enu=turn((m.x, m.y, m.z)),
        v_enu=turn((m.vx, m.vy, m.vz)),
        a_enu=turn((m.afx, m.afy, m.afz)),
        yaw_rad=0.5 * math.pi - m.yaw,
        yaw_rate_rad_s=-m.yaw_rate,
        sender=sender,
    )


def _global_setpoint(m: Any, sender: Sender) -> LocalSetpoint:
    x, y = enu_of(m.lat_int * 1e-7, m.lon_int * 1e-7)
    return LocalSetpoint(
        time_boot_ms=m.time_boot_ms,
        frame=m.coordinate_frame,
        type_mask=m.type_mask,
        p_enu=(x, y, m.alt),
        v_enu=swap_ned_enu((m.vx, m.vy, m.vz)),
        a_enu=swap_ned_enu((m.afx, m.afy, m.afz)),
        yaw_rad=0.5 * math.pi - m.yaw,
        yaw_rate_rad_s=-m.yaw_rate,
        sender=sender,
        is_global=True,
    )


def _attitude_target(m: Any, sender: Sender) -> AttitudeTarget:
    w, x, y, z = m.q
    rates = flip_frd_flu((m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate))
    return AttitudeTarget(m.time_boot_ms, m.type_mask, q_ned_from_frd((w, x, y, z)), rates, m.thrust, sender)


def _manual_control(m: Any, sender: Sender) -> Sticks | None:
    axes = (m.x, m.y, m.z, m.r)
    if any(axis == 0x7FFF for axis in axes):  # an axis that the joystick does not have
        return None
    forward, right, up, turn = (min(max(axis / 1000.0, -1.0), 1.0) for axis in axes)
    return Sticks(forward, -right, 2.0 * max(up, 0.0) - 1.0, -turn, sender)


def _rc_override(m: Any, sender: Sender) -> Sticks | None:
    """Channels 1 to 4 are roll, pitch, throttle and yaw; 65535 leaves one alone, 0 gives it back."""
    channels = (m.chan1_raw, m.chan2_raw, m.chan3_raw, m.chan4_raw)
    if not any(channels):
        return Sticks(0.0, 0.0, 0.0, 0.0, sender, radio=True, released=True)
    if any(pulse_us in (0, 0xFFFF) for pulse_us in channels):
        return None
    right, forward, up, turn = (min(max((pulse_us - 1500) / 500.0, -1.0), 1.0) for pulse_us in channels)
    return Sticks(forward, -right, up, -turn, sender, radio=True)


def _heartbeat(m: Any, sender: Sender) -> StationHeartbeat | None:
    return StationHeartbeat(sender) if m.type == dialect.MAV_TYPE_GCS else None


def _ping(m: Any, sender: Sender) -> Ping | None:
    return Ping(m.time_usec, m.seq, sender) if m.target_system == 0 and m.target_component == 0 else None


def _mission(m: Any, sender: Sender) -> MissionRequest:
    return MissionRequest(m.get_msgId(), m.mission_type, getattr(m, "count", 0), sender)


def _timesync(m: Any, sender: Sender) -> Timesync | None:
    return Timesync(m.tc1, m.ts1, sender) if m.tc1 == 0 else None


def _param_set(m: Any, sender: Sender) -> ParamWrite:
    if m.param_type in _INT_TYPES:
        whole = struct.unpack("<i", struct.pack("<f", m.param_value))[0]
        return ParamWrite(m.param_id, whole, is_int=True, cast=m.param_value)
    return ParamWrite(m.param_id, m.param_value, is_int=False, cast=m.param_value)


_READERS: dict[str, Callable[[Any, Sender], Incoming | None]] = {
    "COMMAND_LONG": _command_long,
    "COMMAND_INT": _command_int,
    "SET_MODE": _set_mode,
    "SET_POSITION_TARGET_LOCAL_NED": _setpoint,
    "SET_POSITION_TARGET_GLOBAL_INT": _global_setpoint,
    "SET_ATTITUDE_TARGET": _attitude_target,
    "MANUAL_CONTROL": _manual_control,
    "RC_CHANNELS_OVERRIDE": _rc_override,
    "HEARTBEAT": _heartbeat,
    "PING": _ping,
    "MISSION_REQUEST_LIST": _mission,
    "MISSION_CLEAR_ALL": _mission,
    "MISSION_COUNT": _mission,
    "TIMESYNC": _timesync,
    "PARAM_REQUEST_READ": lambda m, sender: ParamRead("" if m.param_index >= 0 else m.param_id, m.param_index),
    "PARAM_REQUEST_LIST": lambda m, sender: ParamRead("", -1),
    "PARAM_SET": _param_set,
    "REQUEST_DATA_STREAM": lambda m, sender: StreamRequest(m.req_stream_id, m.req_message_rate if m.start_stop else 0),
}


class Encoder:
    """Values to bytes, from the autopilot of ``system``, numbered for one link."""

    def __init__(self, system: int = 1) -> None:
        self._mav = dialect.MAVLink(None, srcSystem=system, srcComponent=COMPONENT)
        self._text_id = 0  # of the last STATUSTEXT in chunks

    def pack(self, message: Any) -> bytes:
        """Bytes of a pymavlink message object with this link's next sequence number."""
        raw: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) & 0xFF
        return raw

    def ack(self, ack: Ack) -> bytes:
        to = ack.receiver
        return self.pack(
            dialect.MAVLink_command_ack_message(ack.command, int(ack.result), 0, 0, to.system, to.component)
        )

    def text(self, text: Text) -> bytes:
        """One STATUSTEXT; a longer text in chunks of 50 characters under a common id, the last one ends with NUL."""
        raw = text.text.encode()
        if len(raw) <= _TEXT:
            return self.pack(dialect.MAVLink_statustext_message(int(text.severity), raw))
        self._text_id = self._text_id % 0xFFFF + 1
        starts = range(0, len(raw) + 1, _TEXT)  # a last chunk that is full is followed by an empty one
        return b"".join(
            self.pack(
                dialect.MAVLink_statustext_message(int(text.severity), raw[i : i + _TEXT], self._text_id, i // _TEXT)
            )
            for i in starts
        )

    def timesync(self, request: Timesync, now_ns: int) -> bytes:
        """The answer; pymavlink's dialect has no target fields here, so whoever sent ``ts1`` knows it by that."""
        return self.pack(dialect.MAVLink_timesync_message(now_ns, request.ts1))

    def param(self, name: str, value: float | int, index: int, count: int, *, cast_to: int | None = None) -> bytes:
        """PARAM_VALUE; ``cast_to``: MAV_PARAM_TYPE of a number that travels as a plain float, else bytewise."""
        if cast_to is not None:
            wire, kind = float(value), cast_to
        elif isinstance(value, int):
            wire, kind = struct.unpack("<f", struct.pack("<i", value))[0], _PARAM_INT32
        else:
            wire, kind = value, _PARAM_REAL32
        return self.pack(dialect.MAVLink_param_value_message(name.encode(), wire, kind, count, index))

    def param_checksum(self, checksum: int, count: int) -> bytes:
        """PX4's ``_HASH_CHECK``: a UINT32, at no index."""
        wire = struct.unpack("<f", struct.pack("<I", checksum))[0]
        return self.pack(dialect.MAVLink_param_value_message(b"_HASH_CHECK", wire, _PARAM_UINT32, count, 0xFFFF))

    def ping(self, ping: Ping) -> bytes:
        to = ping.sender
        return self.pack(dialect.MAVLink_ping_message(ping.time_usec, ping.seq, to.system, to.component))

    def no_mission(self, request: MissionRequest) -> bytes:
        """None to be listed, none left after a clear, no room for one that is announced."""
        to, kind = request.sender, request.mission_type
        if request.message_id == dialect.MAVLINK_MSG_ID_MISSION_REQUEST_LIST:
            return self.pack(dialect.MAVLink_mission_count_message(to.system, to.component, 0, kind))
        empty = request.message_id == dialect.MAVLINK_MSG_ID_MISSION_CLEAR_ALL or request.items == 0
        result = dialect.MAV_MISSION_ACCEPTED if empty else dialect.MAV_MISSION_NO_SPACE
        return self.pack(dialect.MAVLink_mission_ack_message(to.system, to.component, result, kind))

    def protocol_version(self) -> bytes:
        """PROTOCOL_VERSION (300), which pymavlink's dialect lacks: 2.0, from 1.0 to 2.0, without hashes."""
        payload = struct.pack("<HHH", 200, 100, 200).rstrip(b"\0")  # MAVLink 2 cuts zeros, those of the hashes too
        head = struct.pack("<BBBBBB", len(payload), 0, 0, self._mav.seq, self._mav.srcSystem, self._mav.srcComponent)
        body = head + _PROTOCOL_VERSION.to_bytes(3, "little") + payload
        crc = dialect.x25crc(body)
        crc.accumulate(bytes((_PROTOCOL_VERSION_EXTRA,)))
        self._mav.seq = (self._mav.seq + 1) & 0xFF
        return bytes((_V2,)) + body + struct.pack("<H", crc.crc)

    def message_interval(self, message_id: int, interval_us: int) -> bytes:
        return self.pack(dialect.MAVLink_message_interval_message(message_id, interval_us))


def flip_frd_flu(v: Vec3) -> Vec3:
    """FRD components of an FLU vector, and the other way round."""
    return (v[0], -v[1], -v[2])


def swap_ned_enu(v: Vec3) -> Vec3:
    """NED components of an ENU vector, and the other way round.

    >>> swap_ned_enu((1.0, 2.0, 3.0))
    (2.0, 1.0, -3.0)
    """
    x, y, z = v
    return (y, x, -z)


def q_ned_from_frd(q_enu_from_flu: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """MAVLink's attitude (w, x, y, z): half a turn about (1, 1, 0), times q, times half a turn about x, multiplied out.

    Its own inverse.

    Level and facing east is a heading of 90 degrees:

    >>> [round(x, 4) for x in q_ned_from_frd((1.0, 0.0, 0.0, 0.0))]
    [0.7071, 0.0, 0.0, 0.7071]
    """
    w, x, y, z = q_enu_from_flu
    s = _SQRT_HALF if w + z >= 0.0 else -_SQRT_HALF
    return (s * (w + z), s * (x + y), s * (x - y), s * (w - z))
