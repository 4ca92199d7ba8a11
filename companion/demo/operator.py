"""The operator of the demo: MAVSDK on the simulator's ground station link, as a person with a ground station would.

Run as a process of its own (``python -m companion.demo.operator LINK X Y Z``; LINK is a UDP port of the loopback or a
MAVSDK connection such as ``udpout://simulator:18570``), because MAVSDK cannot be left while one of its calls waits for
an answer. Prints each step as it begins; exit status 1 and one line on standard error if
one fails. Never MAVSDK's Offboard plugin: it streams setpoints of its own beside the daemon's.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from companion.errors import CompanionError

CONNECT_S = 15.0
HOVER_S = 30.0
WATCH_EVERY = 5  # position updates
ATTEMPTS = 4  # of an action that nobody answers
COMPANION_COMPONENT = 196
_NAV_GUIDED_ENABLE = 92

T = TypeVar("T")


class OperatorError(CompanionError):
    """A step of the operator that failed; the message names the step."""


async def take_off_and_engage(
    connection: str, target_enu: tuple[float, float, float], on_step: Callable[[str], None]
) -> None:
    """Connect, wait for health, arm, take off, wait for the hover, engage the companion, watch until ended.

    Raises:
        OperatorError: a connection that cannot be used, or a step that was refused or timed out.
    """
    from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
    from mavsdk.asyncio.exceptions import MavsdkConnectionError

    # MAVSDK blocks executor threads while it waits for acknowledgements
    asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(max_workers=8))
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    async with Mavsdk(configuration) as mavsdk:
        on_step("connect")
        try:
            await mavsdk.add_any_connection(connection)
        except MavsdkConnectionError as error:
            raise OperatorError(f"operator: {connection}: {error}") from None
        system = await mavsdk.first_autopilot(timeout_s=CONNECT_S)
        if system is None:
            raise OperatorError(f"operator: no autopilot on {connection} within {CONNECT_S:g} s")
        await _fly(system, on_step)
        await _watch(system, target_enu, on_step)


async def _fly(system: Any, on_step: Callable[[str], None]) -> None:
    from mavsdk.asyncio.plugins.action import ActionAsync
    from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
    from mavsdk.plugins.action import ActionError
    from mavsdk.plugins.telemetry import FlightMode

    action, telemetry, direct = ActionAsync(system), TelemetryAsync(system), MavlinkDirectAsync(system)
    step = "health"
    try:
        on_step(step)
        await _until(telemetry.subscribe_health_all_ok(), lambda ok: bool(ok), step)
        for step, call in (("arm", action.arm), ("takeoff", action.takeoff)):
            on_step(step)
            await _insist(call)
        step = "hover"
        on_step(step)
        # airborne first: on the ground the mode is HOLD as well
        await _until(telemetry.subscribe_in_air(), bool, step)
        await _until(telemetry.subscribe_flight_mode(), lambda mode: mode == FlightMode.HOLD, step)
        step = "engage"
        on_step(step)
        await engage(direct)
    except ActionError as error:
        raise OperatorError(f"operator: {step} refused: {error}") from None


async def _insist(call: Callable[[], Awaitable[None]]) -> None:
    """An action, again where nobody answered it: MAVSDK gives up after two seconds, a busy machine may need more."""
    from mavsdk.plugins.action import ActionError, ActionResult

    for attempt in range(1, ATTEMPTS + 1):
        try:
            await call()
        except ActionError as error:
            if error.result is not ActionResult.TIMEOUT or attempt == ATTEMPTS:
                raise
        else:
            return


async def _watch(system: Any, target_enu: tuple[float, float, float], on_step: Callable[[str], None]) -> None:
    """Tell the distance to the target; goes on until the process is ended."""
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

    x, y, z = target_enu
    count = 0
    async with contextlib.aclosing(TelemetryAsync(system).subscribe_position_velocity_ned()) as updates:
        async for update in updates:
            p = update.position
            if count % WATCH_EVERY == 0:
                distance_m = math.dist((p.east_m, p.north_m, -p.down_m), (x, y, z))
                on_step(f"{distance_m:.1f} m to the target")
            count += 1


async def engage(direct: Any) -> None:
    """MAV_CMD_NAV_GUIDED_ENABLE to component 196; a denial does not raise in MAVSDK, so its result is read."""
    from mavsdk.plugins.mavlink_direct import MavlinkMessage

    fields: dict[str, float] = {
        "target_system": 1,
        "target_component": COMPANION_COMPONENT,
        "command": _NAV_GUIDED_ENABLE,
    }
    fields |= {"confirmation": 0, "param1": 1.0} | {f"param{i}": 0.0 for i in range(2, 8)}
    command = MavlinkMessage(
        message_name="COMMAND_LONG",
        target_system_id=1,
        target_component_id=COMPANION_COMPONENT,
        fields_json=json.dumps(fields),
    )
    answer = await direct.send_command(command)
    result = json.loads(answer.fields_json or "{}").get("result")
    if result != 0:
        raise OperatorError(f"operator: engage refused by the companion (MAV_RESULT {result})")


async def _until(updates: AsyncIterator[T], accept: Callable[[T], bool], step: str) -> None:
    """The first update that ``accept`` takes; the subscription is closed either way."""
    async with contextlib.aclosing(updates) as stream:  # type: ignore[type-var]
        try:
            async with asyncio.timeout(HOVER_S):
                async for update in stream:
                    if accept(update):
                        return
        except TimeoutError:
            raise OperatorError(f"operator: {step}: expected within {HOVER_S:g} s") from None


def main(arguments: list[str]) -> int:
    """Fly as the operator on the link given, to the target given; MAVSDK's messages go to standard error."""
    from mavsdk.logging import log_subscribe

    def write(level: Any, message: str, file: str | None, line: int) -> bool:
        print(level.name, message, file=sys.stderr)
        return True

    log_subscribe(write)
    try:
        link, (x, y, z) = arguments[0], (float(word) for word in arguments[1:4])
        connection = f"udpin://127.0.0.1:{link}" if link.isdecimal() else link
        asyncio.run(take_off_and_engage(connection, (x, y, z), lambda step: print(step, flush=True)))
    except OperatorError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
