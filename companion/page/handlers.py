"""The page's side of the HTTP server: its files, its WebSocket, and the operator's commands.

A browser is given the newest message ten times a second and never more than it takes: each has its own task, which
waits for its socket alone. One that takes nothing for SEND_S is cut off.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from importlib import resources

from aiohttp import web
from aiohttp.typedefs import Handler

from companion.clock import Clock
from companion.http import HttpServer, same_origin
from companion.page.access import Access
from companion.page.feed import PERIOD_S, PageFeed

log = logging.getLogger("companion")

MAX_CLIENTS = 8
SEND_S = 5.0  # of wall time
HEARTBEAT_S = 10.0  # a browser that does not answer a ping is gone
_TYPES = {"html": "text/html", "js": "text/javascript", "css": "text/css"}


class Page:
    """Adds itself to ``server``. ``clients`` is the number of browsers that watch."""

    def __init__(self, server: HttpServer, feed: PageFeed, access: Access, clock: Clock) -> None:
        self._feed = feed
        self._clock = clock
        self._watching: list[web.Request] = []
        for name, content in _files().items():
            server.add("GET", "/" if name == "index.html" else f"/{name}", _file(name, content))
        server.add("GET", "/feed", self._stream)
        server.add("POST", "/api/engage", access.engage)
        server.add("POST", "/api/target", access.target)
        server.on_stop(self._end)

    @property
    def clients(self) -> int:
        return len(self._watching)

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        """The WebSocket: messages out, nothing in."""
        if not same_origin(request):
            raise web.HTTPForbidden(reason="expected a page of this server")
        if len(self._watching) >= MAX_CLIENTS:
            raise web.HTTPServiceUnavailable(reason=f"expected at most {MAX_CLIENTS} who watch")
        socket = web.WebSocketResponse(timeout=SEND_S, heartbeat=HEARTBEAT_S, compress=False, max_msg_size=1024)
        self._watching.append(request)
        sending = None
        try:
            await socket.prepare(request)
            sending = asyncio.create_task(self._send(request, socket))
            await socket.receive()  # a browser has nothing to say: whatever comes is the end
        finally:
            self._watching.remove(request)
            if sending is not None:
                sending.cancel()
                await asyncio.gather(sending, return_exceptions=True)
        with contextlib.suppress(ConnectionError):
            await socket.close(drain=False)
        return socket

    async def _send(self, request: web.Request, socket: web.WebSocketResponse) -> None:
        """The newest message again and again, until the browser is gone, stuck, or a message cannot be made."""
        first = True
        try:
            while not socket.closed:
                async with asyncio.timeout(SEND_S):
                    await socket.send_str(self._feed.message(first=first).decode())
                first = False
                await self._clock.sleep(PERIOD_S)
        except (ConnectionError, TimeoutError):
            pass
        except Exception:
            log.exception("page: no message could be made")
        _abort(request)

    async def _end(self) -> None:
        for request in tuple(self._watching):
            _abort(request)


def _abort(request: web.Request) -> None:
    if request.transport is not None:
        request.transport.abort()  # a close frame would wait behind what the browser does not take


def _files() -> dict[str, bytes]:
    folder = resources.files("companion.page") / "static"
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.name.rpartition(".")[2] in _TYPES}


def _file(name: str, content: bytes) -> Handler:
    kind = _TYPES[name.rpartition(".")[2]]

    async def answer(_: web.Request) -> web.Response:
        return web.Response(body=content, content_type=kind, charset="utf-8")

    return answer
