"""MAVLink 2 without input or output: bytes in, events out; values in, bytes out.

The wire speaks local NED and milliseconds since the autopilot's boot, everything inside speaks ENU and nanoseconds:
the conversion is here and nowhere else in `companion`. Sources: MAVLink common.xml; pymavlink's dialect module is
the codec of single messages.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.errors import CompanionError
from companion.link import mav, params
from companion.link.decode import DECODERS, Rejected, TextAssembler, command
from companion.link.decode_traffic import TRAFFIC_DECODERS
from companion.link.events import Command, Event
from companion.link.framing import Framer
from companion.link.signing import FLAG_SIGNED, SIGNATURE_BLOCK, Signing
from companion.profiles import ModeRequest
from companion.types import Vec3

_DECODERS = {**DECODERS, **TRAFFIC_DECODERS}
_MAX_SETPOINT = 1e3  # [m/s^2], [m/s], [rad/s]
_MASK_BITS = 0x0FFF
_TEXT_BYTES = 50
_UINT8_UNKNOWN, _UINT32_UNKNOWN, _INT8_UNKNOWN, _INT16_UNKNOWN = 0xFF, 0xFFFFFFFF, 0x7F, 0x7FFF


class SetpointRefused(CompanionError):
    """A setpoint that must not reach the wire: not finite, absurd, or under a mask that is not ours to send."""


class MavlinkCodec:
    """The daemon's protocol state: the framer, the packet sequence and half-received texts.

    What the encoders return goes through ``seal`` on its way out.
    ``system`` is the vehicle's system id; the daemon is component 196 of it. ``signing`` signs what leaves and judges
    what arrives. ``counts`` tells what came in (messages, unknown, bad_packets, garbage_bytes) and what was refused
    (not_finite, out_of_range, unknown_frame, unix_stamp; with signing unsigned, bad_signature, future, replayed).

    >>> codec = MavlinkCodec(system=1)
    >>> codec.receive(b"noise")
    []
    >>> codec.receive(MavlinkCodec(system=1).encode_timesync_request(5))[0].ts1_ns
    5
    """

    def __init__(self, *, system: int = 1, signing: Signing | None = None) -> None:
        self._signing = signing
        self._framer = Framer(signing=signing)
        self._mav = dialect.MAVLink(None, system, mav.COMPONENT)
        if signing is not None:
            # leaves room for the signature, which `seal` fills in
            self._mav.signing.secret_key, self._mav.signing.sign_outgoing = b"", True
        self._texts = TextAssembler()
        self._next_text_id = 1
        self.on_message: Callable[[Any], None] | None = None  # shown every intact message, before it is decoded

    @property
    def system(self) -> int:
        return int(self._mav.srcSystem)

    @system.setter
    def system(self, system: int) -> None:
        self._mav.srcSystem = system

    @property
    def counts(self) -> Counter[str]:
        return self._framer.counts

    def receive(self, data: bytes) -> list[Event]:
        """Events that ``data`` completes, in order; never raises.

        Commands become events only if they name component 196 and this system (or system 0): commands to
        component 0 are left to the autopilot. A message with a number that is not finite or absurd is dropped
        and counted.
        """
        return self.events(self._framer.push(data))

    def new_framer(self) -> Framer:
        """A framer for one more link, under the same key and counts; what it finds goes to ``events``."""
        return Framer(signing=self._signing, counts=self.counts, keep_unknown=True)

    def seal(self, data: bytes, link: int = 0) -> bytes:
        """What the encoders made, signed for one link where signing is on; call it as the bytes leave."""
        if self._signing is None:
            return data
        return b"".join(self._signing.seal(packet, link) for packet in packets(data))

    def close(self) -> None:
        """Keep the signing timestamps for the next run."""
        if self._signing is not None:
            self._signing.close()

    def events(self, messages: Iterable[Any]) -> list[Event]:
        """Events in messages of a framer, as by ``receive``."""
        events: list[Event] = []
        for message in messages:
            if self.on_message is not None:
                self.on_message(message)
            kind = message.get_msgId()  # not .id: STATUSTEXT has a field of that name
            decode = _DECODERS.get(kind)
            try:
                if decode is not None:
                    events.extend(decode(message))
                elif kind == mav.MSG_STATUSTEXT:
                    events.extend(self._texts.push(message))
                elif kind in params.REQUESTS and params.is_for(message, self.system):
                    events.append(params.decode(message))
                elif kind in (mav.MSG_COMMAND_LONG, mav.MSG_COMMAND_INT) and self._is_for_us(message):
                    events.append(command(message))
            except Rejected as reason:
                self.counts[str(reason)] += 1
        return events

    def encode_heartbeat(self, system_status: int, *, custom_mode: int = 0) -> bytes:
        """HEARTBEAT as an onboard controller that is no autopilot; ``system_status`` is a MAV_STATE."""
        flags, version = mav.MODE_FLAG_CUSTOM_ENABLED, 3
        message = dialect.MAVLink_heartbeat_message(
            mav.TYPE_ONBOARD_CONTROLLER, mav.AUTOPILOT_INVALID, flags, custom_mode, system_status, version
        )
        return self._pack(message)

    def encode_setpoint(
        self,
        time_boot_ms: int,
        a_enu: Vec3,
        type_mask: int,
        *,
        v_enu: Vec3 | None = None,
        yaw_rate_enu: float = 0.0,
    ) -> bytes:
        """SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME_LOCAL_NED to the vehicle's autopilot.

        Args:
            time_boot_ms: that of the vehicle state which the setpoint answers.
            a_enu: net acceleration, gravity excluded, shape (3,) [m/s^2].
            type_mask: POSITION_TARGET_TYPEMASK of the profile.
            v_enu: shape (3,) [m/s], needed where the mask uses velocity.
            yaw_rate_enu: counter-clockwise [rad/s], used where the mask does.
        Raises:
            SetpointRefused: NaN, infinity or an absurd number; FORCE or position in the mask; velocity missing.
        """
        _check_mask(type_mask, v_enu is not None)
        ax, ay, az = _checked("a_enu", a_enu, _MAX_SETPOINT)
        vx, vy, vz = (0.0, 0.0, 0.0) if v_enu is None else _checked("v_enu", v_enu, _MAX_SETPOINT)
        (rate,) = _checked("yaw_rate_enu", (yaw_rate_enu,), _MAX_SETPOINT)
        message = dialect.MAVLink_set_position_target_local_ned_message(
            time_boot_ms & 0xFFFFFFFF,
            self.system,
            mav.AUTOPILOT_COMPONENT,
            mav.FRAME_LOCAL_NED,
            type_mask,
            *(0.0, 0.0, 0.0),
            *(vy, vx, 0.0 - vz),  # no negative zeros on the wire
            *(ay, ax, 0.0 - az),
            0.0,
            0.0 - rate,
        )
        return self._pack(message)

    def encode_command_long(
        self, command: int, params: Sequence[float] = (), *, target_component: int = mav.AUTOPILOT_COMPONENT
    ) -> bytes:
        """COMMAND_LONG to a component of the vehicle; ``params`` beyond those given are 0."""
        seven = [*params, *[0.0] * (7 - len(params))]
        return self._pack(dialect.MAVLink_command_long_message(self.system, target_component, command, 0, *seven))

    def encode_set_message_interval(self, message_id: int, rate_hz: float) -> bytes:
        """Ask the autopilot to stream a message at ``rate_hz``."""
        return self.encode_command_long(mav.CMD_SET_MESSAGE_INTERVAL, (message_id, round(1e6 / rate_hz)))

    def encode_request_message(self, message_id: int) -> bytes:
        """Ask the autopilot for one message, once."""
        return self.encode_command_long(mav.CMD_REQUEST_MESSAGE, (message_id,))

    def encode_set_mode(self, mode: ModeRequest) -> bytes:
        """Ask the autopilot for a mode (MAV_CMD_DO_SET_MODE)."""
        return self.encode_command_long(mav.CMD_DO_SET_MODE, (mav.MODE_FLAG_CUSTOM_ENABLED, mode.main, mode.sub))

    def encode_command_ack(self, command: Command, result: int) -> bytes:
        """COMMAND_ACK to whoever sent ``command``; ``result`` is a MAV_RESULT."""
        return self._pack(
            dialect.MAVLink_command_ack_message(
                command.command, result, 0, 0, command.from_system, command.from_component
            )
        )

    def encode_statustext(self, severity: int, text: str) -> bytes:
        """STATUSTEXT, in chunks beyond 50 bytes of UTF-8; a chunk with room left tells that it is the last."""
        data = text.encode("utf-8").replace(b"\x00", b" ")
        if len(data) <= _TEXT_BYTES:
            return self._pack(dialect.MAVLink_statustext_message(severity, data, 0, 0))
        data = data[: 255 * _TEXT_BYTES]  # chunk_seq is one byte
        text_id, self._next_text_id = self._next_text_id, self._next_text_id % 0xFFFF + 1
        chunks = [data[i : i + _TEXT_BYTES] for i in range(0, len(data) + 1, _TEXT_BYTES)]
        return b"".join(
            self._pack(dialect.MAVLink_statustext_message(severity, chunk, text_id, sequence))
            for sequence, chunk in enumerate(chunks)
        )

    def encode_timesync_request(self, ts1_ns: int) -> bytes:
        """TIMESYNC: what is your time? ``ts1_ns`` is ours, never 0."""
        return self._pack(dialect.MAVLink_timesync_message(0, ts1_ns))

    def encode_timesync_reply(self, *, tc1_ns: int, ts1_ns: int) -> bytes:
        """TIMESYNC: our clock stands at ``tc1_ns``; ``ts1_ns`` as in the request."""
        return self._pack(dialect.MAVLink_timesync_message(tc1_ns, ts1_ns))

    def encode_collision(
        self,
        *,
        track_number: int,
        threat_level: int,
        time_to_minimum_s: float,
        altitude_minimum_m: float,
        horizontal_minimum_m: float,
    ) -> bytes:
        """COLLISION: a threat, seen by this component (source 0, action NONE: the setpoints are the answer)."""
        values = _checked("collision", (time_to_minimum_s, altitude_minimum_m, horizontal_minimum_m), 1e6)
        return self._pack(dialect.MAVLink_collision_message(0, track_number & 0xFFFFFFFF, 0, threat_level, *values))

    def encode_onboard_computer_status(
        self, *, time_boot_ms: int, uptime_ms: int, cpu_percent: Sequence[int], ram_used_mib: int, ram_total_mib: int
    ) -> bytes:
        """ONBOARD_COMPUTER_STATUS; what is not measured carries the specification's "unknown"."""
        cores = [*cpu_percent[:8], *[_UINT8_UNKNOWN] * (8 - len(cpu_percent[:8]))]
        combined = round(sum(cpu_percent) / len(cpu_percent)) if cpu_percent else _UINT8_UNKNOWN
        return self._pack(
            dialect.MAVLink_onboard_computer_status_message(
                time_usec=time_boot_ms * 1000,
                uptime=uptime_ms & 0xFFFFFFFF,
                type=0,
                cpu_cores=cores,
                cpu_combined=[combined, *[_UINT8_UNKNOWN] * 9],
                gpu_cores=[_UINT8_UNKNOWN] * 4,
                gpu_combined=[_UINT8_UNKNOWN] * 10,
                temperature_board=_INT8_UNKNOWN,
                temperature_core=[_INT8_UNKNOWN] * 8,
                fan_speed=[_INT16_UNKNOWN] * 4,
                ram_usage=ram_used_mib,
                ram_total=ram_total_mib,
                storage_type=[_UINT32_UNKNOWN] * 4,
                storage_usage=[_UINT32_UNKNOWN] * 4,
                storage_total=[_UINT32_UNKNOWN] * 4,
                link_type=[_UINT32_UNKNOWN] * 6,
                link_tx_rate=[_UINT32_UNKNOWN] * 6,
                link_rx_rate=[_UINT32_UNKNOWN] * 6,
                link_tx_max=[_UINT32_UNKNOWN] * 6,
                link_rx_max=[_UINT32_UNKNOWN] * 6,
            )
        )

    def encode(self, message: Any) -> bytes:
        """A pymavlink message that another module has built."""
        return self._pack(message)

    def _pack(self, message: Any) -> bytes:
        packet: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return packet

    def _is_for_us(self, message: Any) -> bool:
        return message.target_component == mav.COMPONENT and message.target_system in (0, self.system)


