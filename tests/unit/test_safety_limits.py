"""The vehicle's own limits: braking distances worked by hand, and a wall that is never passed."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config import LimitsConfig
from companion.safety.limits import BRAKING_SHARE, VehicleLimits, capability, vehicle_limits
from companion.safety.stopping import Braking

LIMITS = LimitsConfig()


def at(p: tuple[float, ...], v: tuple[float, ...], *, arena_on: bool = True, shrink: float = 0.0) -> VehicleLimits:
    can = capability(LIMITS, shrink_m_s2=shrink, dt_s=0.05)
    return vehicle_limits(np.array(p), np.array(v), LIMITS, can, arena_on=arena_on)


def test_braking_speed_by_hand() -> None:
    """2 m/s^2 on a 0.05 s grid: 4 m/s takes 4^2 / 4 + 4 * 0.025 = 4.1 m."""
    assert Braking(2.0, 0.05).speed(4.1) == pytest.approx(4.0)
    assert Braking(2.0, 0.05).speed(0.0) == pytest.approx(0.0)
    assert Braking(2.0, 0.05).speed(-0.5) == pytest.approx(-0.5)


def test_far_from_everything_only_the_box_is_left() -> None:
    limits = at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), shrink=0.25)
    assert limits.low.tolist() == [-2.75] * 3
    assert limits.high.tolist() == [2.75] * 3
    assert limits.admits(np.full(3, 2.75))
    assert not limits.admits(np.array([2.76, 0.0, 0.0]))


def test_near_a_wall_the_bound_is_the_braking_distance() -> None:
    limits = at((9.0, 0.0, 5.0), (1.5, 0.0, 0.0))
    distance = 10.0 - 9.0 - 0.075
    expected = (Braking(BRAKING_SHARE * 3.0, 0.05).speed(distance) - 1.5) / 0.05
    assert limits.arena_high[0] == pytest.approx(expected)
    slacks = limits.slacks(np.array([expected, 0.0, 0.0]))
    assert slacks["arena"] == pytest.approx(0.0, abs=1e-9)
    assert slacks["floor"] > 3.0


def test_floor_and_ceiling_have_their_own_names() -> None:
    low = at((0.0, 0.0, 0.3), (0.0, 0.0, 0.0)).slacks(np.array([0.0, 0.0, -1.0]))
    assert low["floor"] == pytest.approx(-1.0)
    assert low["arena"] > 0.0
    high = at((0.0, 0.0, 10.0), (0.0, 0.0, 0.0)).slacks(np.array([0.0, 0.0, 1.0]))
    assert high["ceiling"] == pytest.approx(-1.0)


@pytest.mark.parametrize("wall", [0, 1, 2])
def test_full_thrust_at_a_wall_stops_before_it(wall: int) -> None:
    p, v = np.array([0.0, 0.0, 5.0]), np.zeros(3)
    push = 3.0 * np.eye(3)[wall]
    for _ in range(400):
        limits = at(tuple(p), tuple(v))
        a = limits.clip(push[None])[0]
        assert min(limits.slacks(a).values()) > -1e-9
        p, v = p + 0.05 * v, v + 0.05 * a
    assert LIMITS.arena_max[wall] - 0.05 < p[wall] <= LIMITS.arena_max[wall] + 1e-9
    assert abs(v[wall]) < 1e-3


def test_outside_the_arena_no_limit_is_admitted_until_the_vehicle_returns() -> None:
    limits = at((12.0, 0.0, 5.0), (1.0, 0.0, 0.0))
    assert limits.high[0] == -3.0  # all that the box has
    assert not limits.admits(np.array([-3.0, 0.0, 0.0]))
    assert limits.slacks(np.array([-3.0, 0.0, 0.0]))["arena"] < 0.0
    below = at((-12.0, 0.0, 5.0), (0.0, 0.0, 0.0))
    assert not below.admits(np.array([3.0, 0.0, 0.0]))


def test_arena_off_leaves_the_box() -> None:
    limits = at((12.0, 0.0, 0.0), (0.0, 0.0, 0.0), arena_on=False)
    assert limits.admits(np.array([1.0, 0.0, -1.0]))


def test_bounds_of_opposite_walls_never_cross() -> None:
    """Arenas down to a centimetre, boxes down to nothing, far outside and fast: low <= high all the same."""
    rng = np.random.default_rng(0)
    for _ in range(500):
        width = 10.0 ** rng.uniform(-2.0, 1.0)
        arena = LimitsConfig(arena_min=(-width, -width, 0.3), arena_max=(width, width, 0.3 + width))
        shrink = float(rng.choice([0.0, 2.9, 3.0]))
        limits = vehicle_limits(
            rng.uniform(-20.0, 20.0, 3),
            rng.normal(0.0, 4.0, 3),
            arena,
            capability(arena, shrink_m_s2=shrink, dt_s=0.05),
        )
        assert (limits.low <= limits.high).all()


def test_speed_limit_is_the_norm_after_the_step() -> None:
    limits = at((0.0, 0.0, 5.0), (5.9, 0.0, 0.0))
    assert limits.slacks(np.array([1.0, 0.0, 0.0]))["speed"] == pytest.approx(1.0)
    assert limits.admits(np.array([1.9, 0.0, 0.0]))
    assert not limits.admits(np.array([2.1, 0.0, 0.0]))
    assert limits.fast(np.array([[2.1, 0.0, 0.0], [0.0, 0.0, 0.0]])) == pytest.approx([0.1, 0.0])


def test_above_the_speed_limit_half_the_box_must_slow_down() -> None:
    limits = at((0.0, 0.0, 5.0), (6.5, 0.0, 0.0), arena_on=False)
    assert limits.speed.radius * 0.05 == pytest.approx(6.5 - 0.5 * 3.0 * 0.05)
    assert limits.admits(np.array([-1.5001, 0.0, 0.0]))
    assert not limits.admits(np.array([-1.4, 0.0, 0.0]))


def test_speed_row_is_the_tangent_of_the_limit() -> None:
    limits = at((0.0, 0.0, 5.0), (5.0, 2.0, 0.0))
    a, step = np.array([1.0, -0.5, 0.3]), 1e-5
    normal, floor = limits.speed.tangent(a)
    slack = limits.slacks(a)["speed"]
    assert normal @ a - floor == pytest.approx(slack)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        difference = (limits.slacks(a + shift)["speed"] - limits.slacks(a - shift)["speed"]) / (2 * step)
        assert normal[axis] == pytest.approx(difference, abs=1e-6)


def test_the_speed_tangent_of_a_vehicle_at_rest_is_far_away() -> None:
    normal, floor = at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0)).speed.tangent(np.zeros(3))
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert floor == pytest.approx(-6.0 / 0.05)


def test_the_speed_limit_is_asked_where_a_corner_of_the_box_breaks_it() -> None:
    """At 45 degrees in all planes the corner gains sqrt(3) 3 m/s^2 0.05 s = 0.2598 m/s on a limit of 6 m/s."""
    along = np.ones(3) / np.sqrt(3.0)
    for speed, breaks in ((5.73, False), (5.75, True)):
        limits = at((0.0, 0.0, 5.0), tuple(speed * along), arena_on=False)
        corner = np.full((1, 3), 3.0)
        assert limits.may_speed is breaks
        assert (limits.fast(corner)[0] > 0.0) == breaks
        assert (float(np.linalg.norm(limits.v_enu + 0.05 * corner)) > 6.0) == breaks


def test_norm_and_tilt_are_asked_where_a_corner_of_the_box_breaks_them() -> None:
    """A corner of 3 m/s^2 has a norm of 5.196 and, falling, a tilt of atan(4.243 / 6.807) = 31.94 degrees."""
    for config, names in (
        (LimitsConfig(), []),
        (LimitsConfig(tilt_deg=None), []),
        (LimitsConfig(norm_m_s2=5.2, tilt_deg=32.0), []),
        (LimitsConfig(norm_m_s2=5.19, tilt_deg=31.9), ["norm", "tilt"]),
    ):
        assert [cone.name for cone in capability(config, shrink_m_s2=0.0, dt_s=0.05).cones] == names


def test_authority_is_what_every_direction_has() -> None:
    tilted = capability(LimitsConfig(tilt_deg=10.0), shrink_m_s2=0.0, dt_s=0.05)
    assert tilted.authority_m_s2 == pytest.approx(9.80665 * np.sin(np.radians(10.0)))
    assert tilted.braking.a_m_s2 == pytest.approx(tilted.authority_m_s2 / np.sqrt(3.0))  # three walls at once
    assert capability(LimitsConfig(norm_m_s2=1.5), shrink_m_s2=0.5, dt_s=0.05).authority_m_s2 == pytest.approx(
        1.5 - 0.5 * np.sqrt(3.0)  # whatever the disturbance estimate adds stays inside
    )
    assert capability(LimitsConfig(norm_m_s2=9.0), shrink_m_s2=0.5, dt_s=0.05).authority_m_s2 == 2.5
    directions = np.random.default_rng(0).standard_normal((500, 3))
    directions *= 0.999 * tilted.authority_m_s2 / np.linalg.norm(directions, axis=1, keepdims=True)
    assert all((cone.excess(directions) <= 0.0).all() for cone in tilted.cones)


def test_slew_is_a_box_about_the_last_setpoint_within_the_other() -> None:
    config = LimitsConfig(slew_m_s3=10.0)
    can = capability(config, shrink_m_s2=0.0, dt_s=0.05)
    p, v, before = np.array([0.0, 0.0, 5.0]), np.zeros(3), np.array([2.9, 0.0, -3.5])
    limits = vehicle_limits(p, v, config, can, before=before, elapsed_s=0.02)
    assert limits.low == pytest.approx([2.7, -0.2, -3.0])
    assert limits.high == pytest.approx([3.0, 0.2, -2.8])
    assert limits.inside == pytest.approx([2.9, 0.0, -3.0])
    assert vehicle_limits(p, v, config, can).high == pytest.approx([0.5, 0.5, 0.5])  # from hover, one dt
    assert not limits.admits(np.array([2.9, 0.21, -3.0]))
    assert limits.admits(np.array([2.9, 0.19, -3.0]))


def test_the_speed_limit_counts_the_time_to_slew_back() -> None:
    config = LimitsConfig(slew_m_s3=10.0)
    can = capability(config, shrink_m_s2=0.0, dt_s=0.05)
    limits = vehicle_limits(np.array([0.0, 0.0, 5.0]), np.array([5.0, 0.0, 0.0]), config, can)
    a = np.array([1.0 / 0.35, 0.0, 0.0])  # 0.05 s and 3 / 10 s
    assert limits.slacks(a)["speed"] == pytest.approx(0.0, abs=1e-9)


def test_a_limit_tightened_below_the_last_setpoint_has_a_point_inside() -> None:
    config = LimitsConfig(norm_m_s2=1.0, slew_m_s3=10.0)
    can = capability(config, shrink_m_s2=0.0, dt_s=0.05)
    limits = vehicle_limits(np.array([0.0, 0.0, 5.0]), np.zeros(3), config, can, before=np.array([2.0, 0.0, 0.0]))
    assert limits.inside == pytest.approx([1.0, 0.0, 0.0])
    assert limits.clip(np.array([[3.0, 3.0, 3.0]]))[0] == pytest.approx(
        limits.clip_hard(np.array([[3.0, 3.0, 3.0]]))[0]
    )
    assert np.linalg.norm(limits.clip(np.array([[3.0, 3.0, 3.0]]))[0]) <= 1.0 + 1e-9
    assert set(limits.slacks(np.zeros(3))) == {"arena", "floor", "ceiling", "speed", "norm"}


@pytest.mark.parametrize(
    ("p", "a", "name"),
    [
        ((9.0, 0.0, 5.0), (1.0, 0.0, 0.0), "arena"),
        ((-9.0, 0.0, 5.0), (-1.0, 0.0, 0.0), "arena"),
        ((0.0, 9.0, 5.0), (0.0, 1.0, 0.0), "arena"),
        ((0.0, -9.0, 5.0), (0.0, -1.0, 0.0), "arena"),
        ((0.0, 0.0, 9.0), (0.0, 0.0, 1.0), "ceiling"),
        ((0.0, 0.0, 1.3), (0.0, 0.0, -1.0), "floor"),
    ],
)
def test_every_wall_has_its_slack(p: tuple[float, ...], a: tuple[float, ...], name: str) -> None:
    """A metre away at rest: the speed that stops within it, reached in one step, less what is asked."""
    limits = at(p, (0.0, 0.0, 0.0))
    free = Braking(BRAKING_SHARE * 3.0, 0.05).speed(1.0) / 0.05
    slacks = limits.slacks(np.array(a))
    assert slacks[name] == pytest.approx(free - 1.0)
    assert all(slacks[other] > slacks[name] + 1.0 for other in {"arena", "floor", "ceiling"} - {name})
    fast = at(p, tuple(2.0 * component for component in a))
    into = np.array([3.0, 3.0, 3.0]) * a
    assert np.abs(fast.clip(into[None])[0]).max() < 3.0
    assert fast.clip_hard(into[None])[0].tolist() == into.tolist()
    assert not fast.admits(into)
    assert fast.admits(fast.clip(into[None])[0])


def test_what_the_limits_are_made_of() -> None:
    limits = at((0.0, 0.0, 5.0), (1.0, 2.0, 3.0), shrink=1.0)
    assert limits.box_m_s2 == 2.0
    assert limits.v_enu.tolist() == [1.0, 2.0, 3.0]
    assert limits.inside.tolist() == [0.0, 0.0, 0.0]
    assert limits.hard_low.tolist() == [-2.0, -2.0, -2.0]
    assert limits.hard_high.tolist() == [2.0, 2.0, 2.0]
    free = at((0.0, 0.0, 5.0), (1.0, 2.0, 3.0), arena_on=False)
    assert free.arena_low.tolist() == [-np.inf] * 3
    assert free.arena_high.tolist() == [np.inf] * 3
    can = capability(LimitsConfig(slew_m_s3=7.0), shrink_m_s2=4.0, dt_s=0.02)
    assert (can.box_m_s2, can.authority_m_s2) == (0.0, 0.0)
    assert (can.braking.a_m_s2, can.braking.dt_s, can.braking.slew_m_s3) == (0.0, 0.02, 7.0)


def test_what_another_rounds_otherwise_is_admitted() -> None:
    nothing = at((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), shrink=3.0)
    assert nothing.admits(np.array([1e-9, 0.0, -1e-9]))
    assert not nothing.admits(np.array([2e-9, 0.0, 0.0]))
    assert not nothing.admits(np.array([0.0, 0.0, -2e-9]))


def test_exactly_at_the_speed_limit_is_admitted() -> None:
    can = capability(LIMITS, shrink_m_s2=0.0, dt_s=0.5)
    limits = vehicle_limits(np.array([0.0, 0.0, 5.0]), np.array([5.0, 0.0, 0.0]), LIMITS, can, arena_on=False)
    assert limits.may_speed
    assert limits.admits(np.array([2.0, 0.0, 0.0]))
    assert not limits.admits(np.array([2.001, 0.0, 0.0]))


def test_norm_and_tilt_are_admitted_and_clipped_to() -> None:
    config = LimitsConfig(norm_m_s2=2.0, tilt_deg=10.0)
    can = capability(config, shrink_m_s2=0.0, dt_s=0.05)
    limits = vehicle_limits(np.array([0.0, 0.0, 5.0]), np.zeros(3), config, can)
    assert limits.admits(np.array([0.0, 0.0, 2.0]))
    assert not limits.admits(np.array([0.0, 0.0, 2.01]))
    side = 9.80665 * np.tan(np.radians(10.0))  # 1.729
    assert limits.admits(np.array([0.0, side - 1e-6, 0.0]))
    assert not limits.admits(np.array([0.0, side + 1e-6, 0.0]))
    clipped = limits.clip(np.array([[0.0, 0.0, 3.0], [3.0, 0.0, 0.0], [0.5, 0.5, 0.5]]))
    assert clipped == pytest.approx(np.array([[0.0, 0.0, 2.0], [side, 0.0, 0.0], [0.5, 0.5, 0.5]]))
    assert limits.slacks(np.array([0.0, 0.0, 0.5]))["norm"] == pytest.approx(1.5)
    assert limits.slacks(np.zeros(3))["tilt"] == pytest.approx(side * np.cos(np.radians(10.0)))


def test_cones_are_clipped_to_along_the_way_from_the_last_setpoint() -> None:
    """From (0, 1.2, 0) towards (0.5, 1.7, 0), the corner that slew leaves: |a| = 1.5 after a share s of the way.

    0.5 s^2 + 1.2 s + 1.44 = 2.25, so s = -1.2 + sqrt(1.44 + 1.62).
    """
    config = LimitsConfig(norm_m_s2=1.5, slew_m_s3=10.0)
    can = capability(config, shrink_m_s2=0.0, dt_s=0.05)
    before = np.array([0.0, 1.2, 0.0])
    limits = vehicle_limits(np.array([0.0, 0.0, 5.0]), np.zeros(3), config, can, before=before)
    share = -1.2 + np.sqrt(3.06)
    expected = before + share * np.array([0.5, 0.5, 0.0])
    assert limits.clip(np.array([[3.0, 3.0, 0.0]]))[0] == pytest.approx(expected)


def test_a_position_and_a_velocity_have_as_many_components() -> None:
    can = capability(LIMITS, shrink_m_s2=0.0, dt_s=0.05)
    with pytest.raises(ValueError, match="shorter"):
        vehicle_limits(np.array([0.0, 0.0, 5.0]), np.zeros(2), LIMITS, can)
