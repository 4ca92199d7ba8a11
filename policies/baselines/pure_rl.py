"""Pure RL of the paper: one PPO network end to end, with the obstacle in its observation, for one case of motion.

Observation [v, e, p_o - p, v_o] (12), the true obstacle; action, reward and task those of `policies.env`, and a touch
ends the episode at a cost as high as the reward (10) of arriving. The obstacle meets the straight way to the target
about where the vehicle then is: on a straight line, under constant acceleration, or on a figure eight (a lemniscate of
Gerono), and on nothing else: a network knows its own case only. Frame: local ENU.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from stable_baselines3 import PPO

from companion.errors import ArtifactError
from policies.baselines.network import EndToEndPolicy
from policies.env import BoolArray, EnvConfig, FloatArray, PointMassBatch, Step, closest_on_segment
from policies.train import PROGRESS_SEED, CurvePoint, CurveRecorder, TrainConfig, calm, flown_share, ppo
from policies.views import BatchVecEnv

Case = Literal["linear", "accelerated", "figure_eight"]
CASES: tuple[Case, ...] = ("linear", "accelerated", "figure_eight")
REACH_M = 0.4  # of a touch: the paper's drone radius and as much for the obstacle
SCALE = np.array([3.0] * 3 + [5.0] * 3 + [5.0] * 3 + [3.0] * 3)  # of the observation, about what is met
TRAINING = TrainConfig(steps=720_000, actor_width=48, critic_width=64)


class CaseBatch(PointMassBatch):
    """N vehicles with a target and an obstacle of one case of motion each."""

    observation_size = 12

    def __init__(self, config: EnvConfig, count: int, rng: np.random.Generator, case: Case) -> None:
        self.case = case
        self.touched = np.zeros(count, dtype=np.bool_)
        self._cross_s, self._omega = np.zeros(count), np.zeros(count)
        self._cross_enu, self._first, self._second = np.zeros((3, count, 3))
        super().__init__(config, count, rng)

    def reset(self, mask: BoolArray) -> FloatArray:
        """New episodes where ``mask``, each with a new obstacle; the observations of all."""
        super().reset(mask)
        self._draw(mask)
        self.touched[mask] = False
        return self.observe()

    def _draw(self, mask: BoolArray) -> None:
        """The obstacle is at ``cross`` at ``cross_s``, near where a bang-bang flight from rest would be."""
        rng, n, a_max = self._rng, int(mask.sum()), self.config.k_ma_m_s2
        start, way = self.p_enu[mask], self.target_enu[mask] - self.p_enu[mask]
        share = rng.uniform(0.3, 0.7, n)  # of the time of flight
        self._cross_s[mask] = share * 2.0 * np.sqrt(np.abs(way).max(axis=1) / a_max)
        covered = np.where(share < 0.5, 2.0 * share**2, 1.0 - 2.0 * (1.0 - share) ** 2)
        self._cross_enu[mask] = start + covered[:, None] * way + rng.uniform(-0.2, 0.2, (n, 3))
        heading, climb = rng.uniform(-np.pi, np.pi, n), rng.normal(0.0, 0.2, n)
        along = np.stack([np.cos(heading), np.sin(heading), climb], axis=1)
        across = np.stack([-np.sin(heading), np.cos(heading), rng.normal(0.0, 0.2, n)], axis=1)
        if self.case == "figure_eight":
            self._omega[mask] = 2.0 * np.pi / rng.uniform(7.0, 11.0, n)
            size_m = rng.uniform(1.5, 2.5, (n, 1))
            self._first[mask], self._second[mask] = size_m * along, size_m * across
            return
        self._first[mask] = rng.uniform(0.5, 2.0, (n, 1)) * along  # velocity at the crossing
        bend = rng.uniform(-1.0, 1.0, (n, 1)) * along + rng.uniform(-1.0, 1.0, (n, 1)) * across
        self._second[mask] = bend if self.case == "accelerated" else 0.0

    def obstacle(self) -> tuple[FloatArray, FloatArray]:
        """True position and velocity now, (N, 3) each [m], [m/s]."""
        t = (self.steps * self.config.dt_s - self._cross_s)[:, None]
        if self.case == "figure_eight":
            w = self._omega[:, None]
            sine, cosine = np.sin(w * t), np.cos(w * t)
            p = self._cross_enu + self._first * sine + self._second * (sine * cosine)
            return np.asarray(p), np.asarray(w * (self._first * cosine + self._second * np.cos(2.0 * w * t)))
        p = self._cross_enu + self._first * t + 0.5 * self._second * t * t
        return np.asarray(p), np.asarray(self._first + self._second * t)

    def step(self, action: npt.ArrayLike) -> Step:
        """As without an obstacle; a touch, judged along the relative path of the step, ends the episode at a cost."""
        before = self.p_enu - self.obstacle()[0]
        out = super().step(action)
        after = self.p_enu - self.obstacle()[0]
        nearest_m, _ = closest_on_segment(before, after, np.zeros_like(before))
        self.touched = (nearest_m < REACH_M) & ~out.reached
        terms = replace(out.terms, boundary=out.terms.boundary - self.config.m_tr * self.touched)
        ended = out.terminated | self.touched
        return replace(out, reward=terms.total, terms=terms, terminated=ended, truncated=out.truncated & ~ended)

    def observe(self) -> FloatArray:
        """[v, e, p_o - p, v_o], each over its scale, (N, 12)."""
        p, v = self.obstacle()
        return np.asarray(np.concatenate([super().observe(), p - self.p_enu, v], axis=1) / SCALE)


def build(env: EnvConfig, case: Case, config: TrainConfig = TRAINING) -> PPO:
    """PPO on one case as configured, untrained."""
    batches = BatchVecEnv(
        lambda rng: CaseBatch(env, config.vehicles, rng, case),
        config.vehicles,
        config.seed,
        reward_scale=config.reward_scale,
    )
    return ppo(EndToEndPolicy, batches, config)


def train_case(
    env: EnvConfig,
    case: Case,
    config: TrainConfig = TRAINING,
    *,
    on_point: Callable[[CurvePoint], None] = lambda point: None,
) -> tuple[PPO, tuple[CurvePoint, ...], float]:
    """A network for one case, its curve, and the seconds that it took."""
    model = build(env, case, config)
    recorder = CurveRecorder(lambda trained: success(trained, env, case), config.steps, None, on_point)
    start_s = time.perf_counter()
    model.learn(config.steps, callback=recorder)
    return model, tuple(recorder.points), time.perf_counter() - start_s


def success(model: PPO, env: EnvConfig, case: Case, starts: int = 200) -> float:
    """Share of starts at rest from which the network's mean passes the target and touches nothing before."""
    batch = CaseBatch(calm(env), starts, np.random.default_rng(PROGRESS_SEED), case)
    return flown_share(model, batch)


