"""The shell around a brain that misbehaves, and lockstep's guard, in process over real sockets."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import zenoh
from datagrams import listen
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.clock import SystemClock
from companion.config import parse_config
from companion.errors import LockstepStalled
from companion.metrics import Summary
from companion.pilot import Pilot
from companion.service import Service
from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration

OFFBOARD, HOLD = 6 << 16, 4 << 16 | 3 << 24


class Failing:
    """A brain that works until told otherwise."""

    def __init__(self, config: Any) -> None:
        self._pilot = Pilot(config)
        self.fails = False
        self.answers_nan = False
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1
        self._pilot.reset()

    def tracks(self) -> Any:
        return self._pilot.tracks()

    @property
    def tracking_counts(self) -> dict[str, int]:
        return self._pilot.tracking_counts

    def observe(self, frames: Any, stamp_ns: int) -> None:
        self._pilot.observe(frames, stamp_ns)

    def step(self, inputs: Any, *, sent: bool) -> Any:
        if self.fails:
            raise ZeroDivisionError("on purpose")
        output = self._pilot.step(inputs, sent=sent)
        return replace(output, wire=np.full(3, np.nan)) if self.answers_nan else output


class Autopilot:
    """The other end of the UDP link."""

    def __init__(self, port: int) -> None:
        self._address = ("127.0.0.1", port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._mav = dialect.MAVLink(None, 1, 1)
        self.mode = HOLD
        self.tick = 0
        self.answers_time = False
        self.received: list[Any] = []

    def close(self) -> None:
        self._socket.close()

    def _send(self, message: Any) -> None:
        self._socket.sendto(message.pack(self._mav), self._address)

    def beat(self) -> None:
        self._send(self._mav.heartbeat_encode(2, 12, 1 | 128, self.mode, 4))

    def landed(self, state: int) -> None:
        self._send(self._mav.extended_sys_state_encode(0, state))

    async def fly(self, ticks: int = 1) -> None:
        for _ in range(ticks):
            self.tick += 1
            self.beat()
            self.landed(2)
            self._send(self._mav.attitude_quaternion_encode(50 * self.tick, 1.0, 0, 0, 0, 0, 0, 0))
            self._send(self._mav.local_position_ned_encode(50 * self.tick, 0, 0, -2, 0, 0, 0))
            await self.listen()

    async def listen(self) -> None:
        await listen(self._socket, 0.05, self._take)

    def _take(self, data: bytes) -> None:
        for message in self._mav.parse_buffer(data) or []:
            self.received.append(message)
            if self.answers_time and message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self._send(self._mav.timesync_encode(50_000_000 * self.tick + 1, message.ts1))

    def command(self, number: int, param1: float) -> None:
        self._send(self._mav.command_long_encode(1, 196, number, 0, param1, 0, 0, 0, 0, 0, 0))

    def of(self, kind: str) -> list[Any]:
        return [m for m in self.received if m.get_type() == kind]

    def mode_requests(self) -> list[tuple[int, int]]:
        return [(int(m.param2), int(m.param3)) for m in self.of("COMMAND_LONG") if m.command == 176]


def run(script: Callable[[Service, Failing, Autopilot], Awaitable[None]], **sections: Any) -> Summary:
    """Run a service with ``script`` as the world around it."""
    port = free_port()

    async def both() -> Summary:
        config = parse_config(
            {
                "mavlink": {"url": f"udpin://127.0.0.1:{port}", "system_id": 1},
                "zenoh": {"listen": [f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"]},
                **sections,
            }
        )
        brain = Failing(config)
        service = Service(config, SystemClock(), pilot=brain)  # type: ignore[arg-type]
        autopilot = Autopilot(port)
        running = asyncio.create_task(service.run())
        try:
            while not autopilot.received and not running.done():  # the port opens when the service is up
                await autopilot.fly()
            await script(service, brain, autopilot)
        finally:
            service.stop()
            autopilot.close()
        return await running

    return asyncio.run(both())


def neighbour(endpoint: str) -> zenoh.Session:
    """Another peer, connected to the daemon's endpoint and to nobody else."""
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


