"""Braking and swerving distances by hand and by integration; walls and large obstacles in closed loop."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_scenes import uniform_motion

from companion.config import LimitsConfig, SafetyConfig
from companion.safety.filter import FilterInput, SafetyFilter
from companion.safety.stopping import Braking, StopRows, stop_rows, swerve_m
from companion.types import Verdict

DT = 0.05


def flown(a: float, v: float, braking: Braking, slew: float) -> float:
    """Greatest distance after the coming step, integrated: slew to -a_b, half a grid step late, brake, stop."""
    v, x, best, h = v + a * DT, 0.0, 0.0, 1e-3
    late = True
    while v > 0.0 or a > 0.0:
        if late and a <= -braking.a_m_s2:
            x, late = x + 0.5 * v * DT, False
        a = max(a - slew * h, -braking.a_m_s2)
        x, v = x + v * h + 0.5 * a * h * h, v + a * h
        best = max(best, x)
    return best


def test_stopping_speed_by_hand() -> None:
    """2 m/s^2 on a 0.05 s grid: 4 m/s takes 4^2 / 4 + 4 * 0.025 = 4.1 m."""
    braking = Braking(2.0, DT)
    assert braking.speed(4.1) == pytest.approx(4.0)
    assert braking.speed(0.0) == pytest.approx(0.0)
    assert braking.speed(-0.5) == pytest.approx(-0.5)  # back at 1 Hz
    assert braking.speed(-4.1) == pytest.approx(-4.0)  # but no faster than what stops within as much


def test_the_bound_without_slew_is_the_speed_after_the_step() -> None:
    braking = Braking(2.0, DT)
    bound = braking.bound(5.0, 3.0)
    assert 3.0 + DT * bound == pytest.approx(braking.speed(5.0 - 3.0 * DT))


@pytest.mark.parametrize("v", [-1.0, 0.0, 0.4, 1.0, 3.0])
@pytest.mark.parametrize("a", [-2.0, -1.0, 0.0, 1.5, 3.0])
def test_the_distance_with_slew_agrees_with_an_integration(v: float, a: float) -> None:
    braking = Braking(2.0, DT, 5.0)
    assert braking.stop_m(a, v) == pytest.approx(flown(a, v, braking, 5.0), abs=1e-2)


def test_the_bound_with_slew_uses_the_whole_distance_and_no_more() -> None:
    rng = np.random.default_rng(0)
    braking, binding = Braking(2.0, DT, 5.0), 0
    for distance, v in zip(rng.uniform(0.2, 8.0, 300), rng.uniform(-2.0, 5.0, 300), strict=True):
        bound, ahead = braking.bound(distance, v), distance - v * DT
        if -2.0 + 1e-4 < bound < 20.0 - 1e-4 and ahead > 0.0 and bound < (braking.speed(ahead) - v) / DT - 1e-6:
            binding += 1
            assert braking.stop_m(bound, v) <= ahead + 1e-9
            assert braking.stop_m(bound + 1e-4, v) > ahead
        assert bound <= max((braking.speed(ahead) - v) / DT, -2.0) + 1e-9
    assert binding > 50


def test_beyond_what_braking_can_do_the_bound_is_full_braking() -> None:
    assert Braking(2.0, DT, 5.0).bound(0.5, 4.0) <= -2.0


def test_past_the_wall_slew_does_not_soften_the_way_back() -> None:
    assert Braking(2.0, DT, 5.0).bound(-1.0, 0.0) == Braking(2.0, DT).bound(-1.0, 0.0)


def test_swerve_by_hand_and_by_integration() -> None:
    assert swerve_m(3.0, 1.0, None) == pytest.approx(1.5)
    assert swerve_m(3.0, 1.0, 6.0) == pytest.approx(6.0 * 0.125 / 6.0 + 0.75 * 0.5 + 1.5 * 0.25)
    assert swerve_m(3.0, 0.4, 6.0) == pytest.approx(6.0 * 0.064 / 6.0)  # never reaches 3 m/s^2
    t = np.linspace(0.0, 1.1, 20_001)
    a = np.minimum(5.0 * t, 2.7)
    x = np.trapezoid(np.concatenate(([0.0], np.cumsum(0.5 * (a[1:] + a[:-1]) * np.diff(t)))), t)
    assert swerve_m(2.7, 1.1, 5.0) == pytest.approx(float(x), abs=1e-6)


@pytest.mark.parametrize("slew", [2.0, 20.0])
@pytest.mark.parametrize("tick_s", [0.05, 0.02])
def test_with_a_slew_limit_no_push_passes_a_wall(slew: float, tick_s: float) -> None:
    limits = LimitsConfig(slew_m_s3=slew, arena_min=(-4.0, -4.0, 0.3), arena_max=(4.0, 4.0, 5.0))
    guard, rng = SafetyFilter(SafetyConfig(), limits), np.random.default_rng(1)
    p, v, before = np.array([0.0, 0.0, 2.5]), np.zeros(3), np.zeros(3)
    nothing = uniform_motion(np.zeros((0, 3)), np.zeros((0, 3)), radius_m=0.2)
    for step in range(300):
        if step % 60 == 0:
            push = rng.choice([-3.0, 3.0], 3)
        result = guard.step(FilterInput(p, v, push, nothing, elapsed_s=tick_s, a_before=before))
        assert np.abs(result.a_safe - before).max() <= slew * tick_s + 1e-9
        assert np.abs(result.a_safe).max() <= 3.0 + 1e-9
        before = result.a_safe
        p, v = p + tick_s * v + 0.5 * tick_s**2 * before, v + tick_s * before
        assert (p <= np.array(limits.arena_max) + 0.02).all()
        assert (p >= np.array(limits.arena_min) - 0.02).all()


def test_rows_exist_for_what_is_too_large_only() -> None:
    r, v = np.array([[-9.0, 0.0, 0.0], [0.0, 5.0, 0.0]]), np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    braking = Braking(2.0, DT)
    assert stop_rows(r, v, np.array([1.0, 1.5]), braking, 1.6) is None
    rows = stop_rows(r, v, np.array([5.0, 1.5]), braking, 1.6)
    assert rows is not None
    assert rows.normal.tolist() == [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    assert rows.floor.tolist() == [-braking.bound(4.0, 2.0), -math.inf]
    assert rows.slack(np.array([[1.0, 0.0, 0.0]]))[0, 0] == pytest.approx(braking.bound(4.0, 2.0) - 1.0)
    assert rows.select(np.array([0])).floor.tolist() == [rows.floor[0]]


def test_on_top_of_each_other_a_row_is_finite() -> None:
    rows = stop_rows(np.zeros((1, 3)), np.zeros((1, 3)), np.array([2.0]), Braking(2.0, DT), 1.0)
    assert isinstance(rows, StopRows)
    assert np.isfinite(rows.normal).all()
    assert np.isfinite(rows.floor).all()


@pytest.mark.parametrize("speed", [2.0, 5.0])
@pytest.mark.parametrize("obstacle_speed", [0.0, -1.5])
def test_the_vehicle_stops_before_what_it_cannot_swerve_round(speed: float, obstacle_speed: float) -> None:
    """A sphere of 6 m: at 5 m/s the horizon alone sees it too late."""
    guard = SafetyFilter(SafetyConfig(), LimitsConfig(arena_min=(-60.0, -60.0, 0.3), arena_max=(60.0, 60.0, 40.0)))
    p, v, verdicts = np.array([-20.0, 0.0, 10.0]), np.array([speed, 0.0, 0.0]), set()
    o, ov = np.array([[0.0, 0.0, 10.0]]), np.array([[obstacle_speed, 0.0, 0.0]])
    for _ in range(200):
        a_ref = np.clip(3.0 * (np.array([speed, 0.0, 0.0]) - v), -3.0, 3.0)
        result = guard.step(FilterInput(p, v, a_ref, uniform_motion(o, ov, radius_m=6.0), elapsed_s=DT))
        verdicts.add(result.verdict)
        p, v, o = p + DT * v, v + DT * result.a_safe, o + DT * ov
        assert math.dist(p, o[0]) >= 6.2
    assert Verdict.RELAXED not in verdicts
    assert Verdict.ADJUSTED in verdicts


def test_a_braking_row_is_recorded_with_its_track() -> None:
    guard = SafetyFilter(SafetyConfig(), LimitsConfig(arena_min=(-60.0, -60.0, 0.3), arena_max=(60.0, 60.0, 40.0)))
    near = uniform_motion(np.array([[12.75, 0.0, 10.0]]), np.zeros((1, 3)), radius_m=6.0)
    p, v = np.array([0.0, 0.0, 10.0]), np.array([5.0, 0.0, 0.0])
    result = guard.step(FilterInput(p, v, np.array([3.0, 0.0, 0.0]), near))
    assert result.verdict is Verdict.ADJUSTED
    row = next(row for row in result.rows if row.step == -1)
    assert row.track == "0"
    assert row.margin is not None
    assert row.margin.radii == pytest.approx(6.2)
    assert row.slack == pytest.approx(0.0, abs=1e-4)


def test_the_paper_has_no_braking_rows() -> None:
    guard = SafetyFilter(SafetyConfig(braking=False), LimitsConfig())
    task = guard.build(
        FilterInput(
            np.zeros(3), np.zeros(3), np.zeros(3), uniform_motion(np.full((1, 3), 9.0), np.zeros((1, 3)), radius_m=6.0)
        )
    )
    assert task.stops is None


def test_stopping_distances_by_hand() -> None:
    """On a grid of 0.5 s with 6 m/s^3 and 6 m/s^2, and without a slew limit with 2 m/s^2 on one of 0.05 s."""
    slewed = Braking(6.0, 0.5, 6.0)
    assert slewed.stop_m(0.0, 0.75) == pytest.approx(0.25)  # after 0.5 s: 0.75 * 0.5 - 0.5^3
    assert slewed.stop_m(2.0, -1.0) == pytest.approx(4.0 / 27.0)  # from rest at 2 m/s^2, after 2/3 s
    assert slewed.stop_m(-6.0, 9.0) == pytest.approx(36.0 / 12.0 + 0.25 * 6.0)  # 6 m/s and all of the brakes on
    free = Braking(2.0, 0.05)
    assert free.stop_m(1.0, 3.0) == pytest.approx(3.05**2 / 4.0 + 3.05 * 0.025)
    assert free.stop_m(-1.0, 0.0) == 0.0
    assert free.stop_m(0.0, 0.0) == 0.0


def test_on_the_way_back_from_past_a_wall_slew_does_not_forbid_to_slow_down() -> None:
    """Half a metre past it at 1 m/s back, where 0.5 m/s is asked: (1 - 0.5) / 0.05 s."""
    assert Braking(2.0, DT, 5.0).bound(-0.55, -1.0) == pytest.approx(10.0)


def test_at_the_wall_itself_slew_counts() -> None:
    """0.5 m/s back on a grid of 0.5 s: 1 m/s^2 would rest at the wall, but then go on through it."""
    braking = Braking(2.0, 0.5, 5.0)
    bound = braking.bound(-0.25, -0.5)
    assert 0.5 < bound < 1.0
    assert braking.stop_m(bound, -0.5) <= 0.0 < braking.stop_m(bound + 1e-3, -0.5)


def test_with_a_quick_slew_the_bound_is_exact_up_to_ten_times_the_brakes_and_free_beyond() -> None:
    braking = Braking(2.0, DT, 200.0)
    bound = braking.bound(0.5, -0.2)
    assert 16.0 < bound < 16.2
    assert braking.stop_m(bound, -0.2) <= 0.51 < braking.stop_m(bound + 1e-3, -0.2)
    assert braking.stop_m(20.0, -0.5) < 1.025 < braking.stop_m(22.0, -0.5)
    assert braking.bound(1.0, -0.5) == (braking.speed(1.025) + 0.5) / DT


def test_what_can_just_be_swerved_round_has_no_row() -> None:
    braking = Braking(2.0, DT)
    assert stop_rows(np.array([[-9.0, 0.0, 0.0]]), np.zeros((1, 3)), np.array([1.5]), braking, 1.5) is None
    near = stop_rows(np.array([[0.0, 0.0, 0.25]]), np.zeros((1, 3)), np.array([2.0]), braking, 1.5)
    assert near is not None
    assert near.normal.tolist() == [[0.0, 0.0, 1.0]]
    assert near.floor.tolist() == [-braking.bound(-1.75, 0.0)]


def test_a_selection_of_rows_keeps_normals_and_floors_together() -> None:
    rows = StopRows(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), np.array([1.0, 2.0, 3.0]))
    selected = rows.select(np.array([2, 0]))
    assert selected.normal.tolist() == [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    assert selected.floor.tolist() == [3.0, 1.0]


@pytest.mark.parametrize(
    ("floor", "beyond"),
    [
        ((-1.0, -1.0), False),
        ((2.2 - 1e-9, -np.inf), False),  # 0.6 x 2 + 0.8 x 1 = 2 is the most that the box has along the first normal
        ((2.2 + 1e-9, -1.0), True),
        ((-1.0, 3.2 + 1e-9), True),  # along the second, which points down, 3
        ((-np.inf, 3.2 - 1e-9), False),
    ],
)
def test_a_row_that_the_whole_box_breaks_is_known_at_once(floor: tuple[float, float], beyond: bool) -> None:
    rows = StopRows(np.array([[0.6, 0.0, 0.8], [0.0, 0.0, -1.0]]), np.array(floor))
    assert rows.beyond(np.array([-1.0, -2.0, -3.0]), np.array([2.0, 2.0, 1.0]), 0.2) is beyond
