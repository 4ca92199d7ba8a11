"""Batched point mass for training: p' = v, v' = a, a' = (k_ma a_cmd + bias - a) / lag; reward (9)-(13).

N vehicles advance together as arrays. Within a step the command is held and the lag is integrated exactly, so a step of
any length is right, and lag 0 is a double integrator. Frame: local ENU; metres, seconds; gravity is excluded, as (8)'s
gE cancels the one in (1). Source: the paper, 3.1, with Tables 1 and 2.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

VELOCITY = slice(0, 3)  # of an observation [m/s]
ERROR = slice(3, 6)  # target minus position [m]


@dataclass(frozen=True, slots=True)
class EnvConfig:
    """The training task. Defaults are those of the shipped policy; `PRESETS` holds the paper's literal task.

    The last block of options is zero in the paper: its reward never asks to stop, nor to keep a speed limit.
    """

    k_ma_m_s2: float = 3.0  # (8); a_max of Table 1
    dt_s: float = 0.05
    arena_m: float = 10.0  # B is the cube of this half width
    threshold_m: float = 0.1  # epsilon_tr
    segment_test: bool = True  # reached if the path of the step passes the threshold, not its end alone
    max_steps: int = 240
    m_tr: float = 100.0
    m_ds: float = 1.0
    m_bp: float = 10.0
    m_tp: float = 0.1
    lag_s: float = 0.1  # first-order lag of the vehicle's acceleration loop
    dead_steps: int = 0  # whole steps before a command acts
    terminal_speed_cost: float = 0.0  # per m/s at the moment the target is reached
    speed_limit_m_s: float = 6.0
    overspeed_cost: float = 0.0  # per m/s above the limit and second
    start_speed_m_s: float = 0.0  # initial speeds are drawn up to this
    near_share: float = 0.0  # share of episodes whose target is drawn near, log-uniform down to 3 % of the arena
    wall_share: float = 0.0  # share of episodes whose target has one axis within 0.1 m of a wall: overshoot is felt
    lag_spread_s: float = 0.0  # randomisation: lag uniform within +- of lag_s, per episode
    gain_loss: float = 0.0  # acceleration obtained over that asked for, uniform in [1 - loss, 1], per episode
    bias_std_m_s2: float = 0.0  # constant acceleration error, per episode and axis
    noise_p_std_m: float = 0.0  # observation noise, per step and axis
    noise_v_std_m_s: float = 0.0

    def __post_init__(self) -> None:
        positive = ("k_ma_m_s2", "dt_s", "arena_m", "threshold_m", "speed_limit_m_s", "max_steps")
        for item in fields(self):
            value = getattr(self, item.name)
            if not np.isfinite(value) or value < 0 or (item.name in positive and value == 0):
                kind = "positive" if item.name in positive else "non-negative"
                raise ValueError(f"env.{item.name}: expected a finite {kind} number, got {value}")
        if self.lag_spread_s > self.lag_s:
            raise ValueError(f"env.lag_spread_s: expected at most lag_s {self.lag_s}, got {self.lag_spread_s}")


PRESETS: dict[str, EnvConfig] = {
    "default": EnvConfig(
        lag_s=0.12,
        terminal_speed_cost=9.0,
        speed_limit_m_s=5.2,
        overspeed_cost=40.0,
        start_speed_m_s=5.2,
        near_share=0.5,
        wall_share=0.25,
        lag_spread_s=0.06,
        gain_loss=0.15,
        bias_std_m_s2=0.1,
    ),
    "paper": EnvConfig(k_ma_m_s2=1.0, segment_test=False, max_steps=400, lag_s=0.0, speed_limit_m_s=1e3),
}


@dataclass(frozen=True, slots=True)
class RewardTerms:
    """The addends of (9), then the options; each of shape (N,)."""

    target: FloatArray
    shaping: FloatArray
    boundary: FloatArray
    time: FloatArray
    terminal_speed: FloatArray
    overspeed: FloatArray

    @property
    def total(self) -> FloatArray:
        return self.target + self.shaping + self.boundary + self.time + self.terminal_speed + self.overspeed


@dataclass(frozen=True, slots=True)
class Step:
    """What one step of N vehicles gave; ``observation`` is that of the state reached, before any reset."""

    observation: FloatArray  # (N, 6)
    reward: FloatArray  # (N,)
    terminated: BoolArray  # reached, or left the arena
    truncated: BoolArray  # out of steps and not terminated: the value goes on beyond
    reached: BoolArray
    terms: RewardTerms


def reward_terms(
    config: EnvConfig,
    *,
    distance_before_m: FloatArray,
    distance_m: FloatArray,
    reached: BoolArray,
    outside: BoolArray,
    arrival_speed_m_s: FloatArray,
    speed_m_s: FloatArray,
) -> RewardTerms:
    """r = r_tr + r_ds + r_bp + r_tp (9), each by (10)-(13), and the optional speed costs.

    r_tr = M_tr if reached; r_ds = M_ds (|e(k-1)| - |e(k)|); r_bp = -M_bp outside the arena; r_tp = -M_tp dt.
    """
    over_m_s = np.maximum(speed_m_s - config.speed_limit_m_s, 0.0)
    return RewardTerms(
        target=np.where(reached, config.m_tr, 0.0),
        shaping=config.m_ds * (distance_before_m - distance_m),
        boundary=np.where(outside, -config.m_bp, 0.0),
        time=np.full(distance_m.shape, -config.m_tp * config.dt_s),
        terminal_speed=np.where(reached, -config.terminal_speed_cost * arrival_speed_m_s, 0.0),
        overspeed=-config.overspeed_cost * config.dt_s * over_m_s,
    )


def advance(
    p: FloatArray, v: FloatArray, a: FloatArray, command: FloatArray, lag_s: FloatArray, dt_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Exact solution of p' = v, v' = a, a' = (command - a) / lag over ``dt_s`` at constant command.

    With E = exp(-dt / lag): a+ = c + (a - c) E, v+ = v + c dt + (a - c) lag (1 - E),
    p+ = p + v dt + c dt^2 / 2 + (a - c) lag (dt - lag (1 - E)).

    Args:
        p, v, a, command: (N, 3) [m], [m/s], [m/s^2], [m/s^2].
        lag_s: (N, 1), 0 where the command acts at once.
    """
    decay = np.exp(-dt_s / np.maximum(lag_s, 1e-9))
    lead = lag_s * (1.0 - decay)
    gap = a - command
    p_next = p + v * dt_s + 0.5 * dt_s**2 * command + gap * lag_s * (dt_s - lead)
    return p_next, v + command * dt_s + gap * lead, command + gap * decay