async def activate(autopilot: Autopilot) -> None:
    await autopilot.fly(3)
    autopilot.command(92, 1.0)
    while not autopilot.mode_requests():
        await autopilot.fly()
    assert autopilot.mode_requests()[0] == (6, 0)
    autopilot.mode = OFFBOARD
    await autopilot.fly(3)


def test_a_failed_brain_means_fault_silence_and_a_request_for_hold() -> None:
    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        await activate(autopilot)
        brain.fails, brain.resets = True, 0
        await autopilot.fly(1)
        autopilot.received.clear()
        await autopilot.fly(5)
        assert autopilot.of("SET_POSITION_TARGET_LOCAL_NED") == []
        brain.fails = False
        await autopilot.fly(25)
        assert (4, 3) in autopilot.mode_requests()
        assert {m.system_status for m in autopilot.of("HEARTBEAT")} == {5}  # MAV_STATE_CRITICAL
        assert autopilot.of("SET_POSITION_TARGET_LOCAL_NED") == []  # FAULT does not heal in flight
        assert brain.resets == 1

    summary = run(script)
    assert summary.final_state == "FAULT"
    assert summary.verdicts["silent"] >= 30


def test_an_answer_that_must_not_reach_the_wire_means_fault() -> None:
    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        await activate(autopilot)
        brain.answers_nan = True
        autopilot.received.clear()
        await autopilot.fly(5)
        assert autopilot.of("SET_POSITION_TARGET_LOCAL_NED") == []
        assert (4, 3) in autopilot.mode_requests()

    assert run(script).final_state == "FAULT"


def test_a_stop_in_flight_hands_the_vehicle_back_first() -> None:
    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        await activate(autopilot)
        autopilot.received.clear()
        service.stop()
        while not autopilot.mode_requests():
            await autopilot.fly()
        assert autopilot.mode_requests()[0] == (4, 3)
        assert autopilot.of("SET_POSITION_TARGET_LOCAL_NED")  # it streams until the mode is seen
        autopilot.mode = HOLD
        await autopilot.fly(2)

    assert run(script).final_state == "READY"


def test_unknown_and_foreign_traffic_is_ignored() -> None:
    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        autopilot.command(31_000, 0.0)
        await autopilot.fly(3)
        assert [(m.command, m.result) for m in autopilot.of("COMMAND_ACK")] == [(31_000, 3)]

    assert run(script).final_state == "READY"


def test_the_vehicle_state_may_come_by_zenoh() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"

    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        with neighbour(endpoint) as session:
            states = session.declare_publisher("uav/uav1/vehicle/state")
            stamp_ms = 0
            while service._session.situation.state.value != "ACTIVE":
                stamp_ms += 50
                state = {"stamp_ns": stamp_ms * 1_000_000, "frame": "local_ned"}
                states.put(json.dumps({**state, "position": [1.0, 2.0, -3.0], "velocity": [0.0, 0.0, 0.0]}))
                autopilot.beat()
                await autopilot.listen()
                if stamp_ms == 500:
                    autopilot.landed(2)
                    autopilot.command(92, 1.0)
                if autopilot.mode_requests():
                    autopilot.mode = OFFBOARD
            states.put(b"{}")  # rejected, survived
            await autopilot.listen()
        setpoint = autopilot.of("SET_POSITION_TARGET_LOCAL_NED")[0]
        assert 0 < setpoint.time_boot_ms <= stamp_ms

    assert run(script, zenoh={"listen": [endpoint]}, vehicle={"source": "zenoh"}).ticks > 0


