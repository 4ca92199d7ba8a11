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

MIN_ARM_M = 1e-3  # gradients are no shorter than that of a row with this arm: no division by zero at a ball's centre
_ROUNDING = 1e-9  # of |c|^2, which is up to 1e13 for an obstacle far away
_HALVES = np.full(3, 0.5)


def monomials(a: FloatArray) -> FloatArray:
    """(1, a, |a|^2 / 2) of each of C accelerations, along the first axis: (C, 3) -> (5, C)."""
    out = np.empty((5, len(a)))
    out[0] = 1.0
    out[1:4] = a.T
    np.multiply(np.vecdot(a, a), 0.5, out=out[4])
    return out


@dataclass(frozen=True, slots=True)
class Balls:
    """g = q (|a - c|^2 - rho^2) / 2 at one decay of each obstacle."""

    decay: FloatArray  # (M,)
    centre: FloatArray  # (3, M, R) c [m/s^2]
    square: FloatArray  # (M, R) rho^2, negative where a row holds for every a [m^2/s^4]
    q: FloatArray  # (M, R) > 0 [s^4]

    def reachable(self, low: Vec3, high: Vec3) -> npt.NDArray[np.bool_]:
        """Obstacles with a row that some acceleration of the box breaks, (M,).

        With decay 1 all others admit every a of the box: leaving them out can change an answer only by the price of
        their epsilon, never by a row.
        """
        gap = np.minimum(np.maximum(self.centre, low[:, None, None]), high[:, None, None])
        gap -= self.centre
        room = np.add.reduce(gap * gap)
        room -= _ROUNDING * np.add.reduce(self.centre * self.centre)
        return np.asarray(np.logical_or.reduce(room < self.square, axis=-1))

    def select(self, taken: npt.NDArray[np.intp]) -> Balls:
        """Of the obstacles of these indices only."""
        return Balls(
            self.decay.take(taken),
            self.centre.take(taken, axis=1),
            self.square.take(taken, axis=0),
            self.q.take(taken, axis=0),
        )


@dataclass(frozen=True, slots=True)
class BarrierRows:
    """Rows of M obstacles, R = N + 1 each; coefficients over (1, a, |a|^2 / 2).

    Coefficients and components come first, so that one product of matrices evaluates all rows.
    """

    ids: tuple[str, ...]
    coefficients: FloatArray  # (5, 2, M, R), C-contiguous: of psi_{i+1} - psi_i and of psi_i [m^2]
    drift: FloatArray  # (3, M, K) c_k, vehicle minus obstacle without acceleration, ENU [m]
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
        """Coefficients of psi_{i+1} - psi_i, (5, M, R) [m^2]."""
        return np.asarray(self.coefficients[:, 0])

    @property
    def psi(self) -> FloatArray:
        """Coefficients of psi_i, (5, M, R) [m^2]."""
        return np.asarray(self.coefficients[:, 1])

    def evaluate(self, a: Vec3) -> FloatArray:
        """rise and psi at ``a`` (3,), stacked: (2, M, R) [m^2]."""
        x, y, z = a.tolist()
        basis = np.array((1.0, x, y, z, 0.5 * (x * x + y * y + z * z)))
        return np.asarray((basis @ self.coefficients.reshape(5, -1)).reshape(self.coefficients.shape[1:]))

    def evaluate_many(self, a: FloatArray) -> FloatArray:
        """rise and psi at ``a`` (C, 3), stacked: (2, C, M, R) [m^2], C contiguous: reductions over rows are cheap."""
        values = self.coefficients.reshape(5, -1).T @ monomials(a)
        return np.asarray(values.reshape(*self.coefficients.shape[1:], len(a)).transpose(0, 3, 1, 2))

    def gradient(self, a: Vec3, decay: FloatArray) -> tuple[FloatArray, FloatArray]:
        """d g / d a at ``a`` with the obstacles' ``decay`` (M,): (3, M, R) [m s^2], and its norm, floored (M, R)."""
        combined = self.coefficients[1:, 1] * decay[:, None]
        combined += self.coefficients[1:, 0]
        gradient = combined[3] * a[:, None, None]
        gradient += combined[:3]
        norm = np.sqrt(np.add.reduce(gradient * gradient))
        return gradient, np.maximum(norm, MIN_ARM_M * self.reach[2:], out=norm)

    def balls(self, decay: FloatArray) -> Balls:
        """Where rows do not admit an acceleration, each obstacle with its ``decay`` (M,)."""
        combined = self.coefficients[:, 1] * decay[:, None]
        combined += self.coefficients[:, 0]
        q = combined[4]
        combined[:4] /= q
        centre = np.negative(combined[1:4], out=combined[1:4])
        square = np.add.reduce(centre * centre)
        square -= 2.0 * combined[0]
        return Balls(decay, centre, square, q)

    def positions(self, a: FloatArray) -> FloatArray:
        """r_k, vehicle minus obstacle, from k = 2 (the first that ``a`` moves): (..., 3) -> (3, ..., M, R) [m]."""
        a = a.T if a.ndim > 1 else a  # (3, C) or (3,)
        drift = self.drift[:, :, 2:] if a.ndim == 1 else self.drift[:, None, :, 2:]
        return np.asarray(drift + a[..., None, None] * self.reach[2:])

    def margins(self, steps: npt.NDArray[np.intp]) -> list[Margin]:
        """The parts of D of one row of each obstacle, ``steps`` (M,)."""
        sigma = self.sigma_m[np.arange(len(steps)), steps].tolist()
        parts = zip(self.radii_m.tolist(), sigma, self.delay_m.tolist(), strict=True)
        return [Margin(radii, self.cushion_m, sigma, delay) for radii, sigma, delay in parts]

    def select(self, taken: npt.NDArray[np.intp]) -> BarrierRows:
        """The rows of the obstacles of these indices only."""
        return BarrierRows(
            ids=tuple([self.ids[index] for index in taken.tolist()]),
            coefficients=self.coefficients.take(taken, axis=2),
            drift=self.drift.take(taken, axis=1),
            reach=self.reach,
            radii_m=self.radii_m.take(taken),
            cushion_m=self.cushion_m,
            sigma_m=self.sigma_m.take(taken, axis=0),
            delay_m=self.delay_m.take(taken),
            least_decay=self.least_decay.take(taken),
            keep_out_m=self.keep_out_m.take(taken, axis=0),
        )


