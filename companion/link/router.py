"""Several MAVLink links at once: the autopilot's, and whoever else should hear and be heard.

Link 0 is the autopilot's (``mavlink.url``). What comes on any link reaches the daemon, except the word of the
vehicle's autopilot, which counts on its own link alone. Packets pass between links by the rules of `routes`, as they
came, signature included; with signing only those that we accept ourselves.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import AsyncExitStack
from functools import partial
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.clock import Clock
from companion.config_links import MavlinkConfig
from companion.errors import ConfigError
from companion.link import mav
from companion.link.events import Event
from companion.link.mavlink import MavlinkCodec, packets
from companion.link.routes import LINK_LOCAL, SETPOINTS, Address, Routes, target_of
from companion.link.transports import Transport, open_transport
from companion.types import NS_PER_S

AUTOPILOT_LINK = 0
TELL_NS = 10 * NS_PER_S  # another's setpoints are told this often

OnEvents = Callable[[list[Event]], None]
OnPacket = Callable[[bytes, int, bool], None]  # as on the wire, unix time [us], outgoing


class Operator(Protocol):
    """What the router asks of the session."""

    @property
    def flies(self) -> bool:
        """Whether our setpoints fly the vehicle now."""

    def say(self, severity: int, text: str) -> None:
        """A STATUSTEXT for the operator."""


class Router:
    """Every link as one. ``counts``: forwarded, looped (our own or the autopilot's packets on a link that is not
    theirs), other_setpoints, blocked_setpoints.

    Args:
        codec: the daemon's own; its ``system`` is the vehicle's.
        on_events: called with what is for the daemon, after each arrival of bytes.
    """

    def __init__(
        self,
        config: MavlinkConfig,
        codec: MavlinkCodec,
        operator: Operator,
        clock: Clock,
        on_events: OnEvents,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._urls = (config.url, *config.links)
        self._forwards = config.forward and len(self._urls) > 1
        self._blocks = config.block_other_setpoints
        self._codec = codec
        self._operator = operator
        self._clock = clock
        self._on_events = on_events
        self.on_packet: OnPacket | None = None  # told about each packet in or out, for a log
        self.heard_ns: int | None = None  # when bytes last came on the autopilot's link, monotonic clock
        self._framers = [codec.new_framer() for _ in self._urls]
        self._routes = Routes(len(self._urls))
        self._links: tuple[Transport, ...] = ()
        self._told_ns: dict[Address, int] = {}

    async def open(self) -> None:
        """Open every link.

        Raises:
            ConfigError: naming the URL; what was open by then is closed again.
        """
        for index, url in enumerate(self._urls):
            if url in self._urls[:index]:
                raise ConfigError(f"mavlink.links {url}: expected another URL, this one is in use as a link already")
        links: list[Transport] = []
        async with AsyncExitStack() as opened:
            for index, url in enumerate(self._urls):
                key = "mavlink.links" if index else "mavlink.url"
                receive = partial(self._on_bytes, index)
                links.append(await open_transport(url, receive, clock=self._clock, key=key))
                opened.push_async_callback(links[-1].close)
            opened.pop_all()
        self._links = tuple(links)

    @property
    def links(self) -> tuple[Transport, ...]:
        """The open links, the autopilot's first."""
        return self._links

    def all_counts(self) -> dict[str, int]:
        """What was routed, and bytes and losses of each link."""
        routed = {f"router.{name}": count for name, count in sorted(self.counts.items())}
        for index, link in enumerate(self._links):
            routed |= {f"link{index}.{name}": count for name, count in sorted(link.counts.items())}
        return routed

    def send(self, data: bytes) -> None:
        """Packets of our codec, to where they belong; never blocks, never raises."""
        if len(self._links) == 1:
            sealed = self._codec.seal(data)
            self._links[AUTOPILOT_LINK].send(sealed)
            self._note(packets(sealed), outgoing=True)
            return
        for packet in packets(data) if self._links else ():
            for link in self._own_links(target_of(packet)):
                self._links[link].send(self._codec.seal(packet, link))
            self._note((packet,), outgoing=True)

    async def close(self) -> None:
        for link in self._links:
            await link.close()
        self._codec.close()

    def _own_links(self, target: Address) -> tuple[int, ...]:
        """The autopilot is on its link, whoever else claims to be it; so is, for want of better, who is unknown."""
        if target == self._autopilot:
            return (AUTOPILOT_LINK,)
        return self._routes.to(target, vehicle=self._codec.system) or (AUTOPILOT_LINK,)

    @property
    def _autopilot(self) -> Address:
        return self._codec.system, mav.AUTOPILOT_COMPONENT

    def _on_bytes(self, link: int, data: bytes) -> None:
        if not self._links:
            return  # while the others are being opened nobody is at home
        if link == AUTOPILOT_LINK:
            self.heard_ns = self._clock.monotonic_ns()
        messages = self._framers[link].push(data)
        self._note((message.get_msgbuf() for message in messages), outgoing=False)
        self._on_events(self._codec.events([message for message in messages if self._take(link, message)]))

    def _note(self, seen: Iterable[bytes], *, outgoing: bool) -> None:
        if self.on_packet is None:
            return
        unix_us = self._clock.unix_ns() // 1000
        for packet in seen:
            self.on_packet(packet, unix_us, outgoing)

    def _take(self, link: int, message: Any) -> bool:
        """Learn from a message and pass it on; whether it is for the daemon."""
        if isinstance(message, dialect.MAVLink_unknown):
            self._pass_on(link, message, (0, 0))
            return False
        header = message._header
        sender = header.srcSystem, header.srcComponent
        own = self._codec.system, mav.COMPONENT
        if sender == own or (link != AUTOPILOT_LINK and sender == self._autopilot):
            self.counts["looped"] += 1
            return False
        self._routes.learn(link, sender)
        target = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if header.msgId in SETPOINTS and self._is_blocked(link, sender, target):
            return False
        if header.msgId not in LINK_LOCAL:
            self._pass_on(link, message, target)  # what is meant for us alone goes nowhere: we are heard on no link
        return link == AUTOPILOT_LINK or not _is_autopilot(message)  # others' autopilots are not ours to choose from

    def _pass_on(self, link: int, message: Any, target: Address) -> None:
        if not self._forwards:
            return
        packet = bytes(message.get_msgbuf())
        for other in self._routes.onward(link, target, vehicle=self._codec.system):
            self._links[other].send(packet)
            self.counts["forwarded"] += 1

    def _is_blocked(self, link: int, sender: Address, target: Address) -> bool:
        """Notice a second sender of setpoints to our autopilot; whether this one goes no further."""
        autopilot = self._autopilot
        if any(named not in (0, ours) for named, ours in zip(target, autopilot, strict=True)):
            return False
        if link != AUTOPILOT_LINK and not self._forwards:
            return False  # it does not reach the autopilot through us
        self.counts["other_setpoints"] += 1
        if not self._operator.flies:
            return False
        if not self._blocks or link == AUTOPILOT_LINK:
            return False  # that it is there is told by who watches the autopilot
        self.counts["blocked_setpoints"] += 1
        now_ns = self._clock.monotonic_ns()
        if sender not in self._told_ns or now_ns - self._told_ns[sender] >= TELL_NS:
            self._told_ns = {s: ns for s, ns in self._told_ns.items() if now_ns - ns < TELL_NS} | {sender: now_ns}
            self._operator.say(mav.SEVERITY_WARNING, f"setpoints of {sender[0]}/{sender[1]} are blocked")
        return True


def _is_autopilot(message: Any) -> bool:
    return bool(message.get_msgId() == mav.MSG_HEARTBEAT and message.autopilot != mav.AUTOPILOT_INVALID)
