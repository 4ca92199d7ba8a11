"""What one table of a scenario demands of another; each error is a `ScenarioError` that names the key."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sim_bridge.errors import ScenarioError
from sim_bridge.scenario_faults import LINKS, fault_error
from sim_bridge.scenario_obstacles import PursuitObstacle, placing_error

if TYPE_CHECKING:
    from sim_bridge.scenario import Scenario, SensorSpec

_RESERVED_SOURCES = (*LINKS, "obstacles", "daemon", "autopilot", "world")  # what a fault's `on` already means


def check(scenario: Scenario) -> None:
    """Raise for the first key that does not fit the others."""
    vehicles = [v.name for v in scenario.fleet]
    _different("obstacles", [o.id for o in scenario.obstacles])
    _different("sensors", [s.source for s in scenario.sensors])
    _different("vehicles", vehicles)
    _different("vehicles", [f"system_id {v.system_id}" for v in scenario.fleet])
    _different("obstacles", [o.id for o in scenario.obstacles] + vehicles)  # both are ids of detections
    ports = [p for v in scenario.fleet for p in (v.onboard_port, v.gcs_port) if p is not None]
    _different("vehicles", [f"port {p}" for p in ports])
    for index, obstacle in enumerate(scenario.obstacles):
        _refuse(f"obstacles[{index}]", placing_error(obstacle))
        if isinstance(obstacle, PursuitObstacle) and obstacle.of is not None:
            _known(f"obstacles[{index}].of", [obstacle.of], vehicles)
    for index, sensor in enumerate(scenario.sensors):
        _refuse(f"sensors[{index}]", _sensor_error(sensor))
        _known(f"sensors[{index}].vehicles", sensor.vehicles or (), vehicles)
    for index, step in enumerate(scenario.operator):
        if (step.at_tick is None) == (step.after is None):
            raise ScenarioError(f"operator[{index}]: expected exactly one of at_tick and after")
        _known(f"operator[{index}].vehicle", [] if step.vehicle is None else [step.vehicle], vehicles)
    sources = [s.source for s in scenario.sensors]
    for index, fault in enumerate(scenario.faults):
        _refuse(f"faults[{index}]", fault_error(fault, sources=sources, vehicles=vehicles))


def _refuse(at: str, reason: str | None) -> None:
    if reason is not None:
        raise ScenarioError(f"{at}: {reason}")


def _different(key: str, names: Sequence[str]) -> None:
    twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if twice is not None:
        raise ScenarioError(f"{key}: expected different names, got {twice} twice")


def _known(key: str, names: Sequence[str], vehicles: Sequence[str]) -> None:
    for name in names:
        if name not in vehicles:
            raise ScenarioError(f"{key}: expected one of {', '.join(vehicles)}, got {name}")


def _sensor_error(sensor: SensorSpec) -> str | None:
    if sensor.source in _RESERVED_SOURCES:
        return f"source: expected another name, {sensor.source} is a place of faults"
    if sensor.clutter > 0.0 and sensor.clutter_box is None and sensor.range_m is None:
        return "clutter: expected range_m or clutter_box to bound it"
    return None
