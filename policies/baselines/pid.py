"""PID of the paper's Table 1: gains read as newtons per metre, per metre second and per metre per second.

    F = K_P e + K_I int e dt - K_D v,   a = F / m

with m of Table 2, as in the position controller of gym-bullet-drones, which has these very gains and whose bounds on
the integral are taken over: 2 m s level, 0.15 m s in z. Gravity is in nobody's account (8). Frame: local ENU.
"""

from __future__ import annotations

import numpy as np

from companion.types import Vec3

MASS_KG = 0.027
K_P_N_M = np.array([0.4, 0.4, 1.25])
K_I_N_M_S = np.array([0.05, 0.05, 0.05])
K_D_N_S_M = np.array([0.2, 0.2, 0.5])
INTEGRAL_MAX_M_S = np.array([2.0, 2.0, 0.15])


class PositionPid:
    """A reference like a policy's, with the integral as its memory; to be asked once every ``dt_s``."""

    def __init__(self, dt_s: float) -> None:
        self._dt_s = dt_s
        self._integral_m_s = np.zeros(3)

    def act(self, v_enu: Vec3, error_enu: Vec3) -> Vec3:
        """Net acceleration for velocity and target minus position, (3,) [m/s^2]; whoever asks bounds it."""
        integral = self._integral_m_s + error_enu * self._dt_s
        self._integral_m_s = np.clip(integral, -INTEGRAL_MAX_M_S, INTEGRAL_MAX_M_S)
        force_n = K_P_N_M * error_enu + K_I_N_M_S * self._integral_m_s - K_D_N_S_M * v_enu
        return np.asarray(force_n / MASS_KG)
