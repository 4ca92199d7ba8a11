"""One vehicle of a flight: its autopilot and controller, its sensors, and the judge of what it came to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec

from sim_bridge.battery import BatteryState
from sim_bridge.controller import Controller
from sim_bridge.crazyflie import Quad
from sim_bridge.estimator import Estimator
from sim_bridge.judge import Judge
from sim_bridge.messages import NS_PER_S, Reply
from sim_bridge.obstacles import Point
from sim_bridge.personality import Personality
from sim_bridge.physics import BodyState, World
from sim_bridge.scenario import End
from sim_bridge.sensors import Frame, Sensor

_NEVER_NS = 1 << 62
_NEAR_M = 1.0  # closer than this, each obstacle's approach is looked at in every physics step, else in every period


class Craft:
    """Vehicle ``index`` of ``world``.

    Args:
        name: of the vehicle; the others' sensors report it under this id.
        system_id: its MAVLink system.
        autopilot, controller: what flies it.
        estimator: what it believes of its state; None: the truth.
        sensors: by source; they see the obstacles, then the other vehicles.
        others: name and radius of the other vehicles, in their order [m].
        obstacle_ids: of the world's obstacles, in their order.
        end, target_enu: what the judge goes by.
    """

    def __init__(
        self,
        world: World,
        index: int,
        *,
        name: str,
        system_id: int,
        autopilot: Personality,
        controller: Controller,
        estimator: Estimator | None,
        sensors: dict[str, Sensor],
        obstacle_ids: Sequence[str],
        others: Sequence[tuple[str, float]],
        end: End,
        target_enu: Point | None,
    ) -> None:
        self.name = name
        self.system_id = system_id
        self.autopilot = autopilot
        self.sensors = sensors
        self.judge: Judge | None = None
        self.target_enu = target_enu
        self._world = world
        self._index = index
        self._end = end
        self._ids = [*obstacle_ids, *(other for other, _ in others)]
        self._radii_m = [*world.radii_m, *(radius_m for _, radius_m in others)]
        self._controller = controller
        self._estimator = estimator
        self._belief = self.truth if estimator is None else estimator.update(self.truth)
        self._dt_s = 1.0 / world.physics_hz
        self._sense_ns = 0  # when the next sensor measures

    @property
    def prefix(self) -> str:
        """Of its Zenoh keys."""
        return f"uav/{self.name}"

    @property
    def t_ns(self) -> int:
        """Time of the vehicle's clock, which all vehicles of a flight share."""
        return self._world.t_ns

    @property
    def truth(self) -> BodyState:
        """Where it is."""
        return self._world.states[self._index]

    @property
    def state(self) -> BodyState:
        """Where its estimator believes it to be: what autopilot, controller and telemetry go by."""
        return self._belief

    @property
    def accuracy(self) -> tuple[float, float, float]:
        """Standard deviations of the believed position [m], velocity [m/s] and attitude [rad]; 0 for the truth."""
        return (0.0, 0.0, 0.0) if self._estimator is None else self._estimator.std

    @property
    def throttle(self) -> float:
        """Collective thrust, share of that of all rotors at full speed."""
        body = self._world.bodies[self._index]
        return sum(rpm * rpm for rpm in body.rotor_rpm) / (4.0 * body.vehicle.max_rpm**2)

    @property
    def battery(self) -> BatteryState:
        return self._world.batteries[self._index].state

    def set_charge(self, share: float) -> None:
        """Put the battery at ``share`` of its charge, 0 to 1: a fault."""
        self._world.batteries[self._index].share = share

    @property
    def external(self) -> bool:
        """Armed and flown by setpoints from outside."""
        return self.autopilot.external and self.autopilot.armed

    @property
    def clearance_m(self) -> float:
        """Surface to surface to the nearest obstacle or other vehicle [m]; inf where there is none."""
        return self._world.clearances_m[self._index]

    def command(self) -> Quad:
        """Rotor speed commands for the coming physics step [RPM]."""
        state = self._belief
        return self._controller.rpm(state, self.autopilot.target(state))

    def follow(self, t_ns: int, *, at_tick: bool) -> None:
        """After a physics step that ended at ``t_ns``: estimate, heading, sensors, judge."""
        world, index = self._world, self._index
        truth = world.states[index]
        self._belief = truth if self._estimator is None else self._estimator.update(truth)
        self.autopilot.turn(self._dt_s)
        if t_ns >= self._sense_ns:
            self.sense()
        judge = self.judge
        if judge is None:
            return
        clearance_m = world.clearances_m[index]
        grounded = world.bodies[index].on_ground and self.autopilot.external
        judge.step(t_ns, truth.p_enu, clearance_m, grounded=grounded)
        if clearance_m < _NEAR_M or at_tick:
            judge.approach(t_ns, truth.p_enu, self._surroundings())

    def sense(self) -> None:
        """Let the sensors measure that are due."""
        t_ns = self.t_ns
        for sensor in self.sensors.values():
            if t_ns >= sensor.next_ns:
                sensor.sample(t_ns, self._surroundings(), self.truth)
        self._sense_ns = min((sensor.next_ns for sensor in self.sensors.values()), default=_NEVER_NS)

    def control(self) -> tuple[Reply, ...]:
        """The autopilot's look at the clock, once a control period."""
        self.autopilot.battery(self.battery)
        return self.autopilot.step(self.state, self.t_ns)

    def frames(self, source: str, t_ns: int) -> list[Frame]:
        """Frames of a sensor that have arrived by ``t_ns``."""
        return self.sensors[source].due(t_ns)

    def begin(self) -> None:
        """Begin the judgement here: this vehicle has entered external control."""
        self._world.reset_min_clearance(self._index)
        self.judge = Judge(
            self._end,
            self.target_enu,
            start_ns=self.t_ns,
            p_enu=self.truth.p_enu,
            radius_m=self._world.vehicles[self._index].radius_m,
            ids=self._ids,
            radii_m=self._radii_m,
        )

    @property
    def ended(self) -> str | None:
        """Why its flight is over: reached, collision, timeout; None while it goes on."""
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

    def trace(self) -> dict[str, Any]:
        """Truth at this instant, for pictures."""
        return {
            "offboard_s": None if self.judge is None else (self.t_ns - self.judge.start_ns) / NS_PER_S,
            "mode": self.autopilot.mode_name,
            "position": self.truth.p_enu,
            "velocity": self.truth.v_enu,
            "clearance_m": self.clearance_m if self._ids else None,
        }

    def _surroundings(self) -> Sequence[Point]:
        """True centres of the obstacles, then of the other vehicles."""
        world = self._world
        if len(world.states) == 1:
            return world.obstacles_enu
        return [*world.obstacles_enu, *(s.p_enu for i, s in enumerate(world.states) if i != self._index)]
