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
_DIAGONAL = math.sqrt(3.0)  # of a cube of half-side 1, from its centre
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
    may_speed: bool = True  # whether an acceleration of the box can break the speed limit at all

    def slacks(self, a: Vec3) -> dict[str, float]:
        """Room left of each limit at ``a``, negative where broken [m/s^2]."""
        below, above = (a - self.arena_low).tolist(), (self.arena_high - a).tolist()
        return {
            "arena": min(below[0], below[1], above[0], above[1]),
            "floor": below[2],
            "ceiling": above[2],
            "speed": (self.speed_bound_m_s - self._speed_after(a)) / self.dt_s,
        }

    def _speed_after(self, a: Vec3) -> float:
        return math.hypot(*(self.v_enu + a * self.dt_s).tolist())

    def admits(self, a: Vec3) -> bool:
        """Whether ``a`` keeps every limit."""
        box = self.box_m_s2
        for x, low, high in zip(a.tolist(), self.arena_low.tolist(), self.arena_high.tolist(), strict=True):
            if not max(low, -box) - ROUNDING_M_S2 <= x <= min(high, box) + ROUNDING_M_S2:
                return False
        return self._speed_after(a) <= self.speed_bound_m_s

    def slow(self, a: FloatArray) -> FloatArray:
        """How far each of ``a`` (C, 3), within the box, breaks the speed limit, 0 where it holds [m/s^2]."""
        if not self.may_speed:
            return np.zeros(len(a))
        v = self.v_enu + a * self.dt_s
        speed = np.sqrt(np.vecdot(v, v))
        return np.asarray(np.maximum(speed - self.speed_bound_m_s, 0.0) / self.dt_s)

    def speed_row(self, a: Vec3) -> tuple[FloatArray, float]:
        """The tangent of the speed limit at ``a`` as ``normal @ a >= floor``."""
        v = self.v_enu + a * self.dt_s
        speed = math.hypot(*v.tolist())
        if speed < 1e-9:
            return np.zeros(3), -self.speed_bound_m_s / self.dt_s
        normal = -v / speed
        return normal, -(self.speed_bound_m_s + float(normal @ self.v_enu)) / self.dt_s

    def clip(self, a: FloatArray) -> FloatArray:
        """``a`` (..., 3) into box and arena."""
        inside = np.maximum(a, self.low)
        return np.minimum(inside, self.high, out=inside)


def braking_speed(distance_m: float, braking_m_s2: float, dt_s: float) -> float:
    """Largest speed that stops within ``distance_m``: v^2 / (2 a) + v dt / 2 = d; towards the inside where d < 0.

    The way back is no faster than what stops within |d|: the bounds of two opposite walls never cross.
    """
    half = 0.5 * braking_m_s2 * dt_s
    stops = math.sqrt(half * half + 2.0 * braking_m_s2 * abs(distance_m)) - half
    return stops if distance_m >= 0.0 else -min(-RETURN_RATE_HZ * distance_m, stops)


def vehicle_limits(
    p_enu: Vec3, v_enu: Vec3, config: LimitsConfig, *, arena_on: bool, shrink_m_s2: float, dt_s: float
) -> VehicleLimits:
    """The limits at one vehicle state; the box is shrunk by what the disturbance estimate may add."""
    box = max(config.acceleration_m_s2 - shrink_m_s2, 0.0)
    arena_low, arena_high = [-math.inf] * 3, [math.inf] * 3
    low, high = [-box] * 3, [box] * 3
    velocity = v_enu.tolist()
    if arena_on:
        for axis, (p, v) in enumerate(zip(p_enu.tolist(), velocity, strict=True)):
            ahead = p + v * dt_s
            up = braking_speed(config.arena_max[axis] - ahead, BRAKING_SHARE * box, dt_s)
            down = braking_speed(ahead - config.arena_min[axis], BRAKING_SHARE * box, dt_s)
            arena_low[axis], arena_high[axis] = (-down - v) / dt_s, (up - v) / dt_s
            low[axis] = min(max(arena_low[axis], -box), box)
            high[axis] = min(max(arena_high[axis], -box), box)
    bounds = np.array((low, high, arena_low, arena_high))
    speed = math.hypot(*velocity)
    bound = max(config.speed_m_s, speed - 0.5 * box * dt_s)
    return VehicleLimits(
        box_m_s2=box,
        low=bounds[0],
        high=bounds[1],
        arena_low=bounds[2],
        arena_high=bounds[3],
        v_enu=v_enu,
        speed_bound_m_s=bound,
        dt_s=dt_s,
        may_speed=speed + _DIAGONAL * box * dt_s > bound,
    )
