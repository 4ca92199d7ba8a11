"""The whole service between an autopilot and a ground station on links of their own, signed and not."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.clock import SystemClock
from companion.config import parse_config
from companion.errors import ConfigError
from companion.link.signing import timestamp_at
from companion.metrics import Summary
from companion.service import Service
from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration

KEY = bytes(range(32))
OFFBOARD, HOLD = 6 << 16, 4 << 16 | 3 << 24
SETPOINT = "SET_POSITION_TARGET_LOCAL_NED"


class End:
    """One peer of the daemon: pymavlink over a UDP socket, with pymavlink's own signing."""

    def __init__(self, port: int, system: int, component: int, key: bytes | None) -> None:
        self._address = ("127.0.0.1", port)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.mav = dialect.MAVLink(None, system, component)
        self.mav.robust_parsing = True
        if key is not None:
            self.mav.signing.secret_key, self.mav.signing.sign_outgoing = key, True
            self.mav.signing.timestamp = (SystemClock().unix_ns() // 10_000) - 1_420_070_400 * 100_000
        self.received: list[Any] = []

    def send(self, message: Any) -> None:
        self.socket.sendto(message.pack(self.mav), self._address)

    def listen(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                self.received.extend(self.mav.parse_buffer(self.socket.recv(4096)) or [])

    def of(self, kind: str, component: int = 196) -> list[Any]:
        return [m for m in self.received if m.get_type() == kind and m.get_srcComponent() == component]


class World:
    def __init__(self, service: Service, autopilot: End, station: End) -> None:
        self.service, self.autopilot, self.station = service, autopilot, station
        self.mode = HOLD
        self._tick = 0

    async def fly(self) -> None:
        """One state of the vehicle; then listen to what it brought about."""
        self._tick += 1
        mav = self.autopilot.mav
        for message in (
            mav.heartbeat_encode(2, 12, 1 | 128, self.mode, 4),
            mav.extended_sys_state_encode(0, 2),
            mav.attitude_quaternion_encode(50 * self._tick, 1.0, 0, 0, 0, 0, 0, 0),
            mav.local_position_ned_encode(50 * self._tick, 0, 0, -2, 0, 0, 0),
        ):
            self.autopilot.send(message)
        self.station.send(self.station.mav.heartbeat_encode(6, 8, 0, 0, 4))
        await asyncio.sleep(0.02)
        self.autopilot.listen()
        self.station.listen()

    async def until(self, done: Callable[[], object]) -> None:
        async with asyncio.timeout(10.0):
            while not done():
                await self.fly()

    def command(self, number: int, component: int, *params: float) -> None:
        seven = [*params, *[0.0] * (7 - len(params))]
        self.station.send(self.station.mav.command_long_encode(1, component, number, 0, *seven))

    def modes(self) -> list[Any]:
        return [m for m in self.autopilot.of("COMMAND_LONG") if m.command == 176]

    async def activate(self) -> None:
        await self.until(lambda: self.autopilot.of(SETPOINT))
        self.command(92, 196, 1.0)
        await self.until(self.modes)
        self.mode = OFFBOARD
        await self.until(lambda: self.service._session.situation.state.value == "ACTIVE")


def run(
    script: Callable[[World], Awaitable[None]],
    *,
    daemon: dict[str, Any] | None = None,
    keys: tuple[bytes | None, bytes | None] = (None, None),
) -> Summary:
    onboard, ground = free_port(), free_port()

    async def all_three() -> Summary:
        link = {"url": f"udpin://127.0.0.1:{onboard}", "links": [f"udpin://127.0.0.1:{ground}"], "system_id": 1}
        zenoh = {"listen": [f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"]}
        service = Service(parse_config({"mavlink": link | (daemon or {}), "zenoh": zenoh}), SystemClock())
        world = World(service, End(onboard, 1, 1, keys[0]), End(ground, 255, 190, keys[1]))
        running = asyncio.create_task(service.run())
        try:
            await world.until(lambda: world.autopilot.received or running.done())
            await script(world)
        finally:
            world.mode = HOLD
            with contextlib.suppress(ConnectionRefusedError):
                await world.fly()
            service.stop()
            summary = await running
            world.autopilot.socket.close()
            world.station.socket.close()
        return summary

    return asyncio.run(all_three())


def test_an_operator_on_a_link_of_his_own() -> None:
    async def script(world: World) -> None:
        await world.activate()
        acks = world.station.of("COMMAND_ACK")
        assert [(m.command, m.result) for m in acks] == [(92, 0)]
        assert world.autopilot.of("COMMAND_ACK") == []  # on the link that asked, and there alone
        assert world.station.of(SETPOINT) == world.station.of("COMMAND_LONG") == []
        texts = [m.text for m in world.station.of("STATUSTEXT")]
        assert any(text.startswith("companion ACTIVE") for text in texts)
        assert world.station.of("HEARTBEAT")
        assert world.station.of("LOCAL_POSITION_NED", component=1) == []  # nothing is forwarded unasked

    assert "router.forwarded" not in run(script).counts


def test_forwarding_and_a_second_setpoint_sender() -> None:
    async def script(world: World) -> None:
        await world.activate()
        await world.until(lambda: world.station.of("LOCAL_POSITION_NED", component=1))
        world.autopilot.received.clear()
        world.station.send(
            world.station.mav.set_position_target_local_ned_encode(7, 1, 1, 1, 0xDF8, *[0] * 11)
        )  # as an Offboard plugin left running
        warning = "second setpoint sender: 255/190 SET_POSITION_TARGET_LOCAL_NED"
        await world.until(lambda: warning in "".join(m.text for m in world.station.of("STATUSTEXT")))
        assert len(world.autopilot.of(SETPOINT, component=190)) == 1
        world.command(400, 1, 0.0)
        await world.until(lambda: world.autopilot.of("COMMAND_LONG", component=190))

    summary = run(script, daemon={"forward": True})
    assert summary.counts["router.other_setpoints"] == 1
    assert summary.counts["router.forwarded"] > 10


def test_a_signed_flight_with_pymavlink_on_both_sides(tmp_path: Path) -> None:
    key, state = tmp_path / "key", tmp_path / "state"
    key.write_bytes(KEY)
    key.chmod(0o600)
    signing = {"key_file": str(key), "state_file": str(state)}
    intruder = dialect.MAVLink(None, 254, 190)

    async def script(world: World) -> None:
        await world.activate()
        own = [m for m in world.autopilot.received if m.get_srcComponent() == 196]
        assert own
        assert all(m.get_signed() for m in own)
        assert (world.autopilot.mav.signing.badsig_count, world.station.mav.signing.badsig_count) == (0, 0)
        unsigned = world.station.mav.command_long_encode(1, 196, 92, 0, *[0.0] * 7).pack(intruder)
        world.station.socket.sendto(unsigned, world.station._address)  # "release!"
        for _ in range(5):
            await world.fly()
        assert world.service._session.situation.state.value == "ACTIVE"

    summary = run(script, daemon={"signing": signing}, keys=(KEY, KEY))
    assert summary.counts["mavlink.unsigned"] == 1
    assert summary.counts.get("mavlink.bad_signature", 0) == 0
    first = json.loads(state.read_text())
    assert first["transmit"] <= timestamp_at(SystemClock().unix_ns())  # closed: no reserve is skipped
    assert {tuple(stream[:2]) for stream in first["streams"]} == {(1, 1), (255, 190)}

    run(script, daemon={"signing": signing}, keys=(KEY, KEY))  # a second flight goes on from there
    assert json.loads(state.read_text())["transmit"] > first["transmit"]


def test_a_vehicle_without_the_key_is_not_there(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_text("passphrase:secret\n")
    key.chmod(0o600)

    async def script(world: World) -> None:
        for _ in range(10):
            await world.fly()
        assert world.service._session.situation.state.value == "WAITING"

    summary = run(script, daemon={"signing": {"key_file": str(key)}}, keys=(KEY, None))
    assert summary.ticks == 0
    assert summary.counts["mavlink.bad_signature"] > 40
    assert summary.counts["mavlink.unsigned"] > 10


def test_a_key_that_others_may_read_stops_the_daemon_at_once(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_bytes(KEY)
    key.chmod(0o644)
    with pytest.raises(ConfigError, match=r"key_file .*key: expected mode 0600 or less"):
        Service(parse_config({"mavlink": {"signing": {"key_file": str(key)}}}), SystemClock())
