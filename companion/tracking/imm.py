"""The IMM filter bank, batched over M tracks and three models (14)-(19).

One cycle for a measurement z = [I 0] x + q, q ~ N(0, R), dt after the last one:

    c_j = sum_i pi_ij(dt) mu_i,      mu_ij = pi_ij mu_i / c_j                          interaction
    x0_j = sum_i mu_ij T_i(x_i),     P0_j = sum_i mu_ij (P_i + (T_i x_i - x0_j)(.)^T)  (18)
    x_j, P_j, Lambda_j               from the Kalman filter of model j                 filtering
    mu_j ~ c_j mean(Lambda_j)        over the last updates                             (19), Remark 1

Likelihoods stay logarithms until they are relative to the best model. Covariances are symmetrised at every update.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from companion.tracking.agility import growth_factor, look_back, take_notes
from companion.tracking.bank import Bank, Constants
from companion.tracking.models import (
    CT,
    HAS,
    HAS_BLOCK,
    MODELS,
    SIZE,
    TURN,
    TURN_LIMIT_RAD_S,
    P,
    propagate,
    shared,
    to_common,
)
from companion.types import FloatArray

_ENTRIES = np.array([0, 4, 8, 5, 2, 1])  # xx, yy, zz, yz, xz, xy of a row-major 3x3
_LOG_2PI = math.log(2.0 * math.pi)
_WELL_CONDITIONED = 1e-4  # least determinant of S over the product of its diagonal
_VARIANCE_LIMIT = 1e4  # of any component; with R above 1e-6 an update keeps six digits
# Cofactors of a symmetric 3x3 in row-major order: entry k is S[f1] S[f2] - S[f3] S[f4].
_COFACTOR = np.array(
    [
        [4, 5, 3, 2, 0, 1, 1, 2, 0],
        [8, 6, 7, 7, 8, 6, 5, 3, 4],
        [5, 3, 4, 1, 2, 0, 2, 0, 1],
        [7, 8, 6, 8, 6, 7, 4, 5, 3],
    ]
)


def markov(dt: FloatArray, constants: Constants) -> FloatArray:
    """Pi(dt) = exp(G dt), G = log(Pi(dt_s)) / dt_s; transposed: [to, from].

    Shapes: dt (M,) -> (M, 3, 3), or (1, 3, 3) where all share one dt.
    """
    dt_s = shared(dt)
    return _markov(dt, constants) if dt_s is None else _shared_markov(dt_s, constants)


@lru_cache(maxsize=64)
def _shared_markov(dt_s: float, constants: Constants) -> FloatArray:
    return _markov(np.array([dt_s]), constants)


def _markov(dt: FloatArray, constants: Constants) -> FloatArray:
    matrices = (np.exp(dt[:, None] * constants.switching_hz) @ constants.switching).reshape(-1, MODELS, MODELS)
    return np.asarray(np.maximum(matrices, 0.0))  # rounding leaves -1e-17 where dt is zero


def mix(bank: Bank, dt: FloatArray, constants: Constants) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Interaction (18): mixed (x0, P0) of each model and its prior probability c (M, 3)."""
    joint = markov(dt, constants) * bank.probabilities[:, None, :]  # (M, to, from)
    prior = joint.sum(axis=2)
    weights = joint / prior[..., None]
    x, covariance = to_common(bank.x, bank.covariance)
    if constants.turn_window == 0:
        # CV and CA know nothing of the turn rate: CT's own estimate stands for theirs, no surer than a new track's
        x[:, :CT, TURN] = bank.x[:, CT, TURN, None]
        known = np.minimum(bank.covariance[:, CT, TURN, TURN], constants.birth_variance[TURN])
        covariance[:, :CT, TURN, TURN] = known[:, None]
    # second moments about CV's mean, so that metres from the origin do not cost digits
    offset = x - x[:, :1]
    covariance += offset[..., :, None] * offset[..., None, :]
    second = covariance.reshape(len(bank), MODELS, SIZE * SIZE)
    shift = weights @ offset
    mixed = (x[:, :1] + shift) * HAS
    spread = (weights @ second).reshape(len(bank), MODELS, SIZE, SIZE) - shift[..., :, None] * shift[..., None, :]
    spread *= HAS_BLOCK
    if constants.turn_window:
        total = bank.headings.sum(axis=1)
        mixed[:, CT, TURN] = total[:, 0] / np.maximum(total[:, 1], constants.dt_s)
        spread[:, CT, TURN, :] = spread[:, CT, :, TURN] = 0.0
    return mixed, spread, prior


