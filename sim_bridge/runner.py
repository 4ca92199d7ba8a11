"""The two ways to fly a scenario over the wires: paced by the clock, or in lockstep with the companion.

One synchronous loop: physics, then whatever the sockets hold. Nothing else runs in the process but Zenoh's threads,
which wake the loop through a socket pair. Vehicle time is the count of physics steps in both.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
from collections.abc import Callable, Iterator
from typing import IO, Any

import msgspec

from sim_bridge.flight import Flight
from sim_bridge.links import Router
from sim_bridge.messages import NS_PER_S
from sim_bridge.placement import Resolved
from sim_bridge.station import Station
from sim_bridge.zenoh_io import Bridge, encode_frame

_LATE_NS = NS_PER_S // 4  # further behind the clock than this, time is given up instead of caught up


class Wires:
    """Both MAVLink links, the Zenoh session if there is one, and the wake-up; opened together, closed together."""

    def __init__(
        self,
        resolved: Resolved,
        *,
        onboard_port: int,
        ground_port: int,
        endpoint: str | None,
        prefix: str,
        lockstep: bool,
    ) -> None:
        self._wake_in, self._wake_out = socket.socketpair()
        self._wake_in.setblocking(False)
        self._wake_out.setblocking(False)
        self.bridge: Bridge | None = None
        self.router = Router(onboard_port, ground_port)
        if endpoint is not None:
            sources = [sensor.source for sensor in resolved.scenario.sensors]
            try:
                self.bridge = Bridge(endpoint, prefix, sources, reliable=lockstep, wake=self._wake_out)
            except BaseException:
                self.close()
                raise
        self._sockets = [self._wake_in, *(link.socket for link in self.router.links)]

    def wait(self, timeout_s: float) -> bool:
        """Sleep until something arrives or the time is up; whether something did."""
        readable, _, _ = select.select(self._sockets, [], [], max(0.0, timeout_s))
        if self._wake_in in readable:
            with contextlib.suppress(BlockingIOError):
                self._wake_in.recv(4096)
        return bool(readable)

    def poke(self) -> None:
        """Wake the loop; may be called from a signal handler or another thread."""
        with contextlib.suppress(OSError):
            self._wake_out.send(b"\0")

    def close(self) -> None:
        if self.bridge is not None:
            self.bridge.close()
        self.router.close()
        self._wake_in.close()
        self._wake_out.close()


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
    """

    def __init__(
        self, flight: Flight, wires: Wires, *, trace: Trace, progress: Callable[[Flight], None], stay: bool = False
    ) -> None:
        self.flight = flight
        self._wires = wires
        self._trace = trace
        self._progress = progress
        self._epoch_ns = 0
        self._late_ns = 0
        self._stopped = False
        self._ends = flight.resolved.scenario.end.stop and not stay
        self._station = Station(
            flight.crafts[0], wires.router, t_ns=lambda: flight.t_ns, clock_ns=self._clock_ns, lockstep=False
        )

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
                if wires.wait(-behind_ns / NS_PER_S):
                    self._receive()
                continue
            if behind_ns > _LATE_NS:
                self._late_ns += behind_ns
                self._epoch_ns += behind_ns
            self._receive()
            self._step()
            if self._ends and flight.ended is not None:
                break
        wall_s = (time.monotonic_ns() - began_ns) / NS_PER_S
        return {**outcome(flight), "wall_s": wall_s, "late_s": self._late_ns / NS_PER_S}

    def _clock_ns(self) -> int:
        return time.monotonic_ns() - self._epoch_ns

    def _receive(self) -> None:
        for link, packet in self._wires.router.receive():
            self._wires.router.forward(link, packet)
            self._station.handle(link, packet)

    def _step(self) -> None:
        flight = self.flight
        flight.advance()
        if flight.at_tick:
            self._tick()
        else:
            self._publish()
            self._station.stream(*self._wires.router.links)

    def _tick(self) -> None:
        flight = self.flight
        self._station.say(flight.control()[0])
        self._station.announce()
        self._publish()
        self._station.stream(*self._wires.router.links)
        self._trace.write(flight)
        self._progress(flight)

    def _publish(self) -> None:
        bridge = self._wires.bridge
        if bridge is None:
            return
        for source, payload in due_frames(self.flight, self.flight.t_ns):
            bridge.publish_frame(source, payload)


def due_frames(flight: Flight, t_ns: int) -> Iterator[tuple[str, bytes]]:
    """Encoded frames that have arrived by ``t_ns``, source by source."""
    for spec in flight.resolved.scenario.sensors:
        for frame in flight.crafts[0].frames(spec.source, t_ns):
            yield spec.source, encode_frame(frame, spec.sigma_m)


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
