"""What the tracker is measured against: Kalman filters of one model over a grid of noises, and filterpy's IMM.

All of them are given the same measurements and their deviation; none is given the motion.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from companion.types import FloatArray

BoolArray = npt.NDArray[np.bool_]

BIRTH_SPEED_M_S = 3.0
BIRTH_ACCEL_M_S2 = 3.0


class SingleModel:
    """CV (order 2) or CA (order 3) Kalman filters of M obstacles for each of G noise densities.

    The axes are independent and alike, so one covariance (M, G, n, n) and one gain serve all three:

        x' = F x,  P' = F P F^T + Q,  Q = density times that of an integrator chain driven by white noise

    Shapes: state (M, G, n, 3).
    """

    def __init__(self, order: int, densities: FloatArray, z: FloatArray, std_m: float) -> None:
        count, grid = len(z), len(densities)
        self._order = order
        self._densities = densities
        self._variance = std_m**2
        self.x = np.zeros((count, grid, order, 3))
        self.x[:, :, 0] = z[:, None]
        birth = np.array([self._variance, BIRTH_SPEED_M_S**2, BIRTH_ACCEL_M_S2**2])[:order]
        self.covariance = np.broadcast_to(np.diag(birth), (count, grid, order, order)).copy()

    def predict(self, dt_s: float) -> None:
        """Carry every filter ``dt_s`` on."""
        f, q = chain(self._order, dt_s)
        self.x = np.einsum("ij,mgjk->mgik", f, self.x)
        self.covariance = f @ self.covariance @ f.T + self._densities[:, None, None] * q

    def update(self, z: FloatArray, seen: BoolArray) -> None:
        """Use the positions ``z`` (M, 3) of the obstacles that were ``seen`` (M,)."""
        gain = self.covariance[..., 0] / (self.covariance[..., 0, 0] + self._variance)[..., None]
        gain = gain * seen[:, None, None]
        innovation = z[:, None] - self.x[:, :, 0]
        self.x = self.x + gain[..., None] * innovation[:, :, None]
        self.covariance = self.covariance - gain[..., None] * self.covariance[..., :1, :]

    def ahead(self, tau_s: float) -> tuple[FloatArray, FloatArray]:
        """Position and velocity ``tau_s`` on, (M, G, 3) each."""
        f, _ = chain(self._order, tau_s)
        x = np.einsum("ij,mgjk->mgik", f, self.x)
        return x[:, :, 0], x[:, :, 1]


def chain(order: int, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """F and Q (unit density) of ``order`` integrators in a row, the last driven by white noise."""
    factorial = [1.0, 1.0, 2.0, 6.0]
    f, q = np.zeros((order, order)), np.zeros((order, order))
    for i in range(order):
        for j in range(order):
            if j >= i:
                f[i, j] = dt_s ** (j - i) / factorial[j - i]
            behind_i, behind_j = order - 1 - i, order - 1 - j
            power = behind_i + behind_j + 1
            q[i, j] = dt_s**power / (power * factorial[behind_i] * factorial[behind_j])
    return f, q


class FilterpyImm:
    """filterpy's `IMMEstimator` of one obstacle: CV and CA in nine states each, as its documentation shows.

    Raises:
        ModuleNotFoundError: filterpy is not installed (it is in the ``dev`` extra).
    """

    def __init__(self, z: FloatArray, std_m: float, *, accel_psd: float, jerk_psd: float, stay: float) -> None:
        from filterpy.kalman import IMMEstimator, KalmanFilter

        self._filters: list[Any] = []
        self._densities = (accel_psd, jerk_psd)
        for order in (2, 3):
            kalman = KalmanFilter(dim_x=9, dim_z=3)
            kalman.x[:3, 0] = z
            spread = [std_m**2] * 3 + [BIRTH_SPEED_M_S**2] * 3 + [BIRTH_ACCEL_M_S2**2 if order == 3 else 1e-9] * 3
            kalman.P = np.diag(spread)
            kalman.H = np.eye(3, 9)
            kalman.R = np.eye(3) * std_m**2
            self._filters.append(kalman)
        markov = np.full((2, 2), 1.0 - stay) + np.eye(2) * (2.0 * stay - 1.0)
        self._imm = IMMEstimator(self._filters, [0.5, 0.5], markov)

    def step(self, dt_s: float, z: FloatArray | None) -> None:
        """``dt_s`` on, then use the position ``z``, None where it was lost."""
        for order, kalman, density in zip((2, 3), self._filters, self._densities, strict=True):
            kalman.F, kalman.Q = chain_of_axes(order, dt_s, density)
        self._imm.predict()
        if z is not None:
            self.use(z)

    def use(self, z: FloatArray) -> None:
        """Use the position ``z`` (3,)."""
        self._imm.update(z.reshape(3, 1))

    def position(self) -> tuple[FloatArray, FloatArray]:
        """Fused position (3,) and its covariance (3, 3)."""
        return np.asarray(self._imm.x[:3, 0]), np.asarray(self._imm.P[:3, :3])

    def ahead(self, tau_s: float) -> tuple[FloatArray, FloatArray]:
        """Fused position and velocity ``tau_s`` on, (3,) each."""
        state = sum(
            weight * (chain_of_axes(order, tau_s, 0.0)[0] @ kalman.x[:, 0])
            for weight, order, kalman in zip(self._imm.mu, (2, 3), self._filters, strict=True)
        )
        return np.asarray(state[:3]), np.asarray(state[3:6])


def chain_of_axes(order: int, dt_s: float, density: float) -> tuple[FloatArray, FloatArray]:
    """F and Q over [p, v, a] for three axes; a CV filter keeps its acceleration at zero."""
    f, q = np.zeros((9, 9)), np.zeros((9, 9))
    part_f, part_q = chain(order, dt_s)
    for i in range(order):
        for j in range(order):
            for axis in range(3):
                f[3 * i + axis, 3 * j + axis] = part_f[i, j]
                q[3 * i + axis, 3 * j + axis] = density * part_q[i, j]
    return f, q