def closest_on_segment(start: FloatArray, end: FloatArray, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance from ``point`` to the segment start-end and the fraction at which it is least: (N,), (N,)."""
    d, to_point = end - start, point - start
    fraction = np.clip((d * to_point).sum(1) / np.maximum((d * d).sum(1), 1e-12), 0.0, 1.0)
    return np.linalg.norm(to_point - fraction[:, None] * d, axis=1), fraction


class PointMassBatch:
    """N vehicles with a target each. Finished ones stay as they are until `reset`."""

    observation_size = 6

    def __init__(self, config: EnvConfig, count: int, rng: np.random.Generator) -> None:
        self.config, self.count, self._rng = config, count, rng
        self.p_enu, self.v_enu, self.a_enu, self.target_enu, self._bias = (np.zeros((count, 3)) for _ in range(5))
        self._lag_s, self._gain = np.full((count, 1), config.lag_s), np.ones((count, 1))
        self._queue = np.zeros((config.dead_steps, count, 3))  # commands on their way, oldest first
        self.steps = np.zeros(count, dtype=np.int64)
        self.reset(np.ones(count, dtype=np.bool_))

    def reset(self, mask: BoolArray) -> FloatArray:
        """New episodes where ``mask``: start and target uniform in the arena; the observations of all."""
        c, rng, n = self.config, self._rng, int(mask.sum())
        self.p_enu[mask] = rng.uniform(-c.arena_m, c.arena_m, (n, 3))
        self.target_enu[mask] = self._targets(self.p_enu[mask])
        self.v_enu[mask] = self._start_velocities(self.p_enu[mask])
        self.a_enu[mask] = 0.0
        self._queue[:, mask] = 0.0
        self._lag_s[mask] = c.lag_s + rng.uniform(-c.lag_spread_s, c.lag_spread_s, (n, 1))
        self._gain[mask] = 1.0 - rng.uniform(0.0, c.gain_loss, (n, 1))
        self._bias[mask] = rng.normal(0.0, 1.0, (n, 3)) * c.bias_std_m_s2
        self.steps[mask] = 0
        return self.observe()

    def place(self, p_enu: FloatArray, v_enu: FloatArray, target_enu: FloatArray) -> FloatArray:
        """Start every vehicle from a given state, with nothing on its way: nominal lag and gain, no bias."""
        self.p_enu, self.v_enu, self.target_enu = (np.array(x, dtype=float) for x in (p_enu, v_enu, target_enu))
        self.a_enu[:], self._queue[:], self._bias[:], self.steps[:] = 0.0, 0.0, 0.0, 0
        self._lag_s[:], self._gain[:] = self.config.lag_s, 1.0
        return self.observe()

    def step(self, action: npt.ArrayLike) -> Step:
        """Advance all by dt under net accelerations k_ma clip(action, -1, 1), shape (N, 3)."""
        c = self.config
        before_enu, v_before = self.p_enu, self.v_enu
        distance_before_m = np.linalg.norm(self.target_enu - before_enu, axis=1)
        asked = c.k_ma_m_s2 * np.clip(np.asarray(action, dtype=float), -1.0, 1.0)
        command = self._gain * self._delayed(asked) + self._bias
        self.p_enu, self.v_enu, self.a_enu = advance(self.p_enu, self.v_enu, self.a_enu, command, self._lag_s, c.dt_s)
        self.steps += 1
        distance_m = np.linalg.norm(self.target_enu - self.p_enu, axis=1)
        if c.segment_test:
            closest_m, fraction = closest_on_segment(before_enu, self.p_enu, self.target_enu)
        else:
            closest_m, fraction = distance_m, np.ones(self.count)
        reached = closest_m < c.threshold_m
        outside = (np.abs(self.p_enu) > c.arena_m).any(axis=1)
        terms = reward_terms(
            c,
            distance_before_m=distance_before_m,
            distance_m=distance_m,
            reached=reached,
            outside=outside & ~reached,
            arrival_speed_m_s=np.linalg.norm(v_before + fraction[:, None] * (self.v_enu - v_before), axis=1),
            speed_m_s=np.linalg.norm(self.v_enu, axis=1),
        )
        terminated = reached | outside
        truncated = (self.steps >= c.max_steps) & ~terminated
        return Step(self.observe(), terms.total, terminated, truncated, reached, terms)

    def _delayed(self, command: FloatArray) -> FloatArray:
        if not self.config.dead_steps:
            return command
        due: FloatArray = self._queue[0].copy()
        self._queue = np.concatenate([self._queue[1:], command[None]])
        return due

    def _targets(self, p_enu: FloatArray) -> FloatArray:
        """Uniform in the arena; for one share of the episodes at a wall, for another pulled towards the start."""
        c, shape = self.config, (len(p_enu), 1)
        target = self._rng.uniform(-c.arena_m, c.arena_m, p_enu.shape)
        walled = np.flatnonzero(self._rng.uniform(size=len(p_enu)) < c.wall_share)
        axis = self._rng.integers(0, 3, len(walled))
        target[walled, axis] = np.sign(target[walled, axis]) * (c.arena_m - self._rng.uniform(0.0, 0.1, len(walled)))
        pull = np.where(self._rng.uniform(size=shape) < c.near_share, 10.0 ** self._rng.uniform(-1.5, 0.0, shape), 1.0)
        return np.asarray(p_enu + pull * (target - p_enu))

    def _start_velocities(self, p_enu: FloatArray) -> FloatArray:
        """Speeds uniform up to the configured one, each axis slow enough to brake inside the arena at 0.8 k_ma."""
        c = self.config
        direction = self._rng.normal(size=p_enu.shape)
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
        v = direction * self._rng.uniform(0.0, 1.0, (len(p_enu), 1)) * c.start_speed_m_s
        room_m = np.maximum(c.arena_m - np.sign(v) * p_enu - c.lag_s * np.abs(v), 0.0)
        return np.asarray(np.sign(v) * np.minimum(np.abs(v), np.sqrt(1.6 * c.k_ma_m_s2 * room_m)))

    def observe(self) -> FloatArray:
        """[v, e] with the configured noise, shape (N, 6)."""
        c = self.config
        observation = np.concatenate([self.v_enu, self.target_enu - self.p_enu], axis=1)
        if c.noise_p_std_m or c.noise_v_std_m_s:
            std = np.repeat([c.noise_v_std_m_s, c.noise_p_std_m], 3)
            observation += self._rng.normal(size=observation.shape) * std
        return observation
