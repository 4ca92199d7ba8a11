"""Obstacles of the encounters: spheres on closed-form paths, drawn so that they cross a flight."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.types import FloatArray, Vec3, frozen

MOTIONS = ("linear", "accelerating", "eight")


@dataclass(frozen=True, slots=True)
class Obstacle:
    """One sphere. At ``crossing_s`` it is at ``p_enu`` with velocity ``v_enu``."""

    motion: str
    crossing_s: float
    p_enu: Vec3  # [m]
    v_enu: Vec3  # [m/s]
    bend_enu: Vec3  # accelerating: acceleration [m/s^2]; eight: unit vector across v_enu
    rate_rad_s: float = 0.0  # eight only
    radius_m: float = 0.2

    def position(self, t_s: FloatArray) -> FloatArray:
        """Centre at ``t_s`` (...,), ENU (..., 3) [m]. An eight is A (sin wt, sin 2wt) about its own centre."""
        t = np.asarray(t_s)[..., None] - self.crossing_s
        if self.motion == "linear":
            return self.p_enu + self.v_enu * t
        if self.motion == "accelerating":
            return self.p_enu + self.v_enu * t + 0.5 * self.bend_enu * t * t
        w = self.rate_rad_s
        speed = float(np.linalg.norm(self.v_enu))
        along = self.v_enu / speed
        size = speed / (math.sqrt(2.0) * w)  # both parts start with the same speed: the path crosses at 45 degrees
        one, two = (along + self.bend_enu) / math.sqrt(2.0), (along - self.bend_enu) / math.sqrt(2.0)
        return self.p_enu + size * (one * np.sin(w * t) + two * 0.5 * np.sin(2.0 * w * t))


def crossing_obstacle(rng: np.random.Generator, path: FloatArray, time_s: float, tick_s: float) -> Obstacle:
    """One that meets ``path`` (N, 3) [m], a position each ``tick_s``, within 0.1 m per axis of where it then is."""
    crossing_s = rng.uniform(0.25, 0.75) * time_s
    p = path[min(round(crossing_s / tick_s), len(path) - 1)] + rng.uniform(-0.1, 0.1, 3)
    v = rng.standard_normal(3) * (1.0, 1.0, 0.4)
    v *= rng.uniform(0.5, 3.0) / np.linalg.norm(v)
    across = np.cross(v, rng.standard_normal(3))
    across /= np.linalg.norm(across)
    motion = MOTIONS[int(rng.integers(len(MOTIONS)))]
    bend = across if motion == "eight" else rng.uniform(-1.0, 1.0) * v / np.linalg.norm(v)
    return Obstacle(motion, crossing_s, frozen(p), frozen(v), frozen(bend), rate_rad_s=rng.uniform(0.5, 1.2))
