"""CV, CA and CT motion, batched over tracks: transition, process noise, and the way to a common state.

    x(t + dt) = F_j(dt) x(t) + w,   w ~ N(0, Q_j(dt)),   j in (CV, CA, CT)           (14)-(17)

All three models share one layout, [p, v, a, Omega] (10), so that a bank of M tracks is one array (M, 3, 10) and a
prediction is one matrix product. A component that a model does not have stays exactly zero in its mean and
covariance: CV uses 6 of the 10, CA 9, CT 7. Units: m, s, rad; frame: local ENU.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from companion.config import TrackingConfig
from companion.types import FloatArray

ComplexArray = npt.NDArray[np.complex128]

CV, CA, CT = 0, 1, 2
MODELS = 3
P = slice(0, 3)  # position [m]
V = slice(3, 6)  # velocity [m/s]
A = slice(6, 9)  # acceleration [m/s^2], CA only
TURN = 9  # horizontal turn rate [rad/s], CT only
SIZE = 10

HAS = np.zeros((MODELS, SIZE))  # 1 where the model has the component
HAS[:, :6] = 1.0
HAS[CA, A] = 1.0
HAS[CT, TURN] = 1.0
HAS.flags.writeable = False
HAS_BLOCK = HAS[:, :, None] * HAS[:, None, :]  # (3, 10, 10)
HAS_BLOCK.flags.writeable = False

TURN_LIMIT_RAD_S = 10.0  # no obstacle of interest turns faster; keeps an absurd fix from winding CT up
_SERIES_BELOW_RAD = 3e-4
FEW = 4  # different times between tracks and an instant that are worth looking up one by one
_TINY = float(np.finfo(np.float64).tiny)
_ORDER = 5  # highest power of dt in F and Q
_EXPONENTS = np.arange(_ORDER + 1.0)
# (re, im) of two complex factors -> their 2x2 matrices [[re, -im], [im, re]], row-major
_AS_MATRIX = np.kron(np.eye(2), np.array([[1.0, 0.0, 0.0, 1.0], [0.0, -1.0, 1.0, 0.0]]))
_FLAT = MODELS * SIZE * SIZE
_NODES, _NODE_WEIGHTS = np.polynomial.legendre.leggauss(12)
# A Wiener turn rate is one integration away from the heading, two from the position; see `turn_noise`.
_RANK = np.array([0, 0, 0, 1, 1, 1, 3, 3, 3, 2])
_WEIGHT = np.array([[1 / 5, 1 / 4, 1 / 3, 0.0], [1 / 4, 1 / 3, 1 / 2, 0.0], [1 / 3, 1 / 2, 1.0, 0.0], [0.0] * 4])
TURN_WEIGHT = _WEIGHT[_RANK[:, None], _RANK[None, :]]  # (10, 10)
TURN_WEIGHT.flags.writeable = False


@dataclass(frozen=True, slots=True, eq=False)
class MotionModels:
    """Constants of the three models: F and Q as polynomials in dt, so that any dt of any track is one product."""

    polynomials: FloatArray  # (6, 600): coefficients of dt^n of F (CT's rotation left out) and Q (its turn noise too)
    turn_psd: float  # [rad^2/s^3]
    accel_decay_hz: float  # 1 / accel_memory_s in predictions, 0: an acceleration lasts
    jerk_psd: float  # [m^2/s^5]
    prediction_noise: FloatArray  # (3, 6): coefficient of dt^n of each model's predicted position variance


@dataclass(frozen=True, slots=True)
class Step:
    """What `propagate` needs of dt alone; L = 1 where all tracks share it, else L = M."""

    transition: FloatArray  # (L, 3, 10, 10) F, CT's rotation left out
    noise: FloatArray  # (L, 3, 10, 10) Q, the turn's left out; zero going back in time
    turn_noise: FloatArray  # (L, 10, 10) q dt W, see `turn_noise`


def build_models(config: TrackingConfig) -> MotionModels:
    """Coefficients from physical noise densities, or Q = q I per dt_s where ``q_paper`` > 0 (Remark 1)."""
    transition = np.zeros((_ORDER + 1, MODELS, SIZE, SIZE))
    noise = np.zeros_like(transition)
    prediction = np.zeros((MODELS, _ORDER + 1))
    for model in (CV, CA, CT):
        transition[0, model] = np.diag(HAS[model])
        for axis in range(3):
            p, v, a = axis, axis + 3, axis + 6
            if model != CT or axis == 2:
                transition[1, model, p, v] = 1.0
            if model == CA:
                transition[1, model, v, a] = 1.0
                transition[2, model, p, a] = 0.5
            else:
                density = config.accel_psd_cv if model == CV else config.accel_psd_ct
                _integrated_white(noise[:, model], (p, v), density)
        if model == CA:
            for axis in range(3):
                _integrated_white(noise[:, CA], (axis, axis + 3, axis + 6), config.jerk_psd_ca)
        prediction[model] = noise[:, model, 0, 0]
    turn_psd = config.turn_psd_ct
    if config.q_paper > 0.0:
        rate = config.q_paper / config.dt_s
        noise[:] = 0.0
        noise[1] = rate * np.eye(SIZE) * HAS[:, :, None]
        prediction[:] = 0.0
        prediction[:, 1] = rate
        prediction[:, 3] = rate / 3.0
        prediction[CA, 5] = rate / 20.0
        turn_psd = 0.0
    flat = (_ORDER + 1, _FLAT)
    return MotionModels(
        polynomials=np.hstack((transition.reshape(flat), noise.reshape(flat))),
        turn_psd=turn_psd,
        accel_decay_hz=1.0 / config.accel_memory_s if config.accel_memory_s > 0.0 else 0.0,
        jerk_psd=config.jerk_psd_ca,
        prediction_noise=prediction,
    )


def _integrated_white(noise: FloatArray, chain: tuple[int, ...], density: float) -> None:
    """Add Q of an integrator chain whose last member is driven by white noise.

    Q[i, j] = density dt^(n_i + n_j + 1) / ((n_i + n_j + 1) n_i! n_j!), n the integrations behind the driven one.
    """
    factorial = (1.0, 1.0, 2.0)
    depth = len(chain) - 1
    for i, row in enumerate(chain):
        for j, column in enumerate(chain):
            order = (depth - i) + (depth - j) + 1
            noise[order, row, column] += density / (order * factorial[depth - i] * factorial[depth - j])


def turn_terms(turn: FloatArray, dt: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """E = e^(i Omega dt), I = (E - 1) / (i Omega) and dI/dOmega = (dt E - I) / Omega, horizontal plane as complex.

    With w = v_x + i v_y a turning obstacle obeys p' = p + I w and v' = E w, which is (17). By the half angle
    h = Omega dt / 2 nothing is lost at small turn rates:

        I = dt sinc(h) e^(ih),   dI/dOmega = i dt^2 e^(ih) (sinc(h) / 2 + i k(h)),   k = (sinc(h) - cos(h)) / (2 h)

    with k = h / 6 below |h| = 3e-4. Shapes: ``turn`` and ``dt`` broadcast.
    """
    h = turn * (0.5 * dt) + _TINY  # never zero
    half = np.exp(1j * h)
    sinc = half.imag / h
    k = np.where(np.abs(h) < _SERIES_BELOW_RAD, h * (1.0 / 6.0), (sinc - half.real) / (h + h))
    moved = dt * half
    return half * half, moved * sinc, moved * (dt * (0.5j * sinc - k))


def propagate(
    x: FloatArray, covariance: FloatArray, dt: FloatArray, models: MotionModels
) -> tuple[FloatArray, FloatArray]:
    """x' = F x, P' = J P J^T + Q for every track and model; J = F except CT's column dF/dOmega x.

    Args:
        x: (M, 3, 10). covariance: (M, 3, 10, 10). dt: (M,) [s]; negative goes back in time, without noise.
    Returns:
        new (x, covariance), same shapes.
    """
    count = x.shape[0]
    step = _step(models, dt)
    jacobian = np.empty((count, MODELS, SIZE, SIZE))
    jacobian[:] = step.transition
    rotation, integral, slope = turn_terms(x[:, CT, TURN], dt)
    horizontal = jacobian[:, CT, :6].reshape(count, 2, 3, SIZE)[:, :, :2]  # rows p_x, p_y and v_x, v_y
    turned = np.empty((count, 2), dtype=np.complex128)
    turned[:, 0], turned[:, 1] = integral, rotation
    horizontal[..., 3:5] = (turned.view(np.float64) @ _AS_MATRIX).reshape(count, 2, 2, 2)
    moved = (jacobian @ x[..., None])[..., 0]
    w = horizontal_velocity(x)
    turned[:, 0], turned[:, 1] = slope * w, (1j * dt) * (rotation * w)
    horizontal[..., TURN] = turned.view(np.float64).reshape(count, 2, 2)
    # a contiguous transpose: matmul takes three times as long over a swapped one
    spread = (jacobian @ covariance) @ np.ascontiguousarray(jacobian.swapaxes(2, 3))
    spread += step.noise
    if models.turn_psd > 0.0:
        spread[:, CT] += turn_noise(jacobian[:, CT, :, TURN], step.turn_noise)
    return moved, spread


def shared(dt: FloatArray) -> float | None:
    """The one dt of all tracks, as in a frame of one source; None where they differ or there are no tracks."""
    values: list[float] = dt.tolist()
    return values[0] if values and values.count(values[0]) == len(values) else None


def _step(models: MotionModels, dt: FloatArray) -> Step:
    """Of every track, its rows equal to the bit whichever way they are made.

    Steady flight asks for the same few dt again and again: of one for all, or, where some were missed, of a few.
    """
    values: list[float] = dt.tolist()
    different = set(values)
    if len(different) == 1:
        return _shared_step(models, values[0])
    if not 0 < len(different) <= FEW:
        return _steps(models, dt)
    steps = [_shared_step(models, dt_s) for dt_s in values]
    return Step(
        np.concatenate([step.transition for step in steps]),
        np.concatenate([step.noise for step in steps]),
        np.concatenate([step.turn_noise for step in steps]),
    )


@lru_cache(maxsize=64)
def _shared_step(models: MotionModels, dt_s: float) -> Step:
    return _steps(models, np.array([dt_s]))


def _steps(models: MotionModels, dt: FloatArray) -> Step:
    both = ((dt[:, None] ** _EXPONENTS) @ models.polynomials).reshape(-1, 2, MODELS, SIZE, SIZE)
    if models.accel_decay_hz > 0.0:
        _let_accelerations_die(both[:, 0, CA], both[:, 1, CA], dt, models)
    both[:, 1][dt < 0.0] = 0.0
    return Step(both[:, 0], both[:, 1], (models.turn_psd * np.maximum(dt, 0.0))[:, None, None] * TURN_WEIGHT)


def _let_accelerations_die(transition: FloatArray, noise: FloatArray, dt: FloatArray, models: MotionModels) -> None:
    """Singer's CA in place of the plain one: a' = -alpha a + white jerk; writes F (L, 10, 10) and Q (L, 10, 10).

    Q = q integral_0^dt c c^T ds, c(s) = (phi, phi', phi'')(s) `acceleration_response`; twelve Gauss-Legendre nodes
    leave an error below 1e-12 of it up to alpha dt = 5. Source: Singer, IEEE TAES 1970.
    """
    at_end = acceleration_response(dt, models.accel_decay_hz)  # (3, L)
    inside = acceleration_response(0.5 * dt[:, None] * (_NODES + 1.0), models.accel_decay_hz)  # (3, L, 12)
    density = (0.5 * models.jerk_psd * dt)[:, None] * _NODE_WEIGHTS
    integral = np.einsum("iln,jln,ln->lij", inside, inside, density)
    for axis in range(3):
        p, v, a = axis, axis + 3, axis + 6
        chain = np.array((p, v, a))
        transition[:, chain, a] = at_end.T
        noise[:, chain[:, None], chain] = integral


def acceleration_response(t: FloatArray, decay_hz: float) -> FloatArray:
    """(phi, phi', phi''): how far, how fast and how strongly an acceleration of one that dies out acts after ``t``.

    phi = (alpha t - 1 + e^(-alpha t)) / alpha^2, t^2 / 2 where alpha is zero. Shapes: t (...) -> (3, ...).
    """
    x = decay_hz * t
    if decay_hz == 0.0:
        return np.stack((0.5 * t * t, t, np.ones_like(t)))
    lost = -np.expm1(-x)  # 1 - e^-x
    small = np.abs(x) < 1e-2
    series = 0.5 + x * (-1.0 / 6.0 + x * (1.0 / 24.0 + x * (-1.0 / 120.0 + x * (1.0 / 720.0 - x / 5040.0))))
    safe = np.where(small, 1.0, x)
    return np.stack((t * t * np.where(small, series, (safe - lost) / safe**2), lost / decay_hz, 1.0 - lost))


def horizontal_velocity(x: FloatArray) -> ComplexArray:
    """CT's v_x + i v_y, (M,)."""
    return np.asarray(x[:, CT, 3] + 1j * x[:, CT, 4])


def turn_noise(column: FloatArray, weight: FloatArray) -> FloatArray:
    """Q of a Wiener turn rate: Q = q dt (c c^T o W), c = d(state)/dOmega after dt, c_Omega = 1.

    W holds the ratios of the integrated noise to a constant error of the same size: 1/5 for position (v^2 q dt^5 / 20
    across the path), 1/3 for velocity (v^2 q dt^3 / 3), 1 for the rate. W is positive semidefinite, and so is Q
    (Schur product). Exact for a straight path, first order in Omega dt else.

    Shapes: column (M, 10), weight q dt W (M or 1, 10, 10) -> (M, 10, 10).
    """
    noise: FloatArray = column[:, :, None] * column[:, None, :]
    noise *= weight
    return noise


def to_common(x: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Every model in [p, v, a, Omega]: CV and CA as they are, CT with centripetal a = Omega e_z x v (18).

    The covariance goes along by the Jacobian, d a / d (v_x, v_y, Omega) = [[0, -Omega, -v_y], [Omega, 0, v_x]].
    Shapes as in `propagate`; new arrays.
    """
    common, spread = x.copy(), covariance.copy()
    turn, v_x, v_y = x[:, CT, TURN], x[:, CT, 3], x[:, CT, 4]
    slope = np.zeros((x.shape[0], 2, SIZE))
    slope[:, 0, 4], slope[:, 0, TURN] = -turn, -v_y
    slope[:, 1, 3], slope[:, 1, TURN] = turn, v_x
    common[:, CT, 6], common[:, CT, 7] = slope[:, 0, 4] * v_y, turn * v_x
    ct = spread[:, CT]
    rows = slope @ ct
    columns = rows.swapaxes(1, 2)
    ct[:, 6:8], ct[:, :, 6:8], ct[:, 6:8, 6:8] = rows, columns, slope @ columns
    return common, spread
