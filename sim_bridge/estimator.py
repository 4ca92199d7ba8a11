"""What a vehicle believes of its own state: the truth with correlated errors, some time late.

Each axis of the position, velocity and attitude errors is a first-order Gauss-Markov process

    e' = -e / T + sigma sqrt(2 / T) n,   stepped exactly: e <- phi e + sigma sqrt(1 - phi^2) N(0, 1), phi = exp(-dt / T)

because the errors of a real EKF are correlated: an error of the last fix lasts until later fixes have outweighed it.
The attitude error turns the true attitude by a small rotation vector in body axes. Gyro noise is white, on the body
rates. Accelerometer noise enters the velocity through its integration: white noise of sigma_a a step, corrected with
the time constant T_v, is a Gauss-Markov error of the variance sigma_a^2 dt T_v / 2, which adds to that of the velocity.

Position and velocity are those of ``delay_s`` ago. Attitude and rates are not delayed: autopilots propagate them with
the gyro to the present (PX4's output predictor), and no attitude loop would stand it.
The time constants are our choice, of the order of an EKF fed by position fixes at 5 to 10 Hz.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from sim_bridge.body import BodyState
from sim_bridge.crazyflie import Quad, Triple
from sim_bridge.scenario_world import EstimatorNoise, Imu

POSITION_T_S = 1.0
VELOCITY_T_S = 0.5
ATTITUDE_T_S = 1.0


class Estimator:
    """Call `update` once a physics step.

    Args:
        rng: the only source of chance; twelve draws a step.
    """

    def __init__(self, noise: EstimatorNoise, imu: Imu, *, physics_hz: int, rng: np.random.Generator) -> None:
        dt_s = 1.0 / physics_hz
        velocity_std = math.hypot(
            noise.velocity_std_m_s, imu.accelerometer_std_m_s2 * math.sqrt(0.5 * dt_s * VELOCITY_T_S)
        )
        self.std = (noise.position_std_m, velocity_std, noise.attitude_std_rad)  # [m], [m/s], [rad]
        self._rng = rng
        self._position = _GaussMarkov(noise.position_std_m, POSITION_T_S, dt_s)
        self._velocity = _GaussMarkov(velocity_std, VELOCITY_T_S, dt_s)
        self._attitude = _GaussMarkov(noise.attitude_std_rad, ATTITUDE_T_S, dt_s)
        self._gyro_std_rad_s = imu.gyro_std_rad_s
        self._late: deque[tuple[Triple, Triple]] = deque(maxlen=round(noise.delay_s * physics_hz) + 1)
        draws = rng.standard_normal(9).tolist()
        for process, start in ((self._position, 0), (self._velocity, 3), (self._attitude, 6)):
            process.begin(draws[start : start + 3])

    def update(self, truth: BodyState) -> BodyState:
        """The state believed at this step."""
        n = self._rng.standard_normal(12).tolist()
        dp, dv, turn = self._position.step(n[0:3]), self._velocity.step(n[3:6]), self._attitude.step(n[6:9])
        self._late.append((truth.p_enu, truth.v_enu))
        (px, py, pz), (vx, vy, vz) = self._late[0]
        (p, q, r), g = truth.omega_flu, self._gyro_std_rad_s
        return BodyState(
            (px + dp[0], py + dp[1], pz + dp[2]),
            (vx + dv[0], vy + dv[1], vz + dv[2]),
            _turned(truth.q_wxyz, turn),
            (p + g * n[9], q + g * n[10], r + g * n[11]),
        )


class _GaussMarkov:
    """Three independent axes."""

    def __init__(self, std: float, time_constant_s: float, dt_s: float) -> None:
        self._std = std
        self._phi = math.exp(-dt_s / time_constant_s)
        self._drive = std * math.sqrt(-math.expm1(-2.0 * dt_s / time_constant_s))
        self.value: Triple = (0.0, 0.0, 0.0)

    def begin(self, draws: list[float]) -> None:
        """Start from the stationary distribution."""
        x, y, z = draws
        self.value = (self._std * x, self._std * y, self._std * z)

    def step(self, draws: list[float]) -> Triple:
        (x, y, z), (nx, ny, nz), phi, drive = self.value, draws, self._phi, self._drive
        self.value = (phi * x + drive * nx, phi * y + drive * ny, phi * z + drive * nz)
        return self.value


def _turned(q_wxyz: Quad, turn_flu: Triple) -> Quad:
    """q times the quaternion of a rotation vector in body axes [rad]."""
    angle = math.hypot(*turn_flu)
    if angle == 0.0:
        return q_wxyz
    scale = math.sin(0.5 * angle) / angle
    b, c, d = scale * turn_flu[0], scale * turn_flu[1], scale * turn_flu[2]
    a = math.cos(0.5 * angle)
    w, x, y, z = q_wxyz
    return (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