def test_the_vehicle_by_zenoh_is_what_the_brain_uses_and_mavlink_is_not() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"

    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        loop, heard = asyncio.get_running_loop(), asyncio.Queue()
        with neighbour(endpoint) as session:
            watching = session.declare_subscriber(
                "uav/uav1/companion/vehicle", lambda sample: loop.call_soon_threadsafe(heard.put_nowait, sample)
            )
            states = session.declare_publisher("uav/uav1/vehicle/state")
            body = {"frame": "local_ned", "position": [1.0, 2.0, -3.0], "velocity": [0.1, 0.2, -0.3]}
            stamp_ms = 0
            while heard.empty():
                stamp_ms += 50
                states.put(json.dumps({**body, "stamp_ns": stamp_ms * 1_000_000}))
                await autopilot.fly()  # MAVLink says (0, 0, 2), north up
            vehicle = json.loads((await heard.get()).payload.to_bytes())
            assert (vehicle["position"], vehicle["velocity"]) == ([2.0, 1.0, 3.0], [0.2, 0.1, 0.3])
            assert 0 < vehicle["stamp_ns"] <= stamp_ms * 1_000_000
            watching.undeclare()

    assert run(script, zenoh={"listen": [endpoint]}, vehicle={"source": "zenoh"}).ticks > 0


def test_a_stock_query_is_told_what_came_of_a_target_and_an_engagement() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"

    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        with neighbour(endpoint) as session:

            async def ask(key: str, body: object) -> dict[str, Any]:
                def get() -> bytes:
                    (reply,) = session.get(f"uav/uav1/{key}", payload=json.dumps(body), timeout=5.0)
                    return reply.ok.payload.to_bytes()

                return json.loads(await asyncio.to_thread(get))

            probe = session.declare_publisher("uav/uav1/engage")
            while not probe.matching_status.matching:
                await autopilot.fly()
            await autopilot.fly(3)
            assert await ask("target", {"position": [1, 2, 3]}) == {"accepted": True, "reason": ""}
            refused = await ask("target", {"position": [1000, 0, 3]})
            assert not refused["accepted"]
            assert "arena" in refused["reason"]
            assert service._route.current.tolist() == [1.0, 2.0, 3.0]
            assert await ask("engage", {"engaged": True}) == {"accepted": True, "reason": ""}
            while not autopilot.mode_requests():
                await autopilot.fly()
            autopilot.mode = OFFBOARD
            while service._session.situation.state.value != "ACTIVE":
                await autopilot.fly()
            assert await ask("engage", {"engaged": False}) == {"accepted": True, "reason": ""}

    run(script, zenoh={"listen": [endpoint]})


def test_a_reboot_that_shows_in_timesync_first_is_noticed() -> None:
    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        autopilot.answers_time = True
        autopilot.tick = 100_000
        while sum(m.tc1 == 0 for m in autopilot.of("TIMESYNC")) < 8:
            await autopilot.fly()
        autopilot.received.clear()
        autopilot.tick = 0  # up again: the clock began anew, TIMESYNC is answered before a position is known
        while sum(m.tc1 == 0 for m in autopilot.of("TIMESYNC")) < 8:
            autopilot.beat()
            await autopilot.listen()
        autopilot.received.clear()
        await autopilot.fly(20)
        assert autopilot.of("SET_POSITION_TARGET_LOCAL_NED")

    assert run(script).final_state == "READY"


def test_unix_frames_without_a_time_base_mean_hold() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"

    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        with neighbour(endpoint) as session:
            frames = session.declare_publisher("uav/uav1/obstacles/lidar")
            await activate(autopilot)
            for _ in range(10):
                frames.put(json.dumps({"stamp_ns": 1_700_000_000 * 10**9, "clock": "unix", "obstacles": []}))
                await autopilot.fly()
            assert service._session.situation.state.value == "HOLD"
            assert "time base" in service._session.situation.reason
            await autopilot.fly(25)  # the source stopped: nothing that cannot be placed in time any more
            assert service._session.situation.state.value == "ACTIVE"

    run(script, zenoh={"listen": [endpoint]})


def test_lockstep_notices_a_simulator_that_is_gone() -> None:
    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        for _ in range(140):
            await autopilot.listen()

    with pytest.raises(LockstepStalled, match="nothing from the vehicle"):
        run(script, sync="lockstep", lockstep_sources=[])


def test_lockstep_names_the_source_that_is_missing() -> None:
    async def script(service: Service, brain: Failing, autopilot: Autopilot) -> None:
        autopilot.received.clear()
        await autopilot.fly(1)
        for _ in range(60):
            await autopilot.listen()

    with pytest.raises(LockstepStalled, match="marker of radar"):
        run(script, sync="lockstep", lockstep_sources=["radar"])
