"""The motion models against finite differences, closed forms and filterpy's noise matrices."""

import math

import numpy as np
import pytest

from companion.config import TrackingConfig, parse_config
from companion.tracking.models import CA, CT, CV, HAS, SIZE, TURN, build_models, propagate, to_common, turn_terms

MODELS = build_models(TrackingConfig(accel_memory_s=0.0))  # CA to the letter of (16)


def one(model: int, state: list[float]) -> np.ndarray:
    x = np.zeros((1, 3, SIZE))
    x[0, model] = np.array(state) * HAS[model]
    return x


def carried(x: np.ndarray, dt: float) -> np.ndarray:
    return propagate(x, np.zeros((1, 3, SIZE, SIZE)), np.array([dt]), MODELS)[0]


def test_constant_velocity_and_acceleration_follow_their_parabolas():
    state = [1.0, 2.0, 3.0, 0.5, -0.4, 0.3, 2.0, -1.0, 0.6, 0.0]
    p, v, a = np.array(state[:3]), np.array(state[3:6]), np.array(state[6:9])
    np.testing.assert_allclose(carried(one(CV, state), 0.3)[0, CV, :6], [*(p + 0.3 * v), *v], atol=1e-14)
    expected = [*(p + 0.3 * v + 0.045 * a), *(v + 0.3 * a), *a]
    np.testing.assert_allclose(carried(one(CA, state), 0.3)[0, CA, :9], expected, atol=1e-14)


@pytest.mark.parametrize("turn", [-2.0, -1e-4, 0.0, 1e-7, 5e-3, 0.7, 6.0])
def test_turn_stays_on_its_circle(turn):
    """(17) by integrating v' = Omega e_z x v in ten thousand midpoint steps."""
    x = one(CT, [1.0, -2.0, 0.5, 1.2, 0.4, -0.2, 0.0, 0.0, 0.0, turn])
    p, heading, h = np.array([1.0, -2.0]), math.atan2(0.4, 1.2), 0.8 / 10_000
    for k in range(10_000):
        angle = heading + turn * h * (k + 0.5)
        p += h * math.hypot(1.2, 0.4) * np.array([math.cos(angle), math.sin(angle)])
    moved = carried(x, 0.8)[0, CT]
    np.testing.assert_allclose(moved[:2], p, atol=1e-7)
    assert moved[2] == pytest.approx(0.5 - 0.16)
    assert math.hypot(moved[3], moved[4]) == pytest.approx(math.hypot(1.2, 0.4))


@pytest.mark.parametrize("turn", [-3.0, -0.02, 1e-5, 0.0, 0.019, 0.021, 1.0])
@pytest.mark.parametrize("dt", [0.01, 0.05, 0.7])
def test_ct_jacobian_is_the_derivative_of_the_transition(turn, dt):
    state = np.array([0.3, 0.1, -0.2, 1.5, -0.8, 0.2, 0.0, 0.0, 0.0, turn])
    covariance = np.zeros((1, 3, SIZE, SIZE))
    jacobian = np.zeros((SIZE, SIZE))
    quiet = build_models(TrackingConfig(accel_psd_ct=1e-30, turn_psd_ct=1e-30))
    for k in range(SIZE):
        if not HAS[CT, k]:
            continue
        h = 1e-5
        ahead, behind = state.copy(), state.copy()
        ahead[k] += h
        behind[k] -= h
        jacobian[:, k] = (carried(one(CT, ahead), dt)[0, CT] - carried(one(CT, behind), dt)[0, CT]) / (2.0 * h)
        covariance[0, CT, k, k] = 1.0 + k
    _, spread = propagate(one(CT, state), covariance, np.array([dt]), quiet)
    np.testing.assert_allclose(spread[0, CT], jacobian @ covariance[0, CT] @ jacobian.T, atol=2e-8)


