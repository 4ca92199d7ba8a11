"""The target, or a list of waypoints flown in order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.config import LimitsConfig, TargetConfig
from companion.errors import ConfigError
from companion.types import Vec3, frozen

PASSED_M = 0.3  # a waypoint that is not the last counts as passed within this


class Route:
    """Holds where to fly; every new target is checked against the arena before it replaces the old one."""

    def __init__(self, target: TargetConfig, limits: LimitsConfig) -> None:
        self._limits = limits
        self._waypoints: tuple[Vec3, ...] = ()
        if target.position is not None:
            self._waypoints = (frozen(target.position),)

    @property
    def current(self) -> Vec3 | None:
        """The waypoint flown to now, ENU [m]; None: hold where engaged."""
        return self._waypoints[0] if self._waypoints else None

    @property
    def waypoints(self) -> tuple[Vec3, ...]:
        """The waypoint flown to now and those after it."""
        return self._waypoints

    def retune(self, limits: LimitsConfig) -> None:
        """Another arena for every target to come; ask `check` before."""
        self._limits = limits

    def check(self, limits: LimitsConfig) -> None:
        """Raise ConfigError where a waypoint of this route would lie outside the arena of ``limits``."""
        low, high = np.array(limits.arena_min), np.array(limits.arena_max)
        for waypoint in self._waypoints:
            if (waypoint < low).any() or (waypoint > high).any():
                raise ConfigError(f"limits.arena: expected the target {waypoint.tolist()} inside")

    def advance(self, p_enu: Vec3) -> None:
        """Drop the current waypoint once it is reached and another follows."""
        while len(self._waypoints) > 1 and float(np.linalg.norm(self._waypoints[0] - p_enu)) <= PASSED_M:
            self._waypoints = self._waypoints[1:]

    def set_position(self, position_enu: Vec3) -> str | None:
        """Replace the route by one target; why it is refused, or None."""
        return self.set_waypoints([position_enu])

    def set_waypoints(self, waypoints_enu: Sequence[Vec3]) -> str | None:
        """Replace the route; why it is refused, or None."""
        if not waypoints_enu:
            return "waypoints: expected at least one"
        low, high = np.array(self._limits.arena_min), np.array(self._limits.arena_max)
        for waypoint in waypoints_enu:
            if not np.isfinite(waypoint).all() or (waypoint < low).any() or (waypoint > high).any():
                inside = f"{list(self._limits.arena_min)} .. {list(self._limits.arena_max)}"
                return f"position: expected inside the arena {inside}, got {np.asarray(waypoint).tolist()}"
        self._waypoints = tuple(frozen(waypoint) for waypoint in waypoints_enu)
        return None
