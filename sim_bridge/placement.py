"""A scenario and a seed make a concrete flight: jitter drawn, motions placed, generators named."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from sim_bridge.messages import Cmd, Vec3
from sim_bridge.obstacles import Accelerated, FigureEight, Linear, Motion, Static
from sim_bridge.physics import control_steps
from sim_bridge.scenario import (
    AcceleratedObstacle,
    EightObstacle,
    LinearObstacle,
    Obstacle,
    OperatorStep,
    Scenario,
    Vehicle,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolvedObstacle:
    """One obstacle with its motion's numbers."""

    id: str
    radius_m: float
    motion: Motion


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


def resolve(name: str, scenario: Scenario, seed: int, *, obstacles: bool = True) -> Resolved:
    """The concrete flight of ``seed``; ``obstacles`` false leaves them out (the sensors then send empty frames)."""
    rng = np.random.default_rng([seed, 0])
    placed = tuple(_place(obstacle, rng) for obstacle in scenario.obstacles)
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


def _place(obstacle: Obstacle, rng: np.random.Generator) -> ResolvedObstacle:
    """Draw the jitter (the same number of draws for every obstacle) and shift the motion to its place."""
    draws = rng.uniform(-1.0, 1.0, 5).tolist()
    jitter = obstacle.jitter
    anchor = obstacle.cross_point if obstacle.cross_point is not None else obstacle.origin
    assert anchor is not None, "checked when the scenario was parsed"
    x, y, z = (a + w * d for a, w, d in zip(anchor, jitter.position_m, draws, strict=False))
    cross_s = max(0.0, (obstacle.cross_at_s or 0.0) + jitter.time_s * draws[3])
    yaw_rad = math.radians(jitter.yaw_deg * draws[4])
    at_origin = _motion(obstacle, (0.0, 0.0, 0.0), cross_s, yaw_rad)
    if obstacle.cross_point is None:
        return ResolvedObstacle(
            id=obstacle.id, radius_m=obstacle.radius_m, motion=_motion(obstacle, (x, y, z), cross_s, yaw_rad)
        )
    dx, dy, dz = at_origin.position(cross_s)
    moved = _motion(obstacle, (x - dx, y - dy, z - dz), cross_s, yaw_rad)
    return ResolvedObstacle(id=obstacle.id, radius_m=obstacle.radius_m, motion=moved)


def _motion(obstacle: Obstacle, origin: Vec3, cross_s: float, yaw_rad: float) -> Motion:
    if isinstance(obstacle, LinearObstacle):
        return Linear(origin, _turned(obstacle.velocity, yaw_rad))
    if isinstance(obstacle, AcceleratedObstacle):
        return Accelerated(origin, _turned(obstacle.velocity, yaw_rad), _turned(obstacle.acceleration, yaw_rad))
    if isinstance(obstacle, EightObstacle):
        phase_rad = math.radians(obstacle.phase_deg or 0.0)
        if obstacle.cross_point is not None:
            phase_rad = math.radians(obstacle.cross_phase_deg) - 2.0 * math.pi * cross_s / obstacle.period_s
        return FigureEight(
            center_enu=origin,
            size_m=obstacle.size_m,
            period_s=obstacle.period_s,
            phase_rad=math.remainder(phase_rad, math.tau),
            axis_yaw_rad=math.radians(obstacle.axis_yaw_deg) + yaw_rad,
            tilt_rad=math.radians(obstacle.tilt_deg),
        )
    return Static(origin)


def _turned(v: Vec3, yaw_rad: float) -> Vec3:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])
