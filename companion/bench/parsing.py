"""Messages per second off a UDP socket: our transport and codec beside pymavlink's ``mavutil``, in the same run.

A round fills the socket's buffer with datagrams of one message each, then times the reader until it has them all; the
two take turns. Ours is the daemon's own path, `open_transport` and `MavlinkCodec.receive`, and ends in typed, checked
events; theirs is the usual loop over ``recv_match``.
"""

from __future__ import annotations

import asyncio
import os
import socket
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.bench.timing import Quantiles, quantiles
from companion.clock import stopwatch_ns
from companion.link.mavlink import MavlinkCodec
from companion.link.transports import open_transport

DATAGRAMS = 200  # a round; what a default receive buffer holds
WARM_ROUNDS = 3
LIMIT_S = 5.0


@dataclass(frozen=True, slots=True)
class Parsing:
    """``ours``, ``theirs``: milliseconds a round of ``datagrams`` messages."""

    rounds: int
    datagrams: int
    ours: Quantiles
    theirs: Quantiles

    @property
    def ours_per_s(self) -> float:
        return 1e3 * self.datagrams / self.ours.p50

    @property
    def theirs_per_s(self) -> float:
        return 1e3 * self.datagrams / self.theirs.p50


def traffic() -> list[bytes]:
    """A round: mostly what an autopilot streams at 50 Hz, with the slower messages among it."""
    mav = dialect.MAVLink(None, 1, 1)
    packets = []
    for k in range(DATAGRAMS):
        t_ms = 20 * k
        message = [
            dialect.MAVLink_local_position_ned_message(t_ms, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3),
            dialect.MAVLink_attitude_quaternion_message(t_ms, 0.9999, 0.01, 0.0, 0.01, 0.1, 0.1, 0.1),
            dialect.MAVLink_heartbeat_message(2, 12, 129, 6 << 16, 4, 3),
            dialect.MAVLink_local_position_ned_message(t_ms + 1, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3),
            dialect.MAVLink_attitude_quaternion_message(t_ms + 1, 0.9999, 0.01, 0.0, 0.01, 0.1, 0.1, 0.1),
            dialect.MAVLink_extended_sys_state_message(0, 2),
            dialect.MAVLink_timesync_message(1_000_000 * t_ms + 1, 1_000_000 * t_ms + 7),
            dialect.MAVLink_position_target_local_ned_message(t_ms, 1, 0x0C3F, 0, 0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0),
        ][k % 8]
        packets.append(message.pack(mav))
        mav.seq = (mav.seq + 1) % 256
    return packets


async def measure_parsing(rounds: int) -> Parsing:
    """``rounds`` of each, in turn.

    Raises:
        TimeoutError: datagrams were lost on loopback.
    """
    packets = traffic()
    ours, theirs = _Ours(), _Theirs()
    await ours.open()
    ours_ns: list[int] = []
    theirs_ns: list[int] = []
    try:
        for k in range(rounds + WARM_ROUNDS):
            pair = (await ours.round(packets), theirs.round(packets))
            if k >= WARM_ROUNDS:
                ours_ns.append(pair[0])
                theirs_ns.append(pair[1])
    finally:
        await ours.close()
        theirs.close()
    return Parsing(rounds, len(packets), quantiles(ours_ns), quantiles(theirs_ns))


class _Ours:
    async def open(self) -> None:
        self._codec, self._count, self._complete = MavlinkCodec(), 0, asyncio.Event()
        transport: Any = await open_transport("udpin://127.0.0.1:0", self._on_bytes)
        self._transport, self._sender = transport, _sender(transport.local_address)

    async def close(self) -> None:
        self._sender.close()
        await self._transport.close()

    async def round(self, packets: list[bytes]) -> int:
        """Nanoseconds to read a buffer full of ``packets``."""
        for packet in packets:
            self._sender.send(packet)
        self._count, self._wanted = 0, len(packets)
        self._complete.clear()
        began = stopwatch_ns()
        async with asyncio.timeout(LIMIT_S):
            await self._complete.wait()
        return stopwatch_ns() - began

    def _on_bytes(self, data: bytes) -> None:
        self._count += len(self._codec.receive(data))
        if self._count >= self._wanted:
            self._complete.set()


class _Theirs:
    def __init__(self) -> None:
        os.environ.setdefault("MAVLINK20", "1")  # mavutil speaks version 1 otherwise
        from pymavlink import mavutil

        self._connection = mavutil.mavlink_connection("udpin:127.0.0.1:0", dialect="ardupilotmega")
        self._sender = _sender(self._connection.port.getsockname())

    def close(self) -> None:
        self._sender.close()
        self._connection.close()

    def round(self, packets: list[bytes]) -> int:
        """Nanoseconds to read a buffer full of ``packets``."""
        for packet in packets:
            self._sender.send(packet)
        receive = self._connection.recv_match
        began = stopwatch_ns()
        for _ in packets:
            if receive(blocking=True, timeout=LIMIT_S) is None:
                raise TimeoutError("bench wire: mavutil did not get every datagram")
        return stopwatch_ns() - began


def _sender(address: tuple[str, int]) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.connect(address)
    return sock
