"""Cases, the peers they run against, and how a case waits: by subscription with a time limit, never by sleep."""

from __future__ import annotations

import asyncio
import math
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import aclosing, asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any

import mavsdk
from mavsdk import Configuration
from mavsdk.asyncio import ComponentType, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.manual_control import ManualControlAsync
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.exceptions import MavsdkError

from sim_bridge.testing import free_port

LIMIT_S = 12.0  # of wall time for one wait, against every peer
DISCOVERY_S = 20.0
M_PER_DEG = 111_320.0  # of latitude
SPEED = 4.0  # vehicle seconds a second

_AT_ONCE = 28

GROUND = ""  # a scenario's [vehicle] table: the default stands on the ground, disarmed
AIR = "start = [0.0, 0.0, 3.0]"  # starts armed, in Hold

Run = Callable[[Any], Any]


class NotSeen(AssertionError):
    """The awaited update did not come within the limit."""


@dataclass(frozen=True)
class Case:
    """One promise, against a vehicle that starts as ``vehicle`` says, at ``speed`` times real time."""

    name: str
    run: Run  # a coroutine function of a Drone, or where ``blocking`` a function of MAVSDK's blocking System
    vehicle: str
    speed: float
    more: str  # further tables of the scenario
    blocking: bool


def case(vehicle: str = AIR, *, speed: float = SPEED, more: str = "", blocking: bool = False) -> Callable[[Run], Run]:
    """Mark a function as a case of its module."""

    def mark(run: Run) -> Run:
        run.case = Case(run.__name__, run, vehicle, speed, more, blocking)  # type: ignore[attr-defined]
        return run

    return mark


def cases_of(*modules: ModuleType) -> list[Case]:
    """Every case that was written in ``modules``, in the order of the text."""
    found = [getattr(value, "case", None) for module in modules for value in vars(module).values()]
    return [each for each in found if isinstance(each, Case)]


@dataclass
class Drone:
    """A vehicle through MAVSDK, its plugins made on first use, and the peer's process."""

    system: Any
    speed: float
    process: subprocess.Popen[bytes]
    limit_s: float = LIMIT_S

    @cached_property
    def action(self) -> Any:
        return ActionAsync(self.system)

    @cached_property
    def telemetry(self) -> Any:
        return TelemetryAsync(self.system)

    @cached_property
    def offboard(self) -> Any:
        return OffboardAsync(self.system)

    @cached_property
    def param(self) -> Any:
        return ParamAsync(self.system)

    @cached_property
    def info(self) -> Any:
        return InfoAsync(self.system)

    @cached_property
    def manual(self) -> Any:
        return ManualControlAsync(self.system)

    @cached_property
    def direct(self) -> Any:
        return MavlinkDirectAsync(self.system)

    async def until(self, stream: Any, accept: Callable[[Any], bool], limit_s: float | None = None) -> list[Any]:
        """Every update up to the first that ``accept`` takes."""
        seen: list[Any] = []
        await self._collect(stream, accept, seen, limit_s)
        return seen

    async def next(self, stream: Any) -> Any:
        """The first update."""
        return (await self.until(stream, lambda update: True))[-1]

    async def take(self, stream: Any, count: int) -> list[Any]:
        """The first ``count`` updates."""
        left = iter(range(1, count + 1))
        return await self.until(stream, lambda update: next(left) == count)

    @asynccontextmanager
    async def expecting(self, stream: Any, accept: Callable[[Any], bool]) -> AsyncIterator[list[Any]]:
        """Subscribe first, run the block, then wait: what the block brings about cannot be missed."""
        seen: list[Any] = []
        task = asyncio.create_task(self._collect(stream, accept, seen, None))
        await asyncio.sleep(0)  # the task subscribes
        try:
            yield seen
            await task
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError, NotSeen):
                await task

    @asynccontextmanager
    async def watching(self, stream: Any) -> AsyncIterator[list[Any]]:
        """What arrives during the block."""
        seen: list[Any] = []
        task = asyncio.create_task(self._collect(stream, lambda update: False, seen, None))
        await asyncio.sleep(0)  # the task subscribes
        try:
            yield seen
        finally:
            task.cancel()
            with suppress(asyncio.CancelledError, NotSeen):
                await task

    async def _collect(
        self, stream: Any, accept: Callable[[Any], bool], seen: list[Any], limit_s: float | None
    ) -> None:
        limit_s = self.limit_s if limit_s is None else limit_s
        try:
            async with asyncio.timeout(limit_s), aclosing(stream) as updates:
                async for update in updates:
                    seen.append(update)
                    if accept(update):
                        return
        except TimeoutError:
            last = seen[-1] if seen else "none"
            raise NotSeen(f"{len(seen)} updates in {limit_s} s, the last: {last}") from None

    # --- what many cases need

    async def healthy(self) -> None:
        await self.until(self.telemetry.subscribe_health_all_ok(), bool)

    async def mode(self, name: str) -> list[Any]:
        """Wait for a flight mode."""
        return await self.until(self.telemetry.subscribe_flight_mode(), named(name))

    async def ned(self, accept: Callable[[Any], bool] = lambda ned: True) -> Any:
        """The first position and velocity that ``accept`` takes."""
        return (await self.until(self.telemetry.subscribe_position_velocity_ned(), accept))[-1]

    async def flying(self) -> None:
        """In the air, as the scenario put it there."""
        await self.until(self.telemetry.subscribe_in_air(), bool)

    async def took_off(self) -> None:
        """Arm on the ground and take off."""
        await self.healthy()
        await self.action.arm()
        await self.action.takeoff()
        await self.until(self.telemetry.subscribe_landed_state(), named("IN_AIR"))

    async def elapsed(self, seconds: float) -> None:
        """Until the vehicle's clock, as the attitude is stamped, has gone on by so much."""
        began_us = (await self.next(self.telemetry.subscribe_attitude_quaternion())).timestamp_us
        passed = lambda q: q.timestamp_us - began_us > seconds * 1e6  # noqa: E731
        await self.until(self.telemetry.subscribe_attitude_quaternion(), passed)

    async def goto(self, north_m: float, east_m: float, up_m: float, yaw_deg: float = math.nan) -> None:
        """Action.goto_location to a place relative to this one."""
        here = await self.next(self.telemetry.subscribe_position())
        latitude_deg = here.latitude_deg + north_m / M_PER_DEG
        longitude_deg = here.longitude_deg + east_m / (M_PER_DEG * math.cos(math.radians(here.latitude_deg)))
        await self.action.goto_location(latitude_deg, longitude_deg, here.absolute_altitude_m + up_m, yaw_deg)

    async def offboard_with(self, *setpoints: Awaitable[None]) -> None:
        """Offboard once the autopilot has seen a second of the stream, as PX4's guide asks for."""
        for each in setpoints:
            await each
        await self.elapsed(1.2)
        await self.offboard.start()
        await self.mode("OFFBOARD")


