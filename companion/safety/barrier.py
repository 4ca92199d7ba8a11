"""Barrier rows of a moving obstacle over the horizon, as functions of one constant net acceleration a.

With the vehicle predicted by (21), r_k(a) = c_k + s_k a where c_k = p + k dt v - o_k and s_k = dt^2 k (k - 1) / 2.
With h_k = (|r_k|^2 - D_i^2) / 2, psi_i = h_{i+1} - (1 - alpha1) h_i and the decay e = alpha2 epsilon in [0, 1],
row i of (24) is

    g_i(a, e) = psi_{i+1}(a) - (1 - e) psi_i(a) = rise_i(a) + e psi_i(a) >= 0,      i = 0..N.

One D_i, that of the row's last step i + 2, serves all its terms: it cancels in rise_i and enters as
-alpha1 D_i^2 / 2 in psi_i, so a larger D never enlarges the admissible set. A D that grew along a row would be a
closing speed that nobody has.

Both parts are quadratics in a with an isotropic Hessian, so a row is five coefficients over (1, a, |a|^2 / 2). For
every e in [0, 1] the coefficient of |a|^2 / 2 in g_i is positive, because s_k^2 is convex and increasing in k:
g_i(., e) is convex and the inadmissible set of a row is a ball. Its tangent at *any* a is a lower bound of the
row, so an acceleration that satisfies the tangents satisfies the rows. The sequential programs build on that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.config import SafetyConfig
from companion.types import FloatArray, Margin, Prediction, Vec3

MIN_ARM_M = (
    1e-3  # gradients are taken no shorter than that of a row with this arm: no division by zero at a ball's centre
)


def monomials(a: FloatArray) -> FloatArray:
    """(1, a, |a|^2 / 2) along the last axis: (..., 3) -> (..., 5)."""
    out = np.empty((*a.shape[:-1], 5))
    out[..., 0] = 1.0
    out[..., 1:4] = a
    out[..., 4] = 0.5 * (a * a).sum(axis=-1)
    return out


@dataclass(frozen=True, slots=True)
class BarrierRows:
    """Rows of M obstacles, R = N + 1 each; coefficients over (1, a, |a|^2 / 2)."""

    ids: tuple[str, ...]
    coefficients: FloatArray  # (2, M, R, 5), C-contiguous: of psi_{i+1} - psi_i and of psi_i [m^2]
    drift: FloatArray  # (M, K, 3) c_k, vehicle minus obstacle without acceleration, ENU [m]
    reach: FloatArray  # (K,) s_k [s^2]
    radii_m: FloatArray  # (M,) vehicle plus obstacle
    cushion_m: float
    sigma_m: FloatArray  # (M, R) kappa sigma
    delay_m: FloatArray  # (M,) |v_r| sigma_delay
    least_decay: FloatArray  # (M,) 0, or the recovery where psi_0 < 0 (which no acceleration changes)
    keep_out_m: FloatArray  # (M, R) the |r| that a row holds: D, or sqrt(2) D to the letter of (22)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def rise(self) -> FloatArray:
        """Coefficients of psi_{i+1} - psi_i, (M, R, 5) [m^2]."""
        return np.asarray(self.coefficients[0])

    @property
    def psi(self) -> FloatArray:
        """Coefficients of psi_i, (M, R, 5) [m^2]."""
        return np.asarray(self.coefficients[1])

    def evaluate(self, a: Vec3) -> FloatArray:
        """rise and psi at ``a`` (3,), stacked: (2, M, R) [m^2]."""
        x, y, z = a.tolist()
        basis = np.array((1.0, x, y, z, 0.5 * (x * x + y * y + z * z)))
        return np.asarray((self.coefficients.reshape(-1, 5) @ basis).reshape(self.coefficients.shape[:3]))

    def evaluate_many(self, a: FloatArray) -> FloatArray:
        """rise and psi at ``a`` (C, 3), stacked: (2, C, M, R) [m^2]."""
        count, rows = self.coefficients.shape[1:3]
        flat = self.coefficients.reshape(2, count * rows, 5).swapaxes(1, 2)
        return np.asarray((monomials(a) @ flat).reshape(2, len(a), count, rows))

    def gradient(self, a: Vec3, decay: FloatArray) -> tuple[FloatArray, FloatArray]:
        """d g / d a at ``a`` with the obstacles' ``decay`` (M,): (M, R, 3) [m s^2], and its norm, floored (M, R)."""
        combined = self.rise + decay[:, None, None] * self.psi
        gradient = combined[..., 1:4] + combined[..., 4:5] * a
        norm = np.sqrt(np.einsum("ijk,ijk->ij", gradient, gradient))
        return gradient, np.maximum(norm, MIN_ARM_M * self.reach[2:])

    def positions(self, a: FloatArray) -> FloatArray:
        """r_k, vehicle minus obstacle, from k = 2 (the first that ``a`` moves): (..., 3) -> (..., M, R, 3) [m]."""
        return self.drift[:, 2:] + self.reach[2:, None] * a[..., None, None, :]

    def margins(self, steps: npt.NDArray[np.intp]) -> list[Margin]:
        """The parts of D of one row of each obstacle, ``steps`` (M,)."""
        sigma = self.sigma_m[np.arange(len(steps)), steps].tolist()
        parts = zip(self.radii_m.tolist(), sigma, self.delay_m.tolist(), strict=True)
        return [Margin(radii, self.cushion_m, sigma, delay) for radii, sigma, delay in parts]

    def select(self, obstacles: npt.NDArray[np.bool_]) -> BarrierRows:
        """The rows of some obstacles only; ``obstacles`` is a boolean mask (M,)."""
        return BarrierRows(
            ids=tuple(name for name, taken in zip(self.ids, obstacles, strict=True) if taken),
            coefficients=np.ascontiguousarray(self.coefficients[:, obstacles]),
            drift=self.drift[obstacles],
            reach=self.reach,
            radii_m=self.radii_m[obstacles],
            cushion_m=self.cushion_m,
            sigma_m=self.sigma_m[obstacles],
            delay_m=self.delay_m[obstacles],
            least_decay=self.least_decay[obstacles],
            keep_out_m=self.keep_out_m[obstacles],
        )


