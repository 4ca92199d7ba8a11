"""Targets and waypoints."""

from __future__ import annotations

import numpy as np

from companion.config import LimitsConfig, TargetConfig
from companion.route import Route
from companion.types import frozen


def test_waypoints_are_flown_in_order_and_the_last_is_kept() -> None:
    route = Route(TargetConfig(), LimitsConfig())
    assert route.current is None
    assert route.set_waypoints([frozen([1, 0, 2]), frozen([2, 0, 2])]) is None
    route.advance(frozen([0, 0, 2]))
    np.testing.assert_array_equal(route.current, [1, 0, 2])
    route.advance(frozen([0.8, 0, 2]))
    np.testing.assert_array_equal(route.current, [2, 0, 2])
    route.advance(frozen([2, 0, 2]))
    np.testing.assert_array_equal(route.current, [2, 0, 2])


def test_refused_targets_leave_the_old_one() -> None:
    route = Route(TargetConfig(position=(1.0, 1.0, 1.0)), LimitsConfig())
    assert "inside the arena" in (route.set_position(frozen([0, 0, 0.1])) or "")
    assert "inside the arena" in (route.set_position(frozen([np.nan, 0, 1])) or "")
    assert "at least one" in (route.set_waypoints([]) or "")
    assert route.set_waypoints([frozen([0, 0, 1]), frozen([11, 0, 1])]) is not None
    np.testing.assert_array_equal(route.current, [1, 1, 1])
