"""Several links at once: scripted peers on loopback sockets, pymavlink on both ends of each."""

from __future__ import annotations

import asyncio
import hashlib
import socket
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.clock import ManualClock
from companion.config import Config, parse_config
from companion.errors import ConfigError
from companion.link import mav
from companion.link.events import Command, Event, Heartbeat, StatusText
from companion.link.mavlink import MavlinkCodec
from companion.link.router import Router
from companion.link.signing import Signing
from sim_bridge.testing import free_port

LOOPBACK = "127.0.0.1"
KEY = bytes(range(32))


class Peer:
    """Somebody on the other end of one of the daemon's UDP links; several components may speak through it."""

    def __init__(self, port: int, *, key: bytes | None = None) -> None:
        self._key = key
        self._address = (LOOPBACK, port)
        self._stamp = 0
        self._senders: dict[tuple[int, int], dialect.MAVLink] = {}
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((LOOPBACK, 0))
        self.socket.setblocking(False)

    def pack(self, message: Any, system: int, component: int) -> bytes:
        sender = self._senders.setdefault((system, component), dialect.MAVLink(None, system, component))
        if self._key is not None and not sender.signing.sign_outgoing:
            sender.signing.secret_key, sender.signing.sign_outgoing = self._key, True
            sender.signing.timestamp = (1_700_000_000 - 1_420_070_400) * 100_000
        packet = bytes(message.pack(sender))
        sender.seq = (sender.seq + 1) % 256
        return packet

    def send(self, message: Any, system: int, component: int) -> bytes:
        packet = self.pack(message, system, component)
        self.socket.sendto(packet, self._address)
        return packet

    def raw(self, packet: bytes) -> None:
        self.socket.sendto(packet, self._address)

    def datagrams(self) -> list[bytes]:
        """Everything that has arrived by now."""
        received = []
        while True:
            try:
                received.append(self.socket.recv(65535))
            except BlockingIOError:
                return received

    def messages(self) -> list[Any]:
        parser = dialect.MAVLink(None)
        return [message for data in self.datagrams() for message in parser.parse_buffer(data) or []]

    def kinds(self) -> list[str]:
        return [message.get_type() for message in self.messages()]


class Operator:
    def __init__(self) -> None:
        self.flies = False
        self.said: list[str] = []

    def say(self, severity: int, text: str) -> None:
        assert severity == mav.SEVERITY_WARNING
        assert len(text) <= 50
        self.said.append(text)


class Scene:
    """A router with an autopilot, a ground station and a sensor on three links that have all been heard."""

    def __init__(self, *, key: bytes | None = None, **mavlink: Any) -> None:
        ports = [free_port() for _ in range(3)]
        urls = [f"udpin://{LOOPBACK}:{port}" for port in ports]
        self.config: Config = parse_config({"mavlink": {"url": urls[0], "links": urls[1:], **mavlink}})
        self.clock = ManualClock()
        signing = None if key is None else Signing(key, self.clock.unix_ns)
        self.codec = MavlinkCodec(system=1, signing=signing)
        self.operator = Operator()
        self.events: list[Event] = []
        self.router = Router(self.config.mavlink, self.codec, self.operator, self.clock, self.events.extend)
        self.peers = [Peer(port, key=key) for port in ports]
        self.autopilot, self.station, self.sensor = self.peers

    async def settle(self) -> None:
        """Loopback delivers at once; the readers run in the loop's next rounds."""
        for _ in range(5):
            await asyncio.sleep(0)

    async def greet(self) -> None:
        self.autopilot.send(heartbeat(autopilot=12), 1, 1)
        self.station.send(heartbeat(), 255, 190)
        self.sensor.send(heartbeat(), 1, 93)
        await self.settle()
        for peer in self.peers:
            peer.datagrams()
        self.events.clear()
        self.router.counts.clear()


def run(test: Callable[[Scene], Awaitable[None]], **settings: Any) -> None:
    async def main() -> None:
        scene = Scene(**settings)
        try:
            await scene.router.open()
            await scene.greet()
            await test(scene)
        finally:
            await scene.router.close()
            for peer in scene.peers:
                peer.socket.close()

    asyncio.run(main())


def heartbeat(autopilot: int = mav.AUTOPILOT_INVALID) -> Any:
    return dialect.MAVLink_heartbeat_message(6, autopilot, 0, 0, 4, 3)


def command(number: int, system: int, component: int) -> Any:
    return dialect.MAVLink_command_long_message(system, component, number, 0, 1, 0, 0, 0, 0, 0, 0)