@pytest.mark.parametrize("turn", [-9.0, -0.0201, 0.0, 1e-9, 1e-3, 0.01999, 0.02001, 0.5, 9.0])
def test_turn_terms_are_their_integrals(turn):
    """I = integral of e^(i Omega s) and dI/dOmega = integral of i s e^(i Omega s), by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    for dt in (0.05, 1.0):
        s = 0.5 * dt * (nodes + 1.0)
        wave = np.exp(1j * turn * s)
        rotation, integral, slope = turn_terms(np.array([turn]), np.array([dt]))
        assert rotation[0] == pytest.approx(complex(math.cos(turn * dt), math.sin(turn * dt)), abs=1e-15)
        assert integral[0] == pytest.approx(0.5 * dt * (weights @ wave), abs=1e-13)
        assert slope[0] == pytest.approx(0.5 * dt * (weights @ (1j * s * wave)), abs=1e-12)


def test_white_noise_matrices_are_filterpys():
    from filterpy.common import Q_continuous_white_noise

    config = TrackingConfig(accel_memory_s=0.0)
    dt = np.array([0.03, 0.2])
    _, noise = propagate(np.zeros((2, 3, SIZE)), np.zeros((2, 3, SIZE, SIZE)), dt, MODELS)
    for row, step in enumerate(dt):
        cv = Q_continuous_white_noise(2, step, config.accel_psd_cv, block_size=3, order_by_dim=False)
        ca = Q_continuous_white_noise(3, step, config.jerk_psd_ca, block_size=3, order_by_dim=False)
        np.testing.assert_allclose(noise[row, CV, :6, :6], cv, atol=1e-15)
        np.testing.assert_allclose(noise[row, CA, :9, :9], ca, atol=1e-13)


@pytest.mark.parametrize("memory_s", [0.2, 1.0, 5.0])
@pytest.mark.parametrize("dt", [0.004, 0.05, 0.5, 1.0])
def test_dying_accelerations_are_singers_by_the_matrix_exponential(memory_s, dt):
    """F and Q of p' = v, v' = a, a' = -a / memory + white jerk by van Loan's method, each axis alike."""
    from scipy.linalg import expm

    config = TrackingConfig(accel_memory_s=memory_s)
    drift = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / memory_s]])
    block = np.block([[-drift, np.diag([0.0, 0.0, config.jerk_psd_ca])], [np.zeros((3, 3)), drift.T]])
    exponential = expm(block * dt)
    f = exponential[3:, 3:].T
    models = build_models(config)
    state = np.array([1.0, 2.0, 3.0, 0.5, -0.4, 0.3, 2.0, -1.0, 0.6, 0.0])
    moved, noise = propagate(one(CA, state), np.zeros((1, 3, SIZE, SIZE)), np.array([dt]), models)
    np.testing.assert_allclose(moved[0, CA, :9], np.kron(f, np.eye(3)) @ state[:9], rtol=1e-11)
    q = np.kron(f @ exponential[:3, 3:], np.eye(3))
    np.testing.assert_allclose(noise[0, CA, :9, :9], q, rtol=1e-11, atol=1e-11 * q.max())


def test_a_memory_without_end_is_the_plain_acceleration():
    far, plain = build_models(TrackingConfig(accel_memory_s=5.0)), MODELS
    state, dt = [0.0] * 6 + [1.0, 0.0, 0.0, 0.0], np.array([1e-3])
    nearly = propagate(one(CA, state), np.zeros((1, 3, SIZE, SIZE)), dt, far)[0][0, CA]
    exact = propagate(one(CA, state), np.zeros((1, 3, SIZE, SIZE)), dt, plain)[0][0, CA]
    np.testing.assert_allclose(nearly, exact, rtol=3e-4, atol=1e-15)


def test_turn_noise_is_the_spread_of_wandering_turn_rates():
    """Monte Carlo over Wiener turn rates: position across the path v^2 q t^5 / 20, heading v^2 q t^3 / 3, rate q t."""
    q, v, t, steps, runs = 0.3, 2.0, 0.5, 200, 20_000
    config = TrackingConfig(accel_psd_ct=1e-12, turn_psd_ct=q)
    x = one(CT, [0.0, 0.0, 0.0, v, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    _, spread = propagate(x, np.zeros((1, 3, SIZE, SIZE)), np.array([t]), build_models(config))
    rng = np.random.default_rng(4)
    h = t / steps
    turn = np.cumsum(rng.normal(scale=math.sqrt(q * h), size=(runs, steps)), axis=1)
    heading = np.cumsum(turn, axis=1) * h
    across = np.cumsum(v * np.sin(heading), axis=1)[:, -1] * h
    sampled = np.cov(np.stack((across, v * np.sin(heading[:, -1]), turn[:, -1])))
    np.testing.assert_allclose(spread[0, CT][np.ix_([1, 4, 9], [1, 4, 9])], sampled, rtol=0.08)


def test_paper_preset_adds_q_times_identity_per_step():
    config = parse_config({"tracking": {"preset": "paper"}}).tracking
    _, noise = propagate(
        np.zeros((1, 3, SIZE)), np.zeros((1, 3, SIZE, SIZE)), np.array([config.dt_s]), build_models(config)
    )
    for model in (CV, CA, CT):
        np.testing.assert_allclose(noise[0, model], 0.05 * np.diag(HAS[model]), atol=1e-15)


def test_going_back_in_time_undoes_the_mean_and_adds_no_noise():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(4, 3, SIZE)) * HAS
    zero = np.zeros((4, 3, SIZE, SIZE))
    there, _ = propagate(x, zero, np.full(4, 0.2), MODELS)
    back, spread = propagate(there, zero, np.full(4, -0.2), MODELS)
    np.testing.assert_allclose(back, x, atol=1e-13)
    assert not spread.any()


def test_common_state_of_a_turn_has_the_centripetal_acceleration():
    """a = dv/dt of the turn itself, and the covariance goes by the derivative of that."""
    state = np.array([0.0, 0.0, 0.0, 1.5, -0.7, 0.2, 0.0, 0.0, 0.0, 0.9])
    x = one(CT, state)
    h = 1e-6
    derivative = (carried(x, h)[0, CT, 3:6] - carried(x, -h)[0, CT, 3:6]) / (2.0 * h)
    covariance = np.zeros((1, 3, SIZE, SIZE))
    covariance[0, CT] = np.diag(HAS[CT] * 0.01)
    common, spread = to_common(x, covariance)
    np.testing.assert_allclose(common[0, CT, 6:9], derivative, atol=1e-8)
    rng = np.random.default_rng(0)
    samples = state + rng.normal(scale=0.1, size=(200_000, SIZE)) * HAS[CT]
    a = np.stack((-samples[:, TURN] * samples[:, 4], samples[:, TURN] * samples[:, 3]), axis=1)
    np.testing.assert_allclose(spread[0, CT, 6:8, 6:8], np.cov(a.T), atol=6e-4)
    assert np.array_equal(common[:, :CT], x[:, :CT])
