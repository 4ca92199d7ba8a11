"""The same IMM filter for one track, written plainly on filterpy's Kalman filters: what `imm` must equal.

No batching, no padding: CV has 6 states, CA 9, CT 7, each a ``filterpy.kalman.KalmanFilter``; the Markov matrix is a
matrix power, the white-noise covariances are filterpy's, the turn is written in sines and cosines as in (17). filterpy
is not part of the base install and is imported only when a `ReferenceImm` is made.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from companion.config import TrackingConfig
from companion.types import FloatArray

CV, CA, CT = range(3)
_SIZES = (6, 9, 7)
_COMMON = 10  # [p, v, a, Omega]
_SLOTS = ([0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5, 6, 7, 8], [0, 1, 2, 3, 4, 5, 9])  # of each model in the common state
_TURN = 6  # of CT's own state
_TURN_LIMIT_RAD_S = 10.0
# Noise in the turn rate against a constant error of it, by integrations: 0 the rate, 1 the heading, 2 the position.
_RATIO = {(2, 2): 1 / 5, (1, 2): 1 / 4, (0, 2): 1 / 3, (1, 1): 1 / 3, (0, 1): 1 / 2, (0, 0): 1.0}
_INTEGRATIONS = (2, 2, 2, 1, 1, 1, 0)


class ReferenceImm:
    """One track of named detections of position (and velocity).

    Raises:
        ModuleNotFoundError: filterpy is not installed (it is in the ``dev`` extra).
    """

    def __init__(self, config: TrackingConfig, z: Sequence[float], noise: FloatArray) -> None:
        from filterpy.kalman import KalmanFilter

        self._config = config
        self.probabilities = [1 / 3] * 3
        self._scores: list[list[float]] = []
        self._headings: list[tuple[float, float]] = []
        self.filters: list[Any] = []
        deviations = {6: config.birth_accel_m_s2, 7: config.birth_accel_m_s2, 8: config.birth_accel_m_s2}
        deviations |= {3: config.birth_speed_m_s, 4: config.birth_speed_m_s, 5: config.birth_speed_m_s}
        deviations |= {9: config.turn_std_rad_s}
        for size, slots in zip(_SIZES, _SLOTS, strict=True):
            kalman = KalmanFilter(dim_x=size, dim_z=len(z))
            kalman.x = np.zeros((size, 1))
            kalman.x[: len(z), 0] = z
            kalman.P = np.diag([deviations.get(slot, 0.0) ** 2 for slot in slots])
            kalman.P[: len(z), : len(z)] = noise
            self.filters.append(kalman)

    def update(self, z: Sequence[float], noise: FloatArray, dt: float) -> None:
        """One cycle: interaction, filtering, probability update."""
        before, _ = self.fused()
        prior = self._interact(dt)
        scores = []
        for model, kalman in enumerate(self.filters):
            kalman.dim_z = len(z)
            kalman.predict(F=self._jacobian(model, dt), Q=self._noise(model, dt))
            if model == CT:  # the mean goes by the transition itself, not by its derivative
                kalman.x = self._mixed_turn
            measured = np.eye(len(z), _SIZES[model])
            kalman.update(np.array(z).reshape(-1, 1), R=noise, H=measured)
            deviation, s = kalman.y[:, 0], kalman.S
            scores.append(
                -0.5 * (deviation @ np.linalg.solve(s, deviation) + math.log(np.linalg.det(2.0 * math.pi * s)))
            )
        turn = self.filters[CT].x
        turn[_TURN, 0] = min(max(turn[_TURN, 0], -_TURN_LIMIT_RAD_S), _TURN_LIMIT_RAD_S)
        self._weigh(prior, scores, averaged=len(z) == 3)
        after, _ = self.fused()
        cross = before[3] * after[4] - before[4] * after[3]
        angle = math.atan2(cross, before[3] * after[3] + before[4] * after[4])
        self._headings = [*self._headings, (angle, dt)][-self._config.turn_window :]

    def fused(self) -> tuple[FloatArray, FloatArray]:
        """Mean (10,) and covariance (10, 10) over [p, v, a, Omega], spread of means included (19)."""
        states = [self._common(model) for model in range(3)]
        return _moments(states, self.probabilities)

    def predict(self, tau_s: float) -> tuple[FloatArray, FloatArray]:
        """Fused mean (10,) and covariance (10, 10) carried ``tau_s`` on; the filters stay as they are."""
        states = []
        for model, kalman in enumerate(self.filters):
            jacobian = self._jacobian(model, tau_s)
            x = kalman.x[:, 0]
            moved = self._turn(x, tau_s) if model == CT else jacobian @ x
            states.append(_to_common(model, moved, jacobian @ kalman.P @ jacobian.T + self._noise(model, tau_s)))
        return _moments(states, self.probabilities)

    def _common(self, model: int) -> tuple[FloatArray, FloatArray]:
        return _to_common(model, self.filters[model].x[:, 0], self.filters[model].P)

    def _interact(self, dt: float) -> list[float]:
        """Mixed initial conditions (18); returns the prior model probabilities."""
        from scipy.linalg import fractional_matrix_power

        stay = self._config.stay_probability
        step = np.full((3, 3), (1.0 - stay) / 2.0) + np.eye(3) * (stay - (1.0 - stay) / 2.0)
        markov = np.real(fractional_matrix_power(step, dt / self._config.dt_s))
        states = [self._common(model) for model in range(3)]
        if self._config.turn_rate == "state":
            turn = self.filters[CT]
            for model in (CV, CA):
                states[model][0][9] = turn.x[_TURN, 0]
                states[model][1][9, 9] = min(turn.P[_TURN, _TURN], self._config.turn_std_rad_s**2)
        prior, mixed = [], []
        for to in range(3):
            joint = [self.probabilities[source] * markov[source, to] for source in range(3)]
            prior.append(sum(joint))
            mixed.append(_moments(states, [weight / prior[-1] for weight in joint]))
        for kalman, slots, (x, covariance) in zip(self.filters, _SLOTS, mixed, strict=True):
            kalman.x = x[slots].reshape(-1, 1)
            kalman.P = covariance[np.ix_(slots, slots)]
        turn = self.filters[CT]
        if self._config.turn_rate == "window":
            angle, taken = sum(a for a, _ in self._headings), sum(t for _, t in self._headings)
            turn.x[_TURN, 0] = angle / max(taken, self._config.dt_s)
            turn.P[_TURN, :] = turn.P[:, _TURN] = 0.0
        self._mixed_turn = self._turn(turn.x[:, 0], dt).reshape(-1, 1)
        return prior

    def _weigh(self, prior: list[float], scores: list[float], *, averaged: bool) -> None:
        """mu_j ~ c_j times the mean likelihood of the last updates; six-dimensional ones are not averaged."""
        self._scores = [*self._scores, scores][-self._config.likelihood_window :] if averaged else [scores]
        best = max(max(row) for row in self._scores)
        likelihood = [sum(math.exp(row[model] - best) for row in self._scores) for model in range(3)]
        if not averaged:
            self._scores = []
        joint = [c * value for c, value in zip(prior, likelihood, strict=True)]
        self.probabilities = [value / sum(joint) for value in joint]

    def _turn(self, x: FloatArray, dt: float) -> FloatArray:
        """(17): the state of CT after dt."""
        moved = self._rotation(x[_TURN], dt) @ x
        return np.asarray(moved)

    def _rotation(self, turn: float, dt: float) -> FloatArray:
        angle = turn * dt
        if abs(angle) < 1e-3:
            along = dt * (1.0 - angle**2 / 6.0)
            across = dt * angle / 2.0 * (1.0 - angle**2 / 12.0)
        else:
            along, across = math.sin(angle) / turn, (1.0 - math.cos(angle)) / turn
        f = np.eye(7)
        f[0, 3], f[0, 4], f[1, 3], f[1, 4], f[2, 5] = along, -across, across, along, dt
        f[3, 3], f[3, 4] = math.cos(angle), -math.sin(angle)
        f[4, 3], f[4, 4] = math.sin(angle), math.cos(angle)
        return f

    def _jacobian(self, model: int, dt: float) -> FloatArray:
        """F of CV and CA; of CT its derivative at the filter's state."""
        if model != CT:
            f = np.eye(_SIZES[model])
            for axis in range(3):
                f[axis, axis + 3] = dt
                if model == CA:
                    f[axis, axis + 6], f[axis + 3, axis + 6] = dt**2 / 2.0, dt
            return f
        x = self.filters[CT].x[:, 0]
        turn, v_x, v_y = x[_TURN], x[3], x[4]
        angle = turn * dt
        if abs(angle) < 1e-3:
            d_along = -(dt**2) * angle / 3.0 * (1.0 - angle**2 / 10.0)
            d_across = dt**2 / 2.0 * (1.0 - angle**2 / 4.0)
        else:
            d_along = (dt * math.cos(angle) - math.sin(angle) / turn) / turn
            d_across = (dt * math.sin(angle) - (1.0 - math.cos(angle)) / turn) / turn
        f = self._rotation(turn, dt)
        f[0, _TURN] = d_along * v_x - d_across * v_y
        f[1, _TURN] = d_across * v_x + d_along * v_y
        f[3, _TURN] = dt * (-math.sin(angle) * v_x - math.cos(angle) * v_y)
        f[4, _TURN] = dt * (math.cos(angle) * v_x - math.sin(angle) * v_y)
        return f

    def _noise(self, model: int, dt: float) -> FloatArray:
        from filterpy.common import Q_continuous_white_noise

        config, size = self._config, _SIZES[model]
        if config.q_paper > 0.0:
            return np.asarray(np.eye(size) * config.q_paper * dt / config.dt_s)
        if model == CA:
            return np.asarray(Q_continuous_white_noise(3, dt, config.jerk_psd_ca, block_size=3, order_by_dim=False))
        density = config.accel_psd_cv if model == CV else config.accel_psd_ct
        noise = np.zeros((size, size))
        noise[:6, :6] = Q_continuous_white_noise(2, dt, density, block_size=3, order_by_dim=False)
        if model == CT:
            column = self._jacobian(CT, dt)[:, _TURN]
            for i in range(size):
                for j in range(size):
                    low, high = sorted((_INTEGRATIONS[i], _INTEGRATIONS[j]))
                    noise[i, j] += config.turn_psd_ct * dt * column[i] * column[j] * _RATIO[low, high]
        return noise


def _to_common(model: int, x: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """[p, v, a, Omega] and its covariance; CT's acceleration is centripetal, Omega e_z x v."""
    slots = _SLOTS[model]
    lift = np.zeros((_COMMON, _SIZES[model]))
    lift[slots, range(_SIZES[model])] = 1.0
    common = lift @ x
    if model == CT:
        turn, v_x, v_y = x[_TURN], x[3], x[4]
        common[6], common[7] = -turn * v_y, turn * v_x
        lift[6, 4], lift[6, _TURN] = -turn, -v_y
        lift[7, 3], lift[7, _TURN] = turn, v_x
    return common, lift @ covariance @ lift.T


def _moments(states: list[tuple[FloatArray, FloatArray]], weights: list[float]) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of a mixture."""
    mean = sum((weight * x for weight, (x, _) in zip(weights, states, strict=True)), np.zeros(_COMMON))
    total = np.zeros((_COMMON, _COMMON))
    for weight, (x, covariance) in zip(weights, states, strict=True):
        total += weight * (covariance + np.outer(x - mean, x - mean))
    return mean, total