def setpoint(system: int = 1, component: int = 1) -> Any:
    return dialect.MAVLink_set_position_target_local_ned_message(7, system, component, 1, 0xC3F, *[0] * 11)


def position() -> Any:
    return dialect.MAVLink_local_position_ned_message(7, 1, 2, 3, 4, 5, 6)


# what the daemon says itself


def test_our_own_messages_go_where_they_belong() -> None:
    async def script(scene: Scene) -> None:
        codec, router = scene.codec, scene.router
        router.send(codec.encode_heartbeat(4) + codec.encode_statustext(6, "x" * 60))
        for peer in scene.peers:
            assert peer.kinds() == ["HEARTBEAT", "STATUSTEXT", "STATUSTEXT"]
        router.send(codec.encode_setpoint(7, [0.0, 0.0, 0.0], 0xC3F))
        router.send(codec.encode_command_long(mav.CMD_DO_SET_MODE, (1, 6)))
        assert scene.autopilot.kinds() == ["SET_POSITION_TARGET_LOCAL_NED", "COMMAND_LONG"]
        assert scene.station.kinds() == scene.sensor.kinds() == []

    run(script)


def test_the_answer_goes_to_the_link_that_asked() -> None:
    async def script(scene: Scene) -> None:
        for peer, sender in ((scene.station, (255, 190)), (scene.autopilot, (254, 25))):
            peer.send(command(31_000, 1, 196), *sender)
            await scene.settle()
            (asked,) = scene.events
            scene.events.clear()
            assert isinstance(asked, Command)
            scene.router.send(scene.codec.encode_command_ack(asked, mav.RESULT_UNSUPPORTED))
            (answer,) = peer.messages()
            assert (answer.get_type(), answer.target_system, answer.target_component) == ("COMMAND_ACK", *sender)
            assert [other.kinds() for other in scene.peers if other is not peer] == [[], []]

    run(script)


def test_who_was_never_heard_is_looked_for_behind_the_autopilot() -> None:
    async def script(scene: Scene) -> None:
        unheard = Command(1, (0.0,) * 7, False, 0, 0, 0, 0.0, 99, 1, 1, 196)
        scene.router.send(scene.codec.encode_command_ack(unheard, 0))
        assert (scene.autopilot.kinds(), scene.station.kinds(), scene.sensor.kinds()) == (["COMMAND_ACK"], [], [])

    run(script)


# what passes between the links


def test_nothing_is_passed_on_unless_configured() -> None:
    async def script(scene: Scene) -> None:
        scene.autopilot.send(position(), 1, 1)
        scene.station.send(command(400, 1, 1), 255, 190)
        scene.station.send(setpoint(), 255, 190)
        await scene.settle()
        assert [peer.kinds() for peer in scene.peers] == [[], [], []]
        assert scene.router.counts["other_setpoints"] == 0  # it reached nobody

    run(script)


def test_broadcast_goes_to_all_others_and_targets_where_they_live() -> None:
    async def script(scene: Scene) -> None:
        sent = scene.autopilot.send(position(), 1, 1)
        await scene.settle()
        assert scene.station.datagrams() == scene.sensor.datagrams() == [sent]  # to the byte
        sent = scene.station.send(command(400, 1, 1), 255, 190)
        await scene.settle()
        assert scene.autopilot.datagrams() == [sent]
        scene.station.send(command(400, 1, 77), 255, 190)  # never heard
        scene.station.send(command(92, 1, 196), 255, 190)  # ours alone
        await scene.settle()
        whole = scene.sensor.send(command(400, 1, 0), 1, 93)  # all of our system, of which we are
        await scene.settle()
        assert scene.autopilot.datagrams() == [whole]
        assert scene.station.datagrams() == scene.sensor.datagrams() == []
        ack = dialect.MAVLink_command_ack_message(400, 0, 0, 0, 255, 190)
        answer = scene.autopilot.send(ack, 1, 1)
        await scene.settle()
        assert scene.station.datagrams() == [answer]
        assert scene.autopilot.datagrams() == scene.sensor.datagrams() == []  # never back
        assert scene.router.counts["forwarded"] == 5

    run(script, forward=True)


def test_an_old_packet_passes_as_it_came() -> None:
    async def script(scene: Scene) -> None:
        packet = bytes(heartbeat().pack(dialect.MAVLink(None, 255, 190), force_mavlink1=True))
        scene.station.raw(packet)
        await scene.settle()
        assert scene.autopilot.datagrams() == [packet]

    run(script, forward=True)


