"""Jerk-limited kinematic shaping, as ArduPilot's position controller does it: a reference that a vehicle can follow.

A reference (p, v, a) of one axis group, east and north together or up alone, moves by p' = v, v' = a; only a is
steered, and it changes no faster than the jerk limit j:

    a* = a_ff + sat_A(sqrt(v* - v; j / A, j)),  v* = v_ff + sat_V(sqrt(p* - p; j / 2A, A)),
    a <- a + sat_{j dt}(a* - a)

where sqrt(e; k, d) is k e for small errors and the speed sqrt(2 d (|e| - d / 2 k^2)) from which a constant
deceleration d comes to rest beyond. Without p* the velocity alone is followed; without v* the acceleration alone.
Sources: ArduPilot's AC_PosControl and AP_Math/control.cpp (input_accel, input_vel_accel, input_pos), in our own words.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

Axes: TypeAlias = tuple[float, ...]  # (east, north) or (up,)


@dataclass(frozen=True, slots=True)
class Goal:
    """What one axis group shall do; ``p`` None leaves its position free, ``v`` None its velocity as well."""

    a: Axes  # [m/s^2]
    v: Axes | None = None  # [m/s]
    p: Axes | None = None  # [m]


@dataclass(frozen=True, slots=True)
class Limits:
    speed_m_s: float
    accel_m_s2: float
    jerk_m_s3: float


@dataclass(frozen=True, slots=True)
class Reference:
    """Where one axis group should be now, how fast, and under which acceleration."""

    p: Axes
    v: Axes
    a: Axes

    def moved(self, goal: Goal, limits: Limits, dt_s: float) -> Reference:
        """After ``dt_s``: first along its acceleration, which is then steered towards ``goal``."""
        p = tuple(x + u * dt_s + 0.5 * a * dt_s * dt_s for x, u, a in zip(self.p, self.v, self.a, strict=True))
        v = tuple(u + a * dt_s for u, a in zip(self.v, self.a, strict=True))
        wanted = _acceleration(goal, p, v, limits, dt_s)
        step = shortened(tuple(w - a for w, a in zip(wanted, self.a, strict=True)), limits.jerk_m_s3 * dt_s)
        return Reference(p, v, tuple(a + d for a, d in zip(self.a, step, strict=True)))


def _acceleration(goal: Goal, p: Axes, v: Axes, limits: Limits, dt_s: float) -> Axes:
    if goal.v is None:
        return goal.a
    jerk, accel = limits.jerk_m_s3, limits.accel_m_s2
    v_goal = goal.v
    if goal.p is not None:
        error = tuple(w - x for w, x in zip(goal.p, p, strict=True))
        approach = shortened(_sqrt_law(error, 0.5 * jerk / accel, accel, dt_s), limits.speed_m_s)
        v_goal = tuple(f + c for f, c in zip(v_goal, approach, strict=True))
    error = tuple(w - u for w, u in zip(v_goal, v, strict=True))
    correction = shortened(_sqrt_law(error, jerk / accel, jerk, dt_s), accel)
    return tuple(f + c for f, c in zip(goal.a, correction, strict=True))


def _sqrt_law(error: Axes, gain_per_s: float, decay: float, dt_s: float) -> Axes:
    """The rate that takes an error away: linear while small, then such that ``decay`` can still stop it."""
    size = math.hypot(*error)
    if size <= 0.0:
        return error
    linear = decay / (gain_per_s * gain_per_s)
    rate = gain_per_s * size if size <= linear else math.sqrt(2.0 * decay * (size - 0.5 * linear))
    rate = min(rate, size / dt_s)
    return tuple(x * rate / size for x in error)


def shortened(v: Axes, longest: float) -> Axes:
    """``v``, or the vector of length ``longest`` in its direction where ``v`` is longer.

    >>> shortened((3.0, 4.0), 1.0)
    (0.6, 0.8)
    """
    length = math.hypot(*v)
    if length <= longest:
        return v
    return tuple(x * longest / length for x in v)
