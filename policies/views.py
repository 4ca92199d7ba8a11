"""The batched point mass as others want to see it: one gymnasium environment, or a stable-baselines3 VecEnv."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv

from policies.env import EnvConfig, PointMassBatch

ONE = np.ones(1, dtype=np.bool_)


def _spaces(size: int) -> tuple[Any, Any]:
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32),
        gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32),
    )


class PointMassGym(gymnasium.Env[npt.NDArray[np.float32], npt.NDArray[np.float32]]):
    """One vehicle: observation [v, e] (6,), action (3,) in [-1, 1]; ``info`` tells ``reached`` and each reward term."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  gymnasium's own class attribute

    def __init__(self, config: EnvConfig) -> None:
        self.config = config
        self.observation_space, self.action_space = _spaces(PointMassBatch.observation_size)
        self._batch: PointMassBatch | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        if self._batch is None or seed is not None:
            self._batch = PointMassBatch(self.config, 1, self.np_random)
        return self._batch.reset(ONE)[0].astype(np.float32), {}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        if self._batch is None:
            raise gymnasium.error.ResetNeeded("step: expected a call of reset first")
        out = self._batch.step(action[None])
        terms = {name: float(getattr(out.terms, name)[0]) for name in out.terms.__slots__}
        return (
            out.observation[0].astype(np.float32),
            float(out.reward[0]),
            bool(out.terminated[0]),
            bool(out.truncated[0]),
            {"reached": bool(out.reached[0]), "terms": terms},
        )


class BatchVecEnv(VecEnv):
    """Thousands of vehicles in one process, with stable-baselines3's automatic reset.

    ``infos`` of a finished one carry ``terminal_observation``, ``TimeLimit.truncated``, ``is_success`` and ``episode``.

    Args:
        make: a batch of ``count`` vehicles for a generator.
    """

    def __init__(
        self,
        make: Callable[[np.random.Generator], PointMassBatch],
        count: int,
        seed: int,
        *,
        reward_scale: float = 1.0,
    ) -> None:
        self.render_mode = None
        self._make = make
        self.batch = make(np.random.default_rng(seed))
        super().__init__(count, *_spaces(self.batch.observation_size))
        self._action = np.zeros((count, 3), dtype=np.float32)
        self._return = np.zeros(count)
        self.reward_scale = reward_scale

    def reset(self) -> npt.NDArray[np.float32]:
        self._return[:] = 0.0
        return self.batch.reset(np.ones(self.num_envs, dtype=np.bool_)).astype(np.float32)

    def step_async(self, actions: npt.NDArray[np.float32]) -> None:
        self._action = actions

    def step_wait(
        self,
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        out = self.batch.step(self._action)
        self._return += out.reward
        done = out.terminated | out.truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        observation = out.observation.astype(np.float32)
        for i in np.flatnonzero(done):
            infos[i] = {
                "terminal_observation": observation[i].copy(),  # its row is that of the next episode below
                "TimeLimit.truncated": bool(out.truncated[i]),
                "is_success": bool(out.reached[i]),
                "episode": {"r": float(self._return[i]), "l": int(self.batch.steps[i])},
            }
        if done.any():
            self._return[done] = 0.0
            observation[done] = self.batch.reset(done)[done]
        return observation, self.reward_scale * out.reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Nothing to release."""

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(f"{attr_name}: the batch is set by its EnvConfig only")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        raise AttributeError(f"{method_name}: the batch has no environments of its own")

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Restart the random stream of all vehicles."""
        if seed is not None:
            self.batch = self._make(np.random.default_rng(seed))
        return [seed] * self.num_envs


class PointMassVecEnv(BatchVecEnv):
    """The task of the policy: no obstacle in sight."""

    def __init__(self, config: EnvConfig, count: int, seed: int, *, reward_scale: float = 1.0) -> None:
        super().__init__(lambda rng: PointMassBatch(config, count, rng), count, seed, reward_scale=reward_scale)
