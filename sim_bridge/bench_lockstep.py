"""The bench's case over real sockets: this process is the simulator, the daemon a subprocess, as a user runs them."""

from __future__ import annotations

import socket
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.daemon import Daemon, daemon_settings
from sim_bridge.errors import SimError
from sim_bridge.flight import Flight
from sim_bridge.inprocess import sectioned
from sim_bridge.lockstep_runner import Lockstep
from sim_bridge.placement import Resolved
from sim_bridge.runner import Tap, Trace
from sim_bridge.sections import Case, Sections, case
from sim_bridge.wires import Wires
from sim_bridge.zenoh_io import Record

_ENGAGE = 92  # MAV_CMD_NAV_GUIDED_ENABLE
_COMPANION = 196


def measure_lockstep(
    name: str, resolved: Resolved, *, demand: float, settings: Sequence[str] = (), sections: bool = True
) -> Case:
    """Ticks from the entry into offboard to the scenario's end, and a second flight for where the time goes.

    Args:
        settings: of the daemon, each KEY=VALUE.
        sections: fly that second flight.
    Raises:
        SimError: the daemon did not start, or lockstep stalled.
    """
    flight = Flight(resolved)
    try:
        with _daemon(resolved, settings) as ports:
            ticks_ns, factor, _, acting = _fly(flight, ports, _noting_ticks)
    finally:
        flight.close()
    spent: dict[str, float] = {}
    if sections:
        counted = Sections()
        with sectioned(counted, resolved) as flight, _daemon(resolved, settings) as ports:
            noted, _, daemon_ms, _ = _fly(flight, ports, lambda runner, wires: _counting(counted, runner, wires))
            spent = counted.ms_per(len(noted)) | daemon_ms
    return case(name, ticks_ns, factor, demand=demand, sections=spent, acting=acting)


Ports = tuple[int, int, str]  # onboard, ground station, Zenoh endpoint
Noting = Callable[[Lockstep, Wires], list[int]]


def _fly(flight: Flight, ports: Ports, prepare: Noting) -> tuple[list[int], float, dict[str, float], float]:
    """The ticks [ns] that ``prepare`` notes, the real-time factor, the daemon's own times [ms, medians], and the
    share of its flown ticks in which its filter acted."""
    onboard, ground, endpoint = ports
    wires = Wires(flight.resolved, onboard_port=onboard, ground_port=ground, endpoint=endpoint, lockstep=True)
    daemon_ms: defaultdict[str, list[float]] = defaultdict(list)
    acted: list[bool] = []

    def note(index: int, record: Record) -> None:
        for key, value in record.timings_ms.items():
            daemon_ms[key].append(value)
        if record.state == "ACTIVE":
            acted.append(record.verdict != "nominal")

    try:
        _engage(wires.crafts[0].router.ground.socket.getsockname())
        tap = Tap(record=note, packet=lambda index, packet: None)
        runner = Lockstep(flight, wires, trace=Trace(None), progress=lambda flight: None, tap=tap)
        noted = prepare(runner, wires)
        factor = runner.run()["real_time_factor"]
    finally:
        wires.close()
    if factor is None or not noted or not acted:
        raise SimError("bench: the daemon did not fly: expected offboard until the scenario's end")
    medians = {f"daemon: {key}": float(np.median(values)) for key, values in daemon_ms.items()}
    return noted, factor, medians, sum(acted) / len(acted)


def _noting_ticks(runner: Lockstep, wires: Wires) -> list[int]:
    """The time of each tick in external mode."""
    ticks_ns: list[int] = []
    account = runner._account

    def noting(marks: list[float]) -> None:
        if runner.flight.crafts[0].judge is not None:
            ticks_ns.append(round((marks[-1] - marks[0]) * 1e9))
        account(marks)

    runner._account = noting  # type: ignore[method-assign]
    return ticks_ns


def _counting(sections: Sections, runner: Lockstep, wires: Wires) -> list[int]:
    """As `_noting_ticks`; from the first of those ticks on, what the parts of a tick cost."""
    sections.wrap(wires, "waiting for the daemon", "wait")
    sections.wrap(runner, "receive", "_receive")
    for craft, station in zip(wires.crafts, runner.stations, strict=True):
        sections.wrap(craft.bridge, "Zenoh", "publish_frame", "publish_marker", "records")
        sections.wrap(station, "telemetry", "stream", "say", "announce")
        for link in craft.router.links:
            sections.wrap(link.encoder, "encode", "pack")
            sections.wrap(link, "sockets", "send")
    ticks_ns = _noting_ticks(runner, wires)
    account = runner._account

    def starting(marks: list[float]) -> None:
        if not ticks_ns:
            sections.start()
        account(marks)

    runner._account = starting  # type: ignore[method-assign]
    return ticks_ns


def _engage(address: tuple[str, int]) -> None:
    """The operator's one command, which lockstep keeps until its tick."""
    codec = dialect.MAVLink(None, 245, 190)
    message = dialect.MAVLink_command_long_message(1, _COMPANION, _ENGAGE, 0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(message.pack(codec), address)


@contextmanager
def _daemon(resolved: Resolved, settings: Sequence[str]) -> Iterator[Ports]:
    """`companion run` on free ports, in lockstep with ``resolved`` and with its log, until the block ends."""
    scenario, vehicle = resolved.scenario, resolved.scenario.fleet[0]
    onboard, ground = _free_port(socket.SOCK_DGRAM), _free_port(socket.SOCK_DGRAM)
    endpoint = f"tcp/127.0.0.1:{_free_port(socket.SOCK_STREAM)}"
    tied = daemon_settings(scenario, vehicle, onboard_port=onboard, endpoint=endpoint, lockstep=True)
    with (
        TemporaryDirectory(prefix="sim-bridge-bench-") as folder,
        Daemon(vehicle.name, (*tied, *settings), Path(folder), log_flight=True) as daemon,
    ):
        try:
            yield onboard, ground, endpoint
        except SimError as error:
            raise SimError(f"{error}; the daemon: {daemon.last_words()}") from None


def _free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
