"""The same promises through `mavsdk`'s blocking API: plain calls, and callbacks on MAVSDK's thread."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from mavsdk.plugins.action import Action
from mavsdk.plugins.info import Info
from mavsdk.plugins.offboard import Offboard, PositionNedYaw, VelocityNedYaw
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry

from mavsdk_cases.harness import AIR, GROUND, LIMIT_S, NotSeen, case, refused


@contextmanager
def updates(plugin: Any, topic: str) -> Iterator[Callable[[Callable[[Any], bool]], Any]]:
    """Subscribe to a topic; yields a function that waits for the first update that is accepted."""
    inbox: queue.Queue[Any] = queue.Queue()
    handle = getattr(plugin, f"subscribe_{topic}")(lambda update, _: inbox.put(update))

    def wait(accept: Callable[[Any], bool]) -> Any:
        deadline_s, last = time.monotonic() + LIMIT_S, None
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            try:
                last = inbox.get(timeout=left_s)
            except queue.Empty:
                break
            if accept(last):
                return last
        raise NotSeen(f"{topic}: not within {LIMIT_S} s, the last: {last}")

    try:
        yield wait
    finally:
        getattr(plugin, f"unsubscribe_{topic}")(handle)


@case(GROUND, blocking=True)
def blocking_takeoff_and_landing(system: Any) -> None:
    """Action.arm, takeoff and land block until acknowledged; Telemetry's callbacks tell the rest."""
    action, telemetry = Action(system), Telemetry(system)
    with updates(telemetry, "health_all_ok") as health, updates(telemetry, "landed_state") as landed:
        health(bool)
        action.arm()
        action.takeoff()
        landed(lambda state: state.name == "IN_AIR")
        action.land()
        landed(lambda state: state.name == "ON_GROUND")
    with updates(telemetry, "armed") as armed:
        armed(lambda value: not value)


@case(AIR, blocking=True)
def blocking_disarm_in_the_air_is_refused(system: Any) -> None:
    """Action.disarm raises ActionError with its result."""
    with updates(Telemetry(system), "in_air") as in_air:
        in_air(bool)
    with refused("COMMAND_DENIED", "COMMAND_DENIED_NOT_LANDED"):
        Action(system).disarm()


@case(AIR, blocking=True)
def blocking_parameter_acts(system: Any) -> None:
    """Param.set_param_float: MPC_LAND_SPEED is flown."""
    param, telemetry = Param(system), Telemetry(system)
    param.set_param_float("MPC_LAND_SPEED", 0.9)
    assert abs(param.get_param_float("MPC_LAND_SPEED") - 0.9) < 1e-6
    with updates(telemetry, "position_velocity_ned") as ned:
        Action(system).land()
        ned(lambda now: 0.75 < now.velocity.down_m_s < 1.05 and now.position.down_m > -1.5)


@case(GROUND, blocking=True)
def blocking_version(system: Any) -> None:
    """Info.get_version and get_product."""
    info = Info(system)
    assert info.get_version().flight_sw_major >= 1
    assert info.get_product().vendor_id > 0


@case(AIR, speed=2.0, blocking=True)
def blocking_offboard_flies(system: Any) -> None:
    """Offboard: a setpoint, a stream, start; the position is flown to; stop is Hold."""
    offboard, telemetry = Offboard(system), Telemetry(system)
    Param(system).set_param_float("COM_OF_LOSS_T", 5.0)  # of vehicle time; MAVSDK streams in wall time
    offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    with updates(telemetry, "attitude_quaternion") as attitude:
        began_us = attitude(lambda q: True).timestamp_us
        attitude(lambda q: q.timestamp_us - began_us > 1_200_000)
    with updates(telemetry, "flight_mode") as mode, updates(telemetry, "position_velocity_ned") as ned:
        offboard.start()
        mode(lambda value: value.name == "OFFBOARD")
        offboard.set_position_ned(PositionNedYaw(1.5, 0.0, -3.0, 0.0))
        ned(lambda now: abs(now.position.north_m - 1.5) < 0.15)
        offboard.stop()
        mode(lambda value: value.name == "HOLD")


@case(AIR, blocking=True)
def blocking_return_to_launch(system: Any) -> None:
    """Action.return_to_launch: mode and climb to the altitude that was set."""
    action, telemetry = Action(system), Telemetry(system)
    action.set_return_to_launch_altitude(4.5)
    Param(system).set_param_int("RTL_CONE_ANG", 0)
    with updates(telemetry, "flight_mode") as mode, updates(telemetry, "position") as position:
        here = position(lambda p: True)
        action.goto_location(here.latitude_deg + 5e-5, here.longitude_deg, here.absolute_altitude_m, 0.0)
        position(lambda p: p.latitude_deg > here.latitude_deg + 4e-5)
        action.return_to_launch()
        mode(lambda value: value.name == "RETURN_TO_LAUNCH")
        position(lambda p: p.relative_altitude_m > 4.2)
