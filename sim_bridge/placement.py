"""A scenario and a seed make a concrete flight: jitter drawn, motions placed, generators named."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from sim_bridge.messages import Cmd
from sim_bridge.physics import control_steps
from sim_bridge.placing import ResolvedObstacle, place
from sim_bridge.scenario import OperatorStep, Scenario, Vehicle

__all__ = ["Resolved", "ResolvedObstacle", "describe", "resolve", "step_command"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Resolved:
    """A scenario of one seed: nothing is left to chance but the sensors' draws, which the same seed fixes."""

    name: str
    seed: int
    scenario: Scenario
    obstacles: tuple[ResolvedObstacle, ...]

    @property
    def control_steps(self) -> int:
        return control_steps(self.scenario.physics_hz, self.scenario.control_hz)

    @property
    def period_ns(self) -> int:
        return 1000 // self.scenario.control_hz * 1_000_000

    def sensor_rng(self, index: int, vehicle: int = 0) -> np.random.Generator:
        """The generator of sensor ``index`` on vehicle ``vehicle`` (indices in the file): independent of the
        obstacles' jitter, of other sensors and of other vehicles."""
        return np.random.default_rng([self.seed, 1, index, vehicle] if vehicle else [self.seed, 1, index])

    def physics_rng(self, effect: int, vehicle: int) -> np.random.Generator:
        """The generator of a random effect of the physics (0 gusts, 1 estimator) on vehicle ``vehicle``."""
        return np.random.default_rng([self.seed, 3, effect, vehicle])


def resolve(name: str, scenario: Scenario, seed: int, *, obstacles: bool = True) -> Resolved:
    """The concrete flight of ``seed``; ``obstacles`` false leaves them out (the sensors then send empty frames)."""
    rng = np.random.default_rng([seed, 0])
    vehicles = [vehicle.name for vehicle in scenario.fleet]
    placed = tuple(place(obstacle, rng, vehicles) for obstacle in scenario.obstacles)
    return Resolved(name=name, seed=seed, scenario=scenario, obstacles=placed if obstacles else ())


def describe(resolved: Resolved, vehicle_name: str) -> dict[str, Any]:
    """What `sim-bridge scenario --json` prints: all that the other side of the wires has to know."""
    scenario = resolved.scenario
    described: dict[str, Any] = msgspec.to_builtins(scenario)
    described |= {
        "name": resolved.name,
        "seed": resolved.seed,
        "prefix": f"uav/{vehicle_name}",
        "fleet": [_described(scenario, vehicle) for vehicle in scenario.fleet],
        "start": scenario.vehicle.start,
        "takeoff_altitude_m": scenario.vehicle.takeoff_altitude_m,
        "target": scenario.target_of(scenario.vehicle),
        "sources": [sensor.source for sensor in scenario.sensors],
        "obstacles": [
            {
                "id": o.id,
                "radius_m": o.radius_m,
                "motion": type(o.motion).__name__,
                "position": o.motion.position(0.0),
                "velocity": o.motion.velocity(0.0),
            }
            for o in resolved.obstacles
        ],
    }
    return described


def _described(scenario: Scenario, vehicle: Vehicle) -> dict[str, Any]:
    """What one vehicle's daemon and operator have to know."""
    return {
        "name": vehicle.name,
        "system_id": vehicle.system_id,
        "prefix": f"uav/{vehicle.name}",
        "personality": vehicle.personality,
        "start": vehicle.start,
        "takeoff_altitude_m": vehicle.takeoff_altitude_m,
        "target": scenario.target_of(vehicle),
        "sources": [sensor.source for _, sensor in scenario.carried(vehicle.name)],
        "daemon": vehicle.daemon,
    }


def step_command(step: OperatorStep) -> tuple[int, int, float | None]:
    """MAV_CMD, target component and param1 (None: any) by which an operator's step is known on the wire."""
    return {
        "arm": (int(Cmd.COMPONENT_ARM_DISARM), 1, 1.0),
        "disarm": (int(Cmd.COMPONENT_ARM_DISARM), 1, 0.0),
        "takeoff": (int(Cmd.NAV_TAKEOFF), 1, None),
        "land": (int(Cmd.NAV_LAND), 1, None),
        "hold": (int(Cmd.DO_SET_MODE), 1, None),
        "engage": (int(Cmd.NAV_GUIDED_ENABLE), 196, 1.0),
        "release": (int(Cmd.NAV_GUIDED_ENABLE), 196, 0.0),
    }[step.do]
