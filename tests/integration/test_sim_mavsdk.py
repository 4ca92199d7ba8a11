"""MAVSDK, which we did not write, against the running simulator process."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import aclosing, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

mavsdk = pytest.importorskip("mavsdk.asyncio")

pytestmark = pytest.mark.integration

HOLD, TAKEOFF_MODE, LAND, OFFBOARD = "HOLD", "TAKEOFF", "LAND", "OFFBOARD"


def free_ports(count: int, kind: socket.SocketKind = socket.SOCK_DGRAM) -> list[int]:
    sockets = [socket.socket(socket.AF_INET, kind) for _ in range(count)]
    try:
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]
    finally:
        for each in sockets:
            each.close()


def start(arguments: list[str], log: Path) -> subprocess.Popen[bytes]:
    with log.open("wb") as stderr:
        return subprocess.Popen(
            [sys.executable, "-m", "sim_bridge.cli", *arguments], stdout=subprocess.PIPE, stderr=stderr
        )


@pytest.fixture
def simulator(tmp_path: Path) -> Iterator[Callable[..., tuple[subprocess.Popen[bytes], int]]]:
    """Start a simulator; returns the process and its ground station port. All are gone afterwards."""
    started: list[subprocess.Popen[bytes]] = []

    def run(scenario: str = "empty") -> tuple[subprocess.Popen[bytes], int]:
        onboard, ground = free_ports(2)
        ports = ["--onboard-port", str(onboard), "--gcs-port", str(ground), "--zenoh-listen", "none"]
        process = start(["run", "--scenario", scenario, *ports, "--json"], tmp_path / "simulator.log")
        started.append(process)
        return process, ground

    yield run
    for process in started:
        if process.poll() is None:
            process.kill()
        process.wait()
        if process.stdout:
            process.stdout.close()


@asynccontextmanager
async def autopilot(ground_port: int) -> AsyncIterator[Any]:
    asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(max_workers=12))
    configuration = mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
    async with mavsdk.Mavsdk(configuration) as library:
        await library.add_any_connection(f"udpin://127.0.0.1:{ground_port}")
        system = await library.first_autopilot(timeout_s=15.0)
        assert system is not None
        yield system


async def until(stream: Any, accept: Callable[[Any], bool], limit_s: float = 20.0) -> list[Any]:
    """Everything up to the first update that ``accept`` takes."""
    seen = []
    async with asyncio.timeout(limit_s), aclosing(stream) as updates:
        async for update in updates:
            seen.append(update)
            if accept(update):
                break
    return seen


def in_order(names: Iterator[str]) -> Callable[[Any], bool]:
    """Takes the update at which the last of ``names`` is seen, each after the one before."""
    awaited = next(names)

    def accept(update: Any) -> bool:
        nonlocal awaited
        if update.name != awaited:
            return False
        following = next(names, None)
        awaited = awaited if following is None else following
        return following is None

    return accept


def test_arm_take_off_hold_land_and_disarm(simulator: Any) -> None:
    from mavsdk.asyncio.plugins.action import ActionAsync
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

    process, port = simulator()

    async def fly() -> None:
        async with autopilot(port) as system:
            action, telemetry = ActionAsync(system), TelemetryAsync(system)
            await until(telemetry.subscribe_health_all_ok(), bool)
            home = (await until(telemetry.subscribe_home(), lambda home: True))[-1]
            assert home.latitude_deg == pytest.approx(47.397742, abs=1e-6)
            assert not (await until(telemetry.subscribe_in_air(), lambda x: True))[-1]

            await action.arm()
            await until(telemetry.subscribe_armed(), bool)
            wanted = iter((TAKEOFF_MODE, HOLD))
            modes = asyncio.create_task(until(telemetry.subscribe_flight_mode(), in_order(wanted)))
            await asyncio.sleep(0)  # the task subscribes before the mode changes
            await action.takeoff()
            await until(telemetry.subscribe_in_air(), bool)
            assert {mode.name for mode in await modes} <= {TAKEOFF_MODE, HOLD}
            ned = (await until(telemetry.subscribe_position_velocity_ned(), lambda x: True))[-1]
            assert ned.position.down_m == pytest.approx(-1.5, abs=0.1)

            with pytest.raises(Exception, match="DENIED"):
                await action.disarm()  # in the air
            await action.land()
            states = await until(telemetry.subscribe_landed_state(), lambda s: s.name == "ON_GROUND")
            assert "LANDING" in {s.name for s in states}
            await until(telemetry.subscribe_armed(), lambda armed: not armed)  # by itself

    asyncio.run(fly())
    assert process.poll() is None


def test_altitude_parameter_acts_through_mavsdk(simulator: Any) -> None:
    from mavsdk.asyncio.plugins.action import ActionAsync
    from mavsdk.asyncio.plugins.param import ParamAsync
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

    _, port = simulator()

    async def fly() -> None:
        async with autopilot(port) as system:
            action, telemetry, param = ActionAsync(system), TelemetryAsync(system), ParamAsync(system)
            assert await param.get_param_int("COM_OBL_RC_ACT") == 5  # bytewise integer
            await action.set_takeoff_altitude(2.25)
            assert await action.get_takeoff_altitude() == pytest.approx(2.25)
            await until(telemetry.subscribe_health_all_ok(), bool)
            await action.arm()
            await action.takeoff()
            await until(telemetry.subscribe_position_velocity_ned(), lambda ned: ned.position.down_m < -2.15)

    asyncio.run(fly())


def test_offboard_needs_a_stream_and_then_accelerates_the_vehicle(simulator: Any, tmp_path: Path) -> None:
    from mavsdk.asyncio.plugins.offboard import OffboardAsync
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
    from mavsdk.plugins.offboard import AccelerationNed

    scenario = tmp_path / "airborne.toml"
    scenario.write_text("[vehicle]\nstart = [0.0, 0.0, 3.0]\n[end]\nstop = false\n")
    _, port = simulator(str(scenario))

    async def fly() -> None:
        async with autopilot(port) as system:
            offboard, telemetry = OffboardAsync(system), TelemetryAsync(system)
            await until(telemetry.subscribe_health_all_ok(), bool)
            await offboard.set_acceleration_ned(AccelerationNed(1.0, 0.0, 0.0))
            texts = asyncio.create_task(until(telemetry.subscribe_status_text(), lambda t: "no setpoint" in t.text))
            await asyncio.sleep(0)  # the task subscribes before the autopilot has anything to say
            with pytest.raises(Exception, match="DENIED"):
                await offboard.start()  # MAVSDK has streamed for some milliseconds only
            await texts
            moments = iter(range(8))  # of telemetry at 10 Hz: MAVSDK goes on streaming meanwhile
            await until(telemetry.subscribe_position_velocity_ned(), lambda _: next(moments) == 7)
            await offboard.start()
            await until(telemetry.subscribe_flight_mode(), lambda m: m.name == OFFBOARD)
            ned = await until(telemetry.subscribe_position_velocity_ned(), lambda x: x.velocity.north_m_s > 0.8)
            assert abs(ned[-1].velocity.east_m_s) < 0.1

    asyncio.run(fly())


def test_signals_end_it_cleanly_with_one_json_object(simulator: Any) -> None:
    from pymavlink.dialects.v20 import ardupilotmega as dialect

    process, port = simulator()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ground:
        ground.bind(("127.0.0.1", port))
        ground.settimeout(15.0)
        first = dialect.MAVLink(None).parse_buffer(ground.recv(4096))
        assert first[0].get_type() == "HEARTBEAT"
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=1.0)
    summary = json.loads(out)
    assert process.returncode == 0
    assert summary["ended"] is None
    assert summary["reached"] is False
