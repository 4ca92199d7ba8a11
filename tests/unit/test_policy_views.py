"""The environment as gymnasium and stable-baselines3 want it."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from policies.env import PRESETS, PointMassBatch
from policies.views import PointMassGym, PointMassVecEnv


def test_gymnasiums_checker_accepts_it() -> None:
    env = PointMassGym(PRESETS["default"])
    with pytest.warns(UserWarning, match=r"Box|spec") as caught:  # it remarks on unbounded boxes and a missing spec
        check_env(env, skip_render_check=True)
    for warning in caught:
        assert "infinity" in str(warning.message) or "env.spec" in str(warning.message)


def test_stepping_before_a_reset_is_refused() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded):
        PointMassGym(PRESETS["default"]).step(np.zeros(3, dtype=np.float32))


def test_one_instance_is_the_batch_of_one() -> None:
    env = PointMassGym(PRESETS["default"])
    observation, _ = env.reset(seed=5)
    batch = PointMassBatch(PRESETS["default"], 1, gymnasium.utils.seeding.np_random(5)[0])
    mask = np.ones(1, dtype=bool)
    np.testing.assert_array_equal(observation, batch.reset(mask)[0].astype(np.float32))
    action = np.array([0.3, -1.0, 0.2], dtype=np.float32)
    observation, reward, terminated, truncated, info = env.step(action)
    step = batch.step(action[None])
    np.testing.assert_array_equal(observation, step.observation[0].astype(np.float32))
    assert (reward, terminated, truncated) == (step.reward[0], step.terminated[0], step.truncated[0])
    assert sum(info["terms"].values()) == pytest.approx(reward)


def test_the_vector_view_tells_truncation_and_keeps_the_last_observation() -> None:
    config = replace(PRESETS["default"], max_steps=3, start_speed_m_s=0.0, near_share=0.0)
    env = PointMassVecEnv(config, 64, seed=1)
    first = env.reset()
    for _ in range(2):
        _, _, done, _ = env.step(np.zeros((64, 3), dtype=np.float32))
        assert not done.any()
    held = env.batch.target_enu - env.batch.p_enu
    observation, reward, done, infos = env.step(np.zeros((64, 3), dtype=np.float32))
    assert done.all()
    assert all(info["TimeLimit.truncated"] and not info["is_success"] for info in infos)
    last = np.array([info["terminal_observation"] for info in infos])
    np.testing.assert_allclose(last[:, 3:], held, atol=0.05)  # it hardly moved: not the state after the reset
    assert np.abs(observation[:, 3:] - first[:, 3:]).max() > 1.0
    assert infos[0]["episode"]["l"] == 3
    assert reward.dtype == np.float32


def test_the_reward_scale_changes_rewards_and_not_the_returns_shown() -> None:
    config = replace(PRESETS["default"], max_steps=2)
    rewards, returns = [], []
    for scale in (1.0, 0.05):
        env = PointMassVecEnv(config, 8, seed=2, reward_scale=scale)
        env.reset()
        _, first, _, _ = env.step(np.ones((8, 3), dtype=np.float32))
        _, _, _, infos = env.step(np.ones((8, 3), dtype=np.float32))
        rewards.append(first)
        returns.append([info["episode"]["r"] for info in infos])
    np.testing.assert_allclose(rewards[1], 0.05 * rewards[0], rtol=1e-6)
    assert returns[0] == returns[1]
