"""Obstacles on the barrier grid: every model by its own dynamics, then fused with its spread of means (20).

    p_j(tau) = first block of F_j(tau) x_j,   P_j(tau) = J P_j J^T + Q_j(tau)
    p(tau) = sum_j mu_j p_j(tau),             P(tau) = sum_j mu_j (P_j(tau) + (p_j - p)(p_j - p)^T)

Every position is a sum over the same seven functions of tau, p_j(tau) = sum_k b_k(tau) e_k with e_k linear in x_j:

    b = (1, tau, phi, Re I - tau, Im I, Re c, Im c),   I = (e^(i Omega tau) - 1) / (i Omega),   c = w dI/dOmega

CV and CA use the first three, CT all but phi. So the mixture is fused once, at the start, as the second moments S of
the e_k, and P(tau) = sum_kl b_k b_l S_kl is one matrix product. Mode probabilities stay what they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.tracking.models import (
    CA,
    CT,
    CV,
    MODELS,
    SIZE,
    TURN,
    A,
    MotionModels,
    P,
    V,
    acceleration_response,
    horizontal_velocity,
    turn_terms,
)
from companion.types import FloatArray

_BASIS = 7
_LASTING, _MEANS, _ALL = 9, 15, 3 * _BASIS  # components of the e_k: of CV and CA, with a mean, all
_ENTRIES = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # of a symmetric 3x3: xx, yy, zz, yz, xz, xy
_XY = 5
_TINY = float(np.finfo(np.float64).tiny)
_MEAN = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) / 3.0
_NORM = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0]) / 6.0


def _ct_parts() -> FloatArray:
    """(21, 10): CT's state -> its e_k, b-major: p, v, 0 (a), (v_x, v_y), (-v_y, v_x), (Omega, 0), (0, Omega)."""
    out = np.zeros((_BASIS, 3, SIZE))
    for k, block in enumerate((P, V, A)):
        out[k, :, block] = np.eye(3)
    out[3, 0, 3] = out[3, 1, 4] = out[4, 1, 3] = 1.0
    out[4, 0, 4] = -1.0
    out[5, 0, TURN] = out[6, 1, TURN] = 1.0
    return out.reshape(_ALL, SIZE)


_PARTS = _ct_parts()
_PARTS_T = np.ascontiguousarray(_PARTS[:_MEANS].T)
# b_k b_l = b_l b_k: the sum over all pairs is one over k <= l with S_kl + S_lk, the squares last.
_K, _L = (np.concatenate((off, np.arange(_BASIS))) for off in np.triu_indices(_BASIS, 1))
_OFF = len(_K) - _BASIS
# (6, 28): where entry (r, c) of S_kl stands in the flattened (21, 21), and (6, 21) where that of S_lk does
_ENTRY_OF = np.array([(3 * _K + r) * _ALL + 3 * _L + c for r, c in _ENTRIES])
_MIRRORED = np.array([(3 * _L + r) * _ALL + 3 * _K + c for r, c in _ENTRIES])[:, :_OFF]
# Every e_k of CT is one component of its state or none, with a sign: its second moments are picked, not multiplied.
_CT_SIGN = _PARTS.sum(axis=1)
_CT_FROM = np.abs(_PARTS).argmax(axis=1)
_CT_SIGNS = np.outer(_CT_SIGN, _CT_SIGN).ravel()
_CT_PICK = (_CT_FROM[:, None] * SIZE + _CT_FROM).ravel()


@dataclass(frozen=True, slots=True)
class Horizon:
    """The instants of a prediction and what depends on nothing else; `horizon` makes it, once for many ticks.

    L = 1 where all tracks share their instants, else L = M.
    """

    tau_s: FloatArray  # (L, K) after the state
    reach: FloatArray  # (L, 3, K): what position, velocity and acceleration contribute, 1, tau, phi
    noise: FloatArray  # (L, 3, K): position variance of each model's own noise [m^2]
    turn_noise: FloatArray  # (L, K): q tau / 5, the turn rate's wandering as a variance of its constant error

    def of(self, rows: slice) -> Horizon:
        """The instants of some tracks."""
        if len(self.tau_s) == 1:
            return self
        return Horizon(self.tau_s[rows], self.reach[rows], self.noise[rows], self.turn_noise[rows])


def horizon(tau_s: FloatArray, models: MotionModels) -> Horizon:
    """Constants of the instants ``tau_s``, (K,) for all tracks or (M, K); going back in time adds no noise.

    An acceleration with a memory T = 1 / alpha dies out as it is carried on: it moves the obstacle by
    phi(tau) = (alpha tau - 1 + e^(-alpha tau)) / alpha^2, tau^2 / 2 where alpha is zero, and white jerk of density q
    leaves q times the integral of phi^2.
    """
    tau_s = np.atleast_2d(tau_s)
    ahead_s = np.maximum(tau_s, 0.0)
    noise = models.prediction_noise @ (ahead_s[:, None] ** np.arange(6.0)[:, None])
    alpha = models.accel_decay_hz
    phi = acceleration_response(tau_s, alpha)[0]
    if alpha > 0.0:
        aged, left = alpha * ahead_s, np.exp(-alpha * ahead_s)
        squared = (((aged - 1.0) ** 3 + 1.0) / 3.0 - 2.0 * aged * left + 0.5 * (1.0 - left * left)) / alpha**5
        noise[:, CA] = models.jerk_psd * squared
    return Horizon(tau_s, np.stack((np.ones_like(tau_s), tau_s, phi), axis=1), noise, 0.2 * models.turn_psd * ahead_s)


