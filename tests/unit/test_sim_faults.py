"""Faults begin and end on their time, hit what they name, and leave the rest alone; several vehicles' ports."""

from __future__ import annotations

import json
import math
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest

from sim_bridge.daemon import daemon_settings
from sim_bridge.errors import ScenarioError
from sim_bridge.faults import Faults
from sim_bridge.flight import Flight
from sim_bridge.messages import NS_PER_S
from sim_bridge.operator import commands
from sim_bridge.placement import Resolved, resolve
from sim_bridge.runner import stations_of
from sim_bridge.scenario import OperatorStep, Scenario, parse_scenario
from sim_bridge.station import Station
from sim_bridge.testing import free_port
from sim_bridge.wires import Wires, ports_of

TWO: dict[str, Any] = {
    "vehicles": [{"start": [0, 0, 2], "target": [3, 0, 2]}, {"start": [0, 4, 2], "system_id": 9, "name": "wing"}],
    "sensors": [{"source": "camera"}, {"source": "radar", "vehicles": ["wing"]}],
}


class Process:
    def __init__(self) -> None:
        self.told: list[str] = []

    def freeze(self) -> None:
        self.told.append("freeze")

    def thaw(self) -> None:
        self.told.append("thaw")

    def kill(self) -> None:
        self.told.append("kill")

    def check_alive(self) -> None:
        self.told.append("looked at")


def scenario(**more: Any) -> Scenario:
    return parse_scenario({**TWO, **more}, source="two")


def resolved(**more: Any) -> Resolved:
    return resolve("two", scenario(**more), 5)


@dataclass
class Rig:
    faults: Faults
    flight: Flight
    wires: Wires
    stations: tuple[Station, ...]


@contextmanager
def flown(*faults: dict[str, Any], processes: dict[str, Process] | None = None) -> Iterator[Rig]:
    flat = resolved(faults=list(faults))
    wires = Wires(
        flat,
        onboard_port=free_port(socket.SOCK_DGRAM) & ~1,
        ground_port=(free_port(socket.SOCK_DGRAM) & ~1) ^ 64,
        endpoint=None,
        lockstep=False,
    )
    flight = Flight(flat)
    try:
        stations = stations_of(flight, wires, clock_ns=lambda: flight.t_ns, lockstep=True)
        yield Rig(Faults(flight, wires.crafts, stations, processes), flight, wires, stations)
    finally:
        flight.close()
        wires.close()


def fly(rig: Rig, ticks: int) -> None:
    """Control periods of flight, each begun by the faults' step."""
    for _ in range(ticks):
        rig.faults.step()
        for _ in range(rig.flight.resolved.control_steps):
            rig.flight.advance()


