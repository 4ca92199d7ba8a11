"""The world around the daemon of `companion bench wire`: an autopilot on UDP and a sensor on Zenoh, in one process.

The autopilot is written with pymavlink alone: it streams its state, answers TIMESYNC, grants modes, and moves as the
setpoints say (p' = v, v' = a). The sensor publishes at random phases, so that every wait for a state message occurs.
"""

from __future__ import annotations

import json
import select
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zenoh
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.clock import Clock
from companion.types import NS_PER_S

OBSTACLES = 10
FRAME_EVERY_S = (0.03, 0.07)  # drawn evenly: 20 Hz on average, at any phase of the telemetry
_HOLD, _OFFBOARD_MAIN = 4 << 16 | 3 << 24, 6
_ENGAGE, _SET_MODE, _IN_AIR, _COMPANION = 92, 176, 2, 196


@dataclass(slots=True)
class Seen:
    """Instants on the monotonic clock [ns]."""

    published: list[tuple[int, int]] = field(default_factory=list)  # (stamp of the frame, before it was put)
    states: dict[int, int] = field(default_factory=dict)  # time_boot_ms -> sent
    setpoints: dict[int, int] = field(default_factory=dict)  # time_boot_ms -> first one that answers it came


class Autopilot:
    """A vehicle in the air at (0, 0, 2) m ENU, on a UDP socket that sends to ``port``."""

    def __init__(self, port: int, clock: Clock, rate_hz: int) -> None:
        self._clock = clock
        self._address = ("127.0.0.1", port)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self._mav = dialect.MAVLink(None, 1, 1)
        self._boot_ns = clock.monotonic_ns() - NS_PER_S
        self._dt_s = 1.0 / rate_hz
        self._p, self._v, self._a = np.array([0.0, 0.0, -2.0]), np.zeros(3), np.zeros(3)  # NED
        self.mode = _HOLD
        self.engaged = False

    def tick(self, number: int, seen: Seen) -> None:
        """One period: move, tell the state, once a second the rest."""
        self._p = self._p + self._v * self._dt_s + 0.5 * self._a * self._dt_s**2
        self._v = self._v + self._a * self._dt_s
        if number % round(1.0 / self._dt_s) == 0:
            self._beat()
            self._send(dialect.MAVLink_extended_sys_state_message(0, _IN_AIR))
            if not self.engaged:
                self._send(dialect.MAVLink_command_long_message(1, _COMPANION, _ENGAGE, 0, 1, 0, 0, 0, 0, 0, 0))
        now_ns = self._clock.monotonic_ns()
        t_ms = (now_ns - self._boot_ns) // 1_000_000
        attitude = dialect.MAVLink_attitude_quaternion_message(t_ms, 1.0, 0, 0, 0, 0, 0, 0)
        position = dialect.MAVLink_local_position_ned_message(t_ms, *self._p.tolist(), *self._v.tolist())
        both = self._pack(attitude) + self._pack(position)
        seen.states[t_ms] = self._clock.monotonic_ns()
        self.socket.sendto(both, self._address)

    def receive(self, seen: Seen) -> None:
        """Everything that has come."""
        while True:
            try:
                data = self.socket.recv(4096)
            except (BlockingIOError, ConnectionRefusedError):
                return
            arrived_ns = self._clock.monotonic_ns()
            for message in self._mav.parse_buffer(data) or []:
                self._take(message, arrived_ns, seen)

    def _take(self, message: Any, arrived_ns: int, seen: Seen) -> None:
        kind = message.get_type()
        if kind == "SET_POSITION_TARGET_LOCAL_NED":
            seen.setpoints.setdefault(message.time_boot_ms, arrived_ns)
            self._a = np.array([message.afx, message.afy, message.afz])
        elif kind == "TIMESYNC" and message.tc1 == 0:
            self._send(dialect.MAVLink_timesync_message(arrived_ns - self._boot_ns, message.ts1))
        elif kind == "COMMAND_LONG" and message.target_component == 1:
            if message.command == _SET_MODE:
                self.mode = int(message.param2) << 16 | int(message.param3) << 24
                self.engaged = int(message.param2) == _OFFBOARD_MAIN
            self._send(dialect.MAVLink_command_ack_message(message.command, 0, 0, 0, 1, _COMPANION))
            self._beat()

    def _beat(self) -> None:
        self._send(dialect.MAVLink_heartbeat_message(2, 12, 1 | 128, self.mode, 4, 3))

    def _pack(self, message: Any) -> bytes:
        packet: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return packet

    def _send(self, message: Any) -> None:
        self.socket.sendto(self._pack(message), self._address)


