"""Predictions against carrying every model on, against sampled paths; the largest axis against LAPACK."""

import numpy as np
import pytest

from companion.config import TrackingConfig, parse_config
from companion.tracking.bank import birth, build_constants
from companion.tracking.imm import fuse, step
from companion.tracking.models import CA, CT, HAS, SIZE, propagate
from companion.tracking.predict import horizon, largest_sigma, predict_positions, velocity_ahead

LASTING = TrackingConfig(accel_memory_s=0.0)
PAPER = parse_config({"tracking": {"preset": "paper"}}).tracking


def square(entries):
    """(M, 6, K) xx, yy, zz, yz, xz, xy -> (M, K, 3, 3)."""
    return entries.swapaxes(1, 2)[..., [[0, 5, 4], [5, 1, 3], [4, 3, 2]]]


def flown_bank(config, count=5):
    rng = np.random.default_rng(8)
    constants = build_constants(config)
    noise = np.eye(3) * np.full((count, 1, 1), 0.0025)
    p, v = rng.normal(size=(count, 3)), rng.normal(size=(count, 3))
    bank = birth(p, noise, constants)
    for _ in range(30):
        v = v + rng.normal(scale=0.15, size=v.shape)
        p = p + 0.05 * v
        bank, _ = step(bank, np.full(count, 0.05), p + rng.normal(scale=0.05, size=p.shape), noise, constants)
    return bank, constants


def test_closed_forms_equal_carrying_every_model_on():
    """With a lasting acceleration each instant is one `propagate` and one `fuse`."""
    bank, constants = flown_bank(LASTING)
    tau = np.arange(23.0) * 0.05
    p, spread = predict_positions(bank.x, bank.covariance, bank.probabilities, horizon(tau, constants.models))
    spread = square(spread)
    for k, t in enumerate(tau):
        x, covariance = propagate(bank.x, bank.covariance, np.full(len(bank), t), constants.models)
        mean, expected = fuse(x, covariance, bank.probabilities)
        np.testing.assert_allclose(p[:, k], mean[:, :3], atol=1e-12)
        np.testing.assert_allclose(spread[:, k], expected[:, :3, :3], atol=1e-11)


def test_paper_preset_predicts_means_by_powers_of_the_transition():
    """(20): the mean of each model is (F_j)^i x, fused by the probabilities that the last update left."""
    bank, constants = flown_bank(PAPER)
    p, _ = predict_positions(
        bank.x, bank.covariance, bank.probabilities, horizon(np.arange(6.0) * 0.05, constants.models)
    )
    x, covariance = bank.x, bank.covariance
    for k in range(6):
        expected = (bank.probabilities[:, :, None] * x[..., :3]).sum(axis=1)
        np.testing.assert_allclose(p[:, k], expected, atol=1e-12)
        x, covariance = propagate(x, covariance, np.full(len(bank), 0.05), constants.models)


@pytest.mark.parametrize("memory_s", [0.0, 0.4])
def test_acceleration_noise_is_the_spread_of_sampled_paths(memory_s):
    """CA alone: a' = -a / T + white jerk, integrated in small steps for many paths."""
    q, runs, h = 20.0, 20_000, 0.005
    config = TrackingConfig(jerk_psd_ca=q, accel_memory_s=memory_s)
    models = build_constants(config).models
    rng = np.random.default_rng(6)
    x, covariance = np.zeros((1, 3, SIZE)), np.zeros((1, 3, SIZE, SIZE))
    x[0, CA, :9] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0]
    covariance[0, CA, 6, 6] = 0.25
    alone = np.array([[0.0, 1.0, 0.0]])
    p, spread = predict_positions(x, covariance, alone, horizon(np.array([0.0, 0.5, 1.0]), models))
    position, v, a = np.zeros(runs), np.ones(runs), 2.0 + rng.normal(scale=0.5, size=runs)
    decay = 0.0 if memory_s == 0.0 else 1.0 / memory_s
    for k in range(1, 201):
        before = a
        a = a + h * -decay * a + rng.normal(scale=np.sqrt(q * h), size=runs)
        position = position + h * v + 0.25 * h * h * (before + a)
        v = v + 0.5 * h * (before + a)
        if k in (100, 200):
            column = k // 100
            assert p[0, column, 0] == pytest.approx(position.mean(), abs=0.02)
            assert spread[0, 0, column] == pytest.approx(position.var(), rel=0.06)


