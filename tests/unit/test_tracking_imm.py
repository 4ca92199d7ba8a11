"""The filter bank: against filterpy, against a single Kalman filter, and its invariants."""

import dataclasses

import numpy as np
import pytest

from companion.config import TrackingConfig, parse_config
from companion.tracking.bank import birth, build_constants, join, put
from companion.tracking.imm import correct, fuse, markov, mix, step
from companion.tracking.models import CA, CT, CV, HAS_BLOCK, SIZE, TURN
from companion.tracking.reference import ReferenceImm

PAPER = parse_config({"tracking": {"preset": "paper"}}).tracking
WINDOWED = TrackingConfig(likelihood_window=3, turn_rate="window", turn_window=5)
FULL = TrackingConfig(likelihood_window=2)


def wander(rng, count, steps):
    """Measurements of ``count`` obstacles that turn, accelerate and stop at random, with noise."""
    v = np.cumsum(rng.normal(scale=0.2, size=(steps, count, 3)), axis=0) + rng.normal(size=(count, 3))
    return np.cumsum(v, axis=0) * 0.05 + rng.normal(scale=0.05, size=(steps, count, 3)), v


@pytest.mark.parametrize(
    "config", [TrackingConfig(), FULL, PAPER, WINDOWED], ids=["default", "mean", "paper", "window"]
)
def test_bank_equals_filterpy_over_random_trajectories(config):
    """Every state, covariance, probability and prediction, to 1e-9, with irregular dt and mixed measurements."""
    rng = np.random.default_rng(11)
    constants = build_constants(config)
    p, v = wander(rng, 4, 60)
    noise = np.stack([np.diag(rng.uniform(0.001, 0.05, size=6)) for _ in range(4)])
    bank = birth(p[0], noise[:, :3, :3], constants)
    references = [ReferenceImm(config, p[0, m], noise[m, :3, :3]) for m in range(4)]
    for k in range(1, 60):
        dt = rng.uniform(0.005, 0.3, size=4) if k % 3 else np.full(4, 0.05)
        d = 6 if k % 10 in (4, 5) else 3
        z = np.concatenate((p[k], v[k]), axis=1)[:, :d]
        bank, _ = step(bank, dt, z, noise[:, :d, :d], constants)
        mean, spread = fuse(bank.x, bank.covariance, bank.probabilities)
        for m, reference in enumerate(references):
            reference.update(z[m], noise[m, :d, :d], float(dt[m]))
            expected, covariance = reference.fused()
            np.testing.assert_allclose(bank.probabilities[m], reference.probabilities, atol=1e-9)
            np.testing.assert_allclose(mean[m], expected, atol=1e-9, rtol=1e-9)
            np.testing.assert_allclose(spread[m], covariance, atol=1e-9, rtol=1e-9)


def test_markov_matrix_rows_sum_to_one_and_compose():
    constants = build_constants(PAPER)
    pi = markov(np.array([0.05, 0.1, 0.013, 0.0, 30.0]), constants).swapaxes(1, 2)  # [from, to]
    np.testing.assert_allclose(pi.sum(axis=2), 1.0, atol=1e-15)
    assert (pi >= 0.0).all()
    step_matrix = np.full((3, 3), 0.2) + 0.4 * np.eye(3)
    np.testing.assert_allclose(pi[0], step_matrix, atol=1e-15)
    np.testing.assert_allclose(pi[1], step_matrix @ step_matrix, atol=1e-15)
    np.testing.assert_allclose(pi[3], np.eye(3), atol=1e-15)