class Barrier:
    """Builds rows; holds what depends on the configuration only."""

    def __init__(self, config: SafetyConfig) -> None:
        self._config = config
        steps = np.arange(config.horizon + 3)
        self._time_s = (steps * config.dt_s)[:, None]
        self._reach: FloatArray = np.asarray(config.dt_s**2 * steps * (steps - 1) / 2.0, dtype=np.float64)
        square = self._reach**2
        decayed = square[1:] - (1.0 - config.alpha1) * square[:-1]
        self._curvature = np.stack((decayed[1:] - decayed[:-1], decayed[:-1]))[:, None]  # (2, 1, R) of |a|^2 / 2
        # the sigma of instants 2, 3, ... counts up to the growth's end; every later row has that of the last
        self._sigma_to = min(max(round(config.sigma_growth_s / config.dt_s), 0), config.horizon + 2)
        sigma_at = np.minimum(steps[2:], self._sigma_to)
        self._sigma_from = int(sigma_at[0])
        self._sigma_at = sigma_at - self._sigma_from
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
        sigma = self._sigma(prediction, p_std_m)
        relative = prediction.v_enu - v_enu
        delay = config.sigma_delay_s * np.sqrt(np.vecdot(relative, relative))
        radii = prediction.radius_m + config.drone_radius_m
        keep_out = sigma + (radii + delay + config.cushion_m)[:, None]
        if self._letter != 1.0:
            keep_out *= self._letter
        drift = np.empty((3, len(prediction), instants))
        np.subtract((p_enu + self._time_s * v_enu).T[:, None], prediction.p_enu[:, :instants].transpose(2, 0, 1), drift)
        coefficients = self._coefficients(drift, keep_out)
        return BarrierRows(
            ids=prediction.ids,
            coefficients=coefficients,
            drift=drift,
            reach=self._reach,
            radii_m=radii,
            cushion_m=config.cushion_m,
            sigma_m=sigma,
            delay_m=delay,
            least_decay=np.asarray((coefficients[0, 1, :, 0] < 0.0) * config.recovery, dtype=np.float64),
            keep_out_m=keep_out,
        )

    def _sigma(self, prediction: Prediction, p_std_m: float) -> FloatArray:
        """The noise part of D of every row, (M, R) [m]: computed where it differs, then spread over the rows.

        min(kappa sigma_k, cap) + kappa_now sigma_2. The error of now is in every tick's picture, and a vehicle that
        passes as near as D allows meets its largest value: it counts more often than what a later look will correct.
        """
        config = self._config
        sigma = prediction.sigma_m[:, self._sigma_from : self._sigma_to + 1]
        sigma = np.sqrt(sigma * sigma + p_std_m * p_std_m)
        part = config.kappa * sigma
        np.minimum(part, config.sigma_cap_m, out=part)
        part += np.minimum(config.kappa_now * sigma[:, :1], config.sigma_cap_m)
        return np.asarray(part.take(self._sigma_at, axis=1))

    def _coefficients(self, drift: FloatArray, keep_out: FloatArray) -> FloatArray:
        """(5, 2, M, R) from c_k (3, M, K): |r_k|^2 / 2 over the monomials, decayed to psi, stepped to rise."""
        _, count, instants = drift.shape
        half_square = np.empty((4, count, instants))
        np.multiply(drift, self._reach, out=half_square[1:])
        np.matmul(_HALVES, (drift * drift).reshape(3, -1), out=half_square[0].reshape(-1))
        decayed = half_square[..., :-1] * (self._config.alpha1 - 1.0)
        decayed += half_square[..., 1:]  # psi without its D
        coefficients = np.empty((5, 2, count, instants - 2))
        np.subtract(decayed[..., 1:], decayed[..., :-1], out=coefficients[:4, 0])
        coefficients[:4, 1] = decayed[..., :-1]
        coefficients[0, 1] -= (0.5 * self._config.alpha1) * (keep_out * keep_out)
        coefficients[4] = self._curvature
        return coefficients
