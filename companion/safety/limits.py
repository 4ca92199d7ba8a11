"""Limits of the vehicle as bounds on the same acceleration: box, arena with floor and ceiling, speed.

Arena, each side: with d the distance left after the coming step (which a no longer changes) and a_b the braking
acceleration, the largest speed that still stops on the grid is w(d), v^2 / (2 a_b) + v dt / 2 = d. The bound is
v + a dt <= w(d): a bound on one component of a, one braking distance ahead of the wall. a_b is a share of the box,
so that lag and disturbance find something left. Outside the arena w is the speed at which to come back.

Speed: |v + a dt| <= v_max; above it, slow down by half of what the box allows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.config import LimitsConfig
from companion.types import FloatArray, Vec3

BRAKING_SHARE = 0.7  # of the acceleration box, counted on for stopping at a wall
RETURN_RATE_HZ = 1.0  # speed towards the arena per metre outside it
ROUNDING_M_S2 = 1e-9  # a reference clipped to the same box by someone else may differ in the last bits


@dataclass(frozen=True, slots=True)
class VehicleLimits:
    """What the vehicle's limits leave of one tick's acceleration, ENU [m/s^2]."""

    box_m_s2: float  # each axis
    low: Vec3  # box and arena together, never empty
    high: Vec3
    arena_low: Vec3  # what the arena asks, possibly beyond the box
    arena_high: Vec3
    v_enu: Vec3  # [m/s]
    speed_bound_m_s: float
    dt_s: float

    def slacks(self, a: Vec3) -> dict[str, float]:
        """Room left of each limit at ``a``, negative where broken [m/s^2]."""
        below, above = a - self.arena_low, self.arena_high - a
        room = np.minimum(below, above)
        speed = math.dist((0.0, 0.0, 0.0), self.v_enu + a * self.dt_s)
        return {
            "arena": float(min(room[0], room[1])),
            "floor": float(below[2]),
            "ceiling": float(above[2]),
            "speed": (self.speed_bound_m_s - speed) / self.dt_s,
        }

    def admits(self, a: Vec3) -> bool:
        """Whether ``a`` keeps every limit."""
        if bool((a < self.low - ROUNDING_M_S2).any()) or bool((a > self.high + ROUNDING_M_S2).any()):
            return False
        if bool((self.arena_high < -self.box_m_s2).any()) or bool((self.arena_low > self.box_m_s2).any()):
            return False
        return math.dist((0.0, 0.0, 0.0), self.v_enu + a * self.dt_s) <= self.speed_bound_m_s

    def slow(self, a: FloatArray) -> FloatArray:
        """How far each of ``a`` (C, 3) breaks the speed limit, 0 where it holds [m/s^2]."""
        v = self.v_enu + a * self.dt_s
        return np.asarray(np.maximum(np.sqrt((v * v).sum(axis=-1)) - self.speed_bound_m_s, 0.0) / self.dt_s)

    def speed_row(self, a: Vec3) -> tuple[FloatArray, float]:
        """The tangent of the speed limit at ``a`` as ``normal @ a >= floor``."""
        v = self.v_enu + a * self.dt_s
        speed = math.dist((0.0, 0.0, 0.0), v)
        if speed < 1e-9:
            return np.zeros(3), -self.speed_bound_m_s / self.dt_s
        normal = -v / speed
        return normal, -(self.speed_bound_m_s + float(normal @ self.v_enu)) / self.dt_s

    def clip(self, a: FloatArray) -> FloatArray:
        """``a`` (..., 3) into box and arena."""
        return np.clip(a, self.low, self.high)


def braking_speed(distance_m: FloatArray, braking_m_s2: float, dt_s: float) -> FloatArray:
    """Largest speed that stops within ``distance_m``: v^2 / (2 a) + v dt / 2 = d; towards the inside where d < 0."""
    half = 0.5 * braking_m_s2 * dt_s
    inside = np.sqrt(half * half + 2.0 * braking_m_s2 * np.maximum(distance_m, 0.0)) - half
    return np.where(distance_m < 0.0, RETURN_RATE_HZ * distance_m, inside)


def vehicle_limits(
    p_enu: Vec3, v_enu: Vec3, config: LimitsConfig, *, arena_on: bool, shrink_m_s2: float, dt_s: float
) -> VehicleLimits:
    """The limits at one vehicle state; the box is shrunk by what the disturbance estimate may add."""
    box = max(config.acceleration_m_s2 - shrink_m_s2, 0.0)
    arena_low, arena_high = np.full(3, -np.inf), np.full(3, np.inf)
    if arena_on:
        ahead = p_enu + v_enu * dt_s
        room = np.array((np.subtract(config.arena_max, ahead), np.subtract(ahead, config.arena_min)))
        allowed = braking_speed(room, BRAKING_SHARE * box, dt_s)
        arena_high = (allowed[0] - v_enu) / dt_s
        arena_low = (-allowed[1] - v_enu) / dt_s
    low, high = np.clip(arena_low, -box, box), np.clip(arena_high, -box, box)
    middle = 0.5 * (low + high)
    crossed = low > high  # an arena narrower than a braking distance
    low, high = np.where(crossed, middle, low), np.where(crossed, middle, high)
    speed = math.dist((0.0, 0.0, 0.0), v_enu)
    return VehicleLimits(
        box_m_s2=box,
        low=low,
        high=high,
        arena_low=arena_low,
        arena_high=arena_high,
        v_enu=v_enu,
        speed_bound_m_s=max(config.speed_m_s, speed - 0.5 * box * dt_s),
        dt_s=dt_s,
    )
