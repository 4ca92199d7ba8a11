"""An autopilot written with pymavlink alone: what the doctor hears, and what it must not send."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

PX4, ARDUPILOT = 12, 3
INT32, REAL32 = 6, 9
HARMLESS = {"HEARTBEAT", "PARAM_REQUEST_READ", "TIMESYNC", "COMMAND_LONG"}
ASKING = {511, 512}  # SET_MESSAGE_INTERVAL, REQUEST_MESSAGE


class Peer:
    """Streams what it was asked for, answers TIMESYNC and parameters as its kind does; time is an argument [s].

    Args:
        parameters: name -> value; an int is an INT32, a float a REAL32.
        read_only: PARAM_SET of these is answered with the old value.
    """

    def __init__(
        self,
        kind: int,
        parameters: dict[str, float | int],
        *,
        system: int = 1,
        armed: bool = False,
        read_only: Iterable[str] = (),
        silent: bool = False,
    ) -> None:
        self.mav = dialect.MAVLink(None, system, 1)
        self.kind, self.parameters, self.armed = kind, dict(parameters), armed
        self.read_only, self.silent = set(read_only), silent
        self.received: list[Any] = []
        self.intervals_s: dict[int, float] = {}
        self.due_s: dict[int, float] = {}
        self.beat_s = 0.0

    def take(self, data: bytes, now_s: float) -> bytes:
        """Answers to what the doctor sent."""
        out = b""
        for message in self.mav.parse_buffer(data) or []:
            self.received.append(message)
            out += self._answer(message, now_s)
        return out

    def stream(self, now_s: float) -> bytes:
        """What is due by now."""
        out = b""
        if now_s >= self.beat_s:
            self.beat_s = now_s + 1.0
            out += self.pack(dialect.MAVLink_heartbeat_message(2, self.kind, 1 | 128 * self.armed, 4, 4, 3))
        for message_id, interval_s in self.intervals_s.items():
            if now_s >= self.due_s[message_id]:
                self.due_s[message_id] += interval_s
                out += self._state(message_id, round(1e3 * now_s))
        return out

    def pack(self, message: Any) -> bytes:
        packet: bytes = message.pack(self.mav)
        self.mav.seq = (self.mav.seq + 1) % 256
        return packet

    def of(self, kind: str) -> list[Any]:
        return [message for message in self.received if message.get_type() == kind]

    def unasked(self) -> list[str]:
        """Whatever was sent that could change more than this link's message rates."""
        return [
            m.get_type()
            for m in self.received
            if m.get_type() not in HARMLESS or (m.get_type() == "COMMAND_LONG" and m.command not in ASKING)
        ]

    def _answer(self, m: Any, now_s: float) -> bytes:
        kind = m.get_type()
        if self.silent or getattr(m, "target_system", self.mav.srcSystem) != self.mav.srcSystem:
            return b""
        if kind == "TIMESYNC" and m.tc1 == 0:
            return self.pack(dialect.MAVLink_timesync_message(round(1e9 * now_s) + 1, m.ts1))
        if kind == "PARAM_REQUEST_READ" and m.param_id in self.parameters:
            return self._value(m.param_id)
        if kind == "PARAM_SET" and m.param_id in self.parameters:
            if m.param_id not in self.read_only:
                self.parameters[m.param_id] = self._decoded(m)
            return self._value(m.param_id)
        if kind == "COMMAND_LONG" and m.command == 511:
            self.intervals_s[int(m.param1)] = 1e-6 * m.param2
            self.due_s[int(m.param1)] = now_s
            return self.pack(dialect.MAVLink_command_ack_message(511, 0, 0, 0, m.get_srcSystem(), 196))
        return b""

    def _decoded(self, m: Any) -> float | int:
        if m.param_type == REAL32:
            return float(m.param_value)
        if self.kind == ARDUPILOT:
            return round(m.param_value)
        return int(struct.unpack("<i", struct.pack("<f", m.param_value))[0])

    def _value(self, name: str) -> bytes:
        value = self.parameters[name]
        if isinstance(value, float) or self.kind == ARDUPILOT:
            wire = float(value)
        else:
            wire = struct.unpack("<f", struct.pack("<i", value))[0]
        kind = REAL32 if isinstance(value, float) else INT32
        return self.pack(dialect.MAVLink_param_value_message(name.encode(), wire, kind, 900, 65535))

    def _state(self, message_id: int, t_ms: int) -> bytes:
        if message_id == 32:
            return self.pack(dialect.MAVLink_local_position_ned_message(t_ms, 0, 0, -2, 0, 0, 0))
        if message_id == 31:
            return self.pack(dialect.MAVLink_attitude_quaternion_message(t_ms, 1, 0, 0, 0, 0, 0, 0))
        return self.pack(dialect.MAVLink_extended_sys_state_message(0, 1))