def test_turning_spread_is_that_of_sampled_turns():
    config = TrackingConfig(accel_psd_ct=1e-12, turn_psd_ct=1e-12)
    models = build_constants(config).models
    rng = np.random.default_rng(7)
    x, covariance = np.zeros((1, 3, SIZE)), np.zeros((1, 3, SIZE, SIZE))
    x[0, CT] = [1.0, 2.0, 3.0, 1.5, -0.5, 0.3, 0.0, 0.0, 0.0, 1.2]
    root = rng.normal(scale=0.03, size=(SIZE, SIZE)) * HAS[CT][:, None]
    covariance[0, CT] = root @ root.T
    tau = np.array([0.0, 0.4, 1.0])
    alone = np.array([[0.0, 0.0, 1.0]])
    _, spread = predict_positions(x, covariance, alone, horizon(tau, models))
    spread = square(spread)
    sampled = np.repeat(x, 40_000, axis=0)
    sampled[:, CT] += rng.normal(size=(40_000, SIZE)) @ root.T
    for k, t in enumerate(tau):
        moved, _ = propagate(sampled, np.zeros((40_000, 3, SIZE, SIZE)), np.full(40_000, t), models)
        np.testing.assert_allclose(spread[0, k], np.cov(moved[:, CT, :3].T), atol=0.03 * np.trace(spread[0, k]))


def test_spread_of_means_is_part_of_the_covariance():
    """Two models that disagree by 2 m at equal weight: at least 1 m^2 along the line between them."""
    models = build_constants(TrackingConfig()).models
    x = np.zeros((1, 3, SIZE))
    x[0, 0, 0], x[0, 1, 0] = -1.0, 1.0
    _, spread = predict_positions(
        x, np.zeros((1, 3, SIZE, SIZE)), np.array([[0.5, 0.5, 0.0]]), horizon(np.zeros(1), models)
    )
    np.testing.assert_allclose(square(spread)[0, 0], np.diag([1.0, 0.0, 0.0]), atol=1e-15)


def test_largest_sigma_is_the_root_of_lapacks_largest_eigenvalue():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(500, 3, 3)) * 10.0 ** rng.uniform(-3, 1, size=(500, 1, 3))
    covariance = root @ root.swapaxes(1, 2)
    special = np.stack([np.zeros((3, 3)), np.eye(3), np.diag([4.0, 1.0, 1.0]), np.diag([4.0, 4.0, 0.0])])
    both = np.concatenate((covariance, special))
    entries = both[:, [0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1], None]
    np.testing.assert_allclose(
        largest_sigma(entries)[:, 0], np.sqrt(np.linalg.eigvalsh(both)[:, -1]), rtol=1e-7, atol=1e-12
    )


def test_no_tracks_predict_to_empty_arrays():
    constants = build_constants(TrackingConfig())
    bank = birth(np.zeros((0, 3)), np.zeros((0, 3, 3)), constants)
    p, spread = predict_positions(
        bank.x, bank.covariance, bank.probabilities, horizon(np.arange(5.0), constants.models)
    )
    assert p.shape == (0, 5, 3)
    assert largest_sigma(spread).shape == (0, 5)


@pytest.mark.parametrize("config", [LASTING, TrackingConfig()], ids=["lasting", "default"])
def test_velocity_and_acceleration_ahead_are_those_of_the_carried_models(config):
    bank, constants = flown_bank(config)
    dt = np.array([0.0, 0.02, 0.3, 0.7, -0.05])
    x, covariance = propagate(bank.x, bank.covariance, dt, constants.models)
    mean, _ = fuse(x, covariance, bank.probabilities)
    v, a = velocity_ahead(bank.x, bank.probabilities, dt, constants.models)
    np.testing.assert_allclose(v, mean[:, 3:6], atol=1e-12)
    np.testing.assert_allclose(a, mean[:, 6:9], atol=1e-12)
