"""A peer that acknowledges everything and does nothing: what a test of a simulator has to tell from a simulator.

It says what a healthy PX4 in Hold says, for ever, disarmed on the ground or armed at a height: heartbeat, SYS_STATUS,
HOME_POSITION, a fixed position, attitude, GPS and battery, with a clock that runs. Every command is ACCEPTED, a
REQUEST_MESSAGE too, though the message never comes; a parameter has any name, holds what was last written and acts on
nothing; a mission or a fence is asked for item by item and ACCEPTED; TIMESYNC is answered. Nothing it is told changes
what it sends.

Plain pymavlink. Run as a process: ``python dumb_autopilot.py PORT@HEIGHT...``, one such vehicle a port, each sending to
127.0.0.1:PORT, where a ground station listens; HEIGHT in metres above home, 0 on the ground.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import struct
import sys
import time
from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

HOLD = 4 << 16 | 3 << 24  # PX4's custom mode
HEALTHY = 0b1111 | 1 << 5 | 0b11111 << 11 | 1 << 25 | 1 << 28
LAT, LON, ALT_MM = 473977420, 85455940, 488000
SLOW_S, FAST_S = 1.0, 0.2
INTS = range(1, 9)  # MAV_PARAM_TYPE UINT8 .. INT64
UNKNOWN = 65535
NAN = float("nan")


class Dumb:
    """One vehicle: ``answer`` bytes in, bytes out; ``slow`` and ``fast`` are what it says unasked."""

    def __init__(self, boot_s: float, height_m: float) -> None:
        self._mav = dialect.MAVLink(None, 1, 1)
        self._mav.robust_parsing = True
        self._boot_s = boot_s
        self._height_m = height_m
        self._flies = height_m > 0.0
        self._parameters: dict[str, tuple[float, int]] = {}  # value as it is on the wire, MAV_PARAM_TYPE
        self._items = 0

    def slow(self, now_s: float) -> bytes:
        """The messages of 1 Hz."""
        cells = [4100] + [UNKNOWN] * 9
        level = [1.0, 0.0, 0.0, 0.0]
        altitude_mm = ALT_MM + round(1e3 * self._height_m)
        return self._pack(
            dialect.MAVLink_heartbeat_message(2, 12, 1 | 4 | 16 | 128 * self._flies, HOLD, 3 + self._flies, 3),
            dialect.MAVLink_sys_status_message(HEALTHY, HEALTHY, HEALTHY, 100, 4100, -1, 100, 0, 0, 0, 0, 0, 0),
            dialect.MAVLink_battery_status_message(0, 0, 1, 32767, cells, -1, -1, -1, 100),
            dialect.MAVLink_home_position_message(LAT, LON, ALT_MM, 0.0, 0.0, 0.0, level, 0.0, 0.0, 0.0),
            dialect.MAVLink_gps_raw_int_message(
                self._us(now_s), 3, LAT, LON, altitude_mm, 80, 80, 0, UNKNOWN, 12, altitude_mm, 800, 800, 100
            ),
            dialect.MAVLink_system_time_message(time.time_ns() // 1000, self._ms(now_s)),
        )

    def fast(self, now_s: float) -> bytes:
        """The messages of 5 Hz."""
        ms, us = self._ms(now_s), self._us(now_s)
        imu = (0.0, 0.0, -9.81, 0.0, 0.0, 0.0, 0.2, 0.0, 0.4)  # accelerometer, gyro, magnetometer
        unknown = [NAN] + [0.0] * 20
        above_mm, h = round(1e3 * self._height_m), self._height_m
        return self._pack(
            dialect.MAVLink_extended_sys_state_message(0, 1 + self._flies),
            dialect.MAVLink_global_position_int_message(ms, LAT, LON, ALT_MM + above_mm, above_mm, 0, 0, 0, 0),
            dialect.MAVLink_local_position_ned_message(ms, 0.0, 0.0, -h, 0.0, 0.0, 0.0),
            dialect.MAVLink_attitude_message(ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            dialect.MAVLink_attitude_quaternion_message(ms, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            dialect.MAVLink_odometry_message(
                us, 1, 12, 0.0, 0.0, -h, [1.0, 0.0, 0.0, 0.0], *[0.0] * 6, unknown, unknown, 0, 1, 100
            ),
            dialect.MAVLink_altitude_message(us, 488.0 + h, 488.0 + h, h, h, NAN, NAN),
            dialect.MAVLink_vfr_hud_message(0.0, 0.0, 0, 50 * self._flies, 488.0 + h, 0.0),
            dialect.MAVLink_highres_imu_message(us, *imu, 955.0, 0, 488.0 + h, 20.0, 0x1FFF),
        )

    def answer(self, data: bytes, now_s: float) -> bytes:
        """Acknowledgements of whatever is in a datagram."""
        out = b""
        for message in self._mav.parse_buffer(data) or []:
            handler = getattr(self, f"_on_{message.get_type().lower()}", None)
            if handler is not None and message.get_srcComponent() != 1:
                out += handler(message, now_s)
        return out

    # --- answers, by message

    def _on_command_long(self, m: Any, now_s: float) -> bytes:
        ack = dialect.MAVLink_command_ack_message(m.command, 0, 100, 0, m.get_srcSystem(), m.get_srcComponent())
        self._mav.srcComponent = m.target_component or 1  # whoever was asked
        out = self._pack(ack)
        self._mav.srcComponent = 1
        return out

    _on_command_int = _on_command_long

    def _on_timesync(self, m: Any, now_s: float) -> bytes:
        return self._pack(dialect.MAVLink_timesync_message(int(now_s * 1e9), m.ts1)) if m.tc1 == 0 else b""

    def _on_ping(self, m: Any, now_s: float) -> bytes:
        return self._pack(dialect.MAVLink_ping_message(m.time_usec, m.seq, m.get_srcSystem(), m.get_srcComponent()))

    def _on_param_set(self, m: Any, now_s: float) -> bytes:
        self._parameters[m.param_id] = (m.param_value, m.param_type)
        return self._parameter(m.param_id)

    def _on_param_request_read(self, m: Any, now_s: float) -> bytes:
        names = list(self._parameters)
        if m.param_index >= 0:
            return self._parameter(names[m.param_index]) if m.param_index < len(names) else b""
        return self._parameter(m.param_id)

    def _on_param_request_list(self, m: Any, now_s: float) -> bytes:
        return b"".join(self._parameter(name) for name in self._parameters)

    def _on_mission_count(self, m: Any, now_s: float) -> bytes:
        self._items = m.count
        return self._next_item(m, 0)

    def _on_mission_item_int(self, m: Any, now_s: float) -> bytes:
        return self._next_item(m, m.seq + 1)

    def _on_mission_clear_all(self, m: Any, now_s: float) -> bytes:
        return self._mission_ack(m)

    def _next_item(self, m: Any, index: int) -> bytes:
        if index >= self._items:
            return self._mission_ack(m)
        to = (m.get_srcSystem(), m.get_srcComponent())
        return self._pack(dialect.MAVLink_mission_request_int_message(*to, index, m.mission_type))

    def _mission_ack(self, m: Any) -> bytes:
        to = (m.get_srcSystem(), m.get_srcComponent())
        return self._pack(dialect.MAVLink_mission_ack_message(*to, 0, m.mission_type))

    # --- encoding

    def _parameter(self, name: str) -> bytes:
        names = list(self._parameters)
        value, kind = self._parameters.get(name, (0.0, 9))
        if kind in INTS:  # bytewise, as it came; a NaN pattern must not be quietened on its way through a float
            value = struct.unpack("<f", struct.pack("<f", value))[0]
        index = names.index(name) if name in names else UNKNOWN
        return self._pack(dialect.MAVLink_param_value_message(name.encode(), value, kind, len(names), index))

    def _pack(self, *messages: Any) -> bytes:
        out = b""
        for message in messages:
            out += message.pack(self._mav)
            self._mav.seq = (self._mav.seq + 1) % 256
        return out

    def _ms(self, now_s: float) -> int:
        return int((now_s - self._boot_s) * 1e3)

    def _us(self, now_s: float) -> int:
        return int((now_s - self._boot_s) * 1e6)


def serve(places: Sequence[tuple[int, float]]) -> None:
    """One vehicle a port and height, until the process is ended."""
    selector = selectors.DefaultSelector()
    vehicles = []
    for port, height_m in places:
        link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        link.bind(("127.0.0.1", 0))
        link.connect(("127.0.0.1", port))
        vehicle = Dumb(time.monotonic(), height_m)
        selector.register(link, selectors.EVENT_READ, vehicle)
        vehicles.append((link, vehicle))
    slow_s = fast_s = time.monotonic()
    while True:
        now_s = time.monotonic()
        if now_s >= fast_s:
            slow = now_s >= slow_s
            for link, vehicle in vehicles:
                send(link, vehicle.fast(now_s))
                if slow:
                    send(link, vehicle.slow(now_s))
            fast_s = max(now_s, fast_s + FAST_S)
            slow_s = max(now_s, slow_s + SLOW_S) if slow else slow_s
        for key, _ in selector.select(max(0.0, fast_s - time.monotonic())):
            assert isinstance(key.fileobj, socket.socket)
            with contextlib.suppress(OSError):  # nobody listens there any more
                send(key.fileobj, key.data.answer(key.fileobj.recv(65536), time.monotonic()))


def send(link: socket.socket, data: bytes) -> None:
    """One datagram, if there is something to say and somebody listens."""
    if data:
        with contextlib.suppress(OSError):
            link.send(data)


if __name__ == "__main__":
    serve([(int(port), float(height)) for port, height in (word.split("@") for word in sys.argv[1:])])
