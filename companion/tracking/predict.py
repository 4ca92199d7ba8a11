"""Obstacles on the barrier grid: every model by its own dynamics, then fused with its spread of means (20).

    p_j(tau) = first block of F_j(tau) x_j,   P_j(tau) = J P_j J^T + Q_j(tau)
    p(tau) = sum_j mu_j p_j(tau),             P(tau) = sum_j mu_j (P_j(tau) + (p_j - p)(p_j - p)^T)

Closed forms, no loop over tracks or instants: CV and CA are polynomials in tau whose coefficients are blocks of the
covariance at the start; CT turns the horizontal velocity as a complex number. Mode probabilities stay what they are.
"""

from __future__ import annotations

import numpy as np

from companion.tracking.models import CT, MODELS, TURN, A, MotionModels, P, V, turn_terms
from companion.types import FloatArray

_CT_PARTS = np.array([0, 1, 2, 3, 4, 5, TURN])
_DIAGONAL = slice(0, 9, 4)  # of a flattened 3x3


def predict_positions(
    x: FloatArray, covariance: FloatArray, probabilities: FloatArray, tau_s: FloatArray, models: MotionModels
) -> tuple[FloatArray, FloatArray]:
    """Fused position and its covariance at ``tau_s`` after the instant of ``x``.

    Args:
        x: (M, 3, 10). covariance: (M, 3, 10, 10). probabilities: (M, 3). tau_s: (K,), >= 0 [s].
    Returns:
        p_enu (M, K, 3) [m] and covariance (M, K, 3, 3) [m^2], spread of means included.
    """
    tracks, steps = x.shape[0], tau_s.shape[0]
    powers = tau_s[:, None] ** np.arange(6.0)  # (K, 6)
    p = np.empty((tracks, MODELS, steps, 3))
    spread = np.empty((tracks, MODELS, steps, 9))
    p[:, :CT], spread[:, :CT] = _straight(x[:, :CT], covariance[:, :CT], powers)
    p[:, CT], spread[:, CT] = _turning(x[:, CT], covariance[:, CT], tau_s, models.turn_psd)
    spread[..., _DIAGONAL] += (models.prediction_noise @ powers.T)[None, :, :, None]
    weights = probabilities[:, None, :]
    fused = (weights @ p.reshape(tracks, MODELS, steps * 3)).reshape(tracks, steps, 3)
    offset = p - fused[:, None]
    spread += (offset[..., :, None] * offset[..., None, :]).reshape(spread.shape)
    total = (weights @ spread.reshape(tracks, MODELS, steps * 9)).reshape(tracks, steps, 3, 3)
    return fused, total


def _straight(x: FloatArray, covariance: FloatArray, powers: FloatArray) -> tuple[FloatArray, FloatArray]:
    """CV and CA: p + v tau + a tau^2 / 2 and its covariance, noise left out; (M, 2, K, 3) and (M, 2, K, 9)."""
    shape = (*x.shape[:2], 3, 3)
    p = powers[:, :3] * (1.0, 1.0, 0.5) @ x[..., :9].reshape(shape)
    pv, pa, va = covariance[..., P, V], covariance[..., P, A], covariance[..., V, A]
    terms = np.empty((*x.shape[:2], 5, 3, 3))
    terms[:, :, 0] = covariance[..., P, P]
    terms[:, :, 1] = pv + pv.swapaxes(2, 3)
    terms[:, :, 2] = covariance[..., V, V] + 0.5 * (pa + pa.swapaxes(2, 3))
    terms[:, :, 3] = 0.5 * (va + va.swapaxes(2, 3))
    terms[:, :, 4] = 0.25 * covariance[..., A, A]
    return p, powers[:, :5] @ terms.reshape(*x.shape[:2], 5, 9)


def _turning(
    x: FloatArray, covariance: FloatArray, tau_s: FloatArray, turn_psd: float
) -> tuple[FloatArray, FloatArray]:
    """CT: positions and covariances, only the turn rate's noise included; (M, K, 3) and (M, K, 9)."""
    tracks, steps = x.shape[0], tau_s.shape[0]
    _, integral, slope = turn_terms(x[:, TURN, None], tau_s)
    w = (x[:, 3] + 1j * x[:, 4])[:, None]
    move, column = integral * w, slope * w
    p = np.empty((tracks, steps, 3))
    p[..., 0] = x[:, 0, None] + move.real
    p[..., 1] = x[:, 1, None] + move.imag
    p[..., 2] = x[:, 2, None] + x[:, 5, None] * tau_s
    jacobian = np.zeros((tracks, steps, 3, 7))
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = jacobian[..., 2, 2] = 1.0
    jacobian[..., 0, 3] = jacobian[..., 1, 4] = integral.real
    jacobian[..., 1, 3] = integral.imag
    jacobian[..., 0, 4] = -integral.imag
    jacobian[..., 2, 5] = tau_s
    jacobian[..., 0, 6] = column.real
    jacobian[..., 1, 6] = column.imag
    part = covariance[:, _CT_PARTS[:, None], _CT_PARTS]
    # the turn rate's own wandering is one more variance on the same column: q tau / 5 (see `turn_noise`)
    left = (jacobian.reshape(tracks, steps * 3, 7) @ part).reshape(jacobian.shape)
    left[..., 6] += (0.2 * turn_psd * tau_s)[:, None] * jacobian[..., 6]
    return p, (left @ jacobian.swapaxes(2, 3)).reshape(tracks, steps, 9)


def largest_sigma(covariance: FloatArray) -> FloatArray:
    """Square root of the largest eigenvalue of symmetric (..., 3, 3), in closed form.

    With q = tr / 3, s^2 = tr((C - q I)^2) / 6 and r = det((C - q I) / s) / 2 the largest eigenvalue is
    q + 2 s cos(arccos(r) / 3). Source: Smith, "Eigenvalues of a symmetric 3 x 3 matrix", CACM 1961.
    """
    c = covariance.reshape(*covariance.shape[:-2], 9)
    mean = c[..., _DIAGONAL].sum(axis=-1) / 3.0
    a, b, d = (c[..., k] - mean for k in (0, 4, 8))
    xy, xz, yz = c[..., 1], c[..., 2], c[..., 5]
    xy2, xz2, yz2 = xy * xy, xz * xz, yz * yz
    scale = np.sqrt((a * a + b * b + d * d + 2.0 * (xy2 + xz2 + yz2)) / 6.0)
    determinant = a * (b * d - yz2) - d * xy2 - b * xz2 + 2.0 * xy * xz * yz
    cube = 2.0 * scale * scale * scale
    ratio = np.minimum(np.maximum(determinant / np.maximum(cube, np.finfo(np.float64).tiny), -1.0), 1.0)
    return np.asarray(np.sqrt(np.maximum(mean + 2.0 * scale * np.cos(np.arccos(ratio) / 3.0), 0.0)))
