"""The vehicles of a scenario in their world, advanced one physics step at a time; no wires."""

from __future__ import annotations

from typing import Any

import msgspec

from sim_bridge.autopilot import Autopilot
from sim_bridge.controller import Controller, Gains
from sim_bridge.craft import Craft
from sim_bridge.crazyflie import Crazyflie
from sim_bridge.errors import ScenarioError
from sim_bridge.estimator import Estimator
from sim_bridge.messages import NS_PER_S, Reply
from sim_bridge.personality import Personality
from sim_bridge.physics import Start, World
from sim_bridge.placement import Resolved
from sim_bridge.scenario import Scenario, Vehicle
from sim_bridge.scenario_world import EstimatorNoise, Imu, Physics
from sim_bridge.sensors import Sensor, sensor_of

_GUSTS, _ESTIMATOR = 0, 1  # effects that draw
_INTEGRAL_HZ2 = 2.0  # PX4's MPC_Z_VEL_I_ACC


class Flight:
    """One scenario, all its vehicles. Time is the count of physics steps.

    Args:
        model: the physical parameters, the same for every vehicle.
    """

    def __init__(self, resolved: Resolved, model: Crazyflie | None = None) -> None:
        model = Crazyflie() if model is None else model
        scenario, fleet = resolved.scenario, resolved.scenario.fleet
        self.resolved = resolved
        self.world = World(
            [model] * len(fleet),
            [o.motion for o in resolved.obstacles],
            radii_m=[o.radius_m for o in resolved.obstacles],
            physics_hz=scenario.physics_hz,
            starts=[Start(spec.start, spec.yaw_rad) for spec in fleet],
            effects=scenario.physics,
            rngs=[resolved.physics_rng(_GUSTS, index) for index in range(len(fleet))],
        )
        self.crafts = tuple(self._craft(index, spec) for index, spec in enumerate(fleet))
        self._started_ns: int | None = None
        for craft in self.crafts:
            craft.sense()

    def _craft(self, index: int, spec: Vehicle) -> Craft:
        scenario, world = self.resolved.scenario, self.world
        model, physics = world.vehicles[index], scenario.physics
        others = [(other.name, world.vehicles[i].radius_m) for i, other in enumerate(scenario.fleet) if i != index]
        ids = [o.id for o in self.resolved.obstacles]
        estimator = None
        if physics.estimator != EstimatorNoise() or physics.imu != Imu():
            rng = self.resolved.physics_rng(_ESTIMATOR, index)
            estimator = Estimator(physics.estimator, physics.imu, physics_hz=scenario.physics_hz, rng=rng)
        gains = Gains(integral_hz2=_INTEGRAL_HZ2) if _disturbed(scenario) else Gains()
        return Craft(
            world,
            index,
            name=spec.name,
            system_id=spec.system_id,
            autopilot=_autopilot(scenario, spec, model),
            controller=Controller(model, scenario.physics_hz, gains, hover_thrust_error=physics.hover_thrust_error),
            estimator=estimator,
            sensors=self._sensors(
                index, [*ids, *(name for name, _ in others)], [*world.radii_m, *(radius for _, radius in others)]
            ),
            obstacle_ids=ids,
            others=others,
            end=scenario.end,
            target_enu=scenario.target_of(spec),
        )

    def _sensors(self, vehicle: int, ids: list[str], radii_m: list[float]) -> dict[str, Sensor]:
        scenario = self.resolved.scenario
        return {
            spec.source: sensor_of(spec, ids, radii_m, self.resolved.sensor_rng(index, vehicle))
            for index, spec in scenario.carried(scenario.fleet[vehicle].name)
        }

    @property
    def t_ns(self) -> int:
        return self.world.t_ns

    @property
    def at_tick(self) -> bool:
        """A control period begins here."""
        return self.world.step_count % self.resolved.control_steps == 0

    def advance(self) -> None:
        """One physics step of every vehicle; the obstacles start with the first that is flown from outside."""
        for craft in self.crafts:
            if craft.judge is None and craft.external:
                self._begin(craft)
        self.world.step([craft.command() for craft in self.crafts])
        t_ns, at_tick = self.world.t_ns, self.at_tick
        for craft in self.crafts:
            craft.follow(t_ns, at_tick=at_tick)

    def _begin(self, craft: Craft) -> None:
        if self._started_ns is None:
            self._started_ns = self.t_ns
            self.world.start_motions()
        craft.begin()

    def control(self) -> tuple[tuple[Reply, ...], ...]:
        """Each autopilot's look at the clock, once a control period."""
        return tuple(craft.control() for craft in self.crafts)

    @property
    def ended(self) -> str | None:
        """Why the flight is over, None while it goes on: the worst of its vehicles' (collision, timeout, reached).

        A vehicle with a target that nobody has taken over yet is waited for until ``timeout_s`` after the first was.
        """
        if self._started_ns is None:
            return None
        over = self.t_ns - self._started_ns >= self.resolved.scenario.end.timeout_s * NS_PER_S
        ends = set()
        for craft in self.crafts:
            end = craft.ended
            if end is None and craft.judge is None:
                end = "timeout" if over else ("reached" if craft.target_enu is None else None)
            if end is None:
                return None
            ends.add(end)
        return next(end for end in ("collision", "timeout", "reached") if end in ends)

    def summary(self) -> dict[str, Any]:
        """The outcome of the first vehicle, as far as it has come; of each under ``vehicles`` where there are more."""
        first = self.crafts[0].summary()
        if len(self.crafts) == 1:
            return first
        return {**first, "vehicles": [{"name": c.name, "ended": c.ended, **c.summary()} for c in self.crafts]}

    def trace_line(self) -> dict[str, Any]:
        """Truth at this instant, for pictures; of each vehicle under ``vehicles`` where there are several."""
        first = self.crafts[0].trace()
        clearance_m = first.pop("clearance_m")
        line = {"t_ns": self.t_ns, **first, "obstacles": self.world.obstacles_enu, "clearance_m": clearance_m}
        if len(self.crafts) > 1:
            line["vehicles"] = [{"name": craft.name, **craft.trace()} for craft in self.crafts]
        return line

    def close(self) -> None:
        self.world.close()


