"""Engage, release and set targets by HTTP: only where the configuration allows it, and only with the token.

The token travels in ``Authorization: Bearer``, which a page of another site cannot send: the browser would ask this
server first (CORS), which allows nothing. What a command does is what the same command by Zenoh does.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
from collections.abc import Callable
from typing import Protocol

import msgspec
from aiohttp import web

from companion.config_links import HttpConfig
from companion.errors import ConfigError, FrameRejected
from companion.http import same_origin
from companion.link import wire
from companion.link.secret_file import read_secret

log = logging.getLogger("companion")

MIN_TOKEN = 16  # characters


class Commands(Protocol):
    """What is commanded: `doors.Doors`."""

    def engage(self, command: wire.EngageCommand) -> wire.Reply: ...

    def target(self, command: wire.TargetCommand) -> wire.Reply: ...


class Access:
    """The handlers of the commands.

    Raises:
        ConfigError: ``http.token_file`` cannot be read, others may read it, or it holds no token.
    """

    def __init__(self, config: HttpConfig, doors: Commands) -> None:
        self._doors = doors
        self._strangers = 0
        self._digest = _digest(read_token(config.token_file)) if config.commands and config.token_file else None

    async def engage(self, request: web.Request) -> web.Response:
        """``{"engaged": true | false}``."""
        return await self._answer(request, wire.EngageCommand, self._doors.engage)

    async def target(self, request: web.Request) -> web.Response:
        """A `wire.TargetCommand`."""
        return await self._answer(request, wire.TargetCommand, self._doors.target)

    async def _answer(
        self, request: web.Request, kind: type[wire.T], act: Callable[[wire.T], wire.Reply]
    ) -> web.Response:
        """Status 200 accepted, 409 refused, 400 no such command, 401 not with this token, 403 not here at all."""
        refused = self._refusal(request)
        if refused is not None:
            return refused
        try:
            command = wire.decode(await request.read(), kind, wire.JSON)
        except FrameRejected as error:
            return _reply(400, error.detail)
        reply = act(command)
        outcome = "accepted" if reply.accepted else f"refused: {reply.reason}"
        log.info("http: %s by %s: %s", msgspec.json.encode(command).decode(), request.remote, outcome)
        return _reply(200 if reply.accepted else 409, reply.reason)

    def _refusal(self, request: web.Request) -> web.Response | None:
        if self._digest is None:
            return _reply(403, "http.commands is false: this daemon takes no commands by HTTP")
        if not same_origin(request):
            return _reply(403, "expected a page of this server")
        scheme, _, token = request.headers.get("Authorization", "").partition(" ")
        if scheme.lower() != "bearer" or not hmac.compare_digest(_digest(token.strip()), self._digest):
            self._strangers += 1
            if (
                self._strangers & (self._strangers - 1) == 0
            ):  # the 1st, 2nd, 4th, ...: who guesses must not fill the log
                log.warning(
                    "http: %s by %s without the token (%d times)", request.path, request.remote, self._strangers
                )
            answer = _reply(401, "expected the token of http.token_file")
            answer.headers["WWW-Authenticate"] = "Bearer"
            return answer
        return None


def read_token(path: str) -> str:
    """The token in a file of mode 0600: one line of at least MIN_TOKEN printable ASCII characters without blanks.

    Raises:
        ConfigError: one line naming ``http.token_file`` and the file; never what it holds.
    """
    name = f"http.token_file: {path}"
    token = read_secret(path, name).removesuffix("\n").removesuffix("\r")
    if len(token) < MIN_TOKEN or not token.isascii() or not token.isprintable() or " " in token:
        raise ConfigError(f"{name}: expected one line of at least {MIN_TOKEN} ASCII characters without blanks")
    return token


def _digest(token: str) -> bytes:
    """Of one length whatever the token's, so that a comparison tells nothing by its time."""
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()


def _reply(status: int, reason: str) -> web.Response:
    body = wire.encode(wire.Reply(accepted=status == 200, reason=reason))
    return web.Response(status=status, body=body, content_type="application/json")
