"""Component 196's standard services through a running daemon's socket, with pymavlink as a plain ground station."""

from __future__ import annotations

import json
import math
import socket
import tomllib
from pathlib import Path
from typing import Any

import pytest
from integration.test_service import Autopilot, Failing, activate, neighbour, run
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.service import Service
from companion.tunables import BY_NAME
from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration


class Station:
    """A ground station 255/190 behind the autopilot's link."""

    def __init__(self, autopilot: Autopilot) -> None:
        self._autopilot = autopilot
        self.mav = dialect.MAVLink(None, 255, 190)

    def send(self, message: Any) -> None:
        self._autopilot._socket.sendto(message.pack(self.mav), self._autopilot._address)

    def command(self, number: int, param1: float, *, component: int = 196) -> None:
        self.send(self.mav.command_long_encode(1, component, number, 0, param1, 0, 0, 0, 0, 0, 0))

    async def result(self, number: int, param1: float) -> int:
        self._autopilot.received.clear()
        self.command(number, param1)
        while not (acks := self._autopilot.of("COMMAND_ACK")):
            await self._autopilot.fly()
        assert (acks[0].command, acks[0].target_system, acks[0].target_component) == (number, 255, 190)
        return int(acks[0].result)

    async def until(self, kind: str, count: int = 1, ticks: int = 100) -> list[Any]:
        for _ in range(ticks):
            if len(found := self._autopilot.of(kind)) >= count:
                return found
            await self._autopilot.fly()
        raise AssertionError(f"no {count} {kind} within {ticks} ticks, got {len(self._autopilot.of(kind))}")


def test_parameters_are_listed_set_and_refused() -> None:
    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        brain.retune = brain._pilot.retune  # type: ignore[attr-defined]
        station = Station(autopilot)
        station.send(station.mav.param_request_list_encode(1, 0))
        values = await station.until("PARAM_VALUE", len(BY_NAME))
        assert [m.param_index for m in values] == list(range(len(BY_NAME)))
        assert [m.param_id for m in values] == list(BY_NAME)
        assert {m.param_count for m in values} == {len(BY_NAME)}

        autopilot.received.clear()
        station.send(station.mav.param_set_encode(1, 196, b"CA_CUSHION", 0.3, 9))
        (value,) = await station.until("PARAM_VALUE")
        assert (value.param_id, value.param_value) == ("CA_CUSHION", pytest.approx(0.3))
        assert service._services._live.config.safety.cushion_m == 0.3
        assert json.loads(service._doors._config_json())["config"]["safety"]["cushion_m"] == 0.3

        for value_sent, reason in ((math.nan, "expected a number in"), (-1.0, "expected a number in")):
            autopilot.received.clear()
            station.send(station.mav.param_set_encode(1, 196, b"CA_CUSHION", value_sent, 9))
            (value,) = await station.until("PARAM_VALUE")
            assert value.param_value == pytest.approx(0.3)
            texts = await station.until("STATUSTEXT")
            assert texts[0].text.startswith("refused: PARAM_SET: CA_CUSHION: ")
            assert reason in "".join(m.text for m in texts)
        autopilot.received.clear()
        station.send(station.mav.param_set_encode(1, 196, b"CA_ACC_MAX", 2.0, 9))  # the policy asks for 3
        (value,) = await station.until("PARAM_VALUE")
        assert value.param_value == 3.0
        autopilot.received.clear()
        station.send(station.mav.param_set_encode(1, 196, b"CA_ARENA_E", 2.0, 9))  # the target is farther east
        (value,) = await station.until("PARAM_VALUE")
        assert value.param_value == 10.0

    assert run(script, target={"position": [3.0, 0.0, 2.0]}).final_state == "READY"


def test_a_target_that_came_later_keeps_the_arena_open() -> None:
    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        brain.retune = brain._pilot.retune  # type: ignore[attr-defined]
        station = Station(autopilot)
        point = (1, 196, 1, 192, 0, 0, 0, 0, 0, math.nan, 0, 80_000, -2.0)  # LOCAL_NED, 8 m east
        station.send(station.mav.command_int_encode(*point))
        await station.until("COMMAND_ACK")
        for wall, held in ((7.0, 10.0), (9.0, 9.0)):
            autopilot.received.clear()
            station.send(station.mav.param_set_encode(1, 196, b"CA_ARENA_E", wall, 9))
            (value,) = await station.until("PARAM_VALUE")
            assert value.param_value == held
        point = (*point[:11], 95_000, -2.0)  # 9.5 m: inside the old arena only
        autopilot.received.clear()
        station.send(station.mav.command_int_encode(*point))
        (ack,) = await station.until("COMMAND_ACK")
        assert ack.result == 2  # DENIED

    run(script)