def obstacle_frame(t_s: float, stamp_ns: int) -> str:
    """Ten obstacles on circles of 2 to 4 m about the vehicle, unix stamp."""
    angles, radii = np.arange(OBSTACLES) * 0.628 + 0.3 * t_s, np.linspace(2.0, 4.0, OBSTACLES)
    obstacles = [
        {"id": f"o{m}", "position": [r * np.cos(a), r * np.sin(a), 2.0], "radius": 0.2, "position_std": 0.05}
        for m, (a, r) in enumerate(zip(angles.tolist(), radii.tolist(), strict=True))
    ]
    return json.dumps({"stamp_ns": stamp_ns, "clock": "unix", "obstacles": obstacles}, default=float)


def fly(
    port: int,
    endpoint: str,
    clock: Clock,
    *,
    rate_hz: int,
    warm_s: float,
    measured_s: float,
    alive: Callable[[], bool],
) -> Seen:
    """Be the world for ``warm_s`` after the daemon has been engaged, then ``measured_s`` more.

    Raises:
        TimeoutError: not engaged within 20 s, or the daemon ended.
    """
    seen, rng = Seen(), np.random.default_rng(50)
    autopilot = Autopilot(port, clock, rate_hz)
    settings = zenoh.Config()
    settings.insert_json5("connect/endpoints", json.dumps([endpoint]))
    settings.insert_json5("scouting/multicast/enabled", "false")
    began_ns = clock.monotonic_ns()
    with autopilot.socket, zenoh.open(settings) as session:
        publisher = session.declare_publisher("uav/uav1/obstacles/bench", express=True)
        engaged_ns: int | None = None
        next_state_ns, next_frame_ns, number = began_ns, began_ns, 0
        while True:
            now_ns = clock.monotonic_ns()
            if engaged_ns is None and autopilot.engaged:
                engaged_ns = now_ns
            if engaged_ns is not None and now_ns - engaged_ns > (warm_s + measured_s) * NS_PER_S:
                break
            if not alive() or (engaged_ns is None and now_ns - began_ns > 20 * NS_PER_S):
                raise TimeoutError("bench wire: the daemon was not engaged within 20 s, or has ended")
            if now_ns >= next_state_ns:
                autopilot.tick(number, seen)
                number, next_state_ns = number + 1, next_state_ns + NS_PER_S // rate_hz
            elif now_ns >= next_frame_ns:
                warm = engaged_ns is not None and now_ns - engaged_ns > warm_s * NS_PER_S
                stamp_ns = clock.unix_ns()
                payload = obstacle_frame((now_ns - began_ns) / NS_PER_S, stamp_ns)
                put_ns = clock.monotonic_ns()
                publisher.put(payload)
                if warm:
                    seen.published.append((stamp_ns, put_ns))
                next_frame_ns = now_ns + round(rng.uniform(*FRAME_EVERY_S) * NS_PER_S)
            due_ns = min(next_state_ns, next_frame_ns) - clock.monotonic_ns()
            if select.select([autopilot.socket], [], [], max(0.0, due_ns / NS_PER_S))[0]:
                autopilot.receive(seen)
    return seen
