"""An obstacle that chases a vehicle: the one motion with a state.

The world advances it once a physics step with the vehicles' true states. Of two flights with the same commands it
makes the same path: nothing is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, Protocol, runtime_checkable

from sim_bridge.obstacles import AWAY_ENU, Motion, Point

_REST: Point = (0.0, 0.0, 0.0)
_LEAST = 1e-9  # [m], [m/s]: no direction below


class Moving(Protocol):
    """What a pursuer sees of a vehicle."""

    @property
    def p_enu(self) -> Point: ...

    @property
    def v_enu(self) -> Point: ...


@runtime_checkable
class Reacting(Motion, Protocol):
    """A motion that depends on the vehicles."""

    def reset(self) -> None:
        """Back to the start, as at t = 0 of the motions' clock."""

    def advance(self, dt_s: float, vehicles: Sequence[Moving]) -> None:
        """One physics step of the motions' clock; ``vehicles`` as they are at its beginning, in the fleet's order."""


class Pursuit:
    """From ``start_s`` on it accelerates, by at most ``accel_m_s2`` and up to ``speed_m_s``, after one vehicle.

    With r = p_target - p and w = v_target - v:

        pure            towards the vehicle: a = (speed r/|r| - v) / dt
        proportional    a = N w x (r x w) / |r|^2 across, and along v whatever restores the speed

    (true proportional navigation: Zarchan, Tactical and Strategic Missile Guidance, chapter 2). Both are cut to the
    acceleration, then the speed is cut. Within a step the acceleration is constant, so positions and velocities of
    successive steps agree exactly. From ``until_s`` on the pursuer flies straight on; from ``end_s`` on it is away.
    """

    def __init__(
        self,
        origin_enu: Point,
        *,
        target: int,
        speed_m_s: float,
        accel_m_s2: float,
        v0_enu: Point = _REST,
        law: Literal["pure", "proportional"] = "pure",
        navigation: float = 3.0,
        start_s: float = 0.0,
        until_s: float = math.inf,
        end_s: float = math.inf,
    ) -> None:
        self.origin_enu = origin_enu
        self.target = target
        self._speed_m_s, self._accel_m_s2, self._v0_enu = speed_m_s, accel_m_s2, v0_enu
        self._law, self._navigation = law, navigation
        self._start_s, self._until_s, self._end_s = start_s, until_s, end_s
        self.reset()

    def reset(self) -> None:
        self._steps, self._t_s = 0, 0.0
        self._p_enu, self._v_enu = self.origin_enu, self._v0_enu

    def position(self, t_s: float) -> Point:
        """Exact at the time of the last step; a little later or earlier along the velocity."""
        if not self._start_s <= t_s < self._end_s:
            return AWAY_ENU
        since_s = t_s - self._t_s
        (px, py, pz), (vx, vy, vz) = self._p_enu, self._v_enu
        if abs(since_s) < _LEAST or self._t_s < self._start_s:
            return self._p_enu
        return (px + vx * since_s, py + vy * since_s, pz + vz * since_s)

    def velocity(self, t_s: float) -> Point:
        return self._v_enu if self._start_s <= t_s < self._end_s else _REST

    def advance(self, dt_s: float, vehicles: Sequence[Moving]) -> None:
        t_s = self._t_s
        self._steps += 1
        self._t_s = self._steps * dt_s  # not a sum: it must agree with the world's own count
        if t_s < self._start_s - _LEAST:
            return
        v = self._v_enu
        vn = v if t_s >= self._until_s else self._steered(dt_s, vehicles[self.target])
        (px, py, pz), half = self._p_enu, 0.5 * dt_s
        self._p_enu = (px + half * (v[0] + vn[0]), py + half * (v[1] + vn[1]), pz + half * (v[2] + vn[2]))
        self._v_enu = vn

    def _steered(self, dt_s: float, vehicle: Moving) -> Point:
        """The velocity one step later."""
        v = self._v_enu
        r = _minus(vehicle.p_enu, self._p_enu)
        if math.hypot(*r) < _LEAST:
            return v
        if self._law == "pure" or math.hypot(*v) < 0.5 * self._speed_m_s:  # from rest: first gain speed
            change = _minus(_scaled(r, self._speed_m_s), v)
        else:
            w = _minus(vehicle.v_enu, v)
            turn = _cross(w, _cross(r, w))
            gain = self._navigation * dt_s / math.hypot(*r) ** 2
            restored = _minus(_scaled(v, self._speed_m_s), v)
            change = (
                gain * turn[0] + restored[0],
                gain * turn[1] + restored[1],
                gain * turn[2] + restored[2],
            )
        x, y, z = _cut(change, self._accel_m_s2 * dt_s)
        return _cut((v[0] + x, v[1] + y, v[2] + z), self._speed_m_s)


def _minus(a: Point, b: Point) -> Point:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _cross(a: Point, b: Point) -> Point:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _scaled(a: Point, length: float) -> Point:
    """``a`` made ``length`` long."""
    factor = length / math.hypot(*a)
    return (a[0] * factor, a[1] * factor, a[2] * factor)


def _cut(a: Point, longest: float) -> Point:
    return a if math.hypot(*a) <= longest else _scaled(a, longest)