def test_messages_on_request() -> None:
    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        station = Station(autopilot)
        assert await station.result(512, 148) == 0
        (version,) = await station.until("AUTOPILOT_VERSION")
        assert version.capabilities == 2 | 8 | 16 | 8192
        assert version.flight_sw_version >> 8 == 0x000100  # 0.1.0
        assert await station.result(520, 1) == 0
        assert len(await station.until("AUTOPILOT_VERSION")) == 1
        assert await station.result(512, 390) == 0
        (status, *_) = await station.until("ONBOARD_COMPUTER_STATUS")
        assert 0 < status.ram_usage < status.ram_total
        assert await station.result(512, 0) == 0
        assert (await station.until("HEARTBEAT"))[0].type == 18
        assert await station.result(512, 396) == 0  # not in pymavlink's dialect: its bytes are tested by hand
        assert await station.result(512, 24) == 3  # GPS_RAW_INT: UNSUPPORTED
        assert await station.result(512, 1e9) == 3
        for senseless in (math.nan, math.inf, 148.5):
            assert await station.result(512, senseless) == 2

    run(script)


def test_the_load_comes_every_two_seconds_and_tells_every_core() -> None:
    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        station = Station(autopilot)
        first, second = (await station.until("ONBOARD_COMPUTER_STATUS", 2))[:2]
        assert 1900 < (second.time_usec - first.time_usec) / 1000 < 2600
        assert first.cpu_cores[0] == 255  # a share needs two readings
        assert 0 <= second.cpu_cores[0] <= 100
        assert 0 <= second.cpu_combined[0] <= 100

    run(script)


def test_storage_waits_for_a_disarmed_vehicle(tmp_path: Path) -> None:
    file = tmp_path / "stored.toml"

    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        brain.retune = brain._pilot.retune  # type: ignore[attr-defined]
        station = Station(autopilot)
        await autopilot.fly(3)
        station.send(station.mav.param_set_encode(1, 196, b"CA_KAPPA", 2.5, 9))
        await station.until("PARAM_VALUE")
        assert await station.result(245, 1) == 1  # armed: TEMPORARILY_REJECTED
        assert not file.exists()
        autopilot.beat = lambda: autopilot._send(autopilot._mav.heartbeat_encode(2, 12, 1, autopilot.mode, 3))  # type: ignore[method-assign]
        await autopilot.fly(2)
        assert await station.result(245, 1) == 0
        assert tomllib.loads(file.read_text()) == {"CA_KAPPA": 2.5}
        assert await station.result(245, 2) == 0
        (value,) = await station.until("PARAM_VALUE")
        assert (value.param_id, value.param_value) == ("CA_KAPPA", 2.0)
        assert await station.result(245, 0) == 0
        (value,) = await station.until("PARAM_VALUE")
        assert value.param_value == 2.5
        assert await station.result(245, 7) == 3

    run(script, params={"file": str(file)})

    async def again(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        station = Station(autopilot)
        station.send(station.mav.param_request_read_encode(1, 196, b"CA_KAPPA", -1))
        (value,) = await station.until("PARAM_VALUE")
        assert value.param_value == 2.5

    run(again, params={"file": str(file)})


def test_an_obstacle_on_a_collision_course_is_announced_once_a_second() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"

    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        with neighbour(endpoint) as session:
            frames = session.declare_publisher("uav/uav1/obstacles/radar")
            await activate(autopilot)
            autopilot.received.clear()
            first = autopilot.tick
            for _ in range(50):  # a ball comes down on the vehicle, which hovers at (0, 0, 2)
                height = 4.0 - 0.05 * (autopilot.tick - first)
                ball = {"id": "ball", "position": [0.1, 0.0, height], "radius": 0.2, "position_std": 0.05}
                stamp_ns = 50_000_000 * (autopilot.tick + 1)
                frames.put(json.dumps({"stamp_ns": stamp_ns, "clock": "vehicle", "obstacles": [ball]}))
                await autopilot.fly()
        found = autopilot.of("COLLISION")
        assert 1 <= len(found) <= 3  # in 2.5 s
        assert {m.src for m in found} == {0}
        assert len({m.id for m in found}) == 1
        for message in found:
            assert message.threat_level in (1, 2)
            assert 0.0 <= message.time_to_minimum_delta <= 1.3
            assert message.horizontal_minimum_delta < 0.3

    run(script, zenoh={"listen": [endpoint]})


def test_a_control_task_that_is_stuck_goes_quiet() -> None:
    """Links are still read and commands acknowledged, but no heartbeat says that all is well."""

    class Never:
        async def wait(self) -> None:
            await service_done.wait()

        def set(self) -> None:
            pass

        def clear(self) -> None:
            pass

    import asyncio

    service_done = asyncio.Event()

    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        station = Station(autopilot)
        await autopilot.fly(25)
        assert autopilot.of("HEARTBEAT")
        wake = service._wake
        service._wake = Never()  # type: ignore[assignment]
        wake.set()
        await autopilot.fly(2)  # what was under way
        autopilot.received.clear()
        station.command(512, 0)  # not even one that is asked for
        station.send(station.mav.param_request_list_encode(1, 196))
        await autopilot.fly(50)
        kinds = {m.get_type() for m in autopilot.received}
        assert "COMMAND_ACK" in kinds  # the loop is alive
        assert not kinds & {"HEARTBEAT", "PARAM_VALUE", "SET_POSITION_TARGET_LOCAL_NED", "ONBOARD_COMPUTER_STATUS"}
        service._wake = wake
        service_done.set()
        wake.set()
        await autopilot.fly(3)
        assert autopilot.of("HEARTBEAT")

    run(script)
