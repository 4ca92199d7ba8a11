"""Obstacles on the barrier grid: every model by its own dynamics, then fused with its spread of means (20).

    p_j(tau) = first block of F_j(tau) x_j,   P_j(tau) = J P_j J^T + Q_j(tau)
    p(tau) = sum_j mu_j p_j(tau),             P(tau) = sum_j mu_j (P_j(tau) + (p_j - p)(p_j - p)^T)

Closed forms, no loop over tracks or instants: CV and CA are polynomials in tau whose coefficients are blocks of the
covariance at the start; CT turns the horizontal velocity as a complex number. Mode probabilities stay what they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.tracking.models import CA, CT, MODELS, SIZE, TURN, MotionModels, horizontal_velocity, turn_terms
from companion.types import FloatArray

_DIAGONAL = slice(0, 9, 4)  # of a flattened 3x3


_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _pair_map() -> FloatArray:
    """(100, 54): a covariance over [p, v, a] -> its blocks summed by pairs, (6, 3, 3).

    A position error moves as f_0 dp + f_1 dv + f_2 da, so its covariance is the sum of f_i f_j (P_ij + P_ij^T) over
    the pairs i < j, and of f_i^2 P_ii.
    """
    out = np.zeros((SIZE, SIZE, len(_PAIRS), 3, 3))
    for k, (i, j) in enumerate(_PAIRS):
        for row in range(3):
            for column in range(3):
                out[3 * i + row, 3 * j + column, k, row, column] = 1.0
                out[3 * j + row, 3 * i + column, k, row, column] = 1.0
    return out.reshape(SIZE * SIZE, 9 * len(_PAIRS))


def _complex_map() -> FloatArray:
    """(100, 48): a covariance -> second moments of u = (p_x + i p_y, v_x + i v_y, Omega), as (3, 8) complex.

    Columns: E[u u^H] (3), E[u u^T] (3), E[u z], E[u v_z].
    """
    u = np.zeros((3, SIZE), dtype=np.complex128)
    u[0, 0], u[0, 1] = 1.0, 1j
    u[1, 3], u[1, 4] = 1.0, 1j
    u[2, TURN] = 1.0
    right = np.hstack((u.conj().T, u.T, np.eye(SIZE)[:, [2, 5]]))  # (10, 8)
    out = u.T[:, None, :, None] * right[None, :, None, :]  # (10, 10, 3, 8)
    return np.ascontiguousarray(out).reshape(SIZE * SIZE, 24).view(np.float64)


_PAIR_MAP = _pair_map()
_FIRST, _SECOND = np.array(_PAIRS).T
_COMPLEX_MAP = _complex_map()


@dataclass(frozen=True, slots=True)
class Horizon:
    """The instants of a prediction and what depends on nothing else; `horizon` makes it, once for many ticks."""

    tau_s: FloatArray  # (K,) after the start, >= 0
    reach: FloatArray  # (K, 3): what position, velocity and acceleration of CV and CA contribute
    pairs: FloatArray  # (K, 6): their products, in the order of the pairs
    noise: FloatArray  # (3, K, 1): position variance of each model's own noise [m^2]
    turn_noise: FloatArray  # (K,): q tau / 5, the turn rate's wandering as a variance of its constant error


def horizon(tau_s: FloatArray, models: MotionModels) -> Horizon:
    """Constants of the instants ``tau_s``.

    An acceleration with a memory T = 1 / alpha dies out as it is carried on: it moves the obstacle by
    phi(tau) = (alpha tau - 1 + e^(-alpha tau)) / alpha^2, tau^2 / 2 where alpha is zero, and white jerk of density q
    leaves q times the integral of phi^2.
    """
    noise = models.prediction_noise @ (tau_s[:, None] ** np.arange(6.0)).T
    alpha = models.accel_decay_hz
    phi = 0.5 * tau_s * tau_s
    if alpha > 0.0:
        aged, left = alpha * tau_s, np.exp(-alpha * tau_s)
        phi = (aged - 1.0 + left) / alpha**2
        squared = (((aged - 1.0) ** 3 + 1.0) / 3.0 - 2.0 * aged * left + 0.5 * (1.0 - left * left)) / alpha**5
        noise[CA] = models.jerk_psd * squared
    reach = np.stack((np.ones_like(tau_s), tau_s, phi), axis=1)
    pairs = reach[:, _FIRST] * reach[:, _SECOND]
    return Horizon(tau_s, reach, pairs, noise[:, :, None], 0.2 * models.turn_psd * tau_s)


def predict_positions(
    x: FloatArray, covariance: FloatArray, probabilities: FloatArray, at: Horizon
) -> tuple[FloatArray, FloatArray]:
    """Fused position and its covariance at the instants of ``at``, counted from that of ``x``.

    Args:
        x: (M, 3, 10). covariance: (M, 3, 10, 10). probabilities: (M, 3).
    Returns:
        p_enu (M, K, 3) [m] and covariance (M, K, 3, 3) [m^2], spread of means included.
    """
    tracks, steps = x.shape[0], at.tau_s.shape[0]
    p = np.empty((tracks, MODELS, steps, 3))
    spread = np.empty((tracks, MODELS, steps, 9))
    np.matmul(at.reach, x[:, :CT, :9].reshape(tracks, CT, 3, 3), out=p[:, :CT])
    blocks = (covariance[:, :CT].reshape(tracks, CT, SIZE * SIZE) @ _PAIR_MAP).reshape(tracks, CT, len(_PAIRS), 9)
    np.matmul(at.pairs, blocks, out=spread[:, :CT])
    _turning(x, covariance, at, p[:, CT], spread[:, CT])
    spread[..., _DIAGONAL] += at.noise
    weights = probabilities[:, None, :]
    fused = (weights @ p.reshape(tracks, MODELS, steps * 3)).reshape(tracks, steps, 3)
    offset = p - fused[:, None]
    spread += (offset[..., :, None] * offset[..., None, :]).reshape(spread.shape)
    total = (weights @ spread.reshape(tracks, MODELS, steps * 9)).reshape(tracks, steps, 3, 3)
    return fused, total


def _turning(x: FloatArray, covariance: FloatArray, at: Horizon, p: FloatArray, spread: FloatArray) -> None:
    """CT's positions (M, K, 3) and covariances (M, K, 9), written into ``p`` and ``spread``; isotropic noise left out.

    In the complex horizontal plane an error moves as dp(tau) = dp + I dv + (dI/dOmega) w dOmega = f^T u. Its variance
    E|dp|^2 and pseudo-variance E[dp^2] hold the three entries of the horizontal block.
    """
    tracks, steps, tau_s = x.shape[0], at.tau_s.shape[0], at.tau_s
    _, integral, slope = turn_terms(x[:, CT, TURN, None], tau_s)
    w = horizontal_velocity(x)[:, None]
    move = integral * w
    p[..., 0] = move.real + x[:, CT, 0, None]
    p[..., 1] = move.imag + x[:, CT, 1, None]
    p[..., 2] = x[:, CT, 5, None] * tau_s + x[:, CT, 2, None]
    f = np.empty((tracks, steps, 3), dtype=np.complex128)
    f[..., 0] = 1.0
    f[..., 1] = integral
    column = f[..., 2] = slope * w
    ct = covariance[:, CT]
    moments = (ct.reshape(tracks, SIZE * SIZE) @ _COMPLEX_MAP).view(np.complex128).reshape(tracks, 3, 8)
    carried = f @ moments  # (M, K, 8)
    wandering = column * at.turn_noise
    carried[..., 2] += wandering
    carried[..., 5] += wandering
    variance = (carried[..., :3] * f.conj()).sum(axis=-1).real
    pseudo = (carried[..., 3:6] * f).sum(axis=-1)
    cross = carried[..., 6] + carried[..., 7] * tau_s
    spread[..., 0] = 0.5 * (variance + pseudo.real)
    spread[..., 4] = 0.5 * (variance - pseudo.real)
    spread[..., 1] = spread[..., 3] = 0.5 * pseudo.imag
    spread[..., 2] = spread[..., 6] = cross.real
    spread[..., 5] = spread[..., 7] = cross.imag
    spread[..., 8] = ct[:, 2, 2, None] + (2.0 * ct[:, 2, 5, None] + ct[:, 5, 5, None] * tau_s) * tau_s


def largest_sigma(covariance: FloatArray) -> FloatArray:
    """Square root of the largest eigenvalue of symmetric (..., 3, 3), in closed form.

    With q = tr / 3, s^2 = tr((C - q I)^2) / 6 and r = det((C - q I) / s) / 2 the largest eigenvalue is
    q + 2 s cos(arccos(r) / 3). Source: Smith, "Eigenvalues of a symmetric 3 x 3 matrix", CACM 1961.
    """
    xx, yy, zz = covariance[..., 0, 0], covariance[..., 1, 1], covariance[..., 2, 2]
    xy, xz, yz = covariance[..., 0, 1], covariance[..., 0, 2], covariance[..., 1, 2]
    mean = (xx + yy + zz) / 3.0
    a, b, d = xx - mean, yy - mean, zz - mean
    xy2, xz2, yz2 = xy * xy, xz * xz, yz * yz
    scale = np.sqrt((a * a + b * b + d * d) / 6.0 + (xy2 + xz2 + yz2) / 3.0)
    determinant = a * (b * d - yz2) - d * xy2 - b * xz2 + 2.0 * xy * xz * yz
    cube = np.maximum(2.0 * scale * scale * scale, np.finfo(np.float64).tiny)
    ratio = np.minimum(np.maximum(determinant / cube, -1.0), 1.0)
    return np.asarray(np.sqrt(np.maximum(mean + 2.0 * scale * np.cos(np.arccos(ratio) / 3.0), 0.0)))