def test_a_daemon_is_frozen_woken_and_killed_on_its_ticks() -> None:
    processes = {"uav1": Process(), "wing": Process()}
    freeze = {"what": "freeze", "on": "daemon", "vehicle": "wing", "at_tick": 2, "for_s": 0.1}
    kill = {"what": "kill", "on": "daemon", "vehicle": "wing", "at_tick": 6}
    with flown(freeze, kill, processes=processes) as rig:
        answers = []
        for _ in range(8):
            fly(rig, 1)
            answers.append(rig.faults.companions[1].answers)
        assert answers == [True, True, False, False, True, True, False, False]
        assert processes["wing"].told == ["freeze", "thaw", "kill"]
        assert processes["uav1"].told == []
        assert rig.faults.companions[0].answers
        assert [(hit.started_ns, hit.ended_ns) for hit in rig.faults.hits] == [
            (NS_PER_S // 10, NS_PER_S // 5),
            (3 * NS_PER_S // 10, None),
        ]


def test_a_dead_daemon_is_not_frozen_any_more() -> None:
    processes = {"uav1": Process(), "wing": Process()}
    kill = {"what": "kill", "on": "daemon", "at_tick": 0}
    freeze = {"what": "freeze", "on": "daemon", "at_tick": 1, "for_s": 0.05}
    with flown(kill, freeze, processes=processes) as rig:
        fly(rig, 4)
        assert [p.told for p in processes.values()] == [["kill"], ["kill"]]


def test_seconds_count_from_the_entry_into_external_control() -> None:
    drop = {"what": "drop", "on": "onboard", "vehicle": "wing", "at_s": 0.1}
    with flown(drop) as rig:
        fly(rig, 5)
        (hit,) = rig.faults.hits
        assert hit.started_ns is None
        rig.flight.crafts[1].begin()
        entered_ns = rig.flight.t_ns
        fly(rig, 4)
        assert hit.started_ns == entered_ns + NS_PER_S // 10


def test_a_links_faults_stand_in_both_directions_of_that_link_alone() -> None:
    cut = {"what": "cut", "on": "ground", "vehicle": "uav1", "at_tick": 1, "for_s": 0.1}
    with flown(cut) as rig:
        first, second = rig.wires.crafts
        link = first.router.ground
        lengths = []
        for _ in range(4):
            fly(rig, 1)
            lengths.append((len(link.outbound.impairments), len(link.inbound.impairments)))
        assert lengths == [(0, 0), (1, 1), (1, 1), (0, 0)]
        assert first.router.onboard.outbound is None
        assert second.router.ground.outbound is None
        assert not rig.faults.touches_onboard(0)


def test_the_clock_jumps_on_and_back_and_never_below_zero() -> None:
    on = {"what": "clock_jump", "on": "autopilot", "vehicle": "uav1", "at_tick": 1, "value": 5.0, "for_s": 0.1}
    back = {"what": "clock_jump", "on": "autopilot", "vehicle": "wing", "at_tick": 2, "value": -60.0}
    with flown(on, back) as rig:
        first, second = rig.stations
        clocks = []
        for _ in range(5):
            rig.faults.step()
            t_ns = rig.flight.t_ns
            clocks.append(tuple((t_ns + s.clock_offset_ns) // 1_000_000 for s in (first, second)))
            for _ in range(12):
                rig.flight.advance()
        assert clocks == [(0, 0), (5050, 50), (5100, 0), (150, 50), (200, 100)]
        assert rig.faults.touches_onboard(0)


def test_a_sources_clock_and_its_frames() -> None:
    jump = {"what": "clock_jump", "on": "radar", "at_tick": 0, "value": 2.0}
    lose = {"what": "drop", "on": "obstacles", "vehicle": "wing", "at_tick": 0}
    with flown(jump, lose) as rig:
        fly(rig, 4)
        first, second = rig.wires.crafts
        camera, radar = second.feeds
        assert radar.encode((100, [])).stamp_ns == 2 * NS_PER_S + 100
        assert camera.encode((100, [])).stamp_ns == 100
        wing = rig.flight.crafts[1]
        assert radar.due(wing, wing.t_ns) == camera.due(wing, wing.t_ns) == []
        uav1 = rig.flight.crafts[0]
        assert first.feeds[0].due(uav1, uav1.t_ns)


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ({"what": "kill", "on": "daemon", "at_tick": 0}, "faults[0]: expected --check"),
        ({"what": "rc", "on": "autopilot", "at_tick": 0, "value": "SWIM"}, "SWIM"),
    ],
)
def test_what_cannot_be_done_is_refused_before_the_flight(fault: dict[str, Any], named: str) -> None:
    with pytest.raises(ScenarioError) as refused, flown(fault):
        pass
    assert named in str(refused.value)


def test_each_vehicle_has_the_next_ports_unless_the_file_says() -> None:
    assert ports_of(resolved(), 14540, 14550) == [(14540, 14550), (14541, 14551)]
    vehicles = [{**TWO["vehicles"][0], "onboard_port": 14550}, TWO["vehicles"][1]]
    with pytest.raises(ScenarioError, match=r"14550 twice"):
        ports_of(resolve("two", scenario(vehicles=vehicles), 0), 14540, 14550)
    with pytest.raises(ScenarioError, match=r"up to 65535"):
        ports_of(resolved(), 65535, 14550)


def test_a_daemon_is_told_what_ties_it_to_its_vehicle() -> None:
    two = scenario(vehicles=[TWO["vehicles"][0], {**TWO["vehicles"][1], "daemon": {"safety.horizon": 5}}])
    settings = daemon_settings(two, two.fleet[1], onboard_port=4711, endpoint="tcp/127.0.0.1:1", lockstep=True)
    told = {key: json.loads(value) for key, _, value in (setting.partition("=") for setting in settings)}
    assert told["mavlink.url"] == "udpin://127.0.0.1:4711"
    assert told["mavlink.system_id"] == 9
    assert told["vehicle.name"] == "wing"
    assert told["lockstep_sources"] == ["camera", "radar"]
    assert told["safety.horizon"] == 5
    assert "target.position" not in told  # it has none: it holds where it is engaged


def test_the_operators_commands_are_those_of_the_autopilot() -> None:
    (vehicle, _) = scenario().fleet
    ((number, component, params),) = commands(OperatorStep(do="takeoff", at_tick=0), vehicle)
    assert (number, component) == (22, 1)
    assert all(math.isnan(p) for p in params)
    assert commands(OperatorStep(do="engage", at_tick=0), vehicle) == [(92, 196, (1.0, 0, 0, 0, 0, 0, 0))]
    (copter,) = parse_scenario({"vehicle": {"personality": "ardupilot"}}, source="copter").fleet
    (guided, arm) = commands(OperatorStep(do="arm", at_tick=0), copter)
    assert guided == (176, 1, (1.0, 4.0, 0, 0, 0, 0, 0))
    assert arm[0] == 400
    ((_, _, params),) = commands(OperatorStep(do="takeoff", at_tick=0), copter)
    assert params[6] == copter.takeoff_altitude_m
