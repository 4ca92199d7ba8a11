"""The same IMM filter for one track, written plainly on filterpy's Kalman filters: what `imm` must equal.

No batching, no padding: CV has 6 states, CA 9, CT 7, each a ``filterpy.kalman.KalmanFilter``; the Markov matrix is a
matrix power, noises are filterpy's or matrix exponentials, the turn is written in sines and cosines as in (17).
`ReferenceBank` puts it behind the interface of the batched bank (``tracking.backend = "reference"``): one obstacle
after the other, some hundred times slower. filterpy is not part of the base install and is imported only here.
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
SLOTS = ([0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5, 6, 7, 8], [0, 1, 2, 3, 4, 5, 9])  # of each model in the common state
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
        self.scores: list[list[float]] = []
        self.headings: list[tuple[float, float]] = []
        self.filters: list[Any] = []
        deviations = {6: config.birth_accel_m_s2, 7: config.birth_accel_m_s2, 8: config.birth_accel_m_s2}
        deviations |= {3: config.birth_speed_m_s, 4: config.birth_speed_m_s, 5: config.birth_speed_m_s}
        deviations |= {9: config.turn_std_rad_s}
        for size, slots in zip(_SIZES, SLOTS, strict=True):
            kalman = KalmanFilter(dim_x=size, dim_z=len(z))
            kalman.x = np.zeros((size, 1))
            kalman.x[: len(z), 0] = z
            kalman.P = np.diag([deviations.get(slot, 0.0) ** 2 for slot in slots])
            kalman.P[: len(z), : len(z)] = noise
            self.filters.append(kalman)

    def update(self, z: Sequence[float], noise: FloatArray, dt: float, *, foreign: bool = False) -> list[float]:
        """One cycle: interaction, filtering, probability update. Returns the NIS of every model."""
        before, _ = self.fused()
        prior = self._interact(dt)
        for model, kalman in enumerate(self.filters):
            kalman.predict(F=self._jacobian(model, dt), Q=self._noise(model, dt))
            if model == CT:  # the mean goes by the transition itself, not by its derivative
                kalman.x = self._mixed_turn
        if foreign:
            noise = self._intersect(prior, noise)
        scores, nis = [], []
        for model, kalman in enumerate(self.filters):
            kalman.dim_z = len(z)
            kalman.update(np.array(z).reshape(-1, 1), R=noise, H=np.eye(len(z), _SIZES[model]))
            deviation, s = kalman.y[:, 0], kalman.S
            nis.append(float(deviation @ np.linalg.solve(s, deviation)))
            scores.append(-0.5 * (nis[-1] + math.log(np.linalg.det(2.0 * math.pi * s))))
        if foreign:
            self._hold_to_birth()
        turn = self.filters[CT].x
        turn[_TURN, 0] = min(max(turn[_TURN, 0], -_TURN_LIMIT_RAD_S), _TURN_LIMIT_RAD_S)
        self._weigh(prior, scores, averaged=len(z) == 3)
        after, _ = self.fused()
        cross = before[3] * after[4] - before[4] * after[3]
        angle = math.atan2(cross, before[3] * after[3] + before[4] * after[4])
        self.headings = [*self.headings, (angle, dt)][-self._config.turn_window :]
        return nis

    def fused(self) -> tuple[FloatArray, FloatArray]:
        """Mean (10,) and covariance (10, 10) over [p, v, a, Omega], spread of means included (19)."""
        states = [self._common(model) for model in range(3)]
        return _moments(states, self.probabilities)

    def carried(self, tau_s: float) -> list[tuple[FloatArray, FloatArray]]:
        """State and covariance of every model ``tau_s`` on (or back, without noise); the filters stay as they are."""
        states = []
        for model, kalman in enumerate(self.filters):
            jacobian = self._jacobian(model, tau_s)
            x = kalman.x[:, 0]
            moved = self._turn(x, tau_s) if model == CT else jacobian @ x
            noise = self._noise(model, tau_s) if tau_s > 0.0 else 0.0
            states.append((moved, jacobian @ kalman.P @ jacobian.T + noise))
        return states

    def predict(self, tau_s: float) -> tuple[FloatArray, FloatArray]:
        """Fused mean (10,) and covariance (10, 10) carried ``tau_s`` on; the filters stay as they are."""
        states = [_to_common(model, *state) for model, state in enumerate(self.carried(tau_s))]
        return _moments(states, self.probabilities)

    def forecast(self, tau_s: float) -> tuple[FloatArray, FloatArray]:
        """Fused position (3,) and its covariance (3, 3) ``tau_s`` on, noise acting all the way there.

        It is that of `predict` but for Remark 1, where Q = q I stands for a step: there every integral of the noise in
        velocity and acceleration reaches the position too.
        """
        mean, spread = self.predict(tau_s)
        q = self._config.q_paper / self._config.dt_s
        through = [q * tau_s**3 / 3.0, q * (tau_s**3 / 3.0 + tau_s**5 / 20.0), q * tau_s**3 / 3.0]
        extra = sum(weight * noise for weight, noise in zip(self.probabilities, through, strict=True))
        return mean[:3], spread[:3, :3] + extra * np.eye(3)

    def _common(self, model: int) -> tuple[FloatArray, FloatArray]:
        return _to_common(model, self.filters[model].x[:, 0], self.filters[model].P)

    def _interact(self, dt: float) -> list[float]:
        """Mixed initial conditions (18); returns the prior model probabilities."""
        from scipy.linalg import fractional_matrix_power

        stay = self._config.stay_probability
        step = np.array([[stay[i] if i == j else (1.0 - stay[i]) / 2.0 for j in range(3)] for i in range(3)])
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
        for kalman, slots, (x, covariance) in zip(self.filters, SLOTS, mixed, strict=True):
            kalman.x = x[slots].reshape(-1, 1)
            kalman.P = covariance[np.ix_(slots, slots)]
        turn = self.filters[CT]
        if self._config.turn_rate == "window":
            angle, taken = sum(a for a, _ in self.headings), sum(t for _, t in self.headings)
            turn.x[_TURN, 0] = angle / max(taken, self._config.dt_s)
            turn.P[_TURN, :] = turn.P[:, _TURN] = 0.0
        self._mixed_turn = self._turn(turn.x[:, 0], dt).reshape(-1, 1)
        return prior

    def _intersect(self, prior: list[float], noise: FloatArray) -> FloatArray:
        """Covariance intersection: P / w for every model, R / (1 - w) returned, w by traces of position."""
        own = sum(c * float(np.trace(kalman.P[:3, :3])) for c, kalman in zip(prior, self.filters, strict=True))
        other = float(np.trace(noise[:3, :3]))
        weight = min(max(other / (own + other), 0.05), 0.95)
        for kalman in self.filters:
            kalman.P = kalman.P / weight
        return noise / (1.0 - weight)

    def _hold_to_birth(self) -> None:
        """Repeated intersections open what is never measured without end: no surer and no vaguer than a new track."""
        config = self._config
        most = [100.0] * 3 + [config.birth_speed_m_s] * 3 + [config.birth_accel_m_s2] * 3 + [config.turn_std_rad_s]
        for kalman, slots in zip(self.filters, SLOTS, strict=True):
            scale = [min(1.0, most[slot] / math.sqrt(kalman.P[k, k])) for k, slot in enumerate(slots)]
            kalman.P = np.diag(scale) @ kalman.P @ np.diag(scale)

    def _weigh(self, prior: list[float], scores: list[float], *, averaged: bool) -> None:
        """mu_j ~ c_j times the mean likelihood of the last updates; six-dimensional ones are not averaged."""
        self.scores = [*self.scores, scores][-self._config.likelihood_window :] if averaged else [scores]
        best = max(max(row) for row in self.scores)
        likelihood = [sum(math.exp(row[model] - best) for row in self.scores) for model in range(3)]
        if not averaged:
            self.scores = []
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
        if model == CV:
            return np.asarray(np.eye(6) + dt * np.eye(6, k=3))
        if model == CA:
            return np.asarray(np.kron(self._singer(dt)[0], np.eye(3)), dtype=np.float64)
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

    def _singer(self, dt: float) -> tuple[FloatArray, FloatArray]:
        """F and Q (3, 3) of one axis of CA, a' = -a / memory + white jerk, by van Loan's matrix exponential.

        Source: van Loan, "Computing integrals involving the matrix exponential", IEEE TAC 1978.
        """
        from scipy.linalg import expm

        memory = self._config.accel_memory_s
        drift = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / memory if memory else 0.0]])
        block = np.zeros((6, 6))
        block[:3, :3], block[3:, 3:] = -drift, drift.T
        block[2, 5] = self._config.jerk_psd_ca
        exponential = expm(block * dt)
        f = exponential[3:, 3:].T
        return f, np.asarray(f @ exponential[:3, 3:])

    def _noise(self, model: int, dt: float) -> FloatArray:
        from filterpy.common import Q_continuous_white_noise

        config, size = self._config, _SIZES[model]
        if config.q_paper > 0.0:
            return np.asarray(np.eye(size) * config.q_paper * dt / config.dt_s)
        if model == CA:
            return np.asarray(np.kron(self._singer(dt)[1], np.eye(3)), dtype=np.float64)
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
    slots = SLOTS[model]
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
