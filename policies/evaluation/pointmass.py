"""Unobstructed flights of a reference on the point mass: does it arrive, stay, and how far from time-optimal.

A flight is *reached* at the instant at which its path passes the target within the threshold, provided that it then
stays within 0.3 m for 3 s. The bound is rest to rest with |a_i| <= a_max on each axis: T = 2 sqrt(max_i |d_i| / a_max).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from companion.types import Vec3
from policies.env import BoolArray, EnvConfig, FloatArray, PointMassBatch, closest_on_segment
from policies.evaluation.statistics import mean_interval, wilson

Reference = Callable[[Vec3, Vec3], Vec3]  # (v_enu, e_enu) -> net acceleration [m/s^2]

STAY_RADIUS_M = 0.3
STAY_S = 3.0


@dataclass(frozen=True, slots=True)
class Flights:
    """N flights, arrays of shape (N,); a flight that did not reach has NaN as its time."""

    time_s: FloatArray
    bound_s: FloatArray
    passed: BoolArray  # within the threshold at least once
    left_arena: BoolArray
    speed_max_m_s: FloatArray
    effort_m2_s3: FloatArray  # integral of |a_ref|^2 up to the arrival

    @property
    def reached(self) -> BoolArray:
        return np.isfinite(self.time_s)


def time_optimal_s(d_enu: FloatArray, a_max_m_s2: float) -> FloatArray:
    """T = 2 sqrt(max_i |d_i| / a_max) for displacements (N, 3)."""
    return np.asarray(2.0 * np.sqrt(np.abs(d_enu).max(axis=1) / a_max_m_s2))


def fly(
    reference: Reference,
    p_enu: FloatArray,
    v_enu: FloatArray,
    target_enu: FloatArray,
    *,
    config: EnvConfig,
    a_max_m_s2: float,
    timeout_s: float = 20.0,
) -> Flights:
    """Fly ``reference`` from N states (N, 3) to N targets, its acceleration clipped to +-a_max per axis."""
    batch = PointMassBatch(replace(config, k_ma_m_s2=a_max_m_s2), len(p_enu), np.random.default_rng(0))
    batch.place(p_enu, v_enu, target_enu)
    stay_steps = round(STAY_S / config.dt_s)
    arrival = np.full(batch.count, -1)  # step of the passage that still counts
    passed, left, effort = (np.zeros(batch.count, dtype=kind) for kind in (bool, bool, float))
    speed_max = np.linalg.norm(batch.v_enu, axis=1)
    time_s = np.full(batch.count, np.nan)
    for step in range(1, round(timeout_s / config.dt_s) + 1):
        live = np.isnan(time_s)
        if not live.any():
            break
        before = batch.p_enu
        a_ref = np.zeros_like(before)
        for i in np.flatnonzero(live):
            a_ref[i] = reference(batch.v_enu[i], target_enu[i] - before[i])
        a_ref = np.clip(a_ref, -a_max_m_s2, a_max_m_s2)
        batch.step(a_ref / a_max_m_s2)
        closest_m, _ = closest_on_segment(before, batch.p_enu, target_enu)
        near = np.linalg.norm(target_enu - batch.p_enu, axis=1) <= STAY_RADIUS_M
        passing = closest_m < config.threshold_m
        effort += np.where(live & (arrival < 0), (a_ref**2).sum(axis=1) * config.dt_s, 0.0)
        arrival = np.where(near, np.where((arrival < 0) & passing, step, arrival), -1)
        passed |= live & passing
        left |= live & (np.abs(batch.p_enu) > config.arena_m).any(axis=1)
        speed_max = np.where(live, np.maximum(speed_max, np.linalg.norm(batch.v_enu, axis=1)), speed_max)
        done = live & (arrival >= 0) & (step - arrival >= stay_steps)
        time_s[done] = arrival[done] * config.dt_s
    return Flights(time_s, time_optimal_s(target_enu - p_enu, a_max_m_s2), passed, left, speed_max, effort)


def random_starts(config: EnvConfig, count: int, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``count`` starts at rest and their targets, both uniform in the arena: p, v, target, each (count, 3)."""
    rng = np.random.default_rng(seed)
    p, target = rng.uniform(-config.arena_m, config.arena_m, (2, count, 3))
    return p, np.zeros((count, 3)), target


def report(flights: Flights, *, seed: int) -> dict[str, object]:
    """The figures of a set of flights, with 95 % intervals (Wilson; normal)."""
    reached, count = flights.reached, len(flights.time_s)
    hits = int(reached.sum())
    low, high = wilson(hits, count)
    figures: dict[str, object] = {
        "starts": count,
        "seed": seed,
        "reached": hits,
        "success": hits / count,
        "success_interval": [low, high],
        "passed_threshold": int(flights.passed.sum()),
        "left_arena": int(flights.left_arena.sum()),
        "speed_max_m_s": float(flights.speed_max_m_s.max()),
        "speed_p99_m_s": float(np.percentile(flights.speed_max_m_s, 99)),
    }
    if hits > 1:
        time_s, bound_s = flights.time_s[reached], flights.bound_s[reached]
        mean, lower, upper = mean_interval(time_s / bound_s)
        figures |= {
            "time_mean_s": float(time_s.mean()),
            "bound_mean_s": float(bound_s.mean()),
            "mean_time_over_mean_bound": float(time_s.mean() / bound_s.mean()),
            "time_over_bound_mean": mean,
            "time_over_bound_interval": [lower, upper],
            "time_over_bound_p95": float(np.percentile(time_s / bound_s, 95)),
            "effort_mean_m2_s3": float(flights.effort_m2_s3[reached].mean()),
        }
    return figures
