"""`sim-bridge run --check`: fly a scenario with a daemon for each vehicle and say which expectations failed.

The check starts ``companion run`` for every vehicle on free ports of the loopback, plays the operator itself as a
MAVLink ground station, injects the scenario's faults, and compares what it saw with what the file expects.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

import msgspec

from sim_bridge.daemon import Daemon, DaemonFailed, daemon_settings
from sim_bridge.errors import SimError
from sim_bridge.expectations import DEFAULT, Finding, of_fault, of_flight
from sim_bridge.flight import Flight
from sim_bridge.lockstep_runner import Lockstep
from sim_bridge.messages import NS_PER_S
from sim_bridge.operator import GroundStation, ScriptedOperator
from sim_bridge.placement import Resolved, resolve
from sim_bridge.runner import RealTime, Tap, Trace
from sim_bridge.scenario import Expectation, Scenario
from sim_bridge.watch import Watch
from sim_bridge.wires import Wires

GIVE_UP_S = 60.0  # of vehicle time without any vehicle in external control
_STOP_S = 5.0
_POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class CheckResult:
    """What a check found: every expectation, the flight's summary, and the daemons' by vehicle (None: killed)."""

    findings: tuple[Finding, ...]
    flight: dict[str, Any]
    daemons: dict[str, dict[str, Any] | None]

    @property
    def passed(self) -> bool:
        return all(finding.met for finding in self.findings)

    def report(self) -> dict[str, Any]:
        """One JSON object."""
        findings = [asdict(finding) for finding in self.findings]
        return {"passed": self.passed, "expectations": findings, "flight": self.flight, "daemons": self.daemons}


def check(
    name: str,
    scenario: Scenario,
    seed: int,
    *,
    folder: Path,
    lockstep: bool = True,
    trace: IO[bytes] | None = None,
    progress: Callable[[Flight], None] = lambda flight: None,
    log_flight: bool = False,
    obstacles: bool = True,
    on_stop: Callable[[Callable[[], None]], None] = lambda stop: None,
) -> CheckResult:
    """Fly ``scenario`` and compare.

    Args:
        folder: for the daemons' configurations and logs.
        log_flight: the daemons also write their MCAP logs there.
        progress: called after every control period.
        on_stop: given a function that ends the flight early, from a signal handler too.
    Raises:
        ScenarioError: the scenario or a daemon's configuration cannot be used.
        SimError: the flight could not be flown to its end.
    """
    with ExitStack() as stack:
        stations = [GroundStation() for _ in scenario.fleet]
        for station in stations:
            stack.callback(station.close)
        scenario, endpoint = _on_free_ports(scenario, [station.port for station in stations])
        daemons = {
            vehicle.name: stack.enter_context(
                Daemon(
                    vehicle.name,
                    daemon_settings(
                        scenario,
                        vehicle,
                        onboard_port=vehicle.onboard_port or 0,
                        endpoint=endpoint,
                        lockstep=lockstep,
                    ),
                    folder,
                    log_flight=log_flight,
                )
            )
            for vehicle in scenario.fleet
        }
        resolved = resolve(name, scenario, seed, obstacles=obstacles)
        flown = _Flown(stack, resolved, endpoint, daemons, stations, lockstep=lockstep, trace=trace, progress=progress)
        on_stop(flown.runner.stop)
        return flown.fly()


class _Flown:
    """One checked flight: the runner, the operator and the eyes on it."""

    def __init__(
        self,
        stack: ExitStack,
        resolved: Resolved,
        endpoint: str,
        daemons: dict[str, Daemon],
        stations: list[GroundStation],
        *,
        lockstep: bool,
        trace: IO[bytes] | None,
        progress: Callable[[Flight], None],
    ) -> None:
        self._daemons = daemons
        self._progress = progress
        self._lag_ns = resolved.period_ns if lockstep else 0
        wires = self._wires = Wires(resolved, onboard_port=0, ground_port=0, endpoint=endpoint, lockstep=lockstep)
        stack.callback(wires.close)
        flight = self._flight = Flight(resolved)
        stack.callback(flight.close)
        watch = self._watch = Watch(flight)
        operator = ScriptedOperator(flight, wires, stations, plays=not lockstep)
        self.runner: Lockstep | RealTime
        tap = Tap(record=watch.record, packet=watch.packet)
        kind = Lockstep if lockstep else RealTime
        self.runner = kind(
            flight, wires, trace=Trace(trace), progress=self._tick, processes=daemons, operator=operator, tap=tap
        )
        watch.listen(self.runner.stations)

    def fly(self) -> CheckResult:
        try:
            summary = self.runner.run()
        except SimError:
            for daemon in self._daemons.values():  # one that has ended by itself is the better explanation
                daemon.check_alive()
            raise
        end_ns = self._flight.t_ns
        findings = [*self._findings(end_ns)]
        ended, failures = self._stop_daemons()
        return CheckResult((*findings, *failures), summary, ended)

    def _tick(self, flight: Flight) -> None:
        # lockstep reports after the physics, real time before it
        self._watch.tick(flight.t_ns - self._lag_ns)
        self._progress(flight)
        if flight.t_ns > GIVE_UP_S * NS_PER_S and all(craft.judge is None for craft in flight.crafts):
            self.runner.stop()

    def _findings(self, end_ns: int) -> Iterator[Finding]:
        crafts, seen = self._flight.crafts, self._watch.seen
        for craft in crafts:
            if craft.judge is None:
                about = f"{end_ns / NS_PER_S:.1f} s of flight without it"
                yield Finding(craft.name, "flight", "external control", False, about)
        for hit in self.runner.faults.hits:
            hit_crafts = range(len(crafts)) if hit.fault.on == "world" else (hit.craft,)
            for index in hit_crafts:
                yield from of_fault(hit, crafts[index], seen[index], end_ns)
        expect = self._flight.resolved.scenario.expect
        for craft, history in zip(crafts, seen, strict=True):
            yield from of_flight(DEFAULT if expect == Expectation() else expect, craft, history)

    def _stop_daemons(self) -> tuple[dict[str, dict[str, Any] | None], list[Finding]]:
        """Their summaries; one that does not end in peace is a failed expectation.

        The links are served meanwhile: a daemon hands a flying vehicle back before it ends.
        """
        for daemon in self._daemons.values():
            daemon.ask_to_stop()
        deadline = time.monotonic() + _STOP_S
        while any(daemon.running for daemon in self._daemons.values()) and time.monotonic() < deadline:
            self.runner.serve(_POLL_S)
        summaries: dict[str, dict[str, Any] | None] = {}
        failures = []
        for name, daemon in self._daemons.items():
            try:
                summaries[name] = daemon.summary()
            except DaemonFailed as error:
                summaries[name] = None
                failures.append(Finding(name, "daemon", "a clean end after SIGTERM", False, str(error)))
        return summaries, failures


def _on_free_ports(scenario: Scenario, ground_ports: list[int]) -> tuple[Scenario, str]:
    """The scenario with a free onboard port for each vehicle, and a free Zenoh endpoint."""
    with _bound([socket.SOCK_DGRAM] * len(ground_ports)) as onboard, _bound([socket.SOCK_STREAM]) as zenoh:
        endpoint = f"tcp/127.0.0.1:{zenoh[0]}"
        fleet = tuple(
            msgspec.structs.replace(vehicle, onboard_port=own, gcs_port=ground)
            for vehicle, own, ground in zip(scenario.fleet, onboard, ground_ports, strict=True)
        )
    vehicles = fleet if scenario.vehicles else ()
    return msgspec.structs.replace(scenario, vehicle=fleet[0], vehicles=vehicles), endpoint


@contextmanager
def _bound(kinds: list[socket.SocketKind]) -> Iterator[list[int]]:
    """Ports on the loopback that nobody else holds, all different."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(socket.AF_INET, kind)) for kind in kinds]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        yield [int(each.getsockname()[1]) for each in sockets]
