"""The tlog, read by pymavlink's own reader of such files."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.clock import ManualClock
from companion.config import parse_config
from companion.link.mavlink import MavlinkCodec
from companion.link.router import Router
from companion.record import Recorder
from companion.tlog import entry, is_secret, read_tlog
from sim_bridge.testing import free_port


class Nobody:
    flies = False

    def say(self, severity: int, text: str) -> None:
        pass


def packed(message: dialect.MAVLink_message, system: int = 1) -> bytes:
    return bytes(message.pack(dialect.MAVLink(None, system, 1)))


def test_what_passes_the_router_is_in_the_tlog_as_mavutil_reads_it(tmp_path: Path) -> None:
    clock, port = ManualClock(unix_ns=1_800_000_000_000_000_000), free_port()
    config = parse_config({"mavlink": {"url": f"udpin://127.0.0.1:{port}"}})
    recorder = Recorder(tmp_path / "flight.mcap", config, clock)
    heard, codec = asyncio.Event(), MavlinkCodec(system=1)
    router = Router(config.mavlink, codec, Nobody(), clock, lambda events: heard.set())
    router.on_packet = recorder.packet

    async def exchange() -> None:
        await router.open()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            peer.sendto(
                packed(dialect.MAVLink_attitude_quaternion_message(5, 1, 0, 0, 0, 0, 0, 0))
                + packed(dialect.MAVLink_setup_signing_message(1, 196, list(range(32)), 7)),
                ("127.0.0.1", port),
            )
            await heard.wait()
        clock.advance(0.5)
        router.send(codec.encode_statustext(6, "x" * 60))  # two packets at once
        await router.close()

    asyncio.run(exchange())
    recorder.close()
    path = tmp_path / "flight.tlog"
    read = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    found = []
    while (message := read.recv_match()) is not None:
        found.append((message.get_type(), message._timestamp, message.get_srcComponent()))
    read.close()
    assert found == [
        ("ATTITUDE_QUATERNION", 1_800_000_000.0, 1),
        ("STATUSTEXT", 1_800_000_000.5, 196),
        ("STATUSTEXT", 1_800_000_000.5, 196),
    ]
    assert bytes(range(32)) not in path.read_bytes()  # the key
    assert [unix_us for unix_us, _ in read_tlog(path)] == [1_800_000_000_000_000] + 2 * [1_800_000_000_500_000]


def test_an_entry_cut_short_ends_the_reading(tmp_path: Path) -> None:
    packet = packed(dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
    path = tmp_path / "cut.tlog"
    path.write_bytes(entry(1, packet) + entry(2, packet)[:-1])
    assert list(read_tlog(path)) == [(1, packet)]


def test_only_the_key_is_secret() -> None:
    assert is_secret(packed(dialect.MAVLink_setup_signing_message(1, 1, [0] * 32, 0)))
    assert not is_secret(packed(dialect.MAVLink_statustext_message(1, b"x", 0, 0)))
