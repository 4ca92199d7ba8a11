"""The Zenoh session of the daemon: keys, quality of service, and the way from Zenoh's thread into the loop.

Keys and their quality of service are in ``link/keys.py``.

Callbacks run on a thread of Zenoh's: they copy, wake the loop and return. At most 4096 messages wait for the loop,
the oldest are dropped and counted.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import zenoh

from companion.config_links import ZenohConfig
from companion.errors import ConfigError, FrameRejected
from companion.link import wire
from companion.link.inbox import MAX_PAYLOAD_BYTES
from companion.link.keys import OUTLETS
from companion.link.zenoh_config import open_session as open_session

MAX_WAITING = 4096

OnPayload = Callable[[str, bytes, str], None]


@dataclass(frozen=True, slots=True)
class ZenohHandlers:
    """What the service does with each key; all are called in the loop's thread.

    ``on_obstacles``, ``on_marker``: source, payload, media type. ``on_vehicle``: payload, media type.
    ``on_target``, ``on_engage``: the decoded command; the reply answers a query and is dropped for a put.
    ``config``, ``health``: the JSON that answers ``companion/config`` and ``companion/health``.
    ``on_rejected``: a put or query that could not be decoded.
    ``extra``: handlers of other doors by key expression, whole and outside the prefix; they get the whole key.
    """

    on_obstacles: OnPayload
    on_target: Callable[[wire.TargetCommand], wire.Reply]
    on_engage: Callable[[wire.EngageCommand], wire.Reply]
    config: Callable[[], bytes]
    health: Callable[[], bytes]
    on_marker: OnPayload | None = None  # lockstep only
    on_vehicle: Callable[[bytes, str], None] | None = None  # vehicle.source = "zenoh" only
    on_rejected: Callable[[str, FrameRejected], None] = lambda key, error: None
    extra: Mapping[str, OnPayload] = field(default_factory=dict)


class ZenohLink:
    """The daemon's subscriptions, queryables, publishers and liveliness token. Made by `open`, ended by `close`.

    ``counts``: received, dropped (the loop did not keep up), too_large.
    """

    def __init__(
        self, session: zenoh.Session, prefix: str, loop: asyncio.AbstractEventLoop, handlers: ZenohHandlers
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._session = session
        self._prefix = prefix
        self._loop = loop
        self._handlers = handlers
        self._waiting: deque[Callable[[], None]] = deque(maxlen=MAX_WAITING)
        self._woken = False
        self._closed = False
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._declared: list[Any] = []  # Zenoh ends what is no longer referenced

    @classmethod
    def open(
        cls,
        config: ZenohConfig,
        prefix: str,
        loop: asyncio.AbstractEventLoop,
        handlers: ZenohHandlers,
        *,
        lockstep: bool = False,
    ) -> ZenohLink:
        """Open the session and declare everything; the liveliness token comes last.

        Raises:
            ConfigError: as `open_session`.
        """
        link = cls(open_session(config), prefix, loop, handlers)
        try:
            link._declare(lockstep)
        except zenoh.ZError as error:
            link.close()
            raise ConfigError(f"zenoh: cannot declare the keys of {prefix}: {error}") from None
        return link

    def put(self, key: str, payload: wire.T) -> None:
        """Publish on ``{prefix}/key`` (one of ``wire.OUTGOING``'s companion keys) as JSON."""
        self.put_encoded(key, wire.encode(payload))

    def put_encoded(self, key: str, payload: bytes) -> None:
        """Publish JSON that is encoded already."""
        if not self._closed:
            self._publishers[key].put(payload)

    def wanted(self, key: str) -> bool:
        """Whether anyone subscribes to ``{prefix}/key``: what nobody reads need not be built."""
        if self._closed:
            return False
        status: Any = self._publishers[key].matching_status  # zenoh's stub says bool
        return bool(status.matching)

    def close(self) -> None:
        """End the session; no handler is called after this returns."""
        if not self._closed:
            self._closed = True
            self._waiting.clear()
            self._session.close()  # type: ignore[no-untyped-call]

    def _declare(self, lockstep: bool) -> None:
        for key, outlet in OUTLETS.items():
            block = lockstep and outlet.each_tick
            self._publishers[key] = self._session.declare_publisher(
                f"{self._prefix}/{key}",
                encoding=wire.JSON,
                congestion_control=zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP,
                priority=outlet.priority,
                express=outlet.express,
                reliability=zenoh.Reliability.RELIABLE,
            )
        handlers = self._handlers
        self._subscribe("obstacles/*", handlers.on_obstacles)
        if handlers.on_marker is not None:
            self._subscribe("sync/*", handlers.on_marker)
        if handlers.on_vehicle is not None:
            on_vehicle = handlers.on_vehicle
            self._subscribe("vehicle/state", lambda _, payload, encoding: on_vehicle(payload, encoding))
        for key_expression, handler in handlers.extra.items():
            self._listen(key_expression, handler, str)
        self._command("target", wire.TargetCommand, handlers.on_target)
        self._command("engage", wire.EngageCommand, handlers.on_engage)
        self._queryable("companion/config", lambda _payload, _encoding: handlers.config())
        self._queryable("companion/health", lambda _payload, _encoding: handlers.health())
        token = self._session.liveliness().declare_token(f"{self._prefix}/companion/alive")
        self._declared.append(token)

    def _subscribe(self, key: str, handler: OnPayload) -> None:
        """``handler`` gets the last chunk of the key (the source), the payload and its media type."""
        self._listen(f"{self._prefix}/{key}", handler, lambda name: name.rpartition("/")[2])

    def _listen(self, key_expression: str, handler: OnPayload, told: Callable[[str], str]) -> None:
        """``handler`` gets what ``told`` makes of the key, the payload and its media type."""

        def received(sample: zenoh.Sample) -> None:
            if len(sample.payload) > MAX_PAYLOAD_BYTES:
                self.counts["too_large"] += 1
                return
            source = told(str(sample.key_expr))
            payload, encoding = sample.payload.to_bytes(), str(sample.encoding)
            self._hand_over(lambda: handler(source, payload, encoding))

        self._declared.append(self._session.declare_subscriber(key_expression, received))

    def _command(self, key: str, kind: type[wire.T], handler: Callable[[wire.T], wire.Reply]) -> None:
        def answer(payload: bytes, encoding: str) -> bytes:
            try:
                reply = handler(wire.decode(payload, kind, encoding))
            except FrameRejected as error:
                self._handlers.on_rejected(key, error)
                reply = wire.Reply(accepted=False, reason=str(error))
            return wire.encode(reply)

        def put(_source: str, payload: bytes, encoding: str) -> None:
            answer(payload, encoding)

        self._subscribe(key, put)
        self._queryable(key, answer)

    def _queryable(self, key: str, answer: Callable[[bytes, str], bytes]) -> None:
        name = f"{self._prefix}/{key}"

        def reply(query: zenoh.Query, payload: bytes, encoding: str) -> None:
            data = answer(payload, encoding)
            with query:  # leaving it tells the questioner that no more replies follow
                query.reply(name, data, encoding=wire.JSON)

        def received(query: zenoh.Query) -> None:
            body = query.payload
            if body is not None and len(body) > MAX_PAYLOAD_BYTES:
                self.counts["too_large"] += 1
                query.drop()  # type: ignore[no-untyped-call]
                return
            payload = b"" if body is None else body.to_bytes()
            encoding = "" if query.encoding is None else str(query.encoding)
            self._hand_over(lambda: reply(query, payload, encoding))

        self._declared.append(self._session.declare_queryable(name, received))

    def _hand_over(self, call: Callable[[], None]) -> None:
        """From Zenoh's thread: queue the call and wake the loop unless it is awake already."""
        if self._closed:
            return
        self.counts["received"] += 1
        if len(self._waiting) == MAX_WAITING:
            self.counts["dropped"] += 1
        self._waiting.append(call)  # a full deque loses its oldest in the same step: no lock is needed
        if not self._woken:
            self._woken = True
            self._loop.call_soon_threadsafe(self._take_over)

    def _take_over(self) -> None:
        # cleared first: what is appended from here on wakes the loop again, what came before is in the queue
        self._woken = False
        for _ in range(len(self._waiting)):
            if self._closed:
                return
            self._waiting.popleft()()
