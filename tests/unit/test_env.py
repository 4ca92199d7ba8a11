"""The training environment: reward terms by hand, dynamics against an integrator of others, the views of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from policies.env import PRESETS, EnvConfig, PointMassBatch, advance, closest_on_segment, reward_terms

PLAIN = EnvConfig(lag_s=0.0)


def one(config: EnvConfig, p: list[float], v: list[float], target: list[float]) -> PointMassBatch:
    batch = PointMassBatch(config, 1, np.random.default_rng(0))
    batch.place(np.array([p]), np.array([v]), np.array([target]))
    return batch


def test_reward_terms_by_hand() -> None:
    config = EnvConfig(terminal_speed_cost=12.0, speed_limit_m_s=5.0, overspeed_cost=40.0)
    terms = reward_terms(
        config,
        distance_before_m=np.array([2.0, 0.3, 9.0]),
        distance_m=np.array([1.75, 0.05, 9.2]),
        reached=np.array([False, True, False]),
        outside=np.array([False, False, True]),
        arrival_speed_m_s=np.array([3.0, 0.5, 3.0]),
        speed_m_s=np.array([3.0, 0.5, 5.5]),
    )
    np.testing.assert_allclose(terms.target, [0.0, 100.0, 0.0])  # (10)
    np.testing.assert_allclose(terms.shaping, [0.25, 0.25, -0.2])  # (11), M_ds = 1
    np.testing.assert_allclose(terms.boundary, [0.0, 0.0, -10.0])  # (12)
    np.testing.assert_allclose(terms.time, [-0.005] * 3)  # (13): 0.1 x 0.05 s
    np.testing.assert_allclose(terms.terminal_speed, [0.0, -6.0, 0.0])
    np.testing.assert_allclose(terms.overspeed, [0.0, 0.0, -1.0])  # 40 x 0.05 s x 0.5 m/s
    np.testing.assert_allclose(terms.total, [0.245, 94.245, -11.205])


def test_the_papers_preset_has_its_reward_alone() -> None:
    paper = PRESETS["paper"]
    assert (paper.m_tr, paper.m_ds, paper.m_bp, paper.m_tp) == (100.0, 1.0, 10.0, 0.1)  # Table 1
    assert (paper.dt_s, paper.arena_m, paper.threshold_m) == (0.05, 10.0, 0.1)  # Table 2
    assert (paper.k_ma_m_s2, paper.terminal_speed_cost, paper.overspeed_cost) == (1.0, 0.0, 0.0)


@pytest.mark.parametrize("lag_s", [0.03, 0.1, 0.5])
def test_the_step_solves_the_differential_equation(lag_s: float) -> None:
    rng = np.random.default_rng(1)
    p, v, a, command = rng.normal(size=(4, 1, 3)) * 3.0
    solved = solve_ivp(
        lambda _, y: np.concatenate([y[3:6], y[6:9], (command[0] - y[6:9]) / lag_s]),
        (0.0, 0.05),
        np.concatenate([p[0], v[0], a[0]]),
        rtol=1e-11,
        atol=1e-12,
    )
    got = np.concatenate(advance(p, v, a, command, np.array([[lag_s]]), 0.05), axis=1)[0]
    np.testing.assert_allclose(got, solved.y[:, -1], atol=1e-9)


def test_without_lag_it_is_a_double_integrator() -> None:
    batch = one(PLAIN, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [5.0, 0.0, 0.0])
    step = batch.step(np.array([[0.0, 1.0, -2.0]]))  # clipped to -1
    np.testing.assert_allclose(batch.v_enu, [[1.0, 0.15, -0.15]])
    np.testing.assert_allclose(batch.p_enu, [[0.05, 0.00375, -0.00375]])
    np.testing.assert_allclose(step.observation[0, 3:], [4.95, -0.00375, 0.00375])


def test_dead_time_delays_a_command_by_whole_steps() -> None:
    batch = one(replace(PLAIN, dead_steps=2), [0.0] * 3, [0.0] * 3, [5.0, 0.0, 0.0])
    speeds = []
    for _ in range(4):
        batch.step(np.array([[1.0, 0.0, 0.0]]))
        speeds.append(batch.v_enu[0, 0])
    np.testing.assert_allclose(speeds, [0.0, 0.0, 0.15, 0.30], atol=1e-12)


def test_passing_between_two_samples_reaches_the_target() -> None:
    # 6 m/s covers 0.3 m a step: the target lies 0.05 m beside the middle of it
    start, v, target = [0.0, 0.0, 0.0], [6.0, 0.0, 0.0], [0.15, 0.05, 0.0]
    still = np.zeros((1, 3))
    on_path = one(PLAIN, start, v, target).step(still)
    at_sample = one(replace(PLAIN, segment_test=False), start, v, target).step(still)
    assert on_path.reached[0]
    assert on_path.terminated[0]
    assert not on_path.truncated[0]
    assert not at_sample.reached[0]


def test_closest_point_of_a_segment_by_hand() -> None:
    start, end = np.zeros((3, 3)), np.array([[2.0, 0.0, 0.0]] * 3)
    points = np.array([[1.0, 3.0, 0.0], [-4.0, 3.0, 0.0], [2.0, 0.0, 1.0]])
    distance, fraction = closest_on_segment(start, end, points)
    np.testing.assert_allclose(distance, [3.0, 5.0, 1.0])
    np.testing.assert_allclose(fraction, [0.5, 0.0, 1.0])


def test_leaving_the_arena_terminates_and_running_out_of_steps_truncates() -> None:
    outside = one(PLAIN, [9.99, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]).step(np.zeros((1, 3)))
    assert outside.terminated[0]
    assert not outside.truncated[0]
    assert outside.terms.boundary[0] == -10.0
    batch = one(replace(PLAIN, max_steps=2), [0.0] * 3, [0.0] * 3, [5.0, 0.0, 0.0])
    first, second = (batch.step(np.zeros((1, 3))) for _ in range(2))
    assert not first.truncated[0]
    assert second.truncated[0]
    assert not second.terminated[0]


def test_reaching_in_the_last_step_is_no_truncation() -> None:
    step = one(replace(PLAIN, max_steps=1), [0.0] * 3, [1.0, 0.0, 0.0], [0.1, 0.0, 0.0]).step(np.zeros((1, 3)))
    assert step.terminated[0]
    assert not step.truncated[0]


def test_starts_lie_in_the_arena_and_can_brake_inside() -> None:
    config = PRESETS["default"]
    batch = PointMassBatch(config, 4000, np.random.default_rng(2))
    assert np.abs(batch.p_enu).max() <= config.arena_m
    assert np.abs(batch.target_enu).max() <= config.arena_m
    assert np.linalg.norm(batch.v_enu, axis=1).max() <= config.speed_limit_m_s
    ends = batch.p_enu + np.sign(batch.v_enu) * batch.v_enu**2 / (1.6 * config.k_ma_m_s2)
    assert np.abs(ends).max() <= config.arena_m + 1e-9


def test_randomisation_is_per_episode_and_noise_per_step() -> None:
    config = replace(EnvConfig(), noise_p_std_m=0.2, bias_std_m_s2=0.5)
    batch = PointMassBatch(config, 3000, np.random.default_rng(3))
    before = batch.v_enu.copy()
    batch.p_enu[:] = 0.0
    batch.target_enu[:] = 0.0
    step = batch.step(np.zeros((3000, 3)))
    assert np.std(step.observation[:, 3:] + batch.p_enu) == pytest.approx(0.2, rel=0.03)
    np.testing.assert_allclose(step.observation[:, :3], batch.v_enu)
    first = batch.v_enu - before
    # with lag 0.1 s a bias b gives b (t - lag (1 - e^(-t/lag))) after t = 0.05 s
    assert np.std(first) == pytest.approx(0.5 * (0.05 - 0.1 * (1 - np.exp(-0.5))), rel=0.03)


def test_a_reset_touches_the_masked_ones_only() -> None:
    batch = PointMassBatch(PRESETS["default"], 5, np.random.default_rng(4))
    batch.step(np.ones((5, 3)))
    before = batch.p_enu.copy()
    mask = np.array([False, True, False, False, True])
    batch.reset(mask)
    np.testing.assert_array_equal(batch.p_enu[~mask], before[~mask])
    assert (batch.p_enu[mask] != before[mask]).all()
    np.testing.assert_array_equal(batch.steps, [1, 0, 1, 1, 0])


@pytest.mark.parametrize(
    ("field", "value"), [("dt_s", 0.0), ("lag_s", -0.1), ("k_ma_m_s2", float("nan")), ("gain_loss", float("inf"))]
)
def test_impossible_configurations_are_refused_by_name(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"env.{field}: expected a finite"):
        EnvConfig(**{field: value})


def test_a_lag_cannot_spread_below_zero() -> None:
    with pytest.raises(ValueError, match=r"env.lag_spread_s: expected at most lag_s"):
        EnvConfig(lag_s=0.05, lag_spread_s=0.06)