def joined(horizons: list[Horizon]) -> Horizon:
    """One horizon a track, as `horizon` of all their instants would be, to the bit."""
    return Horizon(
        np.concatenate([each.tau_s for each in horizons]),
        np.concatenate([each.reach for each in horizons]),
        np.concatenate([each.noise for each in horizons]),
        np.concatenate([each.turn_noise for each in horizons]),
    )


def predict_positions(
    x: FloatArray, covariance: FloatArray, probabilities: FloatArray, at: Horizon
) -> tuple[FloatArray, FloatArray]:
    """Fused position and its covariance at the instants of ``at``, counted from that of ``x``.

    Args:
        x: (M, 3, 10). covariance: (M, 3, 10, 10). probabilities: (M, 3).
    Returns:
        p_enu (M, K, 3) [m] and the entries xx, yy, zz, yz, xz, xy of its covariance (M, 6, K) [m^2], spread of means
        included.
    """
    tracks = x.shape[0]
    basis = _basis(x, at)
    mean, second = _moments(x, covariance, probabilities)
    p_enu = basis[:, :5].swapaxes(1, 2) @ mean.reshape(tracks, 5, 3)
    flat = second.reshape(tracks, _ALL**2)
    weights = flat.take(_ENTRY_OF, axis=1)
    weights[..., :_OFF] += flat.take(_MIRRORED, axis=1)
    spread = weights @ (basis.take(_K, axis=1) * basis.take(_L, axis=1))
    spread[:, :3] += probabilities[:, None] @ at.noise
    wandering = (probabilities[:, CT, None] * at.turn_noise)[:, None] * basis[:, 5:]
    spread[:, :2] += wandering * basis[:, 5:]
    spread[:, _XY] += wandering[:, 0] * basis[:, 6]
    return p_enu, spread


def velocity_ahead(
    x: FloatArray, probabilities: FloatArray, dt: FloatArray, models: MotionModels
) -> tuple[FloatArray, FloatArray]:
    """Fused velocity and acceleration ``dt`` (M,) on, (M, 3) each [m/s], [m/s^2]: every model by its own dynamics."""
    _, speed, left = acceleration_response(dt, models.accel_decay_hz)
    cv, ca, ct = probabilities.T
    turn = x[:, CT, TURN]
    w = horizontal_velocity(x) * np.exp(1j * turn * dt) * ct
    a = (ca * left)[:, None] * x[:, CA, A]
    v = cv[:, None] * x[:, CV, V] + ca[:, None] * x[:, CA, V] + (ca * speed)[:, None] * x[:, CA, A]
    v[:, 0] += w.real
    v[:, 1] += w.imag
    v[:, 2] += ct * x[:, CT, 5]
    a[:, 0] -= turn * w.imag
    a[:, 1] += turn * w.real
    return v, a


def _basis(x: FloatArray, at: Horizon) -> FloatArray:
    """b (M, 7, K)."""
    _, integral, slope = turn_terms(x[:, CT, TURN, None], at.tau_s)
    column = slope * horizontal_velocity(x)[:, None]
    basis = np.empty((x.shape[0], _BASIS, at.tau_s.shape[1]))
    basis[:, :3] = at.reach
    # less tau: what CT does not share with CV, so that fast obstacles cost no digits
    basis[:, 3], basis[:, 4] = integral.real - at.tau_s, integral.imag
    basis[:, 5], basis[:, 6] = column.real, column.imag
    return basis


def _moments(x: FloatArray, covariance: FloatArray, probabilities: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (M, 15) and second moments (M, 21, 21) of the fused e_k; the mean of the last two is zero."""
    parts = np.zeros((x.shape[0], MODELS, _MEANS))
    parts[..., :_LASTING] = x[..., :_LASTING]
    parts[:, CT, _LASTING:] = x[:, CT] @ _PARTS_T[:, _LASTING:]
    mean = (probabilities[:, None] @ parts)[:, 0]
    parts -= mean[:, None]
    weighted = covariance * probabilities[..., None, None]
    second: FloatArray = weighted[:, CT].reshape(-1, SIZE * SIZE).take(_CT_PICK, axis=1)
    second *= _CT_SIGNS
    second = second.reshape(-1, _ALL, _ALL)
    second[:, :_LASTING, :_LASTING] += (weighted[:, 0] + weighted[:, CA])[:, :_LASTING, :_LASTING]
    second[:, :_MEANS, :_MEANS] += (parts * probabilities[..., None]).swapaxes(1, 2) @ parts
    return mean, second


def largest_sigma(entries: FloatArray) -> FloatArray:
    """Square root of the largest eigenvalue of symmetric 3x3, in closed form.

    With q = tr / 3, s^2 = tr((C - q I)^2) / 6 and r = det((C - q I) / s) / 2 the largest eigenvalue is
    q + 2 s cos(arccos(r) / 3). Source: Smith, "Eigenvalues of a symmetric 3 x 3 matrix", CACM 1961.

    Shapes: xx, yy, zz, yz, xz, xy (M, 6, K) -> (M, K).
    """
    mean = _MEAN @ entries
    c = entries.copy()
    c[:, :3] -= mean[:, None]
    squared = c * c
    scale = np.sqrt(_NORM @ squared)
    product = c.reshape(len(c), 2, 3, c.shape[2]).prod(axis=2)  # of the diagonal, of the rest
    half = 0.5 * (product[:, 0] - (c[:, :3] * squared[:, 3:]).sum(axis=1)) + product[:, 1]  # of the determinant
    cube = scale * scale * scale + _TINY
    ratio = np.minimum(np.maximum(half / cube, -1.0), 1.0)
    largest = mean + 2.0 * scale * np.cos(np.arccos(ratio) * (1.0 / 3.0))
    return np.asarray(np.sqrt(np.maximum(largest, 0.0)))
