"""The autopilot's two UDP links, as PX4 SITL has them, and the rules by which packets pass between them.

Each link sends to 127.0.0.1:PORT from a socket of its own, on the loopback unless it is bound elsewhere, and answers
whoever speaks to that socket. A packet that is not for the autopilot alone goes on to the other one: broadcasts always,
addressed ones where the addressee was heard there. Nothing goes back to the link it came from, and nothing that claims
to be the autopilot is passed on. Faults stand between a link and its socket, one `Channel` a direction; what they delay
comes out of `release`.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from typing import TypeAlias

from sim_bridge.impairments import Channel, Passage, join, split
from sim_bridge.mavlink import COMPONENT, Decoder, Encoder, Packet
from sim_bridge.messages import LinkName, Sender

TIMESYNC = 111
_LOOPBACK = "127.0.0.1"
_DATAGRAM = 65535
_PER_DRAIN = 256  # so that a flood cannot keep the simulator from flying
_PEERS = 8
CORKED_BYTES = 60_000  # what is held back must fit one datagram; the oldest goes first

Address: TypeAlias = tuple[str, int]


class Link:
    """One UDP endpoint: who listens there, whom we heard, our numbering of messages.

    Args:
        port: to which it sends unasked, on the loopback.
        bind: address of its own socket, None: the loopback and any free port.
    Raises:
        OSError: ``bind`` is taken, or no address of this host.
    """

    def __init__(self, name: LinkName, port: int, *, bind: Address | None = None, system: int = 1) -> None:
        self.name = name
        self.port = port
        self.encoder = Encoder(system)
        self.heard: set[Sender] = set()
        self.outbound: Channel[bytes] | None = None  # faults, where there are any
        self.inbound: Channel[bytes] | None = None
        self._corked: list[Passage[bytes]] | None = None
        self._home: Address = (_LOOPBACK, port)
        self._peers: list[Address] = []
        self._decoder = Decoder()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        try:
            self.socket.bind(bind or (_LOOPBACK, 0))
        except OSError:
            self.socket.close()
            raise

    @property
    def damaged(self) -> int:
        """Runs of bytes that were no MAVLink."""
        return self._decoder.damaged

    def send(self, data: bytes, *, timed: bool = True) -> None:
        """To the configured port and to everybody else who spoke to this link; nobody there is no error.

        ``timed`` false: what the wall clock alone calls for, while vehicle time is held. It is never corked.
        """
        if self.outbound is None and self._corked is None:
            self._transmit(data)
            return
        messages = split(data)
        channel = self.outbound
        passed = [Passage(m) for m in messages] if channel is None else channel.pass_on(messages, timed=timed)
        if self._corked is not None and timed:
            self._corked += passed
        else:
            self._transmit(join(passed))

    def cork(self) -> None:
        """Hold back what is sent from now on, for one datagram."""
        if self._corked is None:
            self._corked = []

    def uncork(self) -> list[Passage[bytes]]:
        """Send what was held back as one datagram; returns its messages, damaged ones last.

        A receiver that looks for the next packet inside a damaged one may take what follows it for a part of that.
        """
        corked, self._corked = self._corked or [], None
        corked = [p for p in corked if p.intact] + [p for p in corked if not p.intact]
        size = 0
        for at in range(len(corked) - 1, -1, -1):
            size += len(corked[at].item)
            if size > CORKED_BYTES:
                corked = corked[at + 1 :]
                break
        self._transmit(join(corked))
        return corked

    def release(self) -> Iterator[Packet]:
        """Send what was delayed until now, and yield what had been delayed on its way in."""
        if self.outbound is not None and (late := self.outbound.release()):
            if self._corked is None:
                self._transmit(join(late))
            else:
                self._corked += late
        if self.inbound is not None:
            yield from self._decoded(self.inbound.release())

    def impaired(self, packet: Packet, *, timed: bool = True) -> Iterator[Packet]:
        """What the faults leave of a packet that has arrived."""
        if self.inbound is None:
            yield packet
        else:
            yield from self._decoded(self.inbound.pass_on([packet.raw], timed=timed))

    def _decoded(self, passages: list[Passage[bytes]]) -> Iterator[Packet]:
        for passage in passages:
            yield from self._decoder.packets(passage.item)

    def _transmit(self, data: bytes) -> None:
        if not data:
            return
        for address in (self._home, *self._peers):
            with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
                self.socket.sendto(data, address)

    def receive(self) -> Iterator[Packet]:
        """Packets that have arrived, without waiting."""
        for _ in range(_PER_DRAIN):
            try:
                data, address = self.socket.recvfrom(_DATAGRAM)
            except BlockingIOError:
                return
            except ConnectionRefusedError:
                continue
            fresh = address != self._home and address not in self._peers
            for packet in self._decoder.packets(data):
                if fresh:
                    self._peers = [*self._peers[-_PEERS + 1 :], address]
                    fresh = False
                self.heard.add(packet.sender)
                yield packet

    def close(self) -> None:
        self.socket.close()


class Router:
    """The two links of the autopilot of one vehicle, together; ``system`` is its MAVLink system id.

    Raises:
        OSError: of one of the links; neither is open then.
    """

    def __init__(
        self,
        onboard_port: int,
        ground_port: int,
        *,
        onboard_bind: Address | None = None,
        ground_bind: Address | None = None,
        system: int = 1,
    ) -> None:
        self.id = Sender(system, COMPONENT)
        self.onboard = Link(LinkName.ONBOARD, onboard_port, bind=onboard_bind, system=system)
        try:
            self.ground = Link(LinkName.GROUND, ground_port, bind=ground_bind, system=system)
        except OSError:
            self.onboard.close()
            raise
        self.links = (self.onboard, self.ground)

    def other(self, link: Link) -> Link:
        return self.ground if link is self.onboard else self.onboard

    def receive(self) -> Iterator[tuple[Link, Packet]]:
        """What has arrived on both links, without waiting."""
        for link in self.links:
            for packet in link.receive():
                if packet.sender != self.id:
                    yield link, packet

    def forward(self, link: Link, packet: Packet) -> bool:
        """Pass a packet that came in on ``link`` on to the other one, if the rules say so."""
        other = self.other(link)
        passes = _passes(packet, other.heard)
        if passes:
            other.send(packet.raw)
        return passes

    def for_autopilot(self, target: Sender) -> bool:
        """Addressed to everybody, to our whole system, or to us."""
        return target.system in (0, self.id.system) and target.component in (0, self.id.component)

    def close(self) -> None:
        for link in self.links:
            link.close()


def _passes(packet: Packet, heard: set[Sender]) -> bool:
    target = packet.target
    if target.system == 0:
        return packet.message_id != TIMESYNC  # the autopilot is the time base and answers alone
    if target.component == 0:
        return any(sender.system == target.system for sender in heard)
    return target in heard