def test_messages_outside_the_dialect_pass_if_they_are_packets() -> None:
    async def script(scene: Scene) -> None:
        unknown = b"\xfd\x04\x00\x00\x00\x01\x01\xaa\xaa\xaaabcd\x12\x34"
        scene.autopilot.raw(unknown)
        scene.autopilot.raw(b"noise" + unknown + b"noise")
        await scene.settle()
        assert scene.station.datagrams() == [unknown]

    run(script, forward=True)


def test_what_concerns_one_link_stays_there() -> None:
    async def script(scene: Scene) -> None:
        scene.autopilot.send(dialect.MAVLink_radio_status_message(1, 2, 3, 4, 5, 6, 7), 51, 68)
        scene.station.send(dialect.MAVLink_setup_signing_message(1, 1, list(KEY), 5), 255, 190)
        await scene.settle()
        assert [peer.kinds() for peer in scene.peers] == [[], [], []]

    run(script, forward=True)


# whose word counts


def test_the_vehicles_autopilot_speaks_on_its_own_link_only() -> None:
    async def script(scene: Scene) -> None:
        scene.station.send(position(), 1, 1)  # a loop, or somebody who would like to be it
        scene.station.send(heartbeat(autopilot=12), 1, 1)
        scene.station.send(heartbeat(autopilot=3), 2, 1)  # a neighbour's must not disturb the choice of ours
        scene.station.send(heartbeat(), 1, 196)  # our own words come back
        await scene.settle()
        assert scene.events == []
        assert scene.router.counts["looped"] == 3
        assert [m.get_srcSystem() for m in scene.autopilot.messages()] == [2]  # passed on all the same
        assert [m.get_srcSystem() for m in scene.sensor.messages()] == [2]
        scene.router.send(scene.codec.encode_setpoint(7, [0.0, 0.0, 0.0], 0xC3F))
        assert scene.station.kinds() == []  # nor did it learn a false address
        scene.autopilot.send(position(), 1, 1)
        scene.station.send(dialect.MAVLink_statustext_message(6, b"hello", 0, 0), 255, 190)
        await scene.settle()
        assert {type(event).__name__ for event in scene.events} == {"Position", "StatusText"}

    run(script, forward=True)


def test_every_link_has_its_own_stream() -> None:
    """Half a packet on one link does not swallow the other's bytes."""

    async def script(scene: Scene) -> None:
        packet = scene.station.pack(dialect.MAVLink_statustext_message(6, b"halves", 0, 0), 255, 190)
        scene.station.raw(packet[:15])
        await scene.settle()
        scene.autopilot.send(heartbeat(autopilot=12), 1, 1)
        await scene.settle()
        scene.station.raw(packet[15:])
        await scene.settle()
        assert [type(event) for event in scene.events] == [Heartbeat, StatusText]

    run(script)


# a second sender of setpoints


@pytest.mark.parametrize("blocks", [False, True])
def test_a_second_setpoint_sender_is_told_and_blocked_on_request(blocks: bool) -> None:
    async def script(scene: Scene) -> None:
        async def another(message: Any, sender: tuple[int, int] = (255, 190)) -> list[str]:
            scene.station.send(message, *sender)
            await scene.settle()
            kinds: list[str] = scene.autopilot.kinds()
            return kinds

        kind = "SET_POSITION_TARGET_LOCAL_NED"
        assert await another(setpoint()) == [kind]  # while we do not fly, it is theirs to fly
        assert scene.operator.said == []
        scene.operator.flies = True
        assert await another(setpoint()) == ([] if blocks else [kind])
        assert await another(setpoint(component=0)) == ([] if blocks else [kind])
        assert scene.operator.said == ["setpoints of 255/190 are blocked"] * blocks  # once, not at 20 Hz
        await another(setpoint(), (254, 25))
        assert len(scene.operator.said) == 2 * blocks
        assert await another(setpoint(system=2)) == []  # another vehicle's: nobody's business here
        scene.clock.advance(10.0)
        scene.autopilot.send(setpoint(), 255, 190)  # heard by radio: past blocking
        await scene.settle()
        assert len(scene.operator.said) == 2 * blocks
        assert scene.router.counts["other_setpoints"] == 5
        assert scene.router.counts["blocked_setpoints"] == (3 if blocks else 0)
        assert await another(command(400, 1, 1)) == ["COMMAND_LONG"]  # a pilot's commands pass always

    run(script, forward=True, block_other_setpoints=blocks)


