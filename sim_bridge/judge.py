"""Was the target reached, was anything touched: judged at every physics step from the entry into offboard on.

Reached: the path segment of a step passes within ``reach_m`` of the target, and from there the vehicle stays within
``hold_m`` for ``hold_s``. Leaving before that voids the arrival: flying through does not count.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sim_bridge.messages import NS_PER_S, Vec3
from sim_bridge.scenario import End


@dataclass(frozen=True, slots=True)
class Approach:
    """The moment at which one obstacle was closest; time from the entry into offboard."""

    id: str
    t_s: float
    clearance_m: float
    p_enu: Vec3
    p_obstacle_enu: Vec3


class Judge:
    """One flight, from ``start_ns`` on.

    Args:
        radius_m: the vehicle's; ids, radii_m: the obstacles', in the order of the positions given to `approach`.
    """

    def __init__(
        self,
        end: End,
        target_enu: Vec3 | None,
        *,
        start_ns: int,
        p_enu: Vec3,
        radius_m: float,
        ids: Sequence[str],
        radii_m: Sequence[float],
    ) -> None:
        self.start_ns = start_ns
        self.min_clearance_m = math.inf
        self.collided_ns: int | None = None
        self.reached_ns: int | None = None
        self.approaches: list[Approach | None] = [None] * len(ids)
        self._end = end
        self._target_enu = target_enu
        self._arrived_ns: float | None = None
        self._last: tuple[int, Vec3] = (start_ns, p_enu)
        self._reach_sum_m = [radius_m + r for r in radii_m]
        self._nearest_m = [math.inf] * len(ids)
        self._ids = tuple(ids)

    def step(self, t_ns: int, p_enu: Vec3, clearance_m: float, *, grounded: bool) -> None:
        """Take the state after one physics step; ``grounded``: the vehicle touches the ground where it must not."""
        self.min_clearance_m = min(self.min_clearance_m, clearance_m)
        if self.collided_ns is None and (grounded or self.min_clearance_m <= 0.0):
            self.collided_ns = t_ns
        if self._target_enu is not None and self.reached_ns is None:
            self._watch_arrival(self._target_enu, t_ns, p_enu)
        self._last = (t_ns, p_enu)

    def approach(self, t_ns: int, p_enu: Vec3, obstacles_enu: Sequence[Vec3]) -> None:
        """Keep the closest approach of each obstacle; positions in the order of ``ids``."""
        for i, p_obstacle_enu in enumerate(obstacles_enu):
            clearance_m = math.dist(p_enu, p_obstacle_enu) - self._reach_sum_m[i]
            if clearance_m < self._nearest_m[i]:
                self._nearest_m[i] = clearance_m
                since_s = (t_ns - self.start_ns) / NS_PER_S
                self.approaches[i] = Approach(self._ids[i], since_s, clearance_m, p_enu, p_obstacle_enu)

    def verdict(self, t_ns: int) -> str | None:
        """Why the flight is over, or None."""
        if self.collided_ns is not None:
            over = t_ns - self.collided_ns >= self._end.collision_s * NS_PER_S
            return "collision" if over else None
        if self.reached_ns is not None:
            return "reached"
        return "timeout" if t_ns - self.start_ns >= self._end.timeout_s * NS_PER_S else None

    @property
    def flight_time_s(self) -> float | None:
        """From the start to the instant within reach of the target, None if it was not reached."""
        if self.reached_ns is None or self._arrived_ns is None:
            return None
        return (self._arrived_ns - self.start_ns) / NS_PER_S

    def _watch_arrival(self, target_enu: Vec3, t_ns: int, p_enu: Vec3) -> None:
        last_ns, last_enu = self._last
        if self._arrived_ns is None:
            distance_m, share = distance_to_segment(target_enu, last_enu, p_enu)
            if distance_m > self._end.reach_m:
                return
            self._arrived_ns = last_ns + share * (t_ns - last_ns)
        if math.dist(p_enu, target_enu) > self._end.hold_m:
            self._arrived_ns = None
        elif t_ns - self._arrived_ns >= self._end.hold_s * NS_PER_S:
            self.reached_ns = t_ns


def distance_to_segment(point: Vec3, start: Vec3, end: Vec3) -> tuple[float, float]:
    """Least distance from ``point`` to the segment, and where on it that is (0 start, 1 end).

    >>> distance_to_segment((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (3.0, 0.0, 0.0))
    (1.0, 0.25)
    """
    (ax, ay, az), (bx, by, bz), (px, py, pz) = start, end, point
    dx, dy, dz = bx - ax, by - ay, bz - az
    length2 = dx * dx + dy * dy + dz * dz
    along = (px - ax) * dx + (py - ay) * dy + (pz - az) * dz
    share = min(1.0, max(0.0, along / length2)) if length2 > 0.0 else 0.0
    nearest = (ax + share * dx, ay + share * dy, az + share * dz)
    return math.dist(point, nearest), share
