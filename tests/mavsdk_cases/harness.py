"""What a case is, and how it waits: by subscription with a time limit, never by sleep."""

from __future__ import annotations

import asyncio
import math
import subprocess
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import aclosing, asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.info import InfoAsync
from mavsdk.asyncio.plugins.manual_control import ManualControlAsync
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.offboard import OffboardError, OffboardResult

LIMIT_S = 12.0  # of wall time for one wait, against every peer
M_PER_DEG = 111_320.0  # of latitude
SPEED = 4.0  # vehicle seconds a second

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
    alters: bool  # False: the next case finds the vehicle as this one did


def case(
    vehicle: str = AIR, *, speed: float = SPEED, more: str = "", blocking: bool = False, alters: bool = True
) -> Callable[[Run], Run]:
    """Mark a function as a case of its module."""

    def mark(run: Run) -> Run:
        run.case = Case(run.__name__, run, vehicle, speed, more, blocking, alters)  # type: ignore[attr-defined]
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

    async def fenced_out(self) -> None:
        """Home is moved 60 m away and the fence drawn 20 m around it."""
        home = await self.next(self.telemetry.subscribe_home())
        latitude_deg = home.latitude_deg + 60.0 / M_PER_DEG
        await self.param.set_param_int("GF_ACTION", 2)
        await self.param.set_param_float("GF_MAX_HOR_DIST", 20.0)
        await self.action.set_home(False, latitude_deg, home.longitude_deg, home.absolute_altitude_m)

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

    async def poll(self, ask: Callable[[], Awaitable[bool]]) -> None:
        """Ask with each update of the attitude until the answer is yes: for what cannot be subscribed to."""
        try:
            async with (
                asyncio.timeout(self.limit_s),
                aclosing(self.telemetry.subscribe_attitude_quaternion()) as moments,
            ):
                async for _ in moments:
                    if await ask():
                        return
        except TimeoutError:
            raise NotSeen(f"not so within {self.limit_s} s") from None

    async def offboard_ends(self) -> None:
        """Until MAVSDK's is_active is False: it gives up seconds after it has heard of another mode."""

        async def over() -> bool:
            return not await self.offboard.is_active()

        await self.poll(over)

    async def offboard_with(self, setpoint: Awaitable[None], *, loss_s: float = 5.0) -> None:
        """Offboard, once the autopilot has seen enough of the stream; ``loss_s`` of vehicle time without it are borne,
        since MAVSDK streams in wall time."""
        await self.param.set_param_float("COM_OF_LOSS_T", loss_s)
        await setpoint
        await self.elapsed(1.0)

        async def granted() -> bool:
            try:
                await self.offboard.start()
            except OffboardError as error:
                if error.result is OffboardResult.COMMAND_DENIED:
                    return False
                raise
            return True

        await self.poll(granted)
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
