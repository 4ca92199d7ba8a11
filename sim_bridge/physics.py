"""The world: one Crazyflie, moving spheres and the ground in PyBullet, advanced one physics step at a time.

Each step: rotor speeds follow their commands with first-order lag; every rotor pushes with k_f w^2 where it stands
and turns the body with c k_m w^2; rotor drag F = -k (sum w) v acts in body axes; PyBullet integrates. The vehicle
is moved by these forces and by contacts alone: nothing here sets its pose or velocity once it is built.

Contacts follow clearance: when PyBullet looks for contacts the spheres stand where clearance was last taken, and it
makes a contact of two spheres only from zero distance on. So no push can keep a collision from being seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType

import pybullet

from sim_bridge.crazyflie import SPIN_TORQUE_SIGN, Crazyflie, Quad, Triple
from sim_bridge.errors import ScenarioError
from sim_bridge.obstacles import Motion, Point

_RAD_S_PER_RPM = 2.0 * math.pi / 60.0
_GROUND_CONTACT_M = 1e-3
_ORIGIN = (0.0, 0.0, 0.0)
_LEVEL_XYZW = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class BodyState:
    """The vehicle's centre of mass, ENU; attitude as enu_from_flu (w, x, y, z)."""

    p_enu: Triple  # [m]
    v_enu: Triple  # [m/s]
    q_wxyz: Quad
    omega_flu: Triple  # body rates [rad/s]


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