def test_certain_model_is_a_single_kalman_filter():
    """With CV certain and no switching the bank is filterpy's Kalman filter of CV alone."""
    from filterpy.common import Q_continuous_white_noise
    from filterpy.kalman import KalmanFilter

    config = TrackingConfig(stay_probability=(1.0 - 1e-15,) * 3)
    constants = build_constants(config)
    rng = np.random.default_rng(2)
    p, _ = wander(rng, 1, 40)
    noise = np.eye(3)[None] * 0.0025
    bank = birth(p[0], noise, constants)
    single = KalmanFilter(dim_x=6, dim_z=3)
    single.x[:3, 0] = p[0, 0]
    single.P = np.diag([0.0025] * 3 + [config.birth_speed_m_s**2] * 3)
    for k in range(1, 40):
        bank = dataclasses.replace(bank, probabilities=np.array([[1.0, 0.0, 0.0]]))
        bank, _ = step(bank, np.array([0.05]), p[k], noise, constants)
        q = Q_continuous_white_noise(2, 0.05, config.accel_psd_cv, block_size=3, order_by_dim=False)
        f = np.eye(6) + 0.05 * np.eye(6, k=3)
        single.predict(F=f, Q=q)
        single.update(p[k, 0][:, None], R=noise[0], H=np.eye(3, 6))
        np.testing.assert_allclose(bank.x[0, CV, :6], single.x[:, 0], atol=1e-9)
        np.testing.assert_allclose(bank.covariance[0, CV, :6, :6], single.P, atol=1e-9)


def test_agreeing_models_mix_to_themselves():
    """Same [p, v], no acceleration and no turn in every model: mixing changes no mean, whatever the probabilities."""
    constants = build_constants(TrackingConfig())
    bank = birth(np.array([[1.0, 2.0, 3.0, 0.4, 0.5, 0.6]]), np.eye(6)[None] * 0.01, constants)
    bank = dataclasses.replace(bank, probabilities=np.array([[0.5, 0.2, 0.3]]))
    x, covariance, prior = mix(bank, np.array([0.05]), constants)
    np.testing.assert_allclose(x, bank.x, atol=1e-15)
    np.testing.assert_allclose(covariance[..., :6, :6], bank.covariance[..., :6, :6], atol=1e-15)
    assert prior.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("config", [TrackingConfig(), PAPER], ids=["default", "paper"])
@pytest.mark.parametrize(
    ("count", "updates"), [(10, 1500), pytest.param(100, 10_000, marks=pytest.mark.slow)], ids=["short", "million"]
)
def test_many_updates_keep_every_covariance_symmetric_and_positive(config, count, updates):
    """With pauses, perfect fixes and far-off ones among them."""
    rng = np.random.default_rng(5)
    constants = build_constants(config)
    bank = birth(rng.normal(size=(count, 3)), np.eye(3) * np.full((count, 1, 1), 0.01), constants)
    p, v = bank.x[:, CV, :3].copy(), rng.normal(size=(count, 3))
    for k in range(updates):
        v += rng.normal(scale=0.1, size=v.shape) - 0.02 * v
        p = p + 0.05 * v
        variance = 10.0 ** rng.uniform(-6.0, 0.0, size=count)
        z = p + rng.normal(size=p.shape) * np.sqrt(variance)[:, None]
        if k % 50 == 0:
            z += rng.normal(scale=3.0, size=z.shape)
        dt = np.full(count, 0.05) if k % 7 else 10.0 ** rng.uniform(-4.0, 0.0, size=count)
        bank, _ = step(bank, dt, z, variance[:, None, None] * np.eye(3), constants)
        if k % 100 == 0 or k == updates - 1:
            assert np.isfinite(bank.x).all()
            assert np.array_equal(bank.covariance, bank.covariance.swapaxes(2, 3))
            padded = bank.covariance + np.where(HAS_BLOCK, 0.0, np.eye(SIZE))
            assert np.linalg.eigvalsh(padded).min() > 0.0
            assert not (bank.covariance * (1.0 - HAS_BLOCK)).any()
            np.testing.assert_allclose(bank.probabilities.sum(axis=1), 1.0, atol=1e-12)