class Barrier:
    """Builds rows; holds what depends on the configuration only."""

    def __init__(self, config: SafetyConfig) -> None:
        self._config = config
        steps = np.arange(config.horizon + 3)
        self._time_s = steps * config.dt_s
        self._reach: FloatArray = np.asarray(config.dt_s**2 * steps * (steps - 1) / 2.0, dtype=np.float64)
        self._reach_square = self._reach**2
        self._sigma_at = np.minimum(steps[2:], round(config.sigma_growth_s / config.dt_s))
        self._letter = math.sqrt(2.0) if config.form == "paper" else 1.0

    def rows(self, p_enu: Vec3, v_enu: Vec3, prediction: Prediction, p_std_m: float) -> BarrierRows:
        """Rows (24) of every predicted obstacle.

        Args:
            p_enu, v_enu: vehicle at the start of the grid, ENU [m], [m/s].
            prediction: positions o_k for k = 0..N+2 on the grid of ``dt_s``.
            p_std_m: 1 sigma of the vehicle's own position; independent of the obstacle's, so variances add.
        Raises:
            ValueError: the prediction is shorter than the horizon needs.
        """
        config = self._config
        instants = config.horizon + 3
        if prediction.p_enu.shape[1] < instants:
            raise ValueError(f"prediction: expected {instants} instants (horizon + 3), got {prediction.p_enu.shape[1]}")
        drift = (p_enu + self._time_s[:, None] * v_enu) - prediction.p_enu[:, :instants]
        half_square = np.empty((*drift.shape[:2], 5))  # |r_k|^2 / 2 over the monomials
        half_square[..., 0] = 0.5 * np.einsum("ijk,ijk->ij", drift, drift)
        half_square[..., 1:4] = self._reach[:, None] * drift
        half_square[..., 4] = self._reach_square
        decayed = half_square[:, 1:] - (1.0 - config.alpha1) * half_square[:, :-1]  # psi without its D
        sigma = config.kappa * np.sqrt(prediction.sigma_m[:, self._sigma_at] ** 2 + p_std_m**2)
        sigma = np.minimum(sigma, config.sigma_cap_m)
        relative = prediction.v_enu - v_enu
        delay = config.sigma_delay_s * np.sqrt((relative * relative).sum(axis=-1))
        radii = prediction.radius_m + config.drone_radius_m
        keep_out = self._letter * ((radii + delay + config.cushion_m)[:, None] + sigma)
        coefficients = np.empty((2, len(drift), instants - 2, 5))
        np.subtract(decayed[:, 1:], decayed[:, :-1], out=coefficients[0])
        psi = coefficients[1]
        psi[...] = decayed[:, :-1]
        psi[..., 0] -= (0.5 * config.alpha1) * keep_out**2
        return BarrierRows(
            ids=prediction.ids,
            coefficients=coefficients,
            drift=drift,
            reach=self._reach,
            radii_m=radii,
            cushion_m=config.cushion_m,
            sigma_m=sigma,
            delay_m=delay,
            least_decay=np.where(psi[:, 0, 0] < 0.0, config.recovery, 0.0),
            keep_out_m=keep_out,
        )
