"""PPO on the point mass: stable-baselines3's algorithm, our environment and network.

The reward is (9)-(13) plus a cost on the speed at arrival and one on overspeed, because the paper's never asks to stop;
starts, lag, gain and bias are randomised. The preset ``paper`` leaves both costs and the randomisation out.

Everything that decides the outcome is in `TrainConfig` and `EnvConfig`: the same two give the same weights on the same
machine and versions.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from policies.checkpoint import restore_checkpoint, save_checkpoint
from policies.env import PRESETS, EnvConfig, PointMassBatch
from policies.network import AxisSharedNet, AxisSharedPolicy, SharedActorPolicy
from policies.views import BatchVecEnv, PointMassVecEnv

PROGRESS_SEED = 10_003


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """Hyperparameters of PPO. ``steps`` counts environment steps over all vehicles."""

    seed: int = 0
    steps: int = 360_000
    vehicles: int = 128
    rollout: int = 32  # steps of each vehicle between updates
    batch: int = 512
    epochs: int = 4
    learning_rate: float = 2e-3  # falls linearly to a twentieth
    gamma: float = 0.98  # the urgency: (13) is worth 0.005 a step, a step later at the target 2 % of what it pays
    gae_lambda: float = 0.95
    log_std: float = -1.0  # of the exploration at the start
    reward_scale: float = 0.05  # keeps the critic's loss and the actor's of one size; returns are shown unscaled
    actor_width: int = 32
    critic_width: int = 48
    threads: int = 1
    checkpoints: int = 4  # evenly over the run


TRAIN_PRESETS: dict[str, TrainConfig] = {
    "default": TrainConfig(),
    "paper": TrainConfig(steps=700_000, gamma=0.99),  # a third of the acceleration: longer flights
}


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """Where training stood after a rollout.

    The return is a mean over the last 500 episodes, exploration and randomisation included; the success is that of
    the policy's mean from 200 starts at rest, measured every eighth rollout.
    """

    steps: int
    seconds: float
    mean_return: float  # NaN until the first episode ends
    success: float


@dataclass(frozen=True, slots=True)
class Trained:
    """The outcome: weights of the actor (normaliser included), and how it got there."""

    weights: dict[str, npt.NDArray[np.float32]]
    curve: tuple[CurvePoint, ...]
    seconds: float
    cpu_seconds: float  # of this process: what the training costs where the machine is shared

    @property
    def to_99(self) -> CurvePoint | None:
        """The first point at which 99 % of the starts reached the target."""
        return next((point for point in self.curve if point.success >= 0.99), None)


class CurveRecorder(BaseCallback):
    """Notes a point after each rollout, hands it on, and writes checkpoints."""

    def __init__(
        self,
        measure: Callable[[PPO], float],
        every_steps: int,
        folder: Path | None,
        on_point: Callable[[CurvePoint], None],
    ) -> None:
        super().__init__()
        self.points: list[CurvePoint] = []
        self._measure, self._success = measure, 0.0
        self._every_steps, self._folder, self._on_point = every_steps, folder, on_point
        self._start_s, self._due_steps = time.perf_counter(), 0

    def _on_training_start(self) -> None:
        self._due_steps = self.num_timesteps + self._every_steps

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        assert isinstance(self.model, PPO)
        returns = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        if len(self.points) % 8 == 7:
            self._success = self._measure(self.model)
        point = CurvePoint(
            self.num_timesteps,
            time.perf_counter() - self._start_s,
            float(np.mean(returns)) if returns else math.nan,
            self._success,
        )
        self.points.append(point)
        self._on_point(point)
        if self._folder is not None and self.num_timesteps >= self._due_steps:
            self._due_steps += self._every_steps
            save_checkpoint(self.model, self._folder / f"{self.num_timesteps}.safetensors")


def calm(env: EnvConfig) -> EnvConfig:
    """The same task from rest, without randomisation."""
    return replace(
        env,
        start_speed_m_s=0.0,
        near_share=0.0,
        wall_share=0.0,
        lag_spread_s=0.0,
        gain_loss=0.0,
        bias_std_m_s2=0.0,
        noise_p_std_m=0.0,
        noise_v_std_m_s=0.0,
    )


def mean_success(model: PPO, env: EnvConfig, starts: int = 200) -> float:
    """Share of starts at rest from which the policy's mean passes the target before it leaves the arena."""
    return flown_share(model, PointMassBatch(calm(env), starts, np.random.default_rng(PROGRESS_SEED)))


def flown_share(model: PPO, batch: PointMassBatch) -> float:
    """Share of a batch that reaches its target before its episode ends otherwise."""
    observation = batch.observe()
    ended, reached = np.zeros((2, batch.count), dtype=np.bool_)
    for _ in range(batch.config.max_steps):
        action, _ = model.predict(observation.astype(np.float32), deterministic=True)
        step = batch.step(action)
        reached |= step.reached & ~ended
        ended |= step.terminated
        if ended.all():
            break
        observation = step.observation
    return float(reached.mean())


def learning_rate(config: TrainConfig) -> Callable[[float], float]:
    """Falls linearly with the share of the training that remains, to a twentieth."""
    return lambda remaining: config.learning_rate * max(remaining, 0.05)


def build(env: EnvConfig, config: TrainConfig) -> PPO:
    """PPO on the policy's task as configured, untrained."""
    return ppo(
        AxisSharedPolicy, PointMassVecEnv(env, config.vehicles, config.seed, reward_scale=config.reward_scale), config
    )


def ppo(policy: type[SharedActorPolicy], env: BatchVecEnv, config: TrainConfig) -> PPO:
    """stable-baselines3's PPO with our hyperparameters."""
    torch.set_num_threads(config.threads)
    return PPO(
        policy,
        env,
        learning_rate=learning_rate(config),
        n_steps=config.rollout,
        batch_size=config.batch,
        n_epochs=config.epochs,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        seed=config.seed,
        device="cpu",
        stats_window_size=500,
        policy_kwargs={
            "log_std_init": config.log_std,
            "actor_width": config.actor_width,
            "critic_width": config.critic_width,
        },
    )


def actor_weights(model: PPO) -> dict[str, npt.NDArray[np.float32]]:
    """The actor's tensors as arrays, normaliser included."""
    net = model.policy.mlp_extractor
    assert isinstance(net, AxisSharedNet)
    return {name: value.detach().numpy().copy() for name, value in net.actor_weights().items()}


def train(
    env: EnvConfig = PRESETS["default"],
    config: TrainConfig = TRAIN_PRESETS["default"],
    *,
    checkpoints: Path | None = None,
    resume: Path | None = None,
    on_point: Callable[[CurvePoint], None] = lambda point: None,
) -> Trained:
    """Train from scratch, or on from a checkpoint, until ``config.steps`` are done.

    Raises:
        ArtifactError: ``resume`` is not a checkpoint of this network, or has no steps left.
    """
    model = build(env, config)
    if resume is not None:
        restore_checkpoint(model, resume)
    recorder = CurveRecorder(
        lambda trained: mean_success(trained, env), max(1, config.steps // config.checkpoints), checkpoints, on_point
    )
    start_s, start_cpu_s = time.perf_counter(), time.process_time()
    if model.num_timesteps < config.steps:
        model.learn(config.steps - model.num_timesteps, callback=recorder, reset_num_timesteps=resume is None)
    seconds, cpu_seconds = time.perf_counter() - start_s, time.process_time() - start_cpu_s
    return Trained(actor_weights(model), tuple(recorder.points), seconds, cpu_seconds)