def test_perfect_and_absurd_measurements_leave_numbers():
    constants = build_constants(TrackingConfig())
    bank = birth(np.zeros((3, 3)), np.eye(3) * np.full((3, 1, 1), 1e-6), constants)
    z = np.array([[0.0, 0.0, 0.0], [1e4, -1e4, 1e4], [1e-9, 0.0, 0.0]])
    for _ in range(50):
        bank, nis = step(bank, np.full(3, 0.05), z, np.eye(3) * np.full((3, 1, 1), 1e-6), constants)
        z[1] *= -1.0
        assert np.isfinite(bank.x).all()
        assert np.isfinite(bank.probabilities).all()
        assert np.isfinite(nis).all()
        np.testing.assert_allclose(bank.probabilities.sum(axis=1), 1.0, atol=1e-12)
    assert np.abs(bank.x[:, CT, TURN]).max() <= 10.0


def test_update_with_velocity_is_the_textbook_formula():
    """x + P H^T S^-1 (z - H x) and the log density of scipy's normal distribution."""
    from scipy.stats import multivariate_normal

    rng = np.random.default_rng(3)
    x = rng.normal(size=(1, 3, SIZE))
    root = rng.normal(size=(1, 3, SIZE, SIZE))
    covariance = root @ root.swapaxes(2, 3) + np.eye(SIZE)
    for d in (3, 6):
        z, noise = rng.normal(size=(1, d)), np.eye(d)[None] * 0.3
        h = np.eye(d, SIZE)
        updated, spread, log_likelihood, nis = correct(x, covariance, z, noise)
        for model in (CV, CA, CT):
            p, s = covariance[0, model], h @ covariance[0, model] @ h.T + noise[0]
            gain = p @ h.T @ np.linalg.inv(s)
            joseph = (np.eye(SIZE) - gain @ h) @ p @ (np.eye(SIZE) - gain @ h).T + gain @ noise[0] @ gain.T
            innovation = z[0] - h @ x[0, model]
            np.testing.assert_allclose(updated[0, model], x[0, model] + gain @ innovation, atol=1e-10)
            np.testing.assert_allclose(spread[0, model], joseph, atol=1e-10)
            assert log_likelihood[0, model] == pytest.approx(multivariate_normal(cov=s).logpdf(innovation))
            assert nis[0, model] == pytest.approx(innovation @ np.linalg.solve(s, innovation))


def test_foreign_track_never_makes_ours_surer_than_itself():
    """The same already filtered fix, again and again: its errors are one error, and no number of them averages out."""
    constants = build_constants(TrackingConfig())
    noise = np.diag([0.01] * 3 + [0.04] * 3)[None]
    z = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    bank = birth(z, noise, constants)
    independent = bank
    for k in range(1, 200):
        z = np.array([[0.05 * k, 0.0, 0.0, 1.0, 0.0, 0.0]])
        bank, _ = step(bank, np.array([0.05]), z, noise, constants, foreign=True)
        independent, _ = step(independent, np.array([0.05]), z, noise, constants)
    _, spread = fuse(bank.x, bank.covariance, bank.probabilities)
    _, optimistic = fuse(independent.x, independent.covariance, independent.probabilities)
    assert np.diagonal(spread[0, :3, :3]).min() > 0.0075
    assert np.diagonal(optimistic[0, :3, :3]).max() < 0.003
    assert np.diagonal(spread[0]).max() <= 100.0**2


def test_join_and_put_move_whole_tracks():
    constants = build_constants(FULL)
    rng = np.random.default_rng(9)
    noise = np.eye(3) * np.full((3, 1, 1), 0.01)
    first, second = birth(rng.normal(size=(3, 3)), noise, constants), birth(rng.normal(size=(3, 3)), noise, constants)
    both = join(first, second)
    assert len(both) == 6
    rows = np.array([4, 1])
    changed = put(both, rows, first.take(np.array([0, 2])))
    for part, before, source in zip(changed.parts(), both.parts(), first.parts(), strict=True):
        assert np.array_equal(part[rows], source[[0, 2]])
        assert np.array_equal(part[[0, 2, 3, 5]], before[[0, 2, 3, 5]])
