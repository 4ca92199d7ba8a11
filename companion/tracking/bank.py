"""The table that the filter works on: M tracks of three models, and the constants of the configuration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.config import TrackingConfig
from companion.tracking.agility import Watch, build_watch, first_notes
from companion.tracking.models import HAS_BLOCK, MODELS, SIZE, MotionModels, build_models
from companion.types import FloatArray

_EYE = np.eye(MODELS)


@dataclass(frozen=True, slots=True, eq=False)
class Constants:
    """What the bank needs besides a measurement."""

    models: MotionModels
    dt_s: float  # grid of the per-step constants
    switching_hz: FloatArray  # (3,) and
    switching: FloatArray  # (3, 9), of the Markov matrix, see `markov`
    likelihood_window: int  # updates
    turn_window: int  # updates; 0: the turn rate is estimated as a state
    birth_variance: FloatArray  # (10,) of a new track; also the most that a foreign track may leave open
    watch: Watch


def build_constants(config: TrackingConfig) -> Constants:
    """Constants from the configuration, those per step turned into those per second."""
    deviations = np.repeat(
        [100.0, config.birth_speed_m_s, config.birth_accel_m_s2, config.turn_std_rad_s], (3, 3, 3, 1)
    )
    models = build_models(config)
    switching_hz, switching = _switching(config)
    return Constants(
        models=models,
        dt_s=config.dt_s,
        switching_hz=switching_hz,
        switching=switching,
        likelihood_window=config.likelihood_window,
        turn_window=config.turn_window if config.turn_rate == "window" else 0,
        birth_variance=deviations**2,
        watch=build_watch(config, models),
    )


def _switching(config: TrackingConfig) -> tuple[FloatArray, FloatArray]:
    """Rates kappa (3,) [1/s] and projectors E (3, 9) of Pi(dt) = sum_k exp(kappa_k dt) E_k, see `markov`.

    The matrix per ``dt_s`` has ``stay_probability`` on its diagonal, the rest of each row shared evenly. Balanced by
    pi_i ~ 1 / (1 - stay_i) it is symmetric, so its eigenvalues are real, and positive for every stay above 1/3.
    """
    stay = np.array(config.stay_probability)
    per_step = np.where(_EYE > 0.0, stay, 0.5 * (1.0 - stay[:, None]))
    root = np.sqrt(1.0 / (1.0 - stay))
    values, vectors = np.linalg.eigh(root[:, None] * per_step / root)
    left, right = vectors / root[:, None], vectors * root[:, None]
    projectors = left.T[:, :, None] * right.T[:, None, :]  # (k, from, to)
    return np.log(values) / config.dt_s, projectors.swapaxes(1, 2).reshape(MODELS, MODELS**2)


@dataclass(frozen=True, slots=True)
class Bank:
    """M tracks, each at its own instant; rows are tracks. No function here writes into a bank that it was given."""

    x: FloatArray  # (M, 3, 10)
    covariance: FloatArray  # (M, 3, 10, 10)
    probabilities: FloatArray  # (M, 3)
    history: FloatArray  # (M, W - 1, 3) log-likelihoods of the last updates, -inf where none
    headings: FloatArray  # (M, L, 2) angle turned [rad] and time taken [s] in the last updates; L = turn_window
    notes: FloatArray  # (M, 25) predictions to be looked back on, see `agility`
    means: FloatArray  # (M, 2) recent NIS of the predictions and share of S that grew, see `agility`

    def __len__(self) -> int:
        return len(self.x)

    def take(self, rows: npt.NDArray[np.intp]) -> Bank:
        """The tracks ``rows``."""
        return Bank(*(part[rows] for part in self.parts()))

    def parts(self) -> tuple[FloatArray, ...]:
        return self.x, self.covariance, self.probabilities, self.history, self.headings, self.notes, self.means


def join(first: Bank, second: Bank) -> Bank:
    """The tracks of both."""
    return Bank(*(np.concatenate(pair) for pair in zip(first.parts(), second.parts(), strict=True)))


def put(bank: Bank, rows: npt.NDArray[np.intp], values: Bank) -> Bank:
    """``bank`` with ``rows`` replaced."""
    copies = [part.copy() for part in bank.parts()]
    for copy, value in zip(copies, values.parts(), strict=True):
        copy[rows] = value
    return Bank(*copies)


def birth(z: FloatArray, noise: FloatArray, constants: Constants) -> Bank:
    """New tracks from one measurement each: what it does not tell is zero with the configured deviation.

    Args:
        z: (M, d), d = 3 (position) or 6 (position and velocity). noise: R (M, d, d).
    """
    count, d = z.shape
    x = np.zeros((count, MODELS, SIZE))
    x[..., :d] = z[:, None]
    covariance = np.zeros((count, MODELS, SIZE, SIZE))
    covariance[:] = np.diag(constants.birth_variance)
    covariance[..., :d, :d] = noise[:, None]
    return Bank(
        x,
        covariance * HAS_BLOCK,
        np.full((count, MODELS), 1.0 / MODELS),
        np.full((count, constants.likelihood_window - 1, MODELS), -np.inf),
        np.zeros((count, constants.turn_window, 2)),
        *first_notes(count),
    )
