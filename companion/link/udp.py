"""UDP links: a socket of our own on the loop, so that nothing is ever queued behind it."""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from typing import Any

from companion.clock import Clock
from companion.link.url import OnBytes, TransportUrl
from companion.types import NS_PER_S

PEER_NS = 5 * NS_PER_S
MAX_PEERS = 16
# Read until the socket is empty before any task runs: a tick in the middle of a backlog would answer an old state.
# The bound is above what a receive buffer holds, so only a sender faster than this reader ever meets it; without it
# such a sender would keep the loop here for good.
_DRAIN = 4096  # datagrams

Address = tuple[Any, ...]  # (host, port) or IPv6's four


class UdpLink:
    """UDP in either direction.

    A listener answers every peer of the last 5 s, at most 16 of them and first come: random senders can neither
    steal the stream from the autopilot nor push it out of the table.
    """

    def __init__(self, sock: socket.socket, on_bytes: OnBytes, clock: Clock, *, fixed_peer: Address | None) -> None:
        self.counts: Counter[str] = Counter()
        self._socket = sock
        self._on_bytes = on_bytes
        self._clock = clock
        self._fixed_peer = fixed_peer
        self._heard_ns: dict[Address, int] = {}
        self._closed = False
        asyncio.get_running_loop().add_reader(sock, self._read)

    @property
    def local_address(self) -> tuple[str, int]:
        """Host and port on which this link listens."""
        host, port = self._socket.getsockname()[:2]
        return host, port

    @property
    def peers(self) -> tuple[Address, ...]:
        """To whom ``send`` sends."""
        if self._fixed_peer is not None:
            return (self._fixed_peer,)
        oldest_ns = self._clock.monotonic_ns() - PEER_NS
        self._heard_ns = {peer: heard for peer, heard in self._heard_ns.items() if heard >= oldest_ns}
        return tuple(self._heard_ns)

    def send(self, data: bytes) -> None:
        if self._closed:
            return
        for peer in self.peers:
            try:
                self._socket.sendto(data, peer)
            except BlockingIOError:
                self.counts["dropped"] += 1
            except OSError:
                self.counts["errors"] += 1  # no route or nobody there now: telemetry tells when that changes
            else:
                self.counts["bytes_out"] += len(data)

    async def close(self) -> None:
        if not self._closed:
            self._closed = True
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()

    def _read(self) -> None:
        for _ in range(_DRAIN):
            if self._closed:
                return
            try:
                data, peer = self._socket.recvfrom(65535)
            except BlockingIOError:
                return
            except OSError:
                self.counts["errors"] += 1
                return
            if self._fixed_peer is None and (peer in self._heard_ns or len(self.peers) < MAX_PEERS):
                self._heard_ns[peer] = self._clock.monotonic_ns()
            self.counts["bytes_in"] += len(data)
            self._on_bytes(data)


async def open_udp(url: TransportUrl, on_bytes: OnBytes, clock: Clock) -> UdpLink:
    """Bind (udpin) or aim (udpout). Raises OSError where the system refuses."""
    loop = asyncio.get_running_loop()
    listening = url.scheme == "udpin"
    found = await loop.getaddrinfo(url.host, url.port, type=socket.SOCK_DGRAM)
    family, kind, protocol, _, address = found[0]
    sock = socket.socket(family, kind, protocol)
    try:
        sock.setblocking(False)
        if listening:
            sock.bind(address)
    except OSError:
        sock.close()
        raise
    return UdpLink(sock, on_bytes, clock, fixed_peer=None if listening else address)
