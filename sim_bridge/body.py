"""One vehicle in PyBullet: a rigid body under its rotors' thrust, torque and drag.

Each step: rotor speeds follow their commands with first-order lag; every rotor pushes with k_f w^2 where it stands
and turns the body with c k_m w^2; rotor drag F = -k (sum w) v acts in body axes, v relative to the air. The body is
moved by these forces and by contacts alone: nothing here sets its pose or velocity once it is built.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import pybullet

from sim_bridge.crazyflie import SPIN_TORQUE_SIGN, Crazyflie, Quad, Triple

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
        client, body = self._client, self.number
        self.rotor_rpm = self._follow(rpm_command)
        k_f, k_m, link_frame = self.vehicle.k_f, self.vehicle.k_m, pybullet.LINK_FRAME
        torque_z_n_m = 0.0
        for rpm, position_flu, sign, factor in zip(
            self.rotor_rpm, self.rotors_flu, SPIN_TORQUE_SIGN, self.factors, strict=True
        ):
            squared = rpm * rpm
            torque_z_n_m += sign * k_m * squared
            pybullet.applyExternalForce(body, -1, (0.0, 0.0, k_f * squared * factor), position_flu, link_frame, client)
        pybullet.applyExternalTorque(body, -1, (0.0, 0.0, torque_z_n_m), link_frame, client)
        if self._drag:
            pybullet.applyExternalForce(body, -1, self._drag_flu(), _ORIGIN, link_frame, client)
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
        total = sum(self.rotor_rpm) * _RAD_S_PER_RPM
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