def _check_mask(type_mask: int, has_velocity: bool) -> None:
    if type_mask & mav.FORCE or type_mask & ~_MASK_BITS:
        raise SetpointRefused(f"type_mask: expected without FORCE and unknown bits, got 0x{type_mask:04X}")
    if type_mask & mav.IGNORE_POSITION != mav.IGNORE_POSITION:
        raise SetpointRefused(f"type_mask: expected position ignored, got 0x{type_mask:04X}")
    if type_mask & mav.IGNORE_ACCELERATION:
        raise SetpointRefused(f"type_mask: expected all three accelerations used, got 0x{type_mask:04X}")
    ignored = type_mask & mav.IGNORE_VELOCITY
    if ignored not in (0, mav.IGNORE_VELOCITY):
        raise SetpointRefused(f"type_mask: expected all three velocities used or none, got 0x{type_mask:04X}")
    if ignored == 0 and not has_velocity:
        raise SetpointRefused("v_enu: expected a velocity, the type_mask uses it")


def _checked(name: str, values: Iterable[float], bound: float) -> list[float]:
    floats = [float(value) for value in values]
    if not all(math.isfinite(value) and abs(value) <= bound for value in floats):
        raise SetpointRefused(f"{name}: expected finite numbers within +-{bound:g}, got {floats}")
    return floats


def packet_count(data: bytes) -> int:
    """How many MAVLink 2 packets ``data``, made by this codec, consists of."""
    return sum(1 for _ in packets(data))


def packets(data: bytes) -> Iterator[bytes]:
    """Each MAVLink 2 packet of ``data``, made by this codec."""
    at = 0
    while at < len(data):
        end = at + 12 + data[at + 1] + (SIGNATURE_BLOCK if data[at + 2] & FLAG_SIGNED else 0)
        yield data[at:end]
        at = end