def named(*names: str) -> Callable[[Any], bool]:
    """Takes an enumeration value of one of these names."""
    return lambda update: update.name in names


def in_order(*names: str) -> Callable[[Any], bool]:
    """Takes the update at which the last of ``names`` is seen, each after the one before."""
    awaited = list(names)

    def accept(update: Any) -> bool:
        if update.name == awaited[0]:
            awaited.pop(0)
        return not awaited

    return accept


@contextmanager
def refused(*results: str) -> Iterator[None]:
    """The block must raise MAVSDK's error with one of these results."""
    try:
        yield
    except MavsdkError as error:
        result = getattr(error, "result", None)
        if result is None or result.name not in results:
            raise AssertionError(f"expected {' or '.join(results)}, got {error}") from error
    else:
        raise AssertionError(f"expected {' or '.join(results)}, but it was granted")


# --- peers


def simulator(case: Case, folder: Path) -> tuple[subprocess.Popen[bytes], int]:
    """The simulator that a case wants, and the port to listen on."""
    scenario = folder / f"{case.name}.toml"
    scenario.write_text(f"[vehicle]\n{case.vehicle}\n[end]\nstop = false\n{case.more}\n", encoding="utf-8")
    port = free_port()
    words = ["run", "--scenario", str(scenario), "--stay", "--speed", str(case.speed), "--zenoh-listen", "none"]
    words += ["--onboard-port", str(free_port()), "--gcs-port", str(port)]
    with (folder / "simulator.log").open("ab") as log:
        return _process(["-m", "sim_bridge.cli", *words], log), port


def dumb(ports: list[int], folder: Path) -> subprocess.Popen[bytes]:
    """As many dumb autopilots as ``ports``, in one process."""
    script = Path(__file__).parent.parent / "dumb_autopilot.py"
    with (folder / "dumb.log").open("ab") as log:
        return _process([str(script), *map(str, ports)], log)


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


def fly(case: Case, folder: Path) -> None:
    """Run a case against the simulator."""
    process, port = simulator(case, folder)
    try:
        with asyncio.Runner() as runner:
            runner.get_loop().set_default_executor(ThreadPoolExecutor(max_workers=12))
            runner.run(attempt(case, port, process))
    finally:
        end(process)


@dataclass(frozen=True)
class Outcome:
    """How a case ended: what it raised, and whether that is a promise not kept instead of something broken."""

    error: str
    unkept: bool


def fly_dumb(cases: list[Case], folder: Path) -> dict[str, Outcome]:
    """Run all cases at once, each against a dumb autopilot of its own.

    Spread over processes: MAVSDK has 32 MAVLink channels a process, and corrupts memory when they run out.
    """
    count = math.ceil(len(cases) / _AT_ONCE)
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
    process = dumb(ports, folder)

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
