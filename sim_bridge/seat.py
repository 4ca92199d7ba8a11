"""One vehicle's place in lockstep: what its companion is given each tick, and what it and the operator owe.

Without faults on the way to the companion, frames and markers leave ahead of the vehicle's state and every tick is
answered. With them, everything for the companion leaves once a tick as one datagram, so that what it has received is
known; then a marker of the stamp that reached it follows, and only that stamp is waited for. A frozen companion's
messages and frames wait with it (the simulator plays the kernel's buffers), a dead one's go nowhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from sim_bridge.craft import Craft
from sim_bridge.delivery import Delivery
from sim_bridge.faults import Companion
from sim_bridge.links import Link
from sim_bridge.lockstep import COMPANION, UNCOUNTED_IDS, Answer, Desk, LockstepStalled, Offer, step_due
from sim_bridge.mavlink import Packet
from sim_bridge.messages import NS_PER_S, Ack, Command, Reply
from sim_bridge.runner import Tap
from sim_bridge.scenario import OperatorStep
from sim_bridge.station import Station
from sim_bridge.wires import CraftWires
from sim_bridge.zenoh_io import Bridge

FRAMES_KEPT = 64  # of a source, for a frozen companion: its own queue is as long
REMIND_S = 0.05  # of wall time, after a reboot: the marker again, until it is answered


class Seat:
    """Vehicle ``index`` of a flight in lockstep.

    Args:
        careful: faults may stand between it and its companion, see the module's head.
        period_ns: the control period.
    """

    def __init__(
        self,
        index: int,
        craft: Craft,
        wires: CraftWires,
        bridge: Bridge,
        station: Station,
        *,
        desk: Desk,
        companion: Companion,
        careful: bool,
        period_ns: int,
        tap: Tap | None = None,
    ) -> None:
        self.index = index
        self.craft = craft
        self.router = wires.router
        self.bridge = bridge
        self.station = station
        self.desk = desk
        self.companion = companion
        self.companion_acks: dict[int, bytes] = {}  # by command
        self.answer: Answer | None = None  # None: nothing is owed
        self._feeds = wires.feeds
        self._careful = careful
        self._period_ns = period_ns
        self._tap = tap
        self._obstacles_ns = -1  # tick up to which frames and markers have left
        # what every sensor will hand out at the next tick is measured already: it leaves before the physics
        period_s = period_ns / NS_PER_S
        self._foresees = not careful and all(feed.spec.latency_s >= period_s for feed in wires.feeds)
        self._delivery = Delivery()
        self._unmarked = {feed.source: 0 for feed in wires.feeds}  # frames sent that no marker has announced
        self._kept: dict[str, list[bytes]] = {feed.source: [] for feed in wires.feeds}
        self._reminds: int | None = None  # stamp of the marker to repeat
        if careful:
            self.router.onboard.cork()

    # --- a tick

    def send(self, replies: tuple[Reply, ...]) -> None:
        """Everything of this tick for the companion, the state last; from here on it owes its answer."""
        t_ns = self.craft.t_ns
        self.answer = None
        if self.companion.answers and not self._careful:
            self._owe(t_ns)
            self._send_obstacles(t_ns)
        self.station.say(replies)
        self.station.announce()
        self.station.stream(self.router.onboard)
        if self._careful:
            self._send_carefully(t_ns)

    def send_ahead(self) -> None:
        """The next tick's frames and markers, where they are known before the physics."""
        if self._foresees and self.companion.answers:
            self._send_obstacles(self.craft.t_ns + self._period_ns)

    def release(self) -> None:
        """What faults had delayed until now."""
        for link in self.router.links:
            for packet in link.release():
                self._act(link, packet)

    def stay_alive(self, link: Link, message_ids: tuple[int, ...]) -> None:
        """Messages off their schedule, while time is held."""
        self.station.stay_alive(link, message_ids)
        if link is self.router.onboard and (link.outbound is None or link.outbound.clear):
            self._delivery.heard()

    @property
    def waits(self) -> bool:
        """The companion still owes something for this tick."""
        return self.answer is not None and not self.answer.complete

    def remind(self) -> None:
        """After a reboot of the vehicle's clock: the marker again, in case the companion forgot it on seeing that."""
        if self._reminds is not None:
            for source in self._unmarked:
                self.bridge.publish_marker(source, self._reminds, 0)

    @property
    def reminds(self) -> bool:
        return self._reminds is not None

    def _owe(self, stamp_ns: int) -> None:
        self.answer = Answer(stamp_ns, self.bridge.record_key)

    def _send_obstacles(self, tick_ns: int) -> None:
        """The frames that are due at ``tick_ns`` and one marker a source, unless they have left already."""
        if tick_ns <= self._obstacles_ns:
            return
        self._obstacles_ns = tick_ns
        for feed in self._feeds:
            payloads = feed.due(self.craft, tick_ns, self.station.clock_offset_ns)
            for payload in payloads:
                self.bridge.publish_frame(feed.source, payload)
            self._unmarked[feed.source] += len(payloads)
        self._mark(tick_ns)

    def _mark(self, stamp_ns: int) -> None:
        for source, frames in self._unmarked.items():
            self.bridge.publish_marker(source, stamp_ns, frames)
            self._unmarked[source] = 0

    def _send_carefully(self, t_ns: int) -> None:
        for feed in self._feeds:
            payloads = feed.due(self.craft, t_ns, self.station.clock_offset_ns)
            self._kept[feed.source] = [*self._kept[feed.source], *payloads][-FRAMES_KEPT:]
        self._reminds = None
        if self.companion.frozen:
            return
        owed_ns = self._delivery.datagram(self.router.onboard.uncork())
        self.router.onboard.cork()
        if self.companion.dead:
            return
        if self._delivery.rebooted:  # whatever is queued there is forgotten, and so is what was meant to follow it
            self._forget()
            self._reminds = owed_ns
        for source, payloads in self._kept.items():
            for payload in payloads:
                self.bridge.publish_frame(source, payload)
            self._unmarked[source] += len(payloads)
            self._kept[source] = []
        if owed_ns is not None:
            self._owe(owed_ns)
            self._mark(owed_ns)

    def _forget(self) -> None:
        for source in self._unmarked:
            self._unmarked[source] = 0
            self._kept[source] = []

    # --- what comes in

    def receive(self) -> None:
        """Everything that has arrived for this vehicle, without waiting."""
        for record in self.bridge.records():
            if self.answer is not None:
                self.answer.record(record.stamp_ns, sent=record.sent, messages=record.messages)
            if self._tap is not None:
                self._tap.record(self.index, record)
        router = self.router
        for link, packet in router.receive():
            if link is router.onboard:
                self._heard(packet)
            for each in link.impaired(packet, timed=_is_timed(packet)):
                self._act(link, each)

    def _heard(self, packet: Packet) -> None:
        """A packet of the companion has arrived, whatever a fault then makes of it: it owes no more than that."""
        if self.answer is not None:
            self.answer.packet(packet.message_id, packet.sender.component, packet.time_boot_ms)
        if packet.ack_of is not None and packet.sender.component == COMPANION:
            self.companion_acks[packet.ack_of] = packet.raw
        if self._tap is not None:
            self._tap.packet(self.index, packet)

    def _act(self, link: Link, packet: Packet) -> None:
        if link is self.router.ground and self._keep(packet):
            return
        self.router.forward(link, packet)
        self.station.handle(link, packet)

    def _keep(self, packet: Packet) -> bool:
        """Whether a packet of the ground station is an operator's step, to be applied on its tick."""
        if not isinstance(packet.content, Command):
            return False
        answer = self.desk.take(Offer(packet.content, packet))
        if answer:
            self.router.ground.send(answer)
        return answer is not None

    # --- the operator's steps

    def due(self, step: OperatorStep, ended: bool) -> bool:
        """Whether it is time for ``step``; ``ended``: the flight is over."""
        return step_due(step, self.craft, self._period_ns, ended=ended)

    def apply(self, step: OperatorStep, offer: Offer, await_ack: Callable[[Seat, int, str], None]) -> bytes:
        """Carry out a step now; returns the acknowledgement that repetitions of its command get.

        ``await_ack`` holds time until the companion has acknowledged a command, or raises with what is missing.
        """
        ground = self.router.ground
        if offer.command.target_component == COMPANION:
            return self._pass_on(ground, step, offer, await_ack)
        replies = self.station.handle(ground, offer.packet)
        ack = next((reply for reply in replies if isinstance(reply, Ack)), None)
        return b"" if ack is None else ground.encoder.ack(ack)

    def _pass_on(
        self, ground: Link, step: OperatorStep, offer: Offer, await_ack: Callable[[Seat, int, str], None]
    ) -> bytes:
        """Give the command to the companion; its acknowledgement, which `receive` forwards, is waited for.

        A companion behind faults gets it with the rest of the tick, and answers when it does.
        """
        number = offer.command.command
        self.companion_acks.pop(number, None)
        missing = f"no COMMAND_ACK of component {COMPANION} for step {named(step)}"
        if not self.router.forward(ground, offer.packet):
            raise LockstepStalled(f"lockstep: {missing}: the component was never heard on the onboard link")
        if not self._careful and self.companion.answers:
            await_ack(self, number, missing)
        return self.companion_acks.get(number, b"")


def named(step: OperatorStep | None) -> str:
    """A step and its time, for messages."""
    if step is None:
        return "none"
    when = f"at tick {step.at_tick}" if step.at_tick is not None else f"after {step.after}"
    return f"{step.do} ({when})"


def _is_timed(packet: Packet) -> bool:
    """Whether a packet belongs to a tick: what the companion sends by the wall clock does not."""
    return packet.sender.component != COMPANION or packet.message_id not in UNCOUNTED_IDS


def steps_of(steps: Iterable[OperatorStep], vehicle: str) -> tuple[OperatorStep, ...]:
    """Those of one vehicle, in their order."""
    return tuple(step for step in steps if step.vehicle in (None, vehicle))
