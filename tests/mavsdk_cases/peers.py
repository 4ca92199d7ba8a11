"""The peers that a case runs against, the simulator or a dumb autopilot, as processes; and the runs themselves."""

from __future__ import annotations

import asyncio
import math
import socket
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import mavsdk
from mavsdk import Configuration
from mavsdk.asyncio import ComponentType, Mavsdk
from mavsdk.exceptions import MavsdkError

from mavsdk_cases.harness import AIR, Case, Drone
from sim_bridge.testing import free_port

DISCOVERY_S = 20.0
_SIMULATORS = 3  # at once: they wait most of the time, but for two slow cores
_AT_ONCE = 14  # dumb autopilots a process


def simulator(case: Case, folder: Path) -> tuple[subprocess.Popen[bytes], int]:
    """The simulator that a case wants, and the port to listen on."""
    scenario = folder / f"{case.name}.toml"
    scenario.write_text(f"[vehicle]\n{case.vehicle}\n[end]\nstop = false\n{case.more}\n", encoding="utf-8")
    port = free_port()
    words = ["run", "--scenario", str(scenario), "--stay", "--speed", str(case.speed), "--zenoh-listen", "none"]
    words += ["--onboard-port", str(free_port()), "--gcs-port", str(port)]
    with (folder / "simulator.log").open("ab") as log:
        return _process(["-m", "sim_bridge.cli", *words], log), port


def dumb(cases: list[Case], ports: list[int], folder: Path) -> subprocess.Popen[bytes]:
    """A dumb autopilot for each case, on the ground or at the height that the case starts from; in one process."""
    script = Path(__file__).parent.parent / "dumb_autopilot.py"
    with (folder / "dumb.log").open("ab") as log:
        places = (f"{port}@{3.0 if case.vehicle == AIR else 0.0}" for case, port in zip(cases, ports, strict=True))
        return _process([str(script), *places], log)


def _process(words: list[str], log: Any) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, *words], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log)


def end(process: subprocess.Popen[bytes]) -> None:
    """The process is gone afterwards."""
    if process.poll() is None:
        process.kill()
    process.wait()


async def attempt(case: Case, port: int, process: subprocess.Popen[bytes]) -> None:
    """Connect to the vehicle that sends to ``port``, and run the case."""
    if case.blocking:
        await asyncio.get_running_loop().run_in_executor(None, attempt_blocking, case, port)
        return
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as library:
        await library.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await library.first_autopilot(timeout_s=DISCOVERY_S)
        if system is None:
            raise RuntimeError("no autopilot was discovered")
        await case.run(Drone(system, case.speed, process))


def attempt_blocking(case: Case, port: int) -> None:
    """The same with MAVSDK's blocking API."""
    with mavsdk.Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as library:
        library.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = library.first_autopilot(timeout_s=DISCOVERY_S)
        if system is None:
            raise RuntimeError("no autopilot was discovered")
        case.run(system)


def fly(cases: list[Case], folder: Path) -> dict[str, BaseException | None]:
    """Run cases against simulators, a few at a time; what each of them raised.

    Each has a simulator of its own, but for those that leave the vehicle as they found it: they share one. MAVSDK's
    time-outs are wall time, which a busy machine takes away: what failed beside others flies once more, alone.
    """
    raised: dict[str, BaseException | None] = {}
    places = asyncio.Semaphore(_SIMULATORS)

    async def one_after_the_other(group: list[Case]) -> None:
        async with places:
            process, port = simulator(group[0], folder)
            try:
                for case in group:
                    (raised[case.name],) = await asyncio.gather(attempt(case, port, process), return_exceptions=True)
            finally:
                end(process)

    async def all_of_them() -> None:
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(max_workers=12 * _SIMULATORS))
        await asyncio.gather(*map(one_after_the_other, _groups(cases)))
        for case in [case for case in cases if raised[case.name] is not None]:
            await one_after_the_other([case])

    asyncio.run(all_of_them())
    return raised


def _groups(cases: list[Case]) -> list[list[Case]]:
    """Cases that can share a simulator together, the others alone."""
    shared: dict[tuple[str, float, str], list[Case]] = {}
    alone = []
    for case in cases:
        if case.alters:
            alone.append([case])
        else:
            shared.setdefault((case.vehicle, case.speed, case.more), []).append(case)
    return [*shared.values(), *alone]


@dataclass(frozen=True)
class Outcome:
    """How a case ended: what it raised, and whether that is a promise not kept instead of something broken."""

    error: str
    unkept: bool


def fly_dumb(cases: list[Case], folder: Path) -> dict[str, Outcome]:
    """Run all cases at once, each against a dumb autopilot of its own.

    Spread over processes: MAVSDK 4.1 corrupts the memory of one with more than 16 instances (22 and more were seen to).
    """
    count = math.ceil(len(cases) / _AT_ONCE)
    if count == 1:
        return dict(zip([case.name for case in cases], _fly_dumb(cases, folder), strict=True))
    groups = [cases[i::count] for i in range(count)]
    with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
        outcomes = pool.map(_fly_dumb, groups, [folder] * count)
        return {
            case.name: outcome
            for group, ended in zip(groups, outcomes, strict=True)
            for case, outcome in zip(group, ended, strict=True)
        }


def _fly_dumb(cases: list[Case], folder: Path) -> list[Outcome]:
    ports = free_ports(len(cases))
    process = dumb(cases, ports, folder)

    async def all_of_them() -> list[BaseException | None]:
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(max_workers=5 * len(cases)))
        attempts = (attempt(case, port, process) for case, port in zip(cases, ports, strict=True))
        return await asyncio.gather(*attempts, return_exceptions=True)

    try:
        raised = asyncio.run(all_of_them())
    finally:
        end(process)
    return [Outcome(repr(error), isinstance(error, AssertionError | MavsdkError)) for error in raised]


def free_ports(count: int) -> list[int]:
    """Different ports, all of them held until the last is known."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]
    finally:
        for each in sockets:
            each.close()
