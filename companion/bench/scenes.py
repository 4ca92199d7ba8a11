"""Flights through obstacles for the bench of the filter: a double integrator among spheres that fly straight.

A flight is `Flight.inputs` into a filter and `Flight.advance` by its answer, tick by tick, so that the filter is in
the state in which it flies: it remembers its last answer and every obstacle's epsilon.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from companion.config import SafetyConfig
from companion.safety.filter import FilterInput
from companion.types import NS_PER_S, FloatArray, Prediction, Vec3, frozen

RADIUS_M = 0.2
SIGMA_M = 0.05  # of a predicted position now; it grows by as much a second
SHRINK_M_S2 = 0.3  # of the box: what the disturbance estimate may add
NEAREST_M = 0.9  # no obstacle starts nearer
START = (0.0, 0.0, 5.0)
LOW, HIGH = (-10.0, -10.0, 0.5), (10.0, 10.0, 10.0)  # where obstacles start [m]
FLIGHT_TICKS = 8


@dataclass(frozen=True, slots=True)
class Scene:
    """How a flight begins, ENU [m], [m/s], [m/s^2]."""

    p_enu: Vec3
    v_enu: Vec3
    a_ref: Vec3  # asked for in every tick
    obstacle_p: FloatArray  # (M, 3)
    obstacle_v: FloatArray  # (M, 3)


def draw_scene(rng: np.random.Generator, count: int, config: SafetyConfig) -> Scene:
    """``count`` obstacles of up to 3 m/s in the arena, the first on the way of a vehicle of up to 3.5 m/s.

    They meet within 0.5 m on each axis, no sooner than after 0.3 s and at most 0.5 s beyond T = (N + 2) dt, where the
    rows end: some flights begin where no acceleration helps any more, in some the obstacle comes into sight.
    """
    horizon_s = (config.horizon + 2) * config.dt_s
    while True:
        p = np.array(START)
        v = _directions(rng, 1, flatten=0.3)[0] * rng.uniform(0.0, 3.5)
        a_ref = np.clip(rng.standard_normal(3) * (1.5, 1.5, 0.5), -2.7, 2.7)
        obstacle_p = rng.uniform(LOW, HIGH, (count, 3))
        obstacle_v = _directions(rng, count, flatten=0.4) * rng.uniform(0.0, 3.0, (count, 1))
        meeting_s = rng.uniform(0.3, 0.5 + horizon_s)
        obstacle_p[0] = p + (v - obstacle_v[0]) * meeting_s + rng.uniform(-0.5, 0.5, 3)
        if float(np.linalg.norm(obstacle_p - p, axis=1).min()) > NEAREST_M:
            return Scene(p, v, a_ref, obstacle_p, obstacle_v)


def _directions(rng: np.random.Generator, count: int, *, flatten: float) -> FloatArray:
    """Unit vectors (count, 3), vertical components drawn smaller by ``flatten``."""
    drawn = rng.standard_normal((count, 3)) * (1.0, 1.0, flatten)
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def scenes(seed: int, count: int, config: SafetyConfig) -> Iterator[Scene]:
    """Endless, the same for the same arguments."""
    rng = np.random.default_rng((seed, count, config.horizon))
    while True:
        yield draw_scene(rng, count, config)


class Flight:
    """A vehicle that does what it is told, p' = v, v' = a, held over each tick, among obstacles that fly straight."""

    def __init__(self, scene: Scene, config: SafetyConfig, *, sigma_m: float = SIGMA_M) -> None:
        self._instants, self._dt_s, self.sigma_m = config.horizon + 3, config.dt_s, sigma_m
        self.p_enu, self.v_enu, self.ticks = scene.p_enu, scene.v_enu, 0
        self._scene = scene
        self._ids = tuple(f"o{index}" for index in range(len(scene.obstacle_p)))

    def obstacles(self) -> FloatArray:
        """Where the obstacles are now, (M, 3)."""
        return self._scene.obstacle_p + self._scene.obstacle_v * (self.ticks * self._dt_s)

    def inputs(self, a_ref: Vec3 | None = None, *, error_m: FloatArray | None = None) -> FilterInput:
        """What the filter is told now; ``error_m`` (M, 3) is added to the predicted positions, the scene's reference
        is taken unless ``a_ref`` is given."""
        begin = self.obstacles() if error_m is None else self.obstacles() + error_m
        return FilterInput(
            frozen(self.p_enu),
            frozen(self.v_enu),
            frozen(self._scene.a_ref if a_ref is None else a_ref),
            self._prediction(begin),
            accel_shrink_m_s2=SHRINK_M_S2,
            elapsed_s=self._dt_s if self.ticks else None,
        )

    def _prediction(self, begin: FloatArray) -> Prediction:
        ahead_s = np.arange(self._instants) * self._dt_s
        velocity, count = self._scene.obstacle_v, len(begin)
        return Prediction(
            start_ns=round(self.ticks * self._dt_s * NS_PER_S),
            dt_s=self._dt_s,
            ids=self._ids,
            p_enu=frozen(begin[:, None] + ahead_s[:, None] * velocity[:, None]),
            sigma_m=frozen(np.tile(self.sigma_m * (1.0 + ahead_s), (count, 1))),
            v_enu=frozen(velocity),
            a_enu=frozen(np.zeros((count, 3))),
            radius_m=frozen(np.full(count, RADIUS_M)),
        )

    def advance(self, a: Vec3) -> None:
        """One tick under ``a``."""
        self.p_enu = self.p_enu + self.v_enu * self._dt_s + a * (0.5 * self._dt_s**2)
        self.v_enu = self.v_enu + a * self._dt_s
        self.ticks += 1

    def clearance_m(self, a: Vec3, substeps: int) -> float:
        """Least distance from an obstacle's centre during the next tick under ``a``, infinite without obstacles [m]."""
        t_s = (np.arange(substeps + 1) * (self._dt_s / substeps))[:, None]
        path = self.p_enu + self.v_enu * t_s + a * (0.5 * t_s**2)
        apart = path[:, None] - self.obstacles() - self._scene.obstacle_v * t_s[:, None]
        return float(np.sqrt(np.vecdot(apart, apart)).min(initial=np.inf))
