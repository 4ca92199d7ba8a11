"""Limits of the vehicle as constraints on the same acceleration.

What the vehicle cannot exceed is kept by every answer: the acceleration box, slew (a box about the last setpoint, one
tick wide), norm and tilt (`cone`), each less what the disturbance estimate may add on the wire. Arena with floor and
ceiling: one braking distance ahead of each wall (`stopping`), a bound on one component of a; braking counts on a share
of what the vehicle has only, so that lag and disturbance find something left, and where norm or tilt bind on no more
than three walls at once leave each of them. Speed: |v + a t| <= v_max with t = dt, and with a slew limit the time to
slew from the box to nothing on top; above it, slow down by half of what the box allows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.config import LimitsConfig
from companion.safety.cone import Cone, norm_cone, speed_cone, tilt_cone
from companion.safety.stopping import Braking
from companion.types import FloatArray, Vec3

BRAKING_SHARE = 0.7  # of the acceleration in every direction, counted on for stopping at a wall
ROUNDING_M_S2 = 1e-9  # a reference clipped to the same box by someone else may differ in the last bits
DIAGONAL = math.sqrt(3.0)  # of a cube of half-side 1, from its centre


@dataclass(frozen=True, slots=True)
class VehicleLimits:
    """What the vehicle's limits leave of one tick's acceleration, ENU [m/s^2]."""

    box_m_s2: float  # each axis
    hard_low: Vec3  # box and slew, what no answer leaves
    hard_high: Vec3
    low: Vec3  # the same and the arena, never empty
    high: Vec3
    arena_low: Vec3  # what the arena asks, possibly beyond box and slew
    arena_high: Vec3
    v_enu: Vec3  # [m/s]
    speed: Cone
    may_speed: bool  # whether an acceleration of the box can break the speed limit at all
    cones: tuple[Cone, ...]  # norm and tilt, where an acceleration of the box can break them
    inside: Vec3  # a point of all hard limits

    def slacks(self, a: Vec3) -> dict[str, float]:
        """Room left of each limit at ``a``, negative where broken [m/s^2]."""
        below, above = (a - self.arena_low).tolist(), (self.arena_high - a).tolist()
        room = {
            "arena": min(below[0], below[1], above[0], above[1]),
            "floor": below[2],
            "ceiling": above[2],
            "speed": -float(self.speed.excess(a)),
        }
        return room | {cone.name: -float(cone.excess(a)) for cone in self.cones}

    def admits(self, a: Vec3) -> bool:
        """Whether ``a`` keeps every limit."""
        outside = np.maximum(self.hard_low, self.arena_low) - a, a - np.minimum(self.hard_high, self.arena_high)
        if max(*outside[0].tolist(), *outside[1].tolist()) > ROUNDING_M_S2:
            return False
        if self.may_speed and self.speed.excess(a) > 0.0:
            return False
        return all(cone.excess(a) <= ROUNDING_M_S2 for cone in self.cones)

    def fast(self, a: FloatArray) -> FloatArray:
        """How far each of ``a`` (C, 3) breaks the speed limit, 0 where it holds [m/s^2]."""
        return np.maximum(self.speed.excess(a), 0.0) if self.may_speed else np.zeros(len(a))

    def within(self, a: FloatArray, tolerance_m_s2: float) -> npt.NDArray[np.bool_]:
        """Whether each of ``a`` (C, 3) is inside box, slew and what of the arena they can keep, (C,)."""
        inside = (a >= self.low - tolerance_m_s2) & (a <= self.high + tolerance_m_s2)
        return np.asarray(np.logical_and.reduce(inside, axis=-1))

    def clip(self, a: FloatArray) -> FloatArray:
        """``a`` (C, 3) into box, slew and arena, then the cones, which may lead out of the arena again."""
        return self._into(a, self.low, self.high)

    def clip_hard(self, a: FloatArray) -> FloatArray:
        """``a`` (C, 3) into box, slew and cones: what the vehicle can do at all."""
        return self._into(a, self.hard_low, self.hard_high)

    def _into(self, a: FloatArray, low: Vec3, high: Vec3) -> FloatArray:
        clipped = np.maximum(a, low)
        np.minimum(clipped, high, out=clipped)
        for cone in self.cones:  # towards a point inside of what the vehicle can do: box and slew stay kept
            clipped = self.inside + cone.share(self.inside, clipped)[:, None] * (clipped - self.inside)
        return clipped


@dataclass(frozen=True, slots=True)
class Capability:
    """What the configuration lets a vehicle do, less what the disturbance estimate may add."""

    box_m_s2: float
    braking: Braking
    authority_m_s2: float  # in every direction from hover
    cones: tuple[Cone, ...]


def capability(config: LimitsConfig, *, shrink_m_s2: float, dt_s: float) -> Capability:
    """The same for every tick of one configuration."""
    box = max(config.acceleration_m_s2 - shrink_m_s2, 0.0)
    cones = []
    if config.norm_m_s2 is not None:
        cones.append(norm_cone(config.norm_m_s2))
    if config.tilt_deg is not None:
        cones.append(tilt_cone(config.tilt_deg))
    cones = [cone.shrunk(shrink_m_s2) for cone in cones]
    corners = box * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    binding = tuple(cone for cone in cones if cone.excess(corners).max() > 0.0)
    authority = min(box, *(cone.reach for cone in binding)) if binding else box
    share = min(BRAKING_SHARE, 1.0 / DIAGONAL) if binding else BRAKING_SHARE
    return Capability(box, Braking(share * authority, dt_s, config.slew_m_s3), authority, binding)


def vehicle_limits(
    p_enu: Vec3,
    v_enu: Vec3,
    config: LimitsConfig,
    can: Capability,
    *,
    arena_on: bool = True,
    before: Vec3 | None = None,
    elapsed_s: float | None = None,
) -> VehicleLimits:
    """The limits at one vehicle state.

    Args:
        before: the last setpoint sent [m/s^2], for slew; None: hover.
        elapsed_s: vehicle time since then; None: dt.
    """
    box, braking = can.box_m_s2, can.braking
    hard_low, hard_high = [-box] * 3, [box] * 3
    inside = [0.0] * 3
    if braking.slew_m_s3 is not None:
        step = braking.slew_m_s3 * (braking.dt_s if elapsed_s is None else elapsed_s)
        inside = [min(max(x, -box), box) for x in (inside if before is None else before.tolist())]
        hard_low = [max(x - step, -box) for x in inside]
        hard_high = [min(x + step, box) for x in inside]
    arena_low, arena_high = [-math.inf] * 3, [math.inf] * 3
    low, high = hard_low.copy(), hard_high.copy()
    if arena_on:
        for axis, (p, v) in enumerate(zip(p_enu.tolist(), v_enu.tolist(), strict=True)):
            arena_high[axis] = braking.bound(config.arena_max[axis] - p, v)
            arena_low[axis] = -braking.bound(p - config.arena_min[axis], -v)
            low[axis] = min(max(arena_low[axis], low[axis]), hard_high[axis])
            high[axis] = max(min(arena_high[axis], high[axis]), low[axis])
    bounds = np.array((hard_low, hard_high, low, high, arena_low, arena_high, inside))
    centre = bounds[6]
    for cone in can.cones:  # rounding, or a setpoint from before the limits were tightened
        centre = centre * cone.share(np.zeros(3), centre[None])
    speed = math.hypot(*v_enu.tolist())
    ahead_s = braking.dt_s + (box / braking.slew_m_s3 if braking.slew_m_s3 else 0.0)
    bound = max(config.speed_m_s, speed - 0.5 * box * braking.dt_s)
    return VehicleLimits(
        box_m_s2=box,
        hard_low=bounds[0],
        hard_high=bounds[1],
        low=bounds[2],
        high=bounds[3],
        arena_low=bounds[4],
        arena_high=bounds[5],
        v_enu=v_enu,
        speed=speed_cone(v_enu, bound, ahead_s),
        may_speed=speed + DIAGONAL * box * ahead_s > bound,
        cones=can.cones,
        inside=centre,
    )
