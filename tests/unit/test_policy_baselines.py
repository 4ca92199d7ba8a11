"""The paper's baselines: PID by hand, obstacles that cross and touch, and a network that knows a cube's symmetries."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from companion.errors import ArtifactError
from policies.baselines.pid import PositionPid
from policies.baselines.pure_rl import (
    CASES,
    REACH_M,
    SCALE,
    Case,
    CaseBatch,
    EndToEnd,
    build,
    restore,
    save,
    train_case,
)
from policies.env import PRESETS, EnvConfig
from policies.train import CurvePoint, TrainConfig
from policies.views import BatchVecEnv

EASY = EnvConfig(lag_s=0.0)
SMALL = TrainConfig(seed=3, steps=4096, vehicles=64, rollout=32, batch=512, epochs=2, actor_width=8, critic_width=8)


def test_pid_by_hand() -> None:
    pid = PositionPid(0.05)
    v, e = np.array([0.5, 0.0, -1.0]), np.array([2.0, -1.0, 0.4])
    forces = [  # [N]: gains of Table 1 over error, its integral after one step, and speed
        0.4 * 2.0 + 0.05 * (2.0 * 0.05) - 0.2 * 0.5,
        0.4 * -1.0 + 0.05 * (-1.0 * 0.05),
        1.25 * 0.4 + 0.05 * (0.4 * 0.05) - 0.5 * -1.0,
    ]
    assert pid.act(v, e) == pytest.approx(np.array(forces) / 0.027)


def test_the_integral_of_pid_is_bounded() -> None:
    pid = PositionPid(0.05)
    e = np.array([10.0, -10.0, 10.0])
    a = [pid.act(np.zeros(3), e) for _ in range(100)]
    assert a[-1] == pytest.approx((np.array([0.4, 0.4, 1.25]) * e + 0.05 * np.array([2.0, -2.0, 0.15])) / 0.027)
    assert a[-1].tolist() == a[-2].tolist()


@pytest.mark.parametrize("case", CASES)
def test_an_obstacle_crosses_the_way_at_its_instant_with_its_velocity(case: Case) -> None:
    batch = CaseBatch(EASY, 200, np.random.default_rng(2), case)
    way = batch.target_enu - batch.p_enu
    at_s, velocity = [], []
    for steps in (-0.01, 0.0, 0.01):  # of the clock, around the crossing
        batch.steps = batch._cross_s / EASY.dt_s + steps  # type: ignore[assignment]
        p, v = batch.obstacle()
        at_s.append(p)
        velocity.append(v)
    share = ((at_s[1] - batch.p_enu) * way).sum(1) / (way * way).sum(1)
    off = np.linalg.norm(at_s[1] - batch.p_enu - share[:, None] * way, axis=1)
    assert off.max() <= np.sqrt(3) * 0.2 + 1e-9
    assert share.min() > 0.0
    assert share.max() < 1.2
    np.testing.assert_allclose((at_s[2] - at_s[0]) / (0.02 * EASY.dt_s), velocity[1], atol=1e-4)


@pytest.mark.parametrize("case", CASES)
def test_the_motion_is_that_of_its_case(case: Case) -> None:
    batch = CaseBatch(EASY, 50, np.random.default_rng(3), case)
    velocities = []
    for step in (0, 20, 40):
        batch.steps = np.full(50, step)
        velocities.append(batch.obstacle()[1])
    first, second = velocities[1] - velocities[0], velocities[2] - velocities[1]
    if case == "linear":
        assert np.abs(first).max() < 1e-12
    elif case == "accelerated":
        np.testing.assert_allclose(first, second, atol=1e-12)
        assert np.abs(first).max() > 0.1
    else:
        assert np.abs(first - second).max() > 0.1


def test_a_touch_between_two_samples_ends_the_episode_at_the_cost_of_an_arrival() -> None:
    batch = CaseBatch(EASY, 1, np.random.default_rng(0), "linear")
    batch.place(np.zeros((1, 3)), np.array([[6.0, 0.0, 0.0]]), np.array([[9.0, 0.0, 0.0]]))
    batch._cross_s[:], batch._first[:], batch._second[:] = 0.025, [[-20.0, 0.0, 0.0]], 0.0
    batch._cross_enu[:] = [[0.15, 0.0, 0.39]]  # they fly past each other within the step, 1.3 m apart before and after
    out = batch.step(np.zeros((1, 3)))
    assert bool(out.terminated[0])
    assert not out.reached[0]
    assert not out.truncated[0]
    assert out.terms.boundary[0] == -100.0
    assert out.reward[0] == pytest.approx(0.3 - 0.005 - 100.0)
    batch._cross_enu[:] = [[0.45, 0.0, REACH_M + 0.001]]
    batch._cross_s[:] = 0.075
    assert not batch.step(np.zeros((1, 3))).terminated[0]


def test_the_observation_is_scaled_and_tells_the_obstacle() -> None:
    batch = CaseBatch(EASY, 4, np.random.default_rng(1), "accelerated")
    p, v = batch.obstacle()
    seen = batch.observe() * SCALE
    np.testing.assert_allclose(seen[:, :3], batch.v_enu)
    np.testing.assert_allclose(seen[:, 3:6], batch.target_enu - batch.p_enu)
    np.testing.assert_allclose(seen[:, 6:9], p - batch.p_enu)
    np.testing.assert_allclose(seen[:, 9:], v)
    env = BatchVecEnv(lambda rng: CaseBatch(EASY, 4, rng, "linear"), 4, 0)
    assert env.observation_space.shape == (12,)
    assert env.reset().shape == (4, 12)


def test_the_network_has_the_symmetries_of_the_cube() -> None:
    law = EndToEnd(build(PRESETS["default"], "linear", SMALL), 3.0)
    rng = np.random.default_rng(5)
    v, e, r, w = rng.normal(size=(4, 3)) * [[2.0], [4.0], [2.0], [1.0]]
    a = law.act(v, e, r, w)
    assert np.abs(a).max() > 1e-5
    for order, signs in (([1, 0, 2], [1, 1, 1]), ([2, 0, 1], [-1, 1, -1])):
        turned = law.act(*(np.array(signs) * x[order] for x in (v, e, r, w)))
        np.testing.assert_allclose(turned, np.array(signs) * a[order], atol=1e-5)


def test_a_network_comes_back_from_its_file_and_another_does_not(tmp_path: Path) -> None:
    points: list[CurvePoint] = []
    model, curve, seconds = train_case(PRESETS["default"], "figure_eight", SMALL, on_point=points.append)
    assert [point.steps for point in points] == [2048, 4096]
    assert curve == tuple(points)
    assert seconds > 0.0
    save(model, tmp_path / "network.safetensors")
    again = restore(tmp_path / "network.safetensors", PRESETS["default"], "figure_eight", SMALL)
    state = [np.array(x) for x in ([1.0, 0.0, 0.2], [3.0, 1.0, -1.0], [1.0, 0.5, 0.0], [0.0, -1.0, 0.0])]
    assert EndToEnd(again, 3.0).act(*state).tolist() == EndToEnd(model, 3.0).act(*state).tolist()
    for name, before in model.policy.state_dict().items():
        assert torch.equal(before, again.policy.state_dict()[name])
    wider = replace(SMALL, actor_width=9)
    for path in (tmp_path / "network.safetensors", tmp_path / "none.safetensors"):
        with pytest.raises(ArtifactError, match=f"{path.name}: expected a network of `policies paper`"):
            restore(path, PRESETS["default"], "figure_eight", wider)
