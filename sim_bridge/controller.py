"""Cascaded flight controller: position -> velocity -> acceleration -> attitude -> body rates -> four rotor speeds.

An acceleration a asks for the thrust vector f = m (a + g e3). Its direction is the wanted body z axis, which with
the wanted heading gives the wanted attitude; the attitude error gives wanted body rates, the rate error (with rate
damping) an angular acceleration, and the mixer four thrusts, which are rotor speeds through f = k_f w^2.
No wind, drag or motor lag is compensated: an acceleration setpoint closes no velocity loop, as on PX4.

Runs every physics step, so it is written in plain floats: numpy on 3-vectors costs more than the arithmetic.
Attitude law: Brescianini, Hehn, D'Andrea, "Nonlinear Quadrocopter Attitude Control", ETH Zurich, 2013.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TypeAlias

from sim_bridge.crazyflie import Crazyflie, Quad, Triple
from sim_bridge.physics import BodyState

_LEAST_UPRIGHT = 0.5  # cosine of the tilt beyond which the vertical force is no longer kept


@dataclass(frozen=True, slots=True)
class AccelerationSetpoint:
    """Net acceleration, gravity excluded: zero hovers (or keeps the velocity)."""

    a_enu: Triple  # [m/s^2]
    yaw_rad: float = 0.0  # body x axis from east, towards north
    tilt_tan: float | None = field(default=None, compare=False)  # tangent of the most tilt; None: that of the gains


@dataclass(frozen=True, slots=True)
class VelocitySetpoint:
    v_enu: Triple  # [m/s]
    yaw_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class PositionSetpoint:
    p_enu: Triple  # [m]
    yaw_rad: float = 0.0
    v_max_m_s: float = 2.0  # on the way there


@dataclass(frozen=True, slots=True)
class AttitudeSetpoint:
    """An attitude, or body rates alone where ``q_wxyz`` is None; beside an attitude only the yaw rate counts."""

    q_wxyz: Quad | None  # enu_from_flu
    thrust: float  # collective, share of full thrust
    omega_flu: Triple = (0.0, 0.0, 0.0)  # [rad/s]


@dataclass(frozen=True, slots=True)
class MotorsOff:
    """All rotors commanded to zero."""


Setpoint: TypeAlias = AccelerationSetpoint | VelocitySetpoint | PositionSetpoint | AttitudeSetpoint | MotorsOff


@dataclass(frozen=True, slots=True, kw_only=True)
class Gains:
    """Tuned on the simulated vehicle; the step responses are in the tests."""

    position_hz: float = 1.6  # [1/s] position error -> velocity
    velocity_hz: float = 4.0  # [1/s] velocity error -> acceleration
    a_max_m_s2: float = 4.0  # of the position and velocity loops
    tilt_hz: float = 13.0  # [1/s] tilt error -> roll and pitch rate
    yaw_hz: float = 4.0  # [1/s] heading error -> yaw rate
    rate_hz: float = 45.0  # [1/s] roll and pitch rate error -> angular acceleration
    yaw_rate_hz: float = 10.0
    rate_damping: float = 0.4  # share of the measured angular acceleration fed back: shortens the motors' lag
    tilt_max_rad: float = math.radians(35.0)
    rate_max_rad_s: float = 10.0
    least_collective: float = 0.35  # of the weight, so that tilt stays in command while sinking
    most_collective: float = 1.9  # of the weight: the rest is for torques
    integral_hz2: float = 0.0  # [1/s^2] integral of the velocity error -> acceleration; 0 off
    integral_max_m_s2: float = 5.0


class Controller:
    """Rotor speeds that follow a setpoint; call `rpm` once a physics step.

    The hidden state is the body rate of the last step (for its derivative) and, where it is on, the integral of the
    velocity error; ``reset`` forgets both. The integral, like PX4's, rests while acceleration setpoints are flown.

    Args:
        hover_thrust_error: share by which it misjudges its thrust: asked for f it gives (1 + error) f.
    """

    def __init__(
        self, vehicle: Crazyflie, physics_hz: int, gains: Gains | None = None, *, hover_thrust_error: float = 0.0
    ) -> None:
        self.vehicle = vehicle
        self.gains = Gains() if gains is None else gains
        self._rate_hz = float(physics_hz)
        self._tilt_tan = math.tan(self.gains.tilt_max_rad)
        # the vehicle's derived figures, once: these loops run every physics step
        self._weight_n = vehicle.weight_n
        self._least_n, self._most_n = vehicle.idle_thrust_n, vehicle.k_f * vehicle.max_rpm**2
        self._lever_m = 4.0 * vehicle.arm_m / math.sqrt(2.0)
        self._thrust_scale = 1.0 + hover_thrust_error
        self._last_omega: Triple | None = None
        self._integral: Triple = (0.0, 0.0, 0.0)

    def reset(self) -> None:
        self._last_omega = None
        self._integral = (0.0, 0.0, 0.0)

    def rpm(self, state: BodyState, setpoint: Setpoint) -> Quad:
        """Rotor speed commands, front left, rear left, rear right, front right [RPM]."""
        if isinstance(setpoint, MotorsOff):
            self.reset()
            return (0.0, 0.0, 0.0, 0.0)
        if isinstance(setpoint, AttitudeSetpoint):
            return self._follow_attitude(state, setpoint)
        tilt_tan = setpoint.tilt_tan if isinstance(setpoint, AccelerationSetpoint) else None
        fx, fy, fz = self._thrust_vector(
            self._acceleration(state, setpoint), self._tilt_tan if tilt_tan is None else tilt_tan
        )
        _, x, y, _ = state.q_wxyz
        upright = 1.0 - 2.0 * (x * x + y * y)  # cosine of the tilt
        # the vertical force is kept exact while the body turns: sideways steps do not lift or drop the vehicle
        collective_n = fz / max(upright, _LEAST_UPRIGHT) if upright > 0.0 else 0.0
        torque = self._torque(state, self._wanted_rates(state.q_wxyz, (fx, fy, fz), setpoint.yaw_rad))
        return self.mix(self._thrust_scale * collective_n, torque)

    def _follow_attitude(self, state: BodyState, setpoint: AttitudeSetpoint) -> Quad:
        wanted = setpoint.omega_flu
        if setpoint.q_wxyz is not None:
            w, x, y, z = setpoint.q_wxyz
            up = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
            yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
            roll_rate, pitch_rate, yaw_rate = self._wanted_rates(state.q_wxyz, up, yaw)
            wanted = (roll_rate, pitch_rate, yaw_rate + wanted[2])
        vehicle = self.vehicle
        share = min(max(setpoint.thrust, 0.0), 1.0)
        return self.mix(share * vehicle.thrust_to_weight * vehicle.weight_n, self._torque(state, wanted))

    def _acceleration(self, state: BodyState, setpoint: Setpoint) -> Triple:
        """Outer loops: a = k_v (v* - v) with v* = k_p (p* - p), no faster than ``v_max_m_s``."""
        if isinstance(setpoint, AccelerationSetpoint):
            return setpoint.a_enu
        gains = self.gains
        if isinstance(setpoint, PositionSetpoint):
            k, (px, py, pz), (tx, ty, tz) = gains.position_hz, state.p_enu, setpoint.p_enu
            wanted = _shortened((k * (tx - px), k * (ty - py), k * (tz - pz)), setpoint.v_max_m_s)
        elif isinstance(setpoint, VelocitySetpoint):
            wanted = setpoint.v_enu
        else:
            raise TypeError(f"setpoint: expected one of {Setpoint}, got {setpoint!r}")
        k, (vx, vy, vz), (wx, wy, wz) = gains.velocity_hz, state.v_enu, wanted
        a_enu = _shortened((k * (wx - vx), k * (wy - vy), k * (wz - vz)), gains.a_max_m_s2)
        return a_enu if gains.integral_hz2 == 0.0 else self._integrated(a_enu)

    def _integrated(self, a_enu: Triple) -> Triple:
        """``a_enu`` plus the integral of the velocity error, which stands still while ``a_enu`` is at its limit."""
        gains, (ix, iy, iz) = self.gains, self._integral
        if math.hypot(*a_enu) < gains.a_max_m_s2 * 0.999:
            k = gains.integral_hz2 / gains.velocity_hz / self._rate_hz
            grown = (ix + k * a_enu[0], iy + k * a_enu[1], iz + k * a_enu[2])
            ix, iy, iz = self._integral = _shortened(grown, gains.integral_max_m_s2)
        return (a_enu[0] + ix, a_enu[1] + iy, a_enu[2] + iz)

    def _thrust_vector(self, a_enu: Triple, tilt_tan: float) -> Triple:
        """m (a + g e3), its vertical part within the collective's range, its horizontal part within the tilt limit."""
        mass_kg, weight_n, gains = self.vehicle.mass_kg, self._weight_n, self.gains
        fx, fy, fz = mass_kg * a_enu[0], mass_kg * a_enu[1], mass_kg * a_enu[2]
        fz += weight_n
        fz = min(max(fz, gains.least_collective * weight_n), gains.most_collective * weight_n)
        level, level_max = math.hypot(fx, fy), fz * tilt_tan
        if level > level_max:
            fx, fy = fx * level_max / level, fy * level_max / level
        return (fx, fy, fz)

    def _wanted_rates(self, q_wxyz: Quad, f_enu: Triple, yaw_rad: float) -> Triple:
        """Body rates that turn the attitude to the thrust vector and the heading, tilt before heading.

        The error is split into the shortest turn that takes body z to the thrust direction (about an axis in the
        body's xy plane, so yaw is untouched) and the turn about the wanted z axis that remains.
        """
        gains = self.gains
        w, x, y, z = q_wxyz
        fx, fy, fz = f_enu
        norm = math.sqrt(fx * fx + fy * fy + fz * fz)
        nx, ny, nz = fx / norm, fy / norm, fz / norm
        # the wanted z axis in body axes: R^T n
        bx = (1.0 - 2.0 * (y * y + z * z)) * nx + 2.0 * (x * y + w * z) * ny + 2.0 * (x * z - w * y) * nz
        by = 2.0 * (x * y - w * z) * nx + (1.0 - 2.0 * (x * x + z * z)) * ny + 2.0 * (y * z + w * x) * nz
        bz = 2.0 * (x * z + w * y) * nx + 2.0 * (y * z - w * x) * ny + (1.0 - 2.0 * (x * x + y * y)) * nz
        level = math.hypot(bx, by)
        angle = math.atan2(level, bz)
        scale = min(gains.tilt_hz * angle, gains.rate_max_rad_s) / level if level > 1e-12 else 0.0
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        yaw_error = math.remainder(yaw_rad - yaw, 2.0 * math.pi)
        yaw_rate = min(max(gains.yaw_hz * yaw_error, -gains.rate_max_rad_s), gains.rate_max_rad_s)
        # z x R^T n = (-by, bx, 0): the axis of the shortest turn
        return (-by * scale, bx * scale, yaw_rate)

    def _torque(self, state: BodyState, wanted_flu: Triple) -> Triple:
        """I (k (omega* - omega) - d omega') + omega x I omega [N m], body axes."""
        gains = self.gains
        p, q, r = state.omega_flu
        p0, q0, _ = self._last_omega if self._last_omega is not None else state.omega_flu
        self._last_omega = state.omega_flu
        damping = gains.rate_damping * self._rate_hz
        jx, jy, jz = self.vehicle.inertia_kg_m2
        tx = jx * (gains.rate_hz * (wanted_flu[0] - p) - damping * (p - p0))
        ty = jy * (gains.rate_hz * (wanted_flu[1] - q) - damping * (q - q0))
        tz = jz * gains.yaw_rate_hz * (wanted_flu[2] - r)
        return (tx + (jz - jy) * q * r, ty + (jx - jz) * p * r, tz + (jy - jx) * p * q)

    def mix(self, collective_n: float, torque_flu: Triple) -> Quad:
        """Rotor speeds [RPM] for a collective thrust [N] and a body torque [N m].

        Inverse of: sum f = collective, sum y f = tau_x, -sum x f = tau_y, sum c (k_m / k_f) f = tau_z. Where one
        motor cannot, roll and pitch come first, then the collective, then yaw.
        """
        least, most, lever, k_f = self._least_n, self._most_n, self._lever_m, self.vehicle.k_f
        roll, pitch = torque_flu[0] / lever, torque_flu[1] / lever
        t0, t1 = roll - pitch, roll + pitch  # of the left rotors; those across are their opposites
        span = 2.0 * max(abs(t0), abs(t1))
        if span > most - least:
            shrink = (most - least) / span
            t0, t1 = t0 * shrink, t1 * shrink
            span = most - least
        share = min(max(0.25 * collective_n, least + 0.5 * span), most - 0.5 * span)
        yaw = torque_flu[2] * k_f / (4.0 * self.vehicle.k_m)
        # rotors 1 and 3 (turns t1, -t1) speed up for a positive yaw, 0 and 2 (t0, -t0) slow down
        up, down = (abs(t1), abs(t0)) if yaw > 0.0 else (abs(t0), abs(t1))
        room = max(min(most - share - up, share - down - least), 0.0)
        yaw = min(max(yaw, -room), room)
        f0, f1, f2, f3 = share + t0 - yaw, share + t1 + yaw, share - t0 - yaw, share - t1 + yaw
        return (math.sqrt(f0 / k_f), math.sqrt(f1 / k_f), math.sqrt(f2 / k_f), math.sqrt(f3 / k_f))


def _shortened(v: Triple, longest: float) -> Triple:
    """``v``, or the vector of length ``longest`` in its direction where ``v`` is longer."""
    length = math.hypot(*v)
    if length <= longest:
        return v
    scale = longest / length
    return (v[0] * scale, v[1] * scale, v[2] * scale)