class EndToEnd:
    """A trained network as a law of one vehicle's and one obstacle's true state."""

    def __init__(self, model: PPO, k_ma_m_s2: float) -> None:
        self._model, self._k_ma_m_s2 = model, k_ma_m_s2

    def act(self, v_enu: FloatArray, error_enu: FloatArray, r_enu: FloatArray, v_o_enu: FloatArray) -> FloatArray:
        """Net acceleration (8), (3,) [m/s^2]; ``r_enu`` is obstacle minus vehicle."""
        seen = np.concatenate([v_enu, error_enu, r_enu, v_o_enu]) / SCALE
        action, _ = self._model.predict(seen.astype(np.float32), deterministic=True)
        return np.asarray(self._k_ma_m_s2 * np.clip(action.astype(np.float64), -1.0, 1.0))


def save(model: PPO, path: Path) -> None:
    """The parameters as safetensors."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({name: value.contiguous() for name, value in model.policy.state_dict().items()}, path)


def restore(path: Path, env: EnvConfig, case: Case, config: TrainConfig = TRAINING) -> PPO:
    """The network in ``path``, written by `save`.

    Raises:
        ArtifactError: it is none of this shape.
    """
    model = build(env, case, replace(config, vehicles=1, rollout=max(config.batch, 2)))
    try:
        model.policy.load_state_dict(load_file(path))
    except (OSError, SafetensorError, RuntimeError) as error:
        raise ArtifactError(f"{path}: expected a network of `policies paper`: {str(error).splitlines()[0]}") from None
    return model
