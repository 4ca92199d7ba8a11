"""Datagrams that a test's socket hears while the event loop goes on."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable


async def listen(peer: socket.socket, for_s: float, take: Callable[[bytes], None]) -> None:
    """Give ``take`` each datagram that comes within ``for_s``.

    A reader of the loop, not ``sock_recv`` under a time limit: that loses the datagram which was read in the very
    turn of the loop in which the limit ran out.
    """

    def read() -> None:
        try:
            take(peer.recv(4096))
        except (BlockingIOError, ConnectionRefusedError):  # nothing after all; nobody there yet
            return

    loop = asyncio.get_running_loop()
    loop.add_reader(peer, read)
    try:
        await asyncio.sleep(for_s)
    finally:
        loop.remove_reader(peer)
