"""The vehicle in its world: physics, controller, autopilot, sensors and judge, advanced one physics step at a time."""

from __future__ import annotations

from typing import Any

import msgspec

from sim_bridge.autopilot import Autopilot
from sim_bridge.controller import Controller
from sim_bridge.crazyflie import Crazyflie
from sim_bridge.judge import Judge
from sim_bridge.messages import NS_PER_S, Reply
from sim_bridge.personality import Personality
from sim_bridge.physics import BodyState, World
from sim_bridge.placement import Resolved
from sim_bridge.sensors import Frame, Sensor

_NEAR_M = 1.0  # closer than this, each obstacle's approach is looked at in every physics step, else in every period


class Flight:
    """One vehicle, one scenario, no wires. Time is the count of physics steps."""

    def __init__(self, resolved: Resolved, vehicle: Crazyflie | None = None) -> None:
        vehicle = Crazyflie() if vehicle is None else vehicle
        scenario = resolved.scenario
        yaw_rad = scenario.vehicle.yaw_rad
        radii_m = [o.radius_m for o in resolved.obstacles]
        self.resolved = resolved
        self.world = World(
            vehicle,
            [o.motion for o in resolved.obstacles],
            radii_m=radii_m,
            physics_hz=scenario.physics_hz,
            start_enu=scenario.vehicle.start,
            start_yaw_rad=yaw_rad,
        )
        self.autopilot: Personality = Autopilot(
            start_enu=scenario.vehicle.start,
            rest_height_m=vehicle.radius_m,
            yaw_rad=yaw_rad,
            control_hz=scenario.control_hz,
            physics_hz=scenario.physics_hz,
        )
        self.autopilot.parameters.write("MIS_TAKEOFF_ALT", scenario.vehicle.takeoff_altitude_m, is_int=False)
        self.judge: Judge | None = None
        self._controller = Controller(vehicle, scenario.physics_hz)
        self._ids = [o.id for o in resolved.obstacles]
        self._radii_m = radii_m
        self._sensors = {
            spec.source: Sensor(
                self._ids,
                radii_m,
                rate_hz=spec.rate_hz,
                sigma_m=spec.sigma_m,
                latency_s=spec.latency_s,
                dropout=spec.dropout,
                frame_dropout=spec.frame_dropout,
                rng=resolved.sensor_rng(index),
            )
            for index, spec in enumerate(scenario.sensors)
        }
        self._dt_s = 1.0 / scenario.physics_hz
        self._sense()

    @property
    def t_ns(self) -> int:
        return self.world.step_count * NS_PER_S // self.world.physics_hz

    @property
    def state(self) -> BodyState:
        return self.world.state

    @property
    def at_tick(self) -> bool:
        """A control period begins here."""
        return self.world.step_count % self.resolved.control_steps == 0

    def advance(self) -> None:
        """One physics step under the autopilot's present target; the obstacles start with external control."""
        world, autopilot = self.world, self.autopilot
        if self.judge is None and autopilot.external and autopilot.armed:
            self._start()
        world.step(self._controller.rpm(world.state, autopilot.target(world.state)))
        autopilot.turn(self._dt_s)
        self._sense()
        if self.judge is not None:
            grounded = world.on_ground and autopilot.external
            self.judge.step(self.t_ns, world.state.p_enu, world.clearance_m, grounded=grounded)
            if world.clearance_m < _NEAR_M or self.at_tick:
                self.judge.approach(self.t_ns, world.state.p_enu, world.obstacles_enu)

    def control(self) -> tuple[Reply, ...]:
        """The autopilot's look at the clock, once a control period."""
        return self.autopilot.step(self.world.state, self.t_ns)

    def frames(self, source: str, t_ns: int) -> list[Frame]:
        """Frames of a sensor that have arrived by ``t_ns``."""
        return self._sensors[source].due(t_ns)

    @property
    def ended(self) -> str | None:
        """Why the flight is over: reached, collision, timeout; None while it goes on."""
        return None if self.judge is None else self.judge.verdict(self.t_ns)

    def summary(self) -> dict[str, Any]:
        """The outcome, as far as it has come."""
        judge = self.judge
        if judge is None:
            return {
                "reached": False,
                "collided": False,
                "min_clearance_m": None,
                "flight_time_s": None,
                "approaches": [],
            }
        return {
            "reached": judge.reached_ns is not None,
            "collided": judge.collided_ns is not None,
            "min_clearance_m": judge.min_clearance_m if self._ids else None,
            "flight_time_s": judge.flight_time_s,
            "approaches": [msgspec.to_builtins(a) for a in judge.approaches if a is not None],
        }

    def trace_line(self) -> dict[str, Any]:
        """Truth at this instant, for pictures."""
        world = self.world
        judge = self.judge
        return {
            "t_ns": self.t_ns,
            "offboard_s": None if judge is None else (self.t_ns - judge.start_ns) / NS_PER_S,
            "mode": self.autopilot.mode_name,
            "position": world.state.p_enu,
            "velocity": world.state.v_enu,
            "obstacles": world.obstacles_enu,
            "clearance_m": world.clearance_m if self._ids else None,
        }

    def close(self) -> None:
        self.world.close()

    def _start(self) -> None:
        target = self.resolved.scenario.target
        self.world.start_motions()
        self.world.reset_min_clearance()
        self.judge = Judge(
            self.resolved.scenario.end,
            None if target is None else target.position,
            start_ns=self.t_ns,
            p_enu=self.world.state.p_enu,
            radius_m=self.world.vehicle.radius_m,
            ids=self._ids,
            radii_m=self._radii_m,
        )

    def _sense(self) -> None:
        t_ns = self.t_ns
        for sensor in self._sensors.values():
            if t_ns >= sensor.next_ns:
                sensor.sample(t_ns, self.world.obstacles_enu)
