"""TCP links: a server for one client, a client that reconnects."""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from functools import partial

from companion.clock import Clock
from companion.link.url import FIRST_RETRY_S, LAST_RETRY_S, MAX_BACKLOG_BYTES, OnBytes, TransportUrl

DEAD_MS = 5000  # what we sent is not acknowledged: the connection is lost


class _StreamPeer(asyncio.Protocol):
    """One TCP connection of a `TcpServer` or `TcpClient`."""

    def __init__(self, on_bytes: OnBytes, counts: Counter[str]) -> None:
        self.lost: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._on_bytes = on_bytes
        self._counts = counts
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        stream = transport.get_extra_info("socket")
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_BACKLOG_BYTES)  # the default holds minutes
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # a peer without power says no goodbye: the kernel waits 15 min for it
            stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, DEAD_MS)
        transport.set_write_buffer_limits(high=0)

    def data_received(self, data: bytes) -> None:
        self._counts["bytes_in"] += len(data)
        self._on_bytes(data)

    def connection_lost(self, exc: Exception | None) -> None:
        if not self.lost.done():
            self.lost.set_result(None)

    def send(self, data: bytes) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        if transport.get_write_buffer_size():  # the kernel is full: this one would leave behind stale ones
            self._counts["dropped"] += 1
            return
        transport.write(data)
        self._counts["bytes_out"] += len(data)

    def abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()


class TcpServer:
    """Listens for one client. Two streams in one parser would tear each other's packets: the newest wins."""

    def __init__(self, on_bytes: OnBytes) -> None:
        self.counts: Counter[str] = Counter()
        self._on_bytes = on_bytes
        self._peer: _StreamPeer | None = None
        self._server: asyncio.Server | None = None

    @property
    def local_address(self) -> tuple[str, int]:
        assert self._server is not None
        host, port = self._server.sockets[0].getsockname()[:2]
        return host, port

    async def listen(self, url: TransportUrl) -> None:
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._accept, url.host, url.port)

    def send(self, data: bytes) -> None:
        if self._peer is not None:
            self._peer.send(data)

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
        if self._peer is not None:
            self._peer.abort()
        await asyncio.sleep(0)

    def _accept(self) -> _StreamPeer:
        if self._peer is not None:
            self._peer.abort()
        self._peer = _StreamPeer(self._on_bytes, self.counts)
        return self._peer


class TcpClient:
    """Connects and reconnects, 0.2 s after a failure, doubling up to 5 s."""

    def __init__(self, url: TransportUrl, on_bytes: OnBytes, clock: Clock) -> None:
        self.counts: Counter[str] = Counter()
        self._url = url
        self._on_bytes = on_bytes
        self._clock = clock
        self._peer: _StreamPeer | None = None
        self._task = asyncio.get_running_loop().create_task(self._keep_connected(), name="tcpout")

    def send(self, data: bytes) -> None:
        if self._peer is not None:
            self._peer.send(data)

    async def close(self) -> None:
        self._task.cancel()
        await asyncio.wait((self._task,))
        if self._peer is not None:
            self._peer.abort()
        await asyncio.sleep(0)

    async def _keep_connected(self) -> None:
        loop = asyncio.get_running_loop()
        retry_s = FIRST_RETRY_S
        while True:
            peer = _StreamPeer(self._on_bytes, self.counts)
            try:
                await loop.create_connection(partial(_same, peer), self._url.host, self._url.port)
            except OSError:
                self.counts["failed_connects"] += 1
                await self._clock.sleep(retry_s)
                retry_s = min(2.0 * retry_s, LAST_RETRY_S)
                continue
            self.counts["connects"] += 1
            retry_s = FIRST_RETRY_S
            self._peer = peer
            await peer.lost
            self._peer = None
            await self._clock.sleep(retry_s)


def _same(peer: _StreamPeer) -> _StreamPeer:
    return peer