def test_our_own_setpoints_are_no_second_sender() -> None:
    async def script(scene: Scene) -> None:
        scene.operator.flies = True
        scene.autopilot.send(setpoint(), 1, 196)  # a forwarding autopilot
        await scene.settle()
        assert scene.operator.said == []

    run(script, forward=True)


# signing


def test_signed_links_pass_on_what_is_proven_with_its_own_signature() -> None:
    async def script(scene: Scene) -> None:
        sent = scene.station.send(command(400, 1, 1), 255, 190)
        await scene.settle()
        (arrived,) = scene.autopilot.datagrams()
        assert arrived == sent
        assert arrived[-6:] == hashlib.sha256(KEY + arrived[:-6]).digest()[:6]
        forged = Peer(1, key=b"x" * 32)
        with forged.socket:
            scene.station.raw(forged.pack(command(400, 1, 1), 255, 190))
        scene.station.raw(bytes(command(400, 1, 1).pack(dialect.MAVLink(None, 255, 190))))
        scene.station.raw(sent)  # recorded
        scene.sensor.raw(sent)  # and played on another link
        await scene.settle()
        assert scene.autopilot.datagrams() == []
        counts = scene.codec.counts
        assert (counts["bad_signature"], counts["unsigned"], counts["replayed"]) == (1, 1, 2)

    run(script, key=KEY, forward=True)


def test_unknown_messages_pass_signed_links_only_if_proven() -> None:
    async def script(scene: Scene) -> None:
        body = b"\xfd\x04\x01\x00\x00\x01\x01\xaa\xaa\xaaabcd\x12\x34\x00"
        body += ((1_700_000_001 - 1_420_070_400) * 100_000).to_bytes(6, "little")
        proven = body + hashlib.sha256(KEY + body).digest()[:6]
        scene.autopilot.raw(b"\xfd\x04\x00\x00\x00\x01\x01\xaa\xaa\xaaabcd\x12\x34")
        scene.autopilot.raw(body + bytes(6))
        scene.autopilot.raw(proven)
        scene.autopilot.raw(proven)
        await scene.settle()
        assert scene.station.datagrams() == [proven]

    run(script, key=KEY, forward=True)


def test_every_link_gets_signed_packets() -> None:
    async def script(scene: Scene) -> None:
        scene.router.send(scene.codec.encode_heartbeat(4))
        for peer in scene.peers:
            (packet,) = peer.datagrams()
            assert packet[-6:] == hashlib.sha256(KEY + packet[:-6]).digest()[:6]
            assert packet[-13] == scene.peers.index(peer)  # each link is a stream of its own

    run(script, key=KEY)


# opening and closing


def test_a_link_that_cannot_be_opened_is_named_and_the_others_are_closed() -> None:
    async def scenario() -> None:
        first, taken = free_port(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with taken:
            taken.bind((LOOPBACK, 0))
            url = f"udpin://{LOOPBACK}:{taken.getsockname()[1]}"
            config = parse_config({"mavlink": {"url": f"udpin://{LOOPBACK}:{first}", "links": [url]}})
            router = Router(config.mavlink, MavlinkCodec(), Operator(), ManualClock(), list)
            router.send(MavlinkCodec().encode_heartbeat(4))  # nowhere yet
            with pytest.raises(ConfigError, match=rf"^mavlink\.links {url}: cannot be opened"):
                await router.open()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
            again.bind((LOOPBACK, first))

    asyncio.run(scenario())


@pytest.mark.parametrize(
    ("links", "message"),
    [
        (["udpin://127.0.0.1:1", "udpin://127.0.0.1:1"], r"mavlink\.links .*: expected another URL"),
        (["udpin://0.0.0.0:14540"], r"mavlink\.links .*: expected another URL"),
        (["udp://x"], r"mavlink\.links udp://x: expected udpin"),
    ],
)
def test_bad_links_are_named(links: list[str], message: str) -> None:
    async def scenario() -> None:
        config = parse_config({"mavlink": {"url": "udpin://0.0.0.0:14540", "links": links}})
        with pytest.raises(ConfigError, match=message):
            await Router(config.mavlink, MavlinkCodec(), Operator(), ManualClock(), list).open()

    asyncio.run(scenario())


def test_counts_name_their_link() -> None:
    async def script(scene: Scene) -> None:
        scene.station.send(heartbeat(), 1, 196)
        await scene.settle()
        counts = scene.router.all_counts()
        assert counts["router.looped"] == 1
        assert counts["link0.bytes_in"] == counts["link2.bytes_in"] == 21
        assert counts["link1.bytes_in"] == 42

    run(script)
