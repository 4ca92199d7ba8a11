"""An aircraft by ADS-B and a range sensor reach the tracks of a running service, over a real socket."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import Any

import numpy as np
import pytest
from datagrams import listen
from pymavlink.dialects.v20 import ardupilotmega as dialect
from traffic_scenes import adsb, distances, origin

from companion.clock import SystemClock
from companion.config import parse_config
from companion.metrics import Summary
from companion.pilot import Pilot
from companion.service import Service
from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration

AIRCRAFT = (60.0, -30.0, 12.0)  # east, north, up of the origin, at rest


class World:
    """Autopilot, ADS-B receiver and range sensor on one link."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._autopilot = dialect.MAVLink(None, 1, 1)
        self.tick = 0
        self.received: list[Any] = []

    def close(self) -> None:
        self._socket.close()

    def send(self, message: Any, *, component: int = 1) -> None:
        with contextlib.suppress(ConnectionRefusedError):  # until the service is up
            self._socket.send(message.pack(dialect.MAVLink(None, 1, component)))

    async def live(self, ticks: int, *messages: tuple[Any, int]) -> None:
        for _ in range(ticks):
            self.tick += 1
            self.send(dialect.MAVLink_heartbeat_message(2, 12, 129, 0, 4, 3))
            for message, component in messages:
                self.send(message, component=component)
            self.send(dialect.MAVLink_attitude_quaternion_message(50 * self.tick, 1.0, 0, 0, 0, 0, 0, 0))
            self.send(dialect.MAVLink_local_position_ned_message(50 * self.tick, 0, 0, -2, 0, 0, 0))
            await listen(
                self._socket, 0.05, lambda data: self.received.extend(self._autopilot.parse_buffer(data) or [])
            )

    def asked_for_origin(self) -> int:
        commands = [m for m in self.received if m.get_type() == "COMMAND_LONG"]
        return sum((m.command, m.param1, m.target_component) == (512, 49.0, 1) for m in commands)


def test_aircraft_and_ranges_become_tracks_once_the_origin_is_known() -> None:
    port = free_port()
    config = parse_config(
        {
            "mavlink": {"url": f"udpin://127.0.0.1:{port}", "system_id": 1},
            "zenoh": {"listen": [f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"]},
            "traffic": {"adsb": {"enabled": True}, "obstacle_distance": {"enabled": True}},
        }
    )
    pilot = Pilot(config)
    aircraft = (adsb(AIRCRAFT, hor_velocity=0), 156)
    ahead = (distances({0: 500}), 158)  # north, from a peripheral

    async def fly() -> Summary:
        service = Service(config, SystemClock(), pilot=pilot)
        world = World(port)
        running = asyncio.create_task(service.run())
        try:
            while not world.asked_for_origin():
                assert not running.done()
                await world.live(1, aircraft)
            assert pilot.tracks().ids == ()
            world.send(origin())
            await world.live(8, aircraft, ahead)
            table = pilot.tracks()
            assert sorted(table.sources) == [("adsb",), ("obstacle_distance",)]
            by_source = dict(zip(table.sources, table.p_enu, strict=True))
            np.testing.assert_allclose(by_source["adsb",], AIRCRAFT, atol=0.1)
            np.testing.assert_allclose(by_source["obstacle_distance",], [0.0, 5.0, 2.0], atol=0.1)

            world.tick = 100
            await world.live(1)
            world.tick, asked = 0, world.asked_for_origin()  # the autopilot reboots: it may begin elsewhere
            while world.asked_for_origin() == asked:
                await world.live(1, aircraft)
            assert pilot.tracks().ids == ()
        finally:
            service.stop()
            world.close()
        return await running

    counts = asyncio.run(fly()).counts
    assert counts["obstacles.traffic_no_origin"] >= 1
    assert "obstacles.future" not in counts
