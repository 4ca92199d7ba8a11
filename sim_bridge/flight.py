"""The vehicles of a scenario in their world, advanced one physics step at a time; no wires."""

from __future__ import annotations

from typing import Any

from sim_bridge.autopilot import Autopilot
from sim_bridge.craft import Craft
from sim_bridge.crazyflie import Crazyflie
from sim_bridge.messages import NS_PER_S, Reply
from sim_bridge.physics import Start, World
from sim_bridge.placement import Resolved
from sim_bridge.sensors import Sensor


class Flight:
    """One scenario, all its vehicles. Time is the count of physics steps.

    Args:
        model: the physical parameters, the same for every vehicle.
    """

    def __init__(self, resolved: Resolved, model: Crazyflie | None = None) -> None:
        model = Crazyflie() if model is None else model
        scenario = resolved.scenario
        self.resolved = resolved
        self.world = World(
            [model],
            [o.motion for o in resolved.obstacles],
            radii_m=[o.radius_m for o in resolved.obstacles],
            physics_hz=scenario.physics_hz,
            starts=[Start(scenario.vehicle.start, scenario.vehicle.yaw_rad)],
        )
        self.crafts: tuple[Craft, ...] = (self._craft(0),)
        self._started_ns: int | None = None
        for craft in self.crafts:
            craft.sense()

    def _craft(self, index: int) -> Craft:
        scenario, world = self.resolved.scenario, self.world
        spec, model = scenario.vehicle, world.vehicles[index]
        autopilot = Autopilot(
            start_enu=spec.start,
            rest_height_m=model.radius_m,
            yaw_rad=spec.yaw_rad,
            control_hz=scenario.control_hz,
            physics_hz=scenario.physics_hz,
        )
        autopilot.parameters.write("MIS_TAKEOFF_ALT", spec.takeoff_altitude_m, is_int=False)
        ids = [o.id for o in self.resolved.obstacles]
        return Craft(
            world,
            index,
            name="uav1",
            system_id=1,
            autopilot=autopilot,
            sensors=self._sensors(ids, world.radii_m),
            obstacle_ids=ids,
            others=(),
            end=scenario.end,
            target_enu=None if scenario.target is None else scenario.target.position,
        )

    def _sensors(self, ids: list[str], radii_m: tuple[float, ...]) -> dict[str, Sensor]:
        return {
            spec.source: Sensor(
                ids,
                radii_m,
                rate_hz=spec.rate_hz,
                sigma_m=spec.sigma_m,
                latency_s=spec.latency_s,
                dropout=spec.dropout,
                frame_dropout=spec.frame_dropout,
                rng=self.resolved.sensor_rng(index),
            )
            for index, spec in enumerate(self.resolved.scenario.sensors)
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
        at_tick = self.at_tick
        for craft in self.crafts:
            craft.follow(at_tick=at_tick)

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
        line = {
            "t_ns": self.t_ns,
            "name": self.crafts[0].name,
            **first,
            "obstacles": self.world.obstacles_enu,
            "obstacle_ids": [obstacle.id for obstacle in self.resolved.obstacles],
            "obstacle_radii_m": self.world.radii_m,
            "clearance_m": clearance_m,
        }
        if len(self.crafts) > 1:
            line["vehicles"] = [{"name": craft.name, **craft.trace()} for craft in self.crafts]
        return line

    def close(self) -> None:
        self.world.close()
