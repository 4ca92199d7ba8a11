"""Real sockets and a real pseudo-terminal on loopback: what arrives, who is answered, what is refused."""

from __future__ import annotations

import asyncio
import os
import socket
import tty
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import pytest

from companion.clock import ManualClock
from companion.errors import ConfigError
from companion.link.transports import Transport, open_transport, parse_url
from companion.link.url import MAX_BACKLOG_BYTES

LOOPBACK = "127.0.0.1"


class Inbox:
    def __init__(self) -> None:
        self.data = b""
        self._changed = asyncio.Event()

    def __call__(self, data: bytes) -> None:
        self.data += data
        self._changed.set()

    async def until(self, wanted: bytes) -> None:
        async with asyncio.timeout(5.0):
            while wanted not in self.data:
                self._changed.clear()
                await self._changed.wait()


class Waits(ManualClock):
    """Remembers how long was asked to sleep."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: list[float] = []

    async def sleep(self, seconds: float) -> None:
        self.waits.append(seconds)
        await super().sleep(seconds)


@asynccontextmanager
async def opened(url: str, inbox: Inbox, clock: ManualClock | None = None) -> AsyncIterator[Transport]:
    transport = await open_transport(url, inbox, clock=clock)
    try:
        yield transport
    finally:
        await transport.close()


def udp_socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind((LOOPBACK, 0))
    sock.settimeout(5.0)
    return sock


def run(test: Callable[[], Awaitable[None]]) -> None:
    async def main() -> None:
        await test()

    asyncio.run(main())


def test_udpin_answers_every_peer_of_the_last_five_seconds() -> None:
    async def scenario() -> None:
        inbox, clock = Inbox(), ManualClock()
        async with opened(f"udpin://{LOOPBACK}:0", inbox, clock) as link:
            first, second = udp_socket(), udp_socket()
            with first, second:
                link.send(b"nobody")  # nobody was heard yet
                first.sendto(b"one", link.local_address)
                await inbox.until(b"one")
                clock.advance(3.0)
                second.sendto(b"two", link.local_address)
                await inbox.until(b"two")
                link.send(b"both")
                assert first.recv(100) == second.recv(100) == b"both"
                clock.advance(3.0)  # the first was last heard 6 s ago, the second 3 s
                link.send(b"late")
                assert second.recv(100) == b"late"
                first.setblocking(False)
                with pytest.raises(BlockingIOError):
                    first.recv(100)

    run(scenario)


def test_udpin_random_senders_cannot_push_the_autopilot_out() -> None:
    async def scenario() -> None:
        inbox, clock = Inbox(), ManualClock()
        async with opened(f"udpin://{LOOPBACK}:0", inbox, clock) as link:
            autopilot, others = udp_socket(), [udp_socket() for _ in range(30)]
            with autopilot:
                autopilot.sendto(b"pilot", link.local_address)
                await inbox.until(b"pilot")
                for number, other in enumerate(others):
                    other.sendto(b"<%d>" % number, link.local_address)
                    await inbox.until(b"<%d>" % number)
                    other.close()
                assert autopilot.getsockname() in link.peers
                assert len(link.peers) == 16

    run(scenario)


def test_udpin_follows_a_peer_that_comes_back_on_another_port() -> None:
    async def scenario() -> None:
        inbox, clock = Inbox(), ManualClock()
        async with opened(f"udpin://{LOOPBACK}:0", inbox, clock) as link:
            with udp_socket() as before:
                before.sendto(b"one", link.local_address)
                await inbox.until(b"one")
            clock.advance(5.1)
            link.send(b"nobody")  # it is gone, and forgotten
            assert link.peers == ()
            with udp_socket() as after:
                after.sendto(b"two", link.local_address)
                await inbox.until(b"two")
                link.send(b"welcome")
                assert after.recv(100) == b"welcome"

    run(scenario)


def test_udpout_goes_on_when_its_peer_was_away() -> None:
    async def scenario() -> None:
        inbox = Inbox()
        with udp_socket() as peer:
            port = peer.getsockname()[1]
        async with opened(f"udpout://{LOOPBACK}:{port}", inbox) as link:
            for _ in range(3):
                link.send(b"lost")  # refused by the system's ICMP: nothing to stop for
                await asyncio.sleep(0)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as back:
                back.bind((LOOPBACK, port))
                back.settimeout(5.0)
                link.send(b"found")
                data, address = back.recvfrom(100)
                assert data == b"found"
                back.sendto(b"answer", address)
                await inbox.until(b"answer")

    run(scenario)


def test_udpout_sends_and_hears_the_answer() -> None:
    async def scenario() -> None:
        inbox = Inbox()
        with udp_socket() as peer:
            async with opened(f"udpout://{LOOPBACK}:{peer.getsockname()[1]}", inbox) as link:
                link.send(b"hello")
                data, address = peer.recvfrom(100)
                assert data == b"hello"
                peer.sendto(b"answer", address)
                await inbox.until(b"answer")
                assert link.counts == {"bytes_out": 5, "bytes_in": 6}

    run(scenario)


def test_tcp_pair_both_ways_and_reconnect() -> None:
    async def scenario() -> None:
        heard, answered = Inbox(), Inbox()
        async with opened(f"tcpin://{LOOPBACK}:0", heard) as server:
            port = server.local_address[1]
            clock = ManualClock()
            async with opened(f"tcpout://{LOOPBACK}:{port}", answered, clock) as client:
                while client.counts["connects"] == 0 or not client.counts["bytes_out"]:
                    client.send(b"a")
                    await asyncio.sleep(0)
                await heard.until(b"a")
                server.send(b"b")
                await answered.until(b"b")
                # a second client takes the place of the first, which comes back after its retry time
                _, writer = await asyncio.open_connection(LOOPBACK, port)
                writer.write(b"c")
                await heard.until(b"c")
                async with asyncio.timeout(5.0):
                    while client.counts["connects"] < 2:
                        clock.advance(0.2)
                        await asyncio.sleep(0)
                writer.close()

    run(scenario)


def test_tcpin_takes_its_client_back() -> None:
    async def scenario() -> None:
        inbox = Inbox()
        async with opened(f"tcpin://{LOOPBACK}:0", inbox) as server, asyncio.timeout(5.0):
            for word in (b"once", b"again"):
                server.send(b"nobody")
                reader, writer = await asyncio.open_connection(*server.local_address)
                writer.write(word)
                await inbox.until(word)
                server.send(b"<" + word + b">")
                assert await reader.readexactly(len(word) + 2) == b"<" + word + b">"
                writer.close()
                await writer.wait_closed()

    run(scenario)


async def waits_of(clock: Waits, count: int, failed: Callable[[], int]) -> list[float]:
    """The first ``count`` waits between attempts, each let pass in full and not before."""
    async with asyncio.timeout(5.0):
        for number in range(count):
            while len(clock.waits) <= number:
                await asyncio.sleep(0)
            before = failed()
            clock.advance(0.99 * clock.waits[number])
            for _ in range(5):
                await asyncio.sleep(0)
            assert failed() == before
            clock.advance(0.02 * clock.waits[number])
    return clock.waits[:count]


def test_tcpout_retries_later_and_later() -> None:
    async def scenario() -> None:
        with socket.socket() as placeholder:
            placeholder.bind((LOOPBACK, 0))
            port = placeholder.getsockname()[1]
        clock = Waits()
        async with opened(f"tcpout://{LOOPBACK}:{port}", Inbox(), clock) as client:
            waits = await waits_of(clock, 7, lambda: client.counts["failed_connects"])
            assert waits == [0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]
            async with opened(f"tcpin://{LOOPBACK}:{port}", Inbox()), asyncio.timeout(5.0):
                while client.counts["connects"] == 0:
                    clock.advance(5.0)
                    await asyncio.sleep(0)
            async with asyncio.timeout(5.0):  # lost after it was there: from the beginning
                seen = len(clock.waits)
                while len(clock.waits) == seen:
                    await asyncio.sleep(0)
            assert clock.waits[-1] == 0.2

    run(scenario)


def test_tcpout_waits_for_a_peer_that_is_not_there_yet() -> None:
    async def scenario() -> None:
        with socket.socket() as placeholder:
            placeholder.bind((LOOPBACK, 0))
            port = placeholder.getsockname()[1]
        clock, inbox = ManualClock(), Inbox()
        async with opened(f"tcpout://{LOOPBACK}:{port}", inbox, clock) as client, asyncio.timeout(5.0):
            client.send(b"lost")
            while client.counts["failed_connects"] < 2:
                clock.advance(0.4)
                await asyncio.sleep(0)
            async with opened(f"tcpin://{LOOPBACK}:{port}", Inbox()):
                while client.counts["connects"] == 0:
                    clock.advance(5.0)
                    await asyncio.sleep(0)

    run(scenario)


def test_udp_backlog_is_read_before_any_task_runs() -> None:
    async def scenario() -> None:
        inbox = Inbox()
        async with opened(f"udpin://{LOOPBACK}:0", inbox) as link:
            with udp_socket() as sender:
                for number in range(200):  # what waits after a pause of this process
                    sender.sendto(b"<%d>" % number, link.local_address)
            await inbox.until(b"<0>")  # the first task to run after the reader
            assert inbox.data.endswith(b"<199>")

    run(scenario)


def test_tcp_drops_what_a_stalled_peer_does_not_take() -> None:
    async def scenario() -> None:
        async with opened(f"tcpin://{LOOPBACK}:0", Inbox()) as server:
            with socket.socket() as peer:
                peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # leaves the sender's buffers to be seen
                peer.connect(server.local_address)
                peer.send(b"x")
                async with asyncio.timeout(5.0):
                    while server.counts["bytes_in"] == 0:
                        await asyncio.sleep(0)
                setpoint = bytes(65)
                for _ in range(10_000):
                    server.send(setpoint)
                accepted = server.counts["bytes_out"]
                assert accepted + server.counts["dropped"] * len(setpoint) == 10_000 * len(setpoint)
                assert accepted <= 4 * MAX_BACKLOG_BYTES
                assert server._peer._transport.get_write_buffer_size() <= len(setpoint)

    run(scenario)


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="Linux only")
def test_tcp_gives_up_on_a_peer_that_acknowledges_nothing() -> None:
    """A peer without power says no goodbye; loopback cannot show that, so the option is looked at on both ends."""

    async def scenario() -> None:
        async with opened(f"tcpin://{LOOPBACK}:0", Inbox()) as server:
            url = f"tcpout://{LOOPBACK}:{server.local_address[1]}"
            async with opened(url, Inbox(), ManualClock()) as client, asyncio.timeout(5.0):
                while client._peer is None or server._peer is None or server._peer._transport is None:
                    await asyncio.sleep(0)
                for end in (client, server):
                    stream = end._peer._transport.get_extra_info("socket")
                    assert stream.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 5000

    run(scenario)


def test_serial_pty_both_ways_raw() -> None:
    async def scenario() -> None:
        master, slave = os.openpty()
        tty.setraw(master)
        inbox = Inbox()
        try:
            async with opened(f"serial://{os.ttyname(slave)}:57600", inbox) as port:
                every_byte = bytes(range(256))  # a terminal that is not raw would eat or change some
                os.write(master, every_byte)
                await inbox.until(every_byte)
                port.send(every_byte)
                received = b""
                while len(received) < 256:
                    received += os.read(master, 256)
                assert received == every_byte
        finally:
            os.close(slave)
            os.close(master)

    run(scenario)


def test_serial_lost_device_is_opened_again(tmp_path: object) -> None:
    async def scenario() -> None:
        link = f"{tmp_path}/tty"
        master, slave = os.openpty()
        os.symlink(os.ttyname(slave), link)
        inbox, clock = Inbox(), ManualClock()
        async with opened(f"serial://{link}:57600", inbox, clock) as port, asyncio.timeout(5.0):
            os.close(slave)
            os.close(master)  # unplugged
            while port.counts["losses"] == 0:
                await asyncio.sleep(0)
            port.send(b"nowhere")
            master, slave = os.openpty()
            tty.setraw(master)
            os.unlink(link)
            os.symlink(os.ttyname(slave), link)
            for _ in range(3):
                await asyncio.sleep(0)
                clock.advance(5.0)
            os.write(master, b"back")
            await inbox.until(b"back")
        os.close(slave)
        os.close(master)

    run(scenario)


def test_serial_retries_later_and_later(tmp_path: object) -> None:
    async def scenario() -> None:
        link = f"{tmp_path}/tty"
        master, slave = os.openpty()
        os.symlink(os.ttyname(slave), link)
        clock = Waits()
        async with opened(f"serial://{link}:57600", Inbox(), clock) as port:
            os.unlink(link)
            os.close(slave)
            os.close(master)
            waits = await waits_of(clock, 6, lambda: port.counts["failed_connects"])
            assert waits == [0.2, 0.4, 0.8, 1.6, 3.2, 5.0]

    run(scenario)


@pytest.mark.parametrize("scheme", ["udpin", "tcpin"])
def test_port_in_use_names_the_url(scheme: str) -> None:
    kind = socket.SOCK_DGRAM if scheme == "udpin" else socket.SOCK_STREAM
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind((LOOPBACK, 0))
        if scheme == "tcpin":
            taken.listen()
        url = f"{scheme}://{LOOPBACK}:{taken.getsockname()[1]}"

        async def scenario() -> None:
            with pytest.raises(ConfigError, match=rf"{url}: cannot be opened .*in use.*expected a free port"):
                await open_transport(url, Inbox())

        run(scenario)


@pytest.mark.parametrize("device", ["/dev/no-such-port", "/dev/null"])
def test_serial_that_is_none_names_the_url(device: str) -> None:
    async def scenario() -> None:
        with pytest.raises(ConfigError, match=f"serial://{device}:57600: cannot be opened"):
            await open_transport(f"serial://{device}:57600", Inbox())

    run(scenario)


@pytest.mark.parametrize(
    "url",
    [
        "udp://127.0.0.1:14540",
        "udpin://127.0.0.1",
        "udpin://:14540",
        "udpin://127.0.0.1:70000",
        "udpout://127.0.0.1:0",
        "tcpout://127.0.0.1:x",
        "serial://ttyS0:57600",
        "serial:///dev/ttyS0",
        "serial:///dev/ttyS0:57601",
        "",
        "udpin://127.0.0.1:14540 ",
    ],
)
def test_bad_urls_name_the_expectation(url: str) -> None:
    with pytest.raises(ConfigError, match="expected") as caught:
        parse_url(url)
    assert url in str(caught.value)
    assert "\n" not in str(caught.value)


def test_good_urls() -> None:
    parsed = parse_url("serial:///dev/ttyTHS1:921600")
    assert (parsed.scheme, parsed.host, parsed.port) == ("serial", "/dev/ttyTHS1", 921600)
    parsed = parse_url("udpin://[::1]:14540")
    assert (parsed.scheme, parsed.host, parsed.port) == ("udpin", "::1", 14540)