class World:
    """One vehicle among moving spheres above the ground z = 0; a PyBullet client of its own in DIRECT mode.

    Args:
        vehicle: its parameters.
        motions, radii_m: one of each per obstacle.
        physics_hz: steps a second.
        start_enu: where the vehicle's centre starts, at rest; z at least its radius [m].
        start_yaw_rad: heading of the body's x axis from east, towards north.
    Raises:
        ScenarioError: a number of radii unlike that of the motions, a start below the ground, or a bad rate.
    """

    def __init__(
        self,
        vehicle: Crazyflie,
        motions: Sequence[Motion],
        *,
        radii_m: Sequence[float],
        physics_hz: int,
        start_enu: Point,
        start_yaw_rad: float = 0.0,
    ) -> None:
        if len(radii_m) != len(motions):
            raise ScenarioError(f"radii_m: expected {len(motions)} values, one for each motion, got {len(radii_m)}")
        if start_enu[2] < vehicle.radius_m:
            raise ScenarioError(f"start_enu: expected z at least the radius {vehicle.radius_m} m, got {start_enu[2]}")
        if physics_hz < 1:
            raise ScenarioError(f"physics_hz: expected a positive whole number, got {physics_hz}")
        self.vehicle = vehicle
        self.motions = tuple(motions)
        self.radii_m = tuple(float(radius_m) for radius_m in radii_m)
        self.physics_hz = physics_hz
        self.step_count = 0
        self.rotor_rpm: Quad = (0.0, 0.0, 0.0, 0.0)
        self._motions_from_step: int | None = None
        self._rotors_flu = vehicle.rotor_positions_flu
        # exact solution of the lag over one step with the command held
        self._lag_up = -math.expm1(-1.0 / (physics_hz * vehicle.motor_up_s))
        self._lag_down = -math.expm1(-1.0 / (physics_hz * vehicle.motor_down_s))
        self._client = pybullet.connect(pybullet.DIRECT)
        self._build(start_enu, start_yaw_rad)
        self.obstacles_enu = self.obstacle_positions(0.0)  # true centres at this step [m]
        self.state = self._read_state()
        self.clearance_m = self._clearance()
        self.min_clearance_m = self.clearance_m
        self.touched_ground = self.on_ground

    def _build(self, start_enu: Point, start_yaw_rad: float) -> None:
        client = self._client
        pybullet.setTimeStep(1.0 / self.physics_hz, physicsClientId=client)
        pybullet.setGravity(0.0, 0.0, -self.vehicle.g_m_s2, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(deterministicOverlappingPairs=1, physicsClientId=client)
        plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
        ground = pybullet.createMultiBody(0.0, plane, physicsClientId=client)
        # rolling friction keeps the landed ball from rolling away
        pybullet.changeDynamics(
            ground, -1, lateralFriction=1.0, rollingFriction=1.0, spinningFriction=1.0, physicsClientId=client
        )
        self._body = self._build_vehicle(start_enu, start_yaw_rad)
        self._spheres = [
            pybullet.createMultiBody(
                0.0, self._sphere(radius_m), basePosition=motion.position(0.0), physicsClientId=client
            )
            for motion, radius_m in zip(self.motions, self.radii_m, strict=True)
        ]

    def _build_vehicle(self, start_enu: Point, start_yaw_rad: float) -> int:
        vehicle = self.vehicle
        body: int = pybullet.createMultiBody(
            baseMass=vehicle.mass_kg,
            baseCollisionShapeIndex=self._sphere(vehicle.radius_m),
            basePosition=start_enu,
            baseOrientation=(0.0, 0.0, math.sin(0.5 * start_yaw_rad), math.cos(0.5 * start_yaw_rad)),
            physicsClientId=self._client,
        )
        # PyBullet would take the inertia of the collision sphere and damp 4 % of the speed a second
        pybullet.changeDynamics(
            body,
            -1,
            localInertiaDiagonal=vehicle.inertia_kg_m2,
            linearDamping=0.0,
            angularDamping=0.0,
            rollingFriction=0.01,
            spinningFriction=0.01,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=self._client,
        )
        return body

    def _sphere(self, radius_m: float) -> int:
        shape: int = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=radius_m, physicsClientId=self._client)
        return shape

    @property
    def t_s(self) -> float:
        """Time of the vehicle: physics steps taken over their rate."""
        return self.step_count / self.physics_hz

    def step(self, rpm_command: Quad) -> None:
        """Advance one physics step with the rotor speeds commanded to ``rpm_command`` (clipped to the motors')."""
        client, body = self._client, self._body
        self.rotor_rpm = self._follow(rpm_command)
        k_f, k_m, link_frame = self.vehicle.k_f, self.vehicle.k_m, pybullet.LINK_FRAME
        torque_z_n_m = 0.0
        for rpm, position_flu, sign in zip(self.rotor_rpm, self._rotors_flu, SPIN_TORQUE_SIGN, strict=True):
            squared = rpm * rpm
            torque_z_n_m += sign * k_m * squared
            pybullet.applyExternalForce(body, -1, (0.0, 0.0, k_f * squared), position_flu, link_frame, client)
        pybullet.applyExternalTorque(body, -1, (0.0, 0.0, torque_z_n_m), link_frame, client)
        pybullet.applyExternalForce(body, -1, self._drag_flu(), _ORIGIN, link_frame, client)
        pybullet.stepSimulation(client)
        self.step_count += 1
        if self._motions_from_step is not None:
            self._move_obstacles()
        self.state = self._read_state()
        self.clearance_m = self._clearance()
        self.min_clearance_m = min(self.min_clearance_m, self.clearance_m)
        self.touched_ground = self.touched_ground or self.on_ground

    def _follow(self, rpm_command: Quad) -> Quad:
        up, down, top = self._lag_up, self._lag_down, self.vehicle.max_rpm
        speeds = []
        for rpm, command in zip(self.rotor_rpm, rpm_command, strict=True):
            error = min(max(command, 0.0), top) - rpm
            speeds.append(rpm + (up if error > 0.0 else down) * error)
        w0, w1, w2, w3 = speeds
        return (w0, w1, w2, w3)

    def _drag_flu(self) -> Triple:
        """-k (sum of rotor speeds, rad/s) v in body axes [N]."""
        total = sum(self.rotor_rpm) * _RAD_S_PER_RPM
        vx, vy, vz = to_body(self.state.q_wxyz, self.state.v_enu)
        xy, z = -total * self.vehicle.drag_xy_kg_rad, -total * self.vehicle.drag_z_kg_rad
        return (xy * vx, xy * vy, z * vz)

    def _read_state(self) -> BodyState:
        p_enu, (x, y, z, w) = pybullet.getBasePositionAndOrientation(self._body, self._client)
        v_enu, omega_enu = pybullet.getBaseVelocity(self._body, self._client)
        q_wxyz = (w, x, y, z)
        return BodyState(p_enu, v_enu, q_wxyz, to_body(q_wxyz, omega_enu))

    def start_motions(self) -> None:
        """Start the motions' clock at this step; before it obstacles wait where they are at t = 0."""
        self._motions_from_step = self.step_count

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

    def _clearance(self) -> float:
        """min over obstacles of |p - p_o| - r_d - r_o [m]; inf without obstacles."""
        nearest = math.inf
        p_enu, radius_m = self.state.p_enu, self.vehicle.radius_m
        for p_o_enu, r_o_m in zip(self.obstacles_enu, self.radii_m, strict=True):
            nearest = min(nearest, math.dist(p_enu, p_o_enu) - radius_m - r_o_m)
        return nearest

    def reset_min_clearance(self) -> None:
        """Begin ``min_clearance_m`` and ``touched_ground`` anew with this step."""
        self.min_clearance_m = self.clearance_m
        self.touched_ground = self.on_ground

    @property
    def on_ground(self) -> bool:
        """The collision sphere touches the ground at this step."""
        return self.state.p_enu[2] - self.vehicle.radius_m <= _GROUND_CONTACT_M

    def closest_points_m(self, index: int) -> float:
        """Distance from the vehicle to obstacle ``index`` as PyBullet's own narrow phase finds it [m]."""
        points = pybullet.getClosestPoints(self._body, self._spheres[index], 1e3, physicsClientId=self._client)
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


def to_body(q_wxyz: Quad, v_enu: Triple) -> Triple:
    """FLU components of an ENU vector: R^T v."""
    w, x, y, z = q_wxyz
    a, b, c = v_enu
    # v + 2 w (v x u) + 2 (v x u) x u with u = (x, y, z)
    cx, cy, cz = b * z - c * y, c * x - a * z, a * y - b * x
    return (
        a + 2.0 * (w * cx + cy * z - cz * y),
        b + 2.0 * (w * cy + cz * x - cx * z),
        c + 2.0 * (w * cz + cx * y - cy * x),
    )
