"""The daemon's Zenoh door against a plain Zenoh session, over loopback TCP."""

from __future__ import annotations

import asyncio
import json
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import zenoh

from companion.config_links import ZenohConfig
from companion.errors import ConfigError, FrameRejected
from companion.link import wire
from companion.link.inbox import MAX_PAYLOAD_BYTES
from companion.link.zenoh import ZenohHandlers, ZenohLink, open_session

pytestmark = pytest.mark.integration
PREFIX = "uav/test"


@pytest.fixture
def endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class Desk:
    """Records what the link hands over and answers commands."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, object]] = []
        self._changed = asyncio.Event()

    def note(self, what: str, value: object) -> None:
        assert asyncio.get_running_loop() is not None  # raises on any thread but the loop's
        self.seen.append((what, value))
        self._changed.set()

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(5.0):
            while not condition():
                self._changed.clear()
                await self._changed.wait()

    def handlers(self) -> ZenohHandlers:
        def target(command: wire.TargetCommand) -> wire.Reply:
            self.note("target", command)
            return wire.Reply(accepted=command.position == (1.0, 2.0, 3.0), reason="as told")

        def engage(command: wire.EngageCommand) -> wire.Reply:
            self.note("engage", command)
            return wire.Reply(accepted=True)

        def rejected(key: str, error: FrameRejected) -> None:
            self.note("rejected", (key, error.reason))

        return ZenohHandlers(
            on_obstacles=lambda *frame: self.note("obstacles", frame),
            on_marker=lambda *marker: self.note("marker", marker),
            on_vehicle=lambda *state: self.note("vehicle", state),
            on_target=target,
            on_engage=engage,
            config=lambda: b'{"mode":"normal"}',
            health=lambda: b'{"healthy":true}',
            on_rejected=rejected,
        )


class Pair:
    def __init__(self, endpoint: str, *, lockstep: bool = False) -> None:
        self.desk = Desk()
        config = ZenohConfig(listen=(endpoint,))
        self.link = ZenohLink.open(config, PREFIX, asyncio.get_running_loop(), self.desk.handlers(), lockstep=lockstep)
        self.peer = open_session(ZenohConfig(connect=(endpoint,)))

    async def __aenter__(self) -> Pair:
        probe = self.peer.declare_publisher(f"{PREFIX}/engage")
        async with asyncio.timeout(5.0):
            while not probe.matching_status.matching:
                await asyncio.sleep(0)
        probe.undeclare()
        return self

    async def __aexit__(self, *_: object) -> None:
        self.peer.close()
        self.link.close()

    async def ask(self, key: str, payload: bytes | None = None) -> dict[str, object]:
        def get() -> bytes:
            replies = list(self.peer.get(f"{PREFIX}/{key}", payload=payload, timeout=5.0))
            assert len(replies) == 1
            return replies[0].ok.payload.to_bytes()

        return json.loads(await asyncio.to_thread(get))


def test_frames_markers_and_vehicle_states_reach_the_loop_with_source_and_encoding(endpoint: str) -> None:
    async def scenario() -> None:
        async with Pair(endpoint) as pair:
            pair.peer.put(f"{PREFIX}/obstacles/lidar", b"{}", encoding="application/json")
            pair.peer.put(f"{PREFIX}/obstacles/camera", b"\x80", encoding="application/msgpack")
            pair.peer.put(f"{PREFIX}/sync/lidar", b"marker")
            pair.peer.put(f"{PREFIX}/vehicle/state", b"state")
            pair.peer.put("uav/other/obstacles/lidar", b"not ours")
            await pair.desk.until(lambda: len(pair.desk.seen) == 4)
            # across keys Zenoh promises no order; the inbox relies on none
            assert sorted(pair.desk.seen, key=str) == [
                ("marker", ("lidar", b"marker", "zenoh/bytes")),
                ("obstacles", ("camera", b"\x80", "application/msgpack")),
                ("obstacles", ("lidar", b"{}", "application/json")),
                ("vehicle", (b"state", "zenoh/bytes")),
            ]

    asyncio.run(scenario())


def test_target_and_engage_are_answered_and_refused_with_the_reason(endpoint: str) -> None:
    async def scenario() -> None:
        async with Pair(endpoint) as pair:
            assert await pair.ask("target", b'{"position":[1,2,3]}') == {"accepted": True, "reason": "as told"}
            assert await pair.ask("engage", msgspec.msgpack.encode({"engaged": True})) == {
                "accepted": True,
                "reason": "",
            }
            for key in ("target", "engage"):
                answer = await pair.ask(key, b'{"position":"far away","engaged":1}')
                assert answer["accepted"] is False
                assert "expected" in str(answer["reason"]).lower()
            nothing = await pair.ask("target")
            assert nothing["accepted"] is False
            assert [entry for entry in pair.desk.seen if entry[0] == "rejected"] == [
                ("rejected", ("target", "malformed")),
                ("rejected", ("engage", "malformed")),
                ("rejected", ("target", "malformed")),
            ]
            pair.peer.put(f"{PREFIX}/engage", b'{"engaged": false}')
            await pair.desk.until(lambda: ("engage", wire.EngageCommand(engaged=False)) in pair.desk.seen)

    asyncio.run(scenario())


def test_config_health_and_liveliness(endpoint: str) -> None:
    async def scenario() -> None:
        async with Pair(endpoint) as pair:
            assert await pair.ask("companion/config") == {"mode": "normal"}
            assert await pair.ask("companion/health") == {"healthy": True}
            alive = await asyncio.to_thread(lambda: list(pair.peer.liveliness().get("uav/*/companion/alive")))
            assert [str(reply.ok.key_expr) for reply in alive] == [f"{PREFIX}/companion/alive"]

    asyncio.run(scenario())


@pytest.mark.parametrize(
    ("lockstep", "congestion"),
    [(True, zenoh.CongestionControl.BLOCK), (False, zenoh.CongestionControl.DROP)],
)
def test_publishers_reach_subscribers_and_block_only_in_lockstep(
    endpoint: str, lockstep: bool, congestion: zenoh.CongestionControl
) -> None:
    async def scenario() -> None:
        async with Pair(endpoint, lockstep=lockstep) as pair:
            loop, heard = asyncio.get_running_loop(), asyncio.Queue()
            assert not pair.link.wanted("companion/vehicle")
            listening = pair.peer.declare_subscriber(
                f"{PREFIX}/companion/vehicle", lambda sample: loop.call_soon_threadsafe(heard.put_nowait, sample)
            )
            async with asyncio.timeout(5.0):
                while not pair.link.wanted("companion/vehicle"):
                    await asyncio.sleep(0)
                out = wire.VehicleOut(
                    stamp_ns=5, position=(1.0, 2.0, 3.0), velocity=(0.0, 0.0, 0.0), attitude=(1.0, 0.0, 0.0, 0.0)
                )
                pair.link.put("companion/vehicle", out)
                sample = await heard.get()
            assert json.loads(sample.payload.to_bytes())["position"] == [1.0, 2.0, 3.0]
            assert str(sample.encoding) == "application/json"
            assert sample.congestion_control == congestion
            assert not pair.link.wanted("companion/tracks")
            listening.undeclare()

    asyncio.run(scenario())


def test_a_flood_is_bounded_and_counted_while_the_loop_is_stuck(endpoint: str) -> None:
    async def scenario() -> None:
        async with Pair(endpoint) as pair:
            block = zenoh.CongestionControl.BLOCK
            flood = pair.peer.declare_publisher(f"{PREFIX}/obstacles/flood", congestion_control=block)
            for number in range(6000):  # the loop does not turn in here
                flood.put(b"%d" % number)
            flood.put(bytes(MAX_PAYLOAD_BYTES + 1))
            counts = pair.link.counts
            while counts["too_large"] == 0:  # puts arrive in order: all 6000 are in; pytest's time-out bounds this
                pass
            assert counts["received"] == 6000
            assert counts["dropped"] == 6000 - 4096
            await pair.desk.until(lambda: len(pair.desk.seen) == 4096)
            assert pair.desk.seen[-1] == ("obstacles", ("flood", b"5999", "zenoh/bytes"))

    asyncio.run(scenario())


def test_after_close_nothing_is_called_and_nothing_raises(endpoint: str) -> None:
    async def scenario() -> None:
        async with Pair(endpoint) as pair:
            pair.peer.put(f"{PREFIX}/obstacles/late", b"x")
            pair.link.close()
            pair.link.close()
            pair.link.put("companion/status", wire.Reply(accepted=True))
            assert not pair.link.wanted("companion/status")
            await asyncio.sleep(0)
            assert pair.desk.seen == []

    asyncio.run(scenario())


@pytest.fixture
def taken() -> Iterator[str]:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        yield f"tcp/127.0.0.1:{holder.getsockname()[1]}"


def test_endpoint_in_use_names_it(taken: str) -> None:
    with pytest.raises(ConfigError, match=rf"zenoh: cannot open .*{taken}.*in use") as caught:
        open_session(ZenohConfig(listen=(taken,)))
    assert "\n" not in str(caught.value)


def test_bad_endpoint_names_the_key() -> None:
    with pytest.raises(ConfigError, match=r"zenoh.connect: expected endpoints such as tcp/127.0.0.1:7447, got"):
        open_session(ZenohConfig(connect=("localhost",)))


def listening_sockets() -> set[str]:
    """Inodes of this process's TCP sockets in state LISTEN (0A), from /proc."""
    rows = [line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()]
    inodes = {f"socket:[{row[9]}]" for row in rows if row[3] == "0A"}
    return inodes & {os.readlink(fd) for fd in Path("/proc/self/fd").iterdir() if fd.is_symlink()}


def test_nothing_listens_unless_configured(endpoint: str) -> None:
    before = listening_sockets()
    for listen, more in ((), 0), ((endpoint,), 1):
        session = open_session(ZenohConfig(listen=listen))
        try:
            assert len(listening_sockets() - before) == more
        finally:
            session.close()
