"""Fly in lockstep with the companions: simulated time moves only when every participant has answered.

For each tick of vehicle time T: the faults that begin or end, the operator's steps that are due (time is held until
their command is here), then for each vehicle the sensors' frames, one marker a source and its state; then every
companion's answer is waited for, then one control period of physics. Timeouts count vehicle time, but for the guards
of wall time below.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sim_bridge.faults import Faults, Process
from sim_bridge.flight import Flight
from sim_bridge.lockstep import Desk, LockstepStalled
from sim_bridge.messages import NS_PER_S
from sim_bridge.runner import Operator, Tap, Trace, outcome, stations_of
from sim_bridge.seat import REMIND_S, Seat, named, steps_of
from sim_bridge.telemetry import ALIVE, HEARTBEAT
from sim_bridge.wires import Wires

ANSWER_S = 1.0  # wall time without progress of a companion
PRESENCE_S = 30.0  # wall time until the companions are there
OPERATOR_S = 30.0  # wall time until the operator's command is there
_ONBOARD_ALIVE_S = 1.0  # heartbeats in wall time while time is held
_GROUND_ALIVE_S = 0.25  # and the ground station's telemetry, so that it finds us healthy soon
_POLL_S = 0.02


class Lockstep:
    """One flight in lockstep; ``wires`` must have a Zenoh session.

    Args:
        progress: called after every control period with the flight.
        processes: daemons that faults may freeze and kill, by vehicle name.
        operator: plays the scenario's steps; None: someone at the ground links does, and is waited for.
        tap: told what the companions say.
    """

    def __init__(
        self,
        flight: Flight,
        wires: Wires,
        *,
        trace: Trace,
        progress: Callable[[Flight], None],
        stay: bool = False,
        processes: Mapping[str, Process] | None = None,
        operator: Operator | None = None,
        tap: Tap | None = None,
    ) -> None:
        self.flight = flight
        self.stations = stations_of(flight, wires, clock_ns=lambda: flight.t_ns, lockstep=True)
        self.faults = Faults(flight, wires.crafts, self.stations, processes)
        self._wires = wires
        self._trace = trace
        self._progress = progress
        self._operator = operator
        self._seats = tuple(self._seat(index, tap) for index in range(len(flight.crafts)))
        self._stopped = False
        self._ends = flight.resolved.scenario.end.stop and not stay
        self._held_s = 0.0
        self._alive_at = [-math.inf, -math.inf]  # onboard, ground
        self._costs_ms: defaultdict[str, list[float]] = defaultdict(list)
        self._external_wall: float | None = None

    def _seat(self, index: int, tap: Tap | None) -> Seat:
        craft, wires, scenario = self.flight.crafts[index], self._wires.crafts[index], self.flight.resolved.scenario
        if wires.bridge is None:
            raise ValueError("lockstep needs a Zenoh session")
        return Seat(
            index,
            craft,
            wires,
            wires.bridge,
            self.stations[index],
            desk=Desk(steps_of(scenario.operator, wires.vehicle.name)),
            companion=self.faults.companions[index],
            careful=self.faults.touches_onboard(index),
            period_ns=self.flight.resolved.period_ns,
            tap=tap,
        )

    def stop(self) -> None:
        self._stopped = True
        self._wires.poke()

    def run(self) -> dict[str, Any]:
        """Fly; returns the summary.

        Raises:
            LockstepStalled: what was missing.
        """
        flight = self.flight
        self._await_companions()
        began = time.perf_counter()
        while not self._stopped and not (self._ends and flight.ended is not None):
            self._begin()
            held_since = time.perf_counter()
            for seat in self._seats:
                self._await_operator(seat)
            self._held_s += time.perf_counter() - held_since
            marks: list[float] = []
            for phase in (self._send, self._await_answers, self._advance):
                marks.append(time.perf_counter())
                if not self._stopped:
                    phase()
            marks.append(time.perf_counter())
            self._account(marks)
        return {**outcome(flight), **self._timing(began)}

    def serve(self, wait_s: float) -> None:
        """After the flight: answer on the links for at most ``wait_s`` of wall time, time standing still."""
        for seat in self._seats:
            seat.router.onboard.uncork()
        self._stay_alive(time.monotonic())
        self._wires.wait(wait_s)
        self._receive()

    # --- phases of a tick

    def _begin(self) -> None:
        """What changes at the beginning of a control period, whoever is there."""
        self.faults.step()
        if self._operator is not None:
            self._operator.tick(self.flight.t_ns)
        for seat in self._seats:
            seat.release()
            seat.receive()

    def _await_operator(self, seat: Seat) -> None:
        """Apply the steps that are due at this tick, holding time until each command is here."""
        while not self._stopped:
            step = seat.desk.next_step
            if step is None or not seat.due(step, self.flight.ended is not None):
                return
            if self._operator is not None:
                self._operator.give(seat.index, step, self.flight.t_ns)
                seat.receive()
                if seat.desk.ready() is None:
                    return  # lost or late on the way: time goes on, and it is sent again
            else:
                self._hold(
                    lambda: seat.desk.ready() is not None,
                    OPERATOR_S,
                    lambda: f"no operator command for step {named(seat.desk.next_step)} of {seat.craft.name}",
                )
            offer = seat.desk.ready()
            if offer is not None:
                seat.desk.done(seat.apply(step, offer, self._await_ack))

    def _await_ack(self, seat: Seat, number: int, missing: str) -> None:
        self._hold(lambda: number in seat.companion_acks, ANSWER_S, lambda: missing)

    def _send(self) -> None:
        """Frames, markers, then the autopilots' messages with the state last."""
        replies = self.flight.control()
        for seat in self._seats:
            seat.send(replies[seat.index])
        # the companions compute now: what they do not wait for is done beside it
        for seat in self._seats:
            seat.station.stream(seat.router.ground)
        self._trace.write(self.flight)

    def _await_answers(self) -> None:
        deadline, progress = time.monotonic() + ANSWER_S, 0
        while not self._stopped:
            waiting = [seat for seat in self._seats if seat.waits]
            if not waiting:
                return
            left_s = deadline - time.monotonic()
            reminding = [seat for seat in waiting if seat.reminds]
            if not self._wires.wait(min(left_s, REMIND_S) if reminding else left_s):
                if time.monotonic() >= deadline:
                    missing = "; ".join(seat.answer.missing() for seat in waiting if seat.answer is not None)
                    raise LockstepStalled(f"lockstep: after {ANSWER_S:g} s: {missing}")
                for seat in reminding:
                    seat.remind()
            self._receive()
            come = sum(seat.answer.progress for seat in self._seats if seat.answer is not None)
            if come > progress:
                deadline, progress = time.monotonic() + ANSWER_S, come

    def _advance(self) -> None:
        flight = self.flight
        for seat in self._seats:
            seat.send_ahead()
        if self._external_wall is None and any(craft.autopilot.external for craft in flight.crafts):
            self._external_wall = time.perf_counter()
        for _ in range(flight.resolved.control_steps):
            flight.advance()
        self._progress(flight)

    # --- waiting

    def _await_companions(self) -> None:
        bridges = [seat.bridge for seat in self._seats]
        self._hold(
            lambda: all(bridge.companion_alive for bridge in bridges),
            PRESENCE_S,
            lambda: "no liveliness token " + ", ".join(b.alive_key for b in bridges if not b.companion_alive),
        )
        self._hold(
            lambda: not any(bridge.unmatched() for bridge in bridges),
            PRESENCE_S,
            lambda: "no subscriber to " + ", ".join(key for bridge in bridges for key in bridge.unmatched()),
        )

    def _hold(self, arrived: Callable[[], bool], limit_s: float, missing: Callable[[], str]) -> None:
        """Serve the links in wall time until ``arrived``."""
        deadline = time.monotonic() + limit_s
        while not arrived() and not self._stopped:
            now = time.monotonic()
            if now >= deadline:
                raise LockstepStalled(f"lockstep: after {limit_s:g} s: {missing()} (held at {self.flight.t_ns} ns)")
            self.faults.check_daemons()
            self._stay_alive(now)
            self._wires.wait(_POLL_S)
            self._receive()

    def _stay_alive(self, now: float) -> None:
        onboard_at, ground_at = self._alive_at
        if now - onboard_at >= _ONBOARD_ALIVE_S:
            self._alive_at[0] = now
            for seat in self._seats:
                seat.stay_alive(seat.router.onboard, (HEARTBEAT,))
        if now - ground_at >= _GROUND_ALIVE_S:
            self._alive_at[1] = now
            for seat in self._seats:
                seat.stay_alive(seat.router.ground, ALIVE)

    def _receive(self) -> None:
        for seat in self._seats:
            seat.receive()

    # --- figures

    def _account(self, marks: list[float]) -> None:
        for name, start, end in zip(("send", "answer", "physics"), marks, marks[1:], strict=False):
            self._costs_ms[name].append((end - start) * 1e3)

    def _timing(self, began: float) -> dict[str, Any]:
        now = time.perf_counter()
        flight = self.flight
        wall_s = now - began
        starts_ns = [craft.judge.start_ns for craft in flight.crafts if craft.judge is not None]
        factor = None
        if starts_ns and self._external_wall is not None:
            factor = (flight.t_ns - min(starts_ns)) / NS_PER_S / (now - self._external_wall)
        costs = {
            name: {"p50": float(np.percentile(values, 50)), "p99": float(np.percentile(values, 99)), "max": max(values)}
            for name, values in self._costs_ms.items()
        }
        return {"wall_s": wall_s, "held_s": self._held_s, "real_time_factor": factor, "tick_ms": costs}
