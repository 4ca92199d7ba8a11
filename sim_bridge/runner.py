"""The two ways to fly a scenario over the wires: paced by the clock, or in lockstep with the companion.

One synchronous loop: physics, then whatever the sockets hold. Nothing else runs in the process but Zenoh's threads,
which wake the loop through a socket pair. Vehicle time is the count of physics steps in both.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import IO, Any, Protocol

import msgspec

from sim_bridge.faults import Faults, Process
from sim_bridge.flight import Flight
from sim_bridge.mavlink import Packet
from sim_bridge.messages import NS_PER_S
from sim_bridge.scenario import OperatorStep
from sim_bridge.station import Station
from sim_bridge.wires import CraftWires, Wires
from sim_bridge.zenoh_io import Record

_LATE_NS = NS_PER_S // 4  # of wall time: further behind the clock than this, time is given up, not caught up


class Operator(Protocol):
    """An operator in this process, at the ground links: it is never waited for, it acts when it is its turn."""

    def tick(self, t_ns: int) -> None:
        """A control period begins: read what came, keep in touch, in real time also act."""

    def give(self, vehicle: int, step: OperatorStep, t_ns: int) -> None:
        """Lockstep: send the command of a step that is due, now or again."""


@dataclass(frozen=True, slots=True)
class Tap:
    """What an observer of a flight is told of the daemons, each with the vehicle's index."""

    record: Callable[[int, Record], None]
    packet: Callable[[int, Packet], None]  # as it arrived, whatever a fault then makes of it


class Trace:
    """True positions per control tick as JSON lines; without a file it does nothing."""

    def __init__(self, file: IO[bytes] | None) -> None:
        self._file = file
        self._encoder = msgspec.json.Encoder()

    def write(self, flight: Flight) -> None:
        if self._file is not None:
            self._file.write(self._encoder.encode(flight.trace_line()) + b"\n")


class RealTime:
    """Fly at the pace of the clock until the flight ends or `stop` is called.

    Args:
        progress: called at every control period with the flight.
        stay: fly on after the scenario's end.
        speed: vehicle time over wall time, as PX4's PX4_SIM_SPEED_FACTOR; every clock of the vehicle runs as fast.
        processes: daemons that faults may freeze and kill, by vehicle name.
        operator: plays the scenario's steps; None: someone at the ground links does, at will.
        tap: told what the daemons say, by Zenoh too if there is a session.
    """

    def __init__(
        self,
        flight: Flight,
        wires: Wires,
        *,
        trace: Trace,
        progress: Callable[[Flight], None],
        stay: bool = False,
        speed: float = 1.0,
        processes: Mapping[str, Process] | None = None,
        operator: Operator | None = None,
        tap: Tap | None = None,
    ) -> None:
        self.flight = flight
        self.stations = stations_of(flight, wires, clock_ns=self._clock_ns, lockstep=False)
        self.faults = Faults(flight, wires.crafts, self.stations, processes)
        self._operator = operator
        self._tap = tap
        for own in wires.crafts if tap is not None else ():
            if own.bridge is not None:
                own.bridge.listen()
        self._speed = speed
        self._wires = wires
        self._trace = trace
        self._progress = progress
        self._epoch_ns = 0
        self._late_ns = 0
        self._stopped = False
        self._ends = flight.resolved.scenario.end.stop and not stay

    def stop(self) -> None:
        self._stopped = True
        self._wires.poke()

    def run(self) -> dict[str, Any]:
        """Fly; returns the summary."""
        flight, wires = self.flight, self._wires
        began_ns = self._epoch_ns = time.monotonic_ns()
        self._tick()
        while not self._stopped:
            due_ns = (flight.world.step_count + 1) * NS_PER_S // flight.world.physics_hz
            behind_ns = self._clock_ns() - due_ns
            if behind_ns < 0:
                if wires.wait(-behind_ns / self._speed / NS_PER_S):
                    self._receive()
                continue
            late_ns = round(behind_ns / self._speed)  # of wall time
            if late_ns > _LATE_NS:
                self._late_ns += late_ns
                self._epoch_ns += late_ns
            self._receive()
            self._step()
            if self._ends and flight.ended is not None:
                break
        wall_s = (time.monotonic_ns() - began_ns) / NS_PER_S
        return {**outcome(flight), "wall_s": wall_s, "late_s": self._late_ns / NS_PER_S}

    def _clock_ns(self) -> int:
        """The vehicle's clock now."""
        return round((time.monotonic_ns() - self._epoch_ns) * self._speed)

    def serve(self, wait_s: float) -> None:
        """After the flight: answer on the links for at most ``wait_s`` of wall time."""
        self._wires.wait(wait_s)
        self._receive()
        self._stream()

    def _receive(self) -> None:
        for index, (own, station) in enumerate(self._vehicles()):
            self._observe(index, own)
            for link, packet in own.router.receive():
                if self._tap is not None and link is own.router.onboard:
                    self._tap.packet(index, packet)
                for each in link.impaired(packet):
                    own.router.forward(link, each)
                    station.handle(link, each)

    def _step(self) -> None:
        flight = self.flight
        flight.advance()
        if flight.at_tick:
            self._tick()
            return
        self._stream()

    def _tick(self) -> None:
        flight = self.flight
        self.faults.check_daemons()
        self.faults.step()
        if self._operator is not None:
            self._operator.tick(flight.t_ns)
        replies = flight.control()
        for station, said in zip(self.stations, replies, strict=True):
            station.say(said)
            station.announce()
        self._stream()
        self._trace.write(flight)
        self._progress(flight)

    def _stream(self) -> None:
        """Frames and messages that are due, and what faults had delayed until now."""
        for craft, (own, station) in zip(self.flight.crafts, self._vehicles(), strict=True):
            for link in own.router.links:
                for packet in link.release():
                    own.router.forward(link, packet)
                    station.handle(link, packet)
            if own.bridge is not None:
                for feed in own.feeds:
                    for payload in feed.due(craft, craft.t_ns, station.clock_offset_ns):
                        own.bridge.publish_frame(feed.source, payload)
            station.stream(*own.router.links)

    def _observe(self, index: int, own: CraftWires) -> None:
        if self._tap is not None and own.bridge is not None:
            for record in own.bridge.records():
                self._tap.record(index, record)

    def _vehicles(self) -> Iterator[tuple[CraftWires, Station]]:
        return zip(self._wires.crafts, self.stations, strict=True)


def stations_of(flight: Flight, wires: Wires, *, clock_ns: Callable[[], int], lockstep: bool) -> tuple[Station, ...]:
    """The autopilot of each vehicle on its links."""
    return tuple(
        Station(craft, own.router, t_ns=lambda: flight.t_ns, clock_ns=clock_ns, lockstep=lockstep)
        for craft, own in zip(flight.crafts, wires.crafts, strict=True)
    )


def outcome(flight: Flight) -> dict[str, Any]:
    """The summary that both ways of flying share."""
    scenario = flight.resolved.scenario
    return {
        "scenario": flight.resolved.name,
        "seed": flight.resolved.seed,
        "ended": flight.ended,
        **flight.summary(),
        "sim_s": flight.t_ns / NS_PER_S,
        "ticks": flight.world.step_count // (scenario.physics_hz // scenario.control_hz),
    }