def _autopilot(scenario: Scenario, spec: Vehicle, model: Crazyflie) -> Personality:
    """The autopilot of one vehicle, with the parameters of its table."""
    if spec.personality != "px4":
        raise ScenarioError(f"{spec.name}: personality: expected px4, got {spec.personality}")
    autopilot = Autopilot(
        start_enu=spec.start,
        rest_height_m=model.radius_m,
        yaw_rad=spec.yaw_rad,
        control_hz=scenario.control_hz,
        physics_hz=scenario.physics_hz,
        system_id=spec.system_id,
    )
    parameters = autopilot.parameters
    parameters.write("MIS_TAKEOFF_ALT", spec.takeoff_altitude_m, is_int=False)
    for name, value in spec.parameters.items():
        if name not in parameters.names:
            raise ScenarioError(f"{spec.name}: parameters: expected a parameter of {spec.personality}, got {name}")
        is_int = parameters.is_int(name)
        typed = float(value) if not is_int else int(value) if value == int(value) else value
        if not parameters.write(name, typed, is_int=is_int):
            raise ScenarioError(f"{spec.name}: parameters.{name}: expected a value in its range, got {value}")
    return autopilot


def _disturbed(scenario: Scenario) -> bool:
    """Something pushes a hovering vehicle aside: position and velocity loops then need their integral."""
    plain = msgspec.structs.replace(scenario.physics, motor_lag=True, rotor_drag=True, battery_start=1.0)
    return plain != Physics() or any(fault.what == "gust" for fault in scenario.faults)
