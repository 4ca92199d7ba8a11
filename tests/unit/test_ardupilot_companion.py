"""The real daemon's control task against the ardupilot personality in PyBullet, on one counted clock, no waiting.

`vehicle.profile = "auto"`: the daemon finds out that this is ArduPilot, asks for streams, engages by command, flies,
releases and brakes. PSC_JERK_XY is at its greatest, 20 m/s^3: under the default of 5 the reference policy circles its
target (docs/explanation/simulator-ardupilot.md).
"""

from __future__ import annotations

import math
import socket
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import pytest
from ardupilot_rig import Rig, command, set_mode
from autopilot_peer import World, play
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.links import Router
from sim_bridge.station import Station

JERK = {"PSC_JERK_XY": 20.0, "PSC_JERK_Z": 20.0}
SECTIONS: dict[str, Any] = {"limits": {"slew_m_s3": 14.0}, "target": {"position": [3.0, 1.0, 4.0]}}


class SimulatedPeer:
    """The simulator's autopilot as `autopilot_peer` wants one: ten milliseconds a step, bytes out, bytes in."""

    system = 1

    def __init__(self, **parameters: float) -> None:
        self.rig = Rig((0.0, 0.0, 4.0), physics_hz=300, control_hz=50, **parameters)
        self._companion, self._station = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for each in (self._companion, self._station):
            each.bind(("127.0.0.1", 0))
            each.setblocking(False)
        self.router = Router(self._companion.getsockname()[1], self._station.getsockname()[1])
        t_ns = lambda: self.rig.t_ns  # noqa: E731
        self.station = Station(self.rig.craft, self.router, t_ns=t_ns, clock_ns=t_ns, lockstep=False)
        self._codec = dialect.MAVLink(None)
        self.setpoints: list[Any] = []
        self.modes = [self.rig.autopilot.mode_name]

    def step(self) -> bytes:
        flight, station = self.rig.flight, self.station
        for _ in range(3):
            flight.advance()
            if flight.at_tick:
                for replies in flight.control():
                    station.say(replies)
                station.announce()
            station.stream(*self.router.links)
        mode = self.rig.autopilot.mode_name
        if mode != self.modes[-1]:
            self.modes.append(mode)
        return self._drain()

    def receive(self, data: bytes) -> bytes:
        self.setpoints += [m for m in self._codec.parse_buffer(data) or [] if m.get_type().startswith("SET_POSITION")]
        self._companion.sendto(data, self.router.onboard.socket.getsockname())
        for link, packet in self.router.receive():
            self.station.handle(link, packet)
        return self._drain()

    def _drain(self) -> bytes:
        out = bytearray()
        while True:
            try:
                out += self._companion.recv(65535)
            except BlockingIOError:
                return bytes(out)

    def close(self) -> None:
        self.rig.close()
        self.router.close()
        self._companion.close()
        self._station.close()


@pytest.fixture
def peer() -> Iterator[SimulatedPeer]:
    made = SimulatedPeer(**JERK)
    yield made
    made.close()


def flying(peer: SimulatedPeer, script: Callable[[World], Awaitable[None]]) -> World:
    """Engage in the air, then the script."""

    async def whole(world: World) -> None:
        await world.run(8.0, until=lambda: world.state == "READY")
        assert world.state == "READY"
        assert peer.setpoints == []  # nothing is sent to ArduPilot before
        world.engage()
        await world.run(3.0, until=lambda: world.state == "ACTIVE")
        assert (world.state, peer.rig.autopilot.mode_name) == ("ACTIVE", "GUIDED")
        await script(world)

    return play(whole, peer, **SECTIONS)  # type: ignore[arg-type]


def test_it_engages_by_command_flies_to_the_target_and_releases_into_brake(peer: SimulatedPeer) -> None:
    async def script(world: World) -> None:
        await world.run(8.0)
        assert math.dist(peer.rig.p, (3.0, 1.0, 4.0)) < 0.3
        assert world.warnings == ()  # the echo confirms what is sent
        assert peer.rig.autopilot.external
        world.engage(False)
        await world.run(2.0)
        assert peer.rig.autopilot.mode_name == "BRAKE"
        sent = len(peer.setpoints)
        await world.run(2.0)
        assert len(peer.setpoints) == sent
        assert peer.rig.v == pytest.approx(0.0, abs=0.1)

    world = flying(peer, script)
    assert {m.type_mask for m in peer.setpoints} == {0x043F}
    assert world.counts["autopilot.echoes"] >= 20
    assert peer.modes == ["LOITER", "GUIDED", "BRAKE"]


def test_a_fault_of_the_brain_in_flight_ends_in_brake(peer: SimulatedPeer) -> None:
    async def script(world: World) -> None:
        await world.run(1.5)
        assert peer.rig.v[0] > 0.5
        world.session.fail("policy: no answer", world.clock.monotonic_ns())
        await world.run(0.5)
        assert world.state == "FAULT"
        assert peer.rig.autopilot.mode_name == "BRAKE"
        await world.run(4.0)
        assert peer.rig.v == pytest.approx(0.0, abs=0.1)

    flying(peer, script)


def test_a_daemon_that_is_cut_off_coasts_for_guid_timeout_then_brakes(peer: SimulatedPeer) -> None:
    async def script(world: World) -> None:
        await world.run(1.2)
        world.connected = False
        cut, last = peer.rig.p, peer.setpoints[-1]
        await world.run(0.5)
        before = peer.rig.v
        await world.run(2.0)
        gained = (peer.rig.v - before)[:2] / 2.0  # east, north
        assert gained == pytest.approx((last.afy, last.afx), abs=0.25)
        await world.run(6.0)
        assert peer.rig.v == pytest.approx(0.0, abs=0.1)
        assert math.dist(peer.rig.p, cut) > 2.0
        assert peer.rig.autopilot.mode_name == "GUIDED"

    flying(peer, script)


def test_a_pilot_who_changes_the_mode_is_not_fought(peer: SimulatedPeer) -> None:
    async def script(world: World) -> None:
        await world.run(1.0)
        peer.rig.order(set_mode(5))
        peer.station.announce()
        await world.run(2.0)
        assert world.state == "OVERRIDDEN"
        assert peer.rig.autopilot.mode_name == "LOITER"

    flying(peer, script)
    assert peer.modes == ["LOITER", "GUIDED", "LOITER"]


def test_a_reboot_on_the_ground_is_noticed_and_the_streams_are_asked_for_again(peer: SimulatedPeer) -> None:
    async def script(world: World) -> None:
        await world.run(8.0, until=lambda: world.state == "READY")
        peer.rig.order(set_mode(9))
        await world.run(14.0, until=lambda: not peer.rig.autopilot.armed)
        assert not peer.rig.autopilot.armed
        peer.rig.order(command(246, 1.0))
        await world.run(3.0, until=lambda: world.state == "WAITING")
        assert world.state == "WAITING"
        await world.run(8.0, until=lambda: world.state == "READY")
        assert world.state == "READY"

    play(script, peer, **SECTIONS)  # type: ignore[arg-type]
