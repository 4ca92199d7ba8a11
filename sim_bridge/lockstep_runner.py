"""Fly in lockstep with the companion: simulated time moves only when every participant has answered.

For each tick of vehicle time T: the operator's steps that are due (time is held until their command is here), the
sensors' frames and one marker a source, the vehicle's state, then wait for the companion's answer to T, then one
control period of physics. Timeouts count vehicle time, but for the guards of wall time below.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np

from sim_bridge.flight import Flight
from sim_bridge.links import Link
from sim_bridge.lockstep import COMPANION, Answer, Desk, LockstepStalled, Offer
from sim_bridge.mavlink import Packet
from sim_bridge.messages import NS_PER_S, Ack, Command
from sim_bridge.runner import Trace, Wires, due_frames, outcome
from sim_bridge.scenario import OperatorStep
from sim_bridge.station import Station
from sim_bridge.telemetry import ALIVE, HEARTBEAT

ANSWER_S = 1.0  # wall time without progress of the companion
PRESENCE_S = 30.0  # wall time until the companion is there
OPERATOR_S = 30.0  # wall time until the operator's command is there
_ONBOARD_ALIVE_S = 1.0  # heartbeats in wall time while time is held
_GROUND_ALIVE_S = 0.25  # and the ground station's telemetry, so that it finds us healthy soon
_POLL_S = 0.02


class Lockstep:
    """One flight in lockstep; ``wires`` must have a Zenoh session."""

    def __init__(
        self, flight: Flight, wires: Wires, *, trace: Trace, progress: Callable[[Flight], None], stay: bool = False
    ) -> None:
        if wires.bridge is None:
            raise ValueError("lockstep needs a Zenoh session")
        self.flight = flight
        self._wires = wires
        self._bridge = wires.bridge
        self._trace = trace
        self._progress = progress
        self._desk = Desk(flight.resolved.scenario.operator)
        self._station = Station(
            flight.crafts[0], wires.router, t_ns=lambda: flight.t_ns, clock_ns=lambda: flight.t_ns, lockstep=True
        )
        self._answer = Answer(-1, wires.bridge.record_key)
        self._obstacles_ns = -1  # tick up to which frames and markers have left
        # what every sensor will hand out at the next tick is measured already: it leaves before the physics
        period_s = flight.resolved.period_ns / NS_PER_S
        self._foresees = all(spec.latency_s >= period_s for spec in flight.resolved.scenario.sensors)
        self._companion_acks: dict[int, bytes] = {}  # by command
        self._stopped = False
        self._ends = flight.resolved.scenario.end.stop and not stay
        self._held_s = 0.0
        self._alive_at = [-math.inf, -math.inf]  # onboard, ground
        self._costs_ms: defaultdict[str, list[float]] = defaultdict(list)
        self._offboard_wall: float | None = None

    def stop(self) -> None:
        self._stopped = True
        self._wires.poke()

    def run(self) -> dict[str, Any]:
        """Fly; returns the summary.

        Raises:
            LockstepStalled: what was missing.
        """
        flight = self.flight
        self._await_companion()
        began = time.perf_counter()
        while not self._stopped and not (self._ends and flight.ended is not None):
            held_since = time.perf_counter()
            self._await_operator()
            self._held_s += time.perf_counter() - held_since
            marks: list[float] = []
            for phase in (self._send, self._await_answer, self._advance):
                marks.append(time.perf_counter())
                if not self._stopped:
                    phase()
            marks.append(time.perf_counter())
            self._account(marks)
        return {**outcome(flight), **self._timing(began)}

    # --- phases of a tick

    def _await_operator(self) -> None:
        """Apply the steps that are due at this tick, holding time until each command is here."""
        while not self._stopped:
            step = self._desk.next_step
            if step is None or not self._due(step):
                return
            self._hold(
                lambda: self._desk.ready() is not None,
                OPERATOR_S,
                lambda: f"no operator command for step {_named(self._desk.next_step)}",
            )
            offer = self._desk.ready()
            if offer is not None:
                self._desk.done(self._apply(step, offer))

    def _send(self) -> None:
        """Frames, markers, then the autopilot's messages with the state last."""
        flight = self.flight
        self._answer = Answer(flight.t_ns, self._bridge.record_key)
        self._send_obstacles(flight.t_ns)
        self._station.say(flight.control()[0])
        self._station.announce()
        self._station.stream(self._wires.router.onboard)
        # the companion computes now: what it does not wait for is done beside it
        self._station.stream(self._wires.router.ground)
        self._trace.write(flight)

    def _send_obstacles(self, tick_ns: int) -> None:
        """The frames that are due at ``tick_ns`` and one marker a source, unless they have left already."""
        if tick_ns <= self._obstacles_ns:
            return
        self._obstacles_ns = tick_ns
        sent = dict.fromkeys((spec.source for spec in self.flight.resolved.scenario.sensors), 0)
        for source, payload in due_frames(self.flight, tick_ns):
            self._bridge.publish_frame(source, payload)
            sent[source] += 1
        for source, frames in sent.items():
            self._bridge.publish_marker(source, tick_ns, frames)

    def _await_answer(self) -> None:
        answer = self._answer
        deadline, progress = time.monotonic() + ANSWER_S, 0
        while not answer.complete and not self._stopped:
            if not self._wires.wait(deadline - time.monotonic()) and time.monotonic() >= deadline:
                raise LockstepStalled(f"lockstep: after {ANSWER_S:g} s: {answer.missing()}")
            self._receive()
            if answer.progress > progress:
                deadline, progress = time.monotonic() + ANSWER_S, answer.progress

    def _advance(self) -> None:
        flight = self.flight
        if self._foresees:
            self._send_obstacles(flight.t_ns + flight.resolved.period_ns)
        if self._offboard_wall is None and flight.crafts[0].autopilot.external:
            self._offboard_wall = time.perf_counter()
        for _ in range(flight.resolved.control_steps):
            flight.advance()
        self._progress(flight)

    # --- waiting

    def _await_companion(self) -> None:
        bridge = self._bridge
        self._hold(lambda: bridge.companion_alive, PRESENCE_S, lambda: f"no liveliness token {bridge.alive_key}")
        self._hold(
            lambda: not bridge.unmatched(), PRESENCE_S, lambda: f"no subscriber to {', '.join(bridge.unmatched())}"
        )

    def _hold(self, arrived: Callable[[], bool], limit_s: float, missing: Callable[[], str]) -> None:
        """Serve the links in wall time until ``arrived``."""
        deadline = time.monotonic() + limit_s
        while not arrived() and not self._stopped:
            now = time.monotonic()
            if now >= deadline:
                raise LockstepStalled(f"lockstep: after {limit_s:g} s: {missing()} (held at {self.flight.t_ns} ns)")
            self._stay_alive(now)
            self._wires.wait(_POLL_S)
            self._receive()

    def _stay_alive(self, now: float) -> None:
        onboard_at, ground_at = self._alive_at
        if now - onboard_at >= _ONBOARD_ALIVE_S:
            self._alive_at[0] = now
            self._station.stay_alive(self._wires.router.onboard, (HEARTBEAT,))
        if now - ground_at >= _GROUND_ALIVE_S:
            self._alive_at[1] = now
            self._station.stay_alive(self._wires.router.ground, ALIVE)

    def _receive(self) -> None:
        for record in self._bridge.records():
            self._answer.record(record.stamp_ns, sent=record.sent, messages=record.messages)
        router = self._wires.router
        for link, packet in router.receive():
            if link is router.ground and self._keep(packet):
                continue
            if link is router.onboard:
                self._answer.packet(packet.message_id, packet.sender.component, packet.time_boot_ms)
                if packet.ack_of is not None and packet.sender.component == COMPANION:
                    self._companion_acks[packet.ack_of] = packet.raw
            router.forward(link, packet)
            self._station.handle(link, packet)

    def _keep(self, packet: Packet) -> bool:
        """Whether a packet of the ground station is an operator's step, to be applied on its tick."""
        if not isinstance(packet.content, Command):
            return False
        answer = self._desk.take(Offer(packet.content, packet))
        if answer:
            self._wires.router.ground.send(answer)
        return answer is not None

    # --- the operator's steps

    def _due(self, step: OperatorStep) -> bool:
        flight = self.flight
        if step.at_tick is not None:
            return flight.t_ns >= step.at_tick * flight.resolved.period_ns
        if step.after == "airborne_hover":
            return flight.crafts[0].autopilot.hovering(flight.t_ns)
        if step.after == "on_ground":
            return not flight.crafts[0].autopilot.airborne
        return flight.ended is not None

    def _apply(self, step: OperatorStep, offer: Offer) -> bytes:
        """Carry out a step now; returns the acknowledgement that repetitions of its command get."""
        ground = self._wires.router.ground
        if offer.command.target_component == COMPANION:
            return self._pass_on(ground, step, offer)
        replies = self._station.handle(ground, offer.packet)
        ack = next((reply for reply in replies if isinstance(reply, Ack)), None)
        return b"" if ack is None else ground.encoder.ack(ack)

    def _pass_on(self, ground: Link, step: OperatorStep, offer: Offer) -> bytes:
        """Give the command to the companion and wait for its acknowledgement, which `_receive` forwards."""
        number = offer.command.command
        self._companion_acks.pop(number, None)
        missing = f"no COMMAND_ACK of component {COMPANION} for step {_named(step)}"
        if not self._wires.router.forward(ground, offer.packet):
            raise LockstepStalled(f"lockstep: {missing}: the component was never heard on the onboard link")
        self._hold(lambda: number in self._companion_acks, ANSWER_S, lambda: missing)
        return self._companion_acks.get(number, b"")

    # --- figures

    def _account(self, marks: list[float]) -> None:
        for name, start, end in zip(("send", "answer", "physics"), marks, marks[1:], strict=False):
            self._costs_ms[name].append((end - start) * 1e3)

    def _timing(self, began: float) -> dict[str, Any]:
        now = time.perf_counter()
        flight, judge = self.flight, self.flight.crafts[0].judge
        wall_s = now - began
        factor = None
        if judge is not None and self._offboard_wall is not None:
            factor = (flight.t_ns - judge.start_ns) / NS_PER_S / (now - self._offboard_wall)
        costs = {
            name: {"p50": float(np.percentile(values, 50)), "p99": float(np.percentile(values, 99)), "max": max(values)}
            for name, values in self._costs_ms.items()
        }
        return {"wall_s": wall_s, "held_s": self._held_s, "real_time_factor": factor, "tick_ms": costs}


def _named(step: OperatorStep | None) -> str:
    if step is None:
        return "none"
    when = f"at tick {step.at_tick}" if step.at_tick is not None else f"after {step.after}"
    return f"{step.do} ({when})"
