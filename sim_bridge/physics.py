"""The world: vehicles, moving spheres and the ground in PyBullet, advanced one physics step at a time.

Each step the air acts (`air`), the vehicles' rotors push (`body`), PyBullet integrates, the spheres move to where their
motions say, and the batteries discharge (`battery`).

Contacts follow clearance: when PyBullet looks for contacts, spheres and vehicles stand where clearance was last taken,
and it makes a contact of two spheres only from zero distance on. So no push can keep a collision from being seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import TracebackType

import numpy as np
import pybullet

from sim_bridge.air import Air
from sim_bridge.battery import Battery
from sim_bridge.body import Body, BodyState, Start, to_body
from sim_bridge.crazyflie import Crazyflie, Quad, Triple
from sim_bridge.errors import ScenarioError
from sim_bridge.obstacles import Motion, Point
from sim_bridge.pursuit import Reacting
from sim_bridge.scenario_world import Physics

__all__ = ["BodyState", "Start", "World", "control_steps", "to_body"]

_LEVEL_XYZW = (0.0, 0.0, 0.0, 1.0)
_BATTERY_HZ = 20  # at which batteries discharge where they do not act on the flight


def control_steps(physics_hz: int, control_hz: int) -> int:
    """Physics steps in one control period.

    >>> control_steps(240, 20)
    12

    Raises:
        ScenarioError: physics_hz is no whole multiple of control_hz, or the period is no whole number of ms.
    """
    if control_hz < 1 or 1000 % control_hz:
        raise ScenarioError(f"control_hz: expected a divisor of 1000 (a period of whole ms), got {control_hz}")
    if physics_hz < control_hz or physics_hz % control_hz:
        raise ScenarioError(f"physics_hz: expected a whole multiple of control_hz {control_hz}, got {physics_hz}")
    return physics_hz // control_hz


_PLAIN = Physics()


class World:
    """Vehicles among moving spheres above the ground z = 0; a PyBullet client of its own in DIRECT mode.

    Args:
        vehicles: the parameters of each, at least one.
        motions, radii_m: one of each per obstacle.
        physics_hz: steps a second.
        starts: one per vehicle; no two vehicles may touch there.
        effects: which act; by default motor lag and rotor drag.
        rngs: one generator per vehicle for its gusts; none needed without.
    Raises:
        ScenarioError: numbers that do not match, a start below the ground or inside another, or a bad rate.
    """

    def __init__(
        self,
        vehicles: Sequence[Crazyflie],
        motions: Sequence[Motion],
        *,
        radii_m: Sequence[float],
        physics_hz: int,
        starts: Sequence[Start],
        effects: Physics = _PLAIN,
        rngs: Sequence[np.random.Generator] = (),
    ) -> None:
        if len(radii_m) != len(motions):
            raise ScenarioError(f"radii_m: expected {len(motions)} values, one for each motion, got {len(radii_m)}")
        if physics_hz < 1:
            raise ScenarioError(f"physics_hz: expected a positive whole number, got {physics_hz}")
        _check_starts(vehicles, starts)
        self.vehicles = tuple(vehicles)
        self.motions = tuple(motions)
        self._reacting = tuple(motion for motion in self.motions if isinstance(motion, Reacting))
        for motion in self._reacting:
            motion.reset()
        self.radii_m = tuple(float(radius_m) for radius_m in radii_m)
        self.physics_hz = physics_hz
        self.step_count = 0
        self.batteries = tuple(Battery(effects.battery_start) for _ in vehicles)
        self._sag = effects.battery_sag
        self._battery_steps = 1 if self._sag else max(1, physics_hz // _BATTERY_HZ)
        self._motions_from_step: int | None = None
        self._client = pybullet.connect(pybullet.DIRECT)
        self._build(starts, effects)
        self._air = Air(effects, self.bodies, physics_hz=physics_hz, rngs=rngs)
        self.states: tuple[BodyState, ...] = tuple(body.state for body in self.bodies)
        self.obstacles_enu = self.obstacle_positions(0.0)  # true centres at this step [m]
        self.clearances_m = self._clearances()  # surface to surface, of each vehicle from all else but the ground [m]
        self.min_clearances_m = list(self.clearances_m)
        self.touched_ground = [body.on_ground for body in self.bodies]

    def _build(self, starts: Sequence[Start], effects: Physics) -> None:
        client = self._client
        pybullet.setTimeStep(1.0 / self.physics_hz, physicsClientId=client)
        pybullet.setGravity(0.0, 0.0, -self.vehicles[0].g_m_s2, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=client)
        plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
        ground = pybullet.createMultiBody(0.0, plane, physicsClientId=client)
        # rolling friction keeps the landed ball from rolling away
        pybullet.changeDynamics(
            ground, -1, lateralFriction=1.0, rollingFriction=1.0, spinningFriction=1.0, physicsClientId=client
        )
        self.bodies = tuple(
            Body(
                client,
                vehicle,
                start,
                physics_hz=self.physics_hz,
                motor_lag=effects.motor_lag,
                rotor_drag=effects.rotor_drag,
            )
            for vehicle, start in zip(self.vehicles, starts, strict=True)
        )
        self._spheres = [
            pybullet.createMultiBody(
                0.0, self._sphere(radius_m), basePosition=motion.position(0.0), physicsClientId=client
            )
            for motion, radius_m in zip(self.motions, self.radii_m, strict=True)
        ]

    def _sphere(self, radius_m: float) -> int:
        shape: int = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=radius_m, physicsClientId=self._client)
        return shape

    @property
    def t_s(self) -> float:
        """Time of the world: physics steps taken over their rate."""
        return self.step_count / self.physics_hz

    @property
    def t_ns(self) -> int:
        return self.step_count * 1_000_000_000 // self.physics_hz

    def step(self, rpm_commands: Sequence[Quad]) -> None:
        """Advance one physics step; one set of rotor speed commands per vehicle (clipped to the motors') [RPM]."""
        if self._air.stirred:
            self._air.stir(self.t_s)
        for body, command in zip(self.bodies, rpm_commands, strict=True):
            body.push(command)
        pybullet.stepSimulation(self._client)
        self.step_count += 1
        if self._motions_from_step is not None:
            for motion in self._reacting:
                motion.advance(1.0 / self.physics_hz, self.states)  # as they were when the step began
            self._move_obstacles()
        if self.step_count % self._battery_steps == 0:
            self._discharge()
        self.states = tuple([body.read() for body in self.bodies])
        self.clearances_m = self._clearances()
        for index, clearance_m in enumerate(self.clearances_m):
            if clearance_m < self.min_clearances_m[index]:
                self.min_clearances_m[index] = clearance_m
            if not self.touched_ground[index]:
                self.touched_ground[index] = self.bodies[index].on_ground

    def _discharge(self) -> None:
        dt_s = self._battery_steps / self.physics_hz
        for body, battery in zip(self.bodies, self.batteries, strict=True):
            battery.draw(body.thrusts_n, dt_s)
            if self._sag:
                body.limit(battery.available)

    def gust(self, v_enu: Triple, for_s: float) -> None:
        """Add a wind of ``v_enu`` [m/s] everywhere for ``for_s``, from the next step on."""
        self._air.gust(v_enu, self.t_s + for_s)

    def start_motions(self) -> None:
        """Start the motions' clock at this step; before it obstacles wait where they are at t = 0."""
        self._motions_from_step = self.step_count

    @property
    def motions_started(self) -> bool:
        return self._motions_from_step is not None

    def motion_time_s(self, t_s: float) -> float:
        """The motions' clock at vehicle time ``t_s``, 0 before they start."""
        if self._motions_from_step is None:
            return 0.0
        return max(0.0, t_s - self._motions_from_step / self.physics_hz)

    def obstacle_positions(self, t_s: float) -> list[Point]:
        """True centres at vehicle time ``t_s``, ENU [m]."""
        motion_t_s = self.motion_time_s(t_s)
        return [motion.position(motion_t_s) for motion in self.motions]

    def obstacle_velocities(self, t_s: float) -> list[Point]:
        """True velocities at vehicle time ``t_s``, ENU [m/s]; 0 before the motions start."""
        if self._motions_from_step is None or t_s < self._motions_from_step / self.physics_hz:
            return [(0.0, 0.0, 0.0)] * len(self.motions)
        motion_t_s = self.motion_time_s(t_s)
        return [motion.velocity(motion_t_s) for motion in self.motions]

    def _move_obstacles(self) -> None:
        self.obstacles_enu = self.obstacle_positions(self.t_s)
        for sphere, p_enu in zip(self._spheres, self.obstacles_enu, strict=True):
            pybullet.resetBasePositionAndOrientation(sphere, p_enu, _LEVEL_XYZW, self._client)

    def _clearances(self) -> tuple[float, ...]:
        """min over obstacles and other vehicles of |p - p_o| - r_d - r_o [m]; inf where there is nothing else."""
        nearest = []
        for body in self.bodies:
            p_enu, radius_m, nearest_m = body.state.p_enu, body.vehicle.radius_m, math.inf
            for p_o_enu, r_o_m in zip(self.obstacles_enu, self.radii_m, strict=True):
                clearance_m = math.dist(p_enu, p_o_enu) - radius_m - r_o_m
                if clearance_m < nearest_m:
                    nearest_m = clearance_m
            nearest.append(nearest_m)
        for j in range(1, len(nearest)):
            for i in range(j):
                one, other = self.bodies[i], self.bodies[j]
                distance_m = math.dist(one.state.p_enu, other.state.p_enu)
                clearance_m = distance_m - one.vehicle.radius_m - other.vehicle.radius_m
                nearest[i], nearest[j] = min(nearest[i], clearance_m), min(nearest[j], clearance_m)
        return tuple(nearest)

    def reset_min_clearance(self, index: int = 0) -> None:
        """Begin ``min_clearances_m`` and ``touched_ground`` of a vehicle anew with this step."""
        self.min_clearances_m[index] = self.clearances_m[index]
        self.touched_ground[index] = self.bodies[index].on_ground

    def closest_points_m(self, index: int, vehicle: int = 0) -> float:
        """Distance from a vehicle to obstacle ``index`` as PyBullet's own narrow phase finds it [m]."""
        body = self.bodies[vehicle].number
        points = pybullet.getClosestPoints(body, self._spheres[index], 1e3, physicsClientId=self._client)
        return float(min(point[8] for point in points))

    def close(self) -> None:
        """Free the PyBullet client; a second call does nothing."""
        if self._client >= 0:
            pybullet.disconnect(self._client)
            self._client = -1

    def __enter__(self) -> World:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _check_starts(vehicles: Sequence[Crazyflie], starts: Sequence[Start]) -> None:
    if not vehicles:
        raise ScenarioError("vehicles: expected at least one")
    if len(starts) != len(vehicles):
        raise ScenarioError(f"starts: expected {len(vehicles)} values, one for each vehicle, got {len(starts)}")
    for index, (vehicle, start) in enumerate(zip(vehicles, starts, strict=True)):
        if start.p_enu[2] < vehicle.radius_m:
            raise ScenarioError(f"start: expected z at least the radius {vehicle.radius_m} m, got {start.p_enu[2]}")
        for other, at in zip(vehicles[:index], starts[:index], strict=True):
            apart_m = math.dist(start.p_enu, at.p_enu)
            if apart_m <= vehicle.radius_m + other.radius_m:
                least_m = vehicle.radius_m + other.radius_m
                raise ScenarioError(f"start: expected vehicles more than {least_m:g} m apart, got {apart_m:g} m")