def correct(
    x: FloatArray, covariance: FloatArray, z: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Kalman update of every model by z = x[:d] + q, d = 3 (position) or 6 (position and velocity).

    Args:
        x: (M, 3, 10). covariance: (M, 3, 10, 10). z: (M, d). noise: R (M, d, d), positive definite.
    Returns:
        x, covariance, log-likelihood (M, 3), normalised innovation squared (M, 3).
    """
    d = z.shape[1]
    innovation = z[:, None, :] - x[..., :d]
    inverse, log_determinant = _invert(covariance[..., :d, :d] + noise[:, None])
    gain = np.ascontiguousarray(covariance[..., :d]) @ inverse
    shift = (gain @ innovation[..., None])[..., 0]
    nis = (innovation[..., None, :] @ inverse @ innovation[..., None])[..., 0, 0]
    spread: FloatArray = covariance - gain @ covariance[..., :d, :]
    log_likelihood: FloatArray = -0.5 * (nis + log_determinant + d * _LOG_2PI)
    symmetric: FloatArray = spread + spread.swapaxes(2, 3)
    symmetric *= 0.5
    return x + shift, symmetric, log_likelihood, nis


def _invert(s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse and log-determinant of symmetric positive definite (..., d, d).

    d = 3 goes by cofactors, many times faster than LAPACK for small matrices. They lose digits with the square of the
    condition number, so a batch with a nearly singular member takes the slow way.
    """
    if s.shape[-1] == 3:
        flat = np.ascontiguousarray(s).reshape(*s.shape[:-2], 9)
        f = flat.take(_COFACTOR, axis=-1)
        cofactor = f[..., 0, :] * f[..., 1, :] - f[..., 2, :] * f[..., 3, :]
        determinant = (flat[..., None, :3] @ cofactor[..., :3, None])[..., 0, 0]
        if (determinant > _WELL_CONDITIONED * (flat[..., 0] * flat[..., 4] * flat[..., 8])).all():
            inverse: FloatArray = (cofactor / determinant[..., None]).reshape(s.shape)
            return inverse, np.log(determinant)
    return np.asarray(np.linalg.inv(s), dtype=np.float64), np.asarray(np.linalg.slogdet(s)[1])


def step(
    bank: Bank, dt: FloatArray, z: FloatArray, noise: FloatArray, constants: Constants, *, foreign: bool = False
) -> tuple[Bank, FloatArray]:
    """One IMM cycle: the bank after a measurement of every track, each ``dt`` after its last one.

    Args:
        dt: (M,) > 0 [s]. z: (M, d), d = 3 or 6. noise: R (M, d, d), positive definite.
        foreign: z was filtered elsewhere, its errors are correlated with ours: covariance intersection.
    Returns:
        the new bank and the normalised innovation squared of every model, (M, 3).
    """
    x, covariance, prior = mix(bank, dt, constants)
    x, covariance = propagate(x, covariance, dt, constants.models)
    if covariance.size and covariance.max() > _VARIANCE_LIMIT:  # an absurd measurement tore the models apart
        covariance = _bounded(covariance, np.full(SIZE, _VARIANCE_LIMIT))
    inflated = noise
    if foreign:
        covariance, inflated = _shared(covariance, prior, noise)
    x, covariance, log_likelihood, nis = correct(x, covariance, z, inflated)
    if foreign:
        covariance = _bounded(covariance, constants.birth_variance)
    turn = x[:, CT, TURN]
    turn[:] = np.minimum(np.maximum(turn, -TURN_LIMIT_RAD_S), TURN_LIMIT_RAD_S)
    score, history = log_likelihood, bank.history
    if history.shape[1]:
        recent = np.concatenate((history, log_likelihood[:, None]), axis=1)
        # a likelihood of six numbers has other units than one of three: it is not averaged with them
        score = np.logaddexp.reduce(recent, axis=1) if z.shape[1] == 3 else log_likelihood
        history = recent[:, 1:] if z.shape[1] == 3 else np.full_like(history, -np.inf)
    score = np.log(prior) + score
    probabilities = np.exp(score - score.max(axis=1, keepdims=True))
    probabilities /= probabilities.sum(axis=1, keepdims=True)
    headings = bank.headings
    if constants.turn_window:
        headings = _turned(bank, fuse_mean(x, probabilities), dt)
    notes, means, due = look_back(bank.notes, bank.means, dt, z[:, :3], noise[:, :3, :3], constants.watch)
    notes = take_notes(notes, due, x, covariance, probabilities, constants.watch)
    return Bank(x, covariance, probabilities, history, headings, notes, means), nis


def _shared(covariance: FloatArray, prior: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariance intersection as a Kalman update with P / w and R / (1 - w).

    w = tr R / (tr P + tr R) over the position blocks. Source: Niehsen, "Information fusion based on fast covariance
    intersection filtering", 2002.
    """
    own = (prior * np.trace(covariance[..., P, P], axis1=2, axis2=3)).sum(axis=1)
    other = np.trace(noise[:, :3, :3], axis1=1, axis2=2)
    weight = np.clip(other / (own + other), 0.05, 0.95)
    return covariance / weight[:, None, None, None], noise / (1.0 - weight)[:, None, None]


def _bounded(covariance: FloatArray, most: FloatArray) -> FloatArray:
    """Rows and columns scaled down where a variance exceeds ``most``: a congruence, so the matrix stays positive."""
    variance = np.diagonal(covariance, axis1=2, axis2=3)
    scale = np.sqrt(most / np.maximum(variance, most))
    return np.asarray(covariance * scale[..., :, None] * scale[..., None, :])


def _turned(bank: Bank, mean: FloatArray, dt: FloatArray) -> FloatArray:
    """The window of heading changes with that from the fused velocity before to the one after appended."""
    before = fuse_mean(bank.x, bank.probabilities)
    cross = before[:, 3] * mean[:, 4] - before[:, 4] * mean[:, 3]
    angle = np.arctan2(cross, before[:, 3] * mean[:, 3] + before[:, 4] * mean[:, 4])
    latest = np.stack((angle, dt), axis=1)[:, None]
    return np.concatenate((bank.headings[:, 1:], latest), axis=1)


def fuse_mean(x: FloatArray, probabilities: FloatArray) -> FloatArray:
    """Fused [p, v, a, Omega] (19), (M, 10), centripetal acceleration for CT."""
    mean: FloatArray = (probabilities[:, None, :] @ x)[:, 0]
    turn = probabilities[:, CT] * x[:, CT, TURN]
    mean[:, 6] -= turn * x[:, CT, 4]
    mean[:, 7] += turn * x[:, CT, 3]
    return mean


def fuse(x: FloatArray, covariance: FloatArray, probabilities: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fused mean (M, 10) and covariance (M, 10, 10) over [p, v, a, Omega], spread of means included (19)."""
    common, spread = to_common(x, covariance)
    mean = (probabilities[:, None, :] @ common)[:, 0]
    offset = common - mean[:, None]
    spread += offset[..., :, None] * offset[..., None, :]
    flat = spread.reshape(len(x), MODELS, SIZE * SIZE)
    return mean, (probabilities[:, None, :] @ flat).reshape(len(x), SIZE, SIZE)


def widened(spread: FloatArray, bank: Bank, constants: Constants) -> FloatArray:
    """Predicted position covariances (M, 6, K) of ``bank``, grown faster where a track breaks its models.

    P(tau) -> P_0 + factor (P(tau) - P_0), P_0 that of the last update, at the instants at which every axis has grown;
    going back in time (a stamp ahead of the prediction's start) nothing is widened.
    """
    factor = growth_factor(bank.means, constants.watch)
    agile = np.flatnonzero(factor > 1.0)
    if not agile.size:
        return spread
    p, weights = bank.x[agile, :, P], bank.probabilities[agile, None]
    offset = p - weights @ p
    second = bank.covariance[agile, :, P, P] + offset[..., :, None] * offset[..., None, :]
    base = (weights @ second.reshape(-1, MODELS, 9))[:, 0, _ENTRIES, None]
    growth = spread[agile] - base
    growth *= growth[:, :3].min(axis=1, keepdims=True) > 0.0
    spread = spread.copy()
    spread[agile] += (factor[agile, None, None] - 1.0) * growth
    return spread
