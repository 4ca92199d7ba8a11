"""One vehicle in PyBullet: a rigid body under its rotors' thrust, torque and drag.

Each step: rotor speeds follow their commands with first-order lag; every rotor pushes with k_f w^2 where it stands
and turns the body with c k_m w^2; rotor drag F = -k (sum w) v acts in body axes, v relative to the air. The body is
moved by these forces and by contacts alone: nothing here sets its pose or velocity once it is built. PyBullet is given
their sum and its torque about the centre of mass, not each: its calls are what a step costs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import pybullet

from sim_bridge.crazyflie import Crazyflie, Quad, Triple

_RAD_S_PER_RPM = 2.0 * math.pi / 60.0
_GROUND_CONTACT_M = 1e-3
_ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class BodyState:
    """A vehicle's centre of mass, ENU; attitude as enu_from_flu (w, x, y, z)."""

    p_enu: Triple  # [m]
    v_enu: Triple  # [m/s]
    q_wxyz: Quad
    omega_flu: Triple  # body rates [rad/s]


@dataclass(frozen=True, slots=True)
class Start:
    """Where a vehicle's centre starts, at rest and level."""

    p_enu: Triple  # z at least its radius [m]
    yaw_rad: float = 0.0  # heading of the body's x axis from east, towards north


class Body:
    """A vehicle's body in the PyBullet client ``client``, its rotors and its last state."""

    def __init__(
        self,
        client: int,
        vehicle: Crazyflie,
        start: Start,
        *,
        physics_hz: int,
        motor_lag: bool = True,
        rotor_drag: bool = True,
    ) -> None:
        self.vehicle = vehicle
        self.rotor_rpm: Quad = (0.0, 0.0, 0.0, 0.0)
        self.rotors_flu = vehicle.rotor_positions_flu
        self.factors: Quad = (1.0, 1.0, 1.0, 1.0)  # of each rotor's thrust
        self.wind_enu: Triple | None = None  # the air's velocity [m/s]; None: still
        self.downwash_n = 0.0  # downwards, at the centre of mass
        self._client = client
        self._rated_rpm = vehicle.max_rpm
        self._top_rpm = self._rated_rpm
        self._drag = rotor_drag
        self._lever_m = vehicle.arm_m / math.sqrt(2.0)  # of a rotor, about x and about y
        # exact solution of the lag over one step with the command held
        self._lag_up = -math.expm1(-1.0 / (physics_hz * vehicle.motor_up_s))
        self._lag_down = -math.expm1(-1.0 / (physics_hz * vehicle.motor_down_s))
        if not motor_lag:
            self._lag_up = self._lag_down = 1.0
        self.number = self._build(start)
        self.state = self.read()

    def _build(self, start: Start) -> int:
        vehicle, client = self.vehicle, self._client
        shape = pybullet.createCollisionShape(pybullet.GEOM_SPHERE, radius=vehicle.radius_m, physicsClientId=client)
        body: int = pybullet.createMultiBody(
            baseMass=vehicle.mass_kg,
            baseCollisionShapeIndex=shape,
            basePosition=start.p_enu,
            baseOrientation=(0.0, 0.0, math.sin(0.5 * start.yaw_rad), math.cos(0.5 * start.yaw_rad)),
            physicsClientId=client,
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
            physicsClientId=client,
        )
        return body

    def push(self, rpm_command: Quad) -> None:
        """Let the rotors follow ``rpm_command`` (clipped to the motors') over one step and apply their forces."""
        client, body, link_frame = self._client, self.number, pybullet.LINK_FRAME
        self.rotor_rpm = w0, w1, w2, w3 = self._follow(rpm_command)
        s0, s1, s2, s3 = w0 * w0, w1 * w1, w2 * w2, w3 * w3
        k_f, (c0, c1, c2, c3) = self.vehicle.k_f, self.factors
        f0, f1, f2, f3 = k_f * s0 * c0, k_f * s1 * c1, k_f * s2 * c2, k_f * s3 * c3
        roll, pitch = self._lever_m * (f0 + f1 - f2 - f3), self._lever_m * (f1 + f2 - f0 - f3)
        torque_flu = (roll, pitch, self.vehicle.k_m * (s1 + s3 - s0 - s2))
        dx, dy, dz = self._drag_flu() if self._drag else _ORIGIN
        force_flu = (dx, dy, dz + f0 + f1 + f2 + f3)
        pybullet.applyExternalForce(body, -1, force_flu, _ORIGIN, link_frame, client)
        pybullet.applyExternalTorque(body, -1, torque_flu, link_frame, client)
        if self.downwash_n > 0.0:
            down = (0.0, 0.0, -self.downwash_n)
            pybullet.applyExternalForce(body, -1, down, self.state.p_enu, pybullet.WORLD_FRAME, client)

    @property
    def thrusts_n(self) -> list[float]:
        """Of each rotor, away from ground and wakes [N]."""
        k_f = self.vehicle.k_f
        return [k_f * rpm * rpm for rpm in self.rotor_rpm]

    def limit(self, available: float) -> None:
        """Let the motors give no more than this share of their rated thrust."""
        self._top_rpm = self._rated_rpm * math.sqrt(available)

    def _follow(self, rpm_command: Quad) -> Quad:
        up, down, top = self._lag_up, self._lag_down, self._top_rpm
        speeds = []
        for rpm, command in zip(self.rotor_rpm, rpm_command, strict=True):
            error = (0.0 if command < 0.0 else top if command > top else command) - rpm
            speeds.append(rpm + (up if error > 0.0 else down) * error)
        w0, w1, w2, w3 = speeds
        return (w0, w1, w2, w3)

    def _drag_flu(self) -> Triple:
        """-k (sum of rotor speeds, rad/s) (v - wind) in body axes [N]."""
        w0, w1, w2, w3 = self.rotor_rpm
        total = (w0 + w1 + w2 + w3) * _RAD_S_PER_RPM
        v_enu, wind_enu = self.state.v_enu, self.wind_enu
        if wind_enu is not None:
            v_enu = (v_enu[0] - wind_enu[0], v_enu[1] - wind_enu[1], v_enu[2] - wind_enu[2])
        vx, vy, vz = to_body(self.state.q_wxyz, v_enu)
        xy, z = -total * self.vehicle.drag_xy_kg_rad, -total * self.vehicle.drag_z_kg_rad
        return (xy * vx, xy * vy, z * vz)

    def read(self) -> BodyState:
        """Take the state from PyBullet."""
        p_enu, (x, y, z, w) = pybullet.getBasePositionAndOrientation(self.number, self._client)
        v_enu, omega_enu = pybullet.getBaseVelocity(self.number, self._client)
        q_wxyz = (w, x, y, z)
        self.state = BodyState(p_enu, v_enu, q_wxyz, to_body(q_wxyz, omega_enu))
        return self.state

    @property
    def on_ground(self) -> bool:
        """The collision sphere touches the ground at this step."""
        return self.state.p_enu[2] - self.vehicle.radius_m <= _GROUND_CONTACT_M


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
