"""Where a search starts, which obstacles it may leave out, and how a vehicle at an obstacle gets round it."""

from __future__ import annotations

import numpy as np
import pytest
from safety_scenes import uniform_motion

from companion.config import LimitsConfig, SafetyConfig
from companion.safety.barrier import Barrier, BarrierRows
from companion.safety.limits import capability, vehicle_limits
from companion.safety.stopping import StopRows
from companion.safety.task import STANDING_M, Judgement, Task, candidates, judge, turned
from companion.types import Prediction, frozen

CONFIG = SafetyConfig(kappa=0.0, sigma_delay_s=0.0)
ORIGIN = np.array([0.0, 0.0, 5.0])


def rows_of(
    offsets: list[tuple[float, ...]],
    velocities: list[tuple[float, ...]],
    v: tuple[float, ...] = (0.0, 0.0, 0.0),
    radii: tuple[float, ...] | None = None,
) -> BarrierRows:
    prediction = uniform_motion(
        ORIGIN + np.reshape(offsets, (-1, 3)), velocities, radius_m=0.2 if radii is None else radii
    )
    return Barrier(CONFIG).rows(ORIGIN, np.array(v), prediction, 0.0)


def task_of(rows: BarrierRows, a_ref: tuple[float, ...] = (1.0, 0.0, 0.0)) -> Task:
    can = capability(LimitsConfig(), shrink_m_s2=0.0, dt_s=0.05)
    limits = vehicle_limits(ORIGIN, np.zeros(3), LimitsConfig(), can)
    return Task(rows, limits, np.array(a_ref), np.zeros(len(rows)), np.full(len(rows), 4.0), CONFIG)


def test_far_and_leaving_obstacles_are_out_of_reach() -> None:
    rows = rows_of(
        [(2.0, 0.0, 0.0), (9.0, 0.0, 0.0), (9.0, 0.0, 0.0), (2.0, 0.0, 0.0)],
        [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (-6.0, 0.0, 0.0), (9.0, 0.0, 0.0)],
    )
    limits = task_of(rows).limits
    near = rows.balls(np.ones(4)).reachable(limits.hard_low, limits.hard_high)
    assert near.tolist() == [True, False, True, False]


def test_candidates_begin_with_the_reference_and_stay_in_the_box() -> None:
    starts = candidates(task_of(rows_of([(2.0, 0.0, 0.0)], [(-1.0, 0.0, 0.0)])))
    assert starts[0].tolist() == [1.0, 0.0, 0.0]
    assert np.abs(starts).max() <= 3.0
    assert len(starts) == 1 + 27 + 16


@pytest.mark.parametrize(
    ("velocity", "right"),
    [
        ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),  # the vehicle closes eastwards: its right is south
        ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0)),  # northwards: east
        ((0.0, 0.0, -1.0), (1.0, 0.0, 0.0)),  # straight up: east, for want of a right
    ],
)
def test_the_ring_lies_across_the_relative_velocity_and_begins_to_the_right(
    velocity: tuple[float, ...], right: tuple[float, ...]
) -> None:
    offset = tuple(-2.0 * component for component in velocity)
    task = task_of(rows_of([offset], [velocity]))
    ring = candidates(task)[1 + 27 : 1 + 27 + 8] / 3.0
    assert ring[0] == pytest.approx(right)
    assert np.linalg.norm(ring, axis=-1) == pytest.approx(np.ones(8))
    assert np.abs(ring @ np.array(velocity)) == pytest.approx(np.zeros(8), abs=1e-12)


def test_a_ring_exists_at_rest_and_on_top_of_each_other() -> None:
    for offset in ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)):
        starts = candidates(task_of(rows_of([offset], [(0.0, 0.0, 0.0)])))
        assert np.isfinite(starts).all()
        assert np.linalg.norm(starts[28:36], axis=-1) == pytest.approx(np.full(8, 3.0))


def test_cost_is_the_deviation_and_the_price_of_epsilon() -> None:
    """Epsilon 0.8 where 0 is wanted and the CLF leaves 0.25: 0.01 * 0.64 + 0.01 * (0.64 - 0.25)^2."""
    rows = rows_of([(5.0, 0.0, 0.0)], [(-0.5, 0.0, 0.0)])
    task = task_of(rows)
    a = np.array([[1.5, 0.0, 0.0]])
    verdict = judge(task, a)
    epsilon = verdict.lower[0, 0]
    cheap = Task(rows, task.limits, task.a_ref, task.star, np.array([epsilon**2 - 0.1]), CONFIG)
    assert verdict.cost[0] == pytest.approx(0.25 + 0.01 * epsilon**2)
    assert judge(cheap, a).cost[0] == pytest.approx(0.25 + 0.01 * epsilon**2 + 0.01 * 0.01)


def test_a_vehicle_at_an_obstacle_is_turned_to_its_right() -> None:
    a_ref = np.array([2.0, 0.0, 0.0])
    rows = rows_of([(0.6, 0.0, 0.0)], [(0.0, 0.0, 0.0)])
    assert turned(rows, a_ref) == pytest.approx([2.0, -2.0, 0.0])


def test_a_vehicle_that_already_moves_to_one_side_goes_on() -> None:
    rows = rows_of([(0.6, 0.0, 0.0)], [(0.0, 0.0, 0.0)], v=(0.0, 0.1, 0.0))
    assert turned(rows, np.array([2.0, 0.0, 0.0])) == pytest.approx([2.0, 2.0, 0.0])


def test_straight_above_an_obstacle_the_turn_is_to_the_east() -> None:
    rows = rows_of([(0.0, 0.0, -0.6)], [(0.0, 0.0, 0.0)])
    assert turned(rows, np.array([0.0, 0.0, -1.0])) == pytest.approx([1.0, 0.0, -1.0])


@pytest.mark.parametrize(
    ("offset", "velocity", "a_ref"),
    [
        ((0.5 + STANDING_M + 0.01, 0.0, 0.0), (0.0, 0.0, 0.0), (2.0, 0.0, 0.0)),  # not there yet
        ((0.6, 0.0, 0.0), (-1.0, 0.0, 0.0), (2.0, 0.0, 0.0)),  # not standing
        ((0.6, 0.0, 0.0), (0.0, 0.0, 0.0), (2.0, 2.0, 0.0)),  # sent past it
        ((0.6, 0.0, 0.0), (0.0, 0.0, 0.0), (-2.0, 0.0, 0.0)),  # sent away
        ((0.6, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),  # sent nowhere
    ],
)
def test_otherwise_the_reference_stays(
    offset: tuple[float, ...], velocity: tuple[float, ...], a_ref: tuple[float, ...]
) -> None:
    assert turned(rows_of([offset], [velocity]), np.array(a_ref)).tolist() == list(a_ref)


STILL = (0.0, 0.0, 0.0)


def test_the_lattice_and_two_rings_are_offered() -> None:
    task = task_of(rows_of([(2.0, 0.0, 0.0)], [(-1.0, 0.0, 0.0)]))
    starts = candidates(task)
    assert {tuple(point) for point in starts[1:28].tolist()} == {
        (x, y, z) for x in (-3.0, 0.0, 3.0) for y in (-3.0, 0.0, 3.0) for z in (-3.0, 0.0, 3.0)
    }
    assert starts[1].tolist() == [0.0, 0.0, 0.0]
    assert starts[36:] == pytest.approx(0.5 * starts[28:36])
    assert len(candidates(task_of(rows_of([], [])))) == 28


@pytest.mark.parametrize(
    ("offset", "velocity", "right", "up"),
    [
        ((2.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
        ((2.0, 0.5, 0.0), (-0.6, -0.8, 0.0), (0.8, -0.6, 0.0), (0.0, 0.0, 1.0)),
        ((2.0, 0.0, 2.0), (-3.0, 0.0, -4.0), (0.0, -1.0, 0.0), (-0.8, 0.0, 0.6)),  # climbing: up and back
        ((0.0, 2.0, 0.0), STILL, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),  # at rest: across the line between
        ((0.0, 0.0, 2.0), STILL, (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
        (STILL, STILL, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),  # on top: as if flying north
    ],
)
def test_the_ring_turns_from_the_right_over_the_top(
    offset: tuple[float, ...], velocity: tuple[float, ...], right: tuple[float, ...], up: tuple[float, ...]
) -> None:
    ring = candidates(task_of(rows_of([offset], [velocity])))[28:36] / 3.0
    half = np.sqrt(0.5)
    east, north = np.array(right), np.array(up)
    expected = [east, half * (east + north), north, half * (north - east), -east, -half * (east + north), -north]
    assert ring == pytest.approx(np.array([*expected, half * (east - north)]), abs=1e-12)


def test_the_ring_is_that_of_the_obstacle_whose_surface_comes_closest() -> None:
    """The one ahead comes as near as 1.9 m, the one from the left only 2 m, but it is larger by more."""
    rows = rows_of([(3.0, 0.0, 0.0), (0.0, 3.1, 0.0)], [(-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)], radii=(0.1, 0.5))
    assert candidates(task_of(rows))[28] == pytest.approx([3.0, 0.0, 0.0])  # flying north against it: east
    rows = rows_of([(3.0, 0.0, 0.0), (0.0, 3.1, 0.0)], [(-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)], radii=(0.5, 0.5))
    assert candidates(task_of(rows))[28] == pytest.approx([0.0, -3.0, 0.0])
    rows = rows_of([(0.0, 3.1, 0.0), (3.0, 0.0, 0.0)], [(0.0, -1.0, 0.0), (-1.0, 0.0, 0.0)], radii=(0.5, 0.45))
    assert candidates(task_of(rows))[28] == pytest.approx([0.0, -3.0, 0.0])


def test_a_selection_keeps_everything_of_its_obstacles() -> None:
    rows = rows_of([(2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0)], [STILL] * 3)
    whole = task_of(rows)
    stops = StopRows(np.eye(3), np.array([1.0, 2.0, 3.0]))
    star, budget = np.array([0.1, 0.2, 0.3]), np.array([4.0, 5.0, 6.0])
    part = Task(rows, whole.limits, whole.a_ref, star, budget, CONFIG, stops).select(np.array([2, 0]))
    assert part.rows.ids == ("2", "0")
    assert part.star.tolist() == [0.3, 0.1]
    assert part.budget.tolist() == [6.0, 4.0]
    assert part.limits is whole.limits
    assert part.a_ref is whole.a_ref
    assert part.config is CONFIG
    assert part.stops is not None
    assert part.stops.floor.tolist() == [3.0, 1.0]
    assert whole.select(np.array([1])).stops is None


def test_judged_together_as_one_by_one() -> None:
    """Interval, admissibility and price of every acceleration from the rows' values, the definition and loops."""
    rows = rows_of([(1.6, 0.1, 0.0), (0.2, 1.8, 0.3)], [(-1.0, 0.0, 0.0), (0.0, -0.8, 0.0)], v=(0.5, 0.0, 0.0))
    whole = task_of(rows)
    star, budget = np.array([0.3, 0.9]), np.array([0.05, 0.2])
    config = SafetyConfig(kappa=0.0, sigma_delay_s=0.0, lambda_u=2.0, lambda_epsilon=0.5, lambda_delta=3.0)
    task = Task(rows, whole.limits, whole.a_ref, star, budget, config)
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (60, 3))
    verdict = judge(task, points)
    assert 5 < verdict.admissible.sum() < 55
    for c, a in enumerate(points):
        rise, psi = rows.evaluate(a)
        cost, admissible = 2.0 * float(np.sum((a - task.a_ref) ** 2)), True
        for j in range(2):
            pairs = list(zip(rise[j], psi[j], strict=True))
            lower = max([0.0, *(-r / p for r, p in pairs if p > 0.0)]) / 0.5
            upper = min([1.0, *(-r / p for r, p in pairs if p < 0.0)]) / 0.5
            assert (verdict.lower[c, j], verdict.upper[c, j]) == pytest.approx((lower, upper))
            epsilon = min(max(star[j], lower), upper)
            excess = max((epsilon - star[j]) ** 2 - budget[j], 0.0)
            cost += 0.5 * (epsilon - star[j]) ** 2 + 3.0 * excess**2
            admissible &= lower <= upper
        assert verdict.admissible[c] == admissible
        assert verdict.cost[c] == pytest.approx(cost)
        assert verdict.ranked[c] == (verdict.cost[c] if admissible else np.inf)


def test_speed_and_stops_are_judged_within_the_tolerance() -> None:
    rows, config = rows_of([], []), LimitsConfig()
    can = capability(config, shrink_m_s2=0.0, dt_s=0.05)
    fast = vehicle_limits(ORIGIN, np.array([5.9, 0.0, 0.0]), config, can)
    nothing = np.zeros(0)
    task = Task(rows, fast, np.zeros(3), nothing, nothing, CONFIG)
    edge = np.array([[2.0 + 5e-7, 0.0, 0.0], [2.0 + 2e-6, 0.0, 0.0]])  # |v + 0.05 a| = 6 at 2
    assert judge(task, edge).admissible.tolist() == [True, False]
    ahead = rows_of([(0.9, 0.0, 0.0)], [STILL], v=(5.9, 0.0, 0.0))
    task = Task(ahead, fast, np.zeros(3), np.zeros(1), np.full(1, 4.0), CONFIG)
    assert judge(task, np.zeros((1, 3))).admissible.tolist() == [False]  # slow enough, but into an obstacle
    slow = vehicle_limits(ORIGIN, np.zeros(3), config, can)
    stops = StopRows(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([-1.0, -np.inf]))
    rows = rows_of([(9.0, 0.0, 0.0), (0.0, 9.0, 0.0)], [STILL] * 2)
    task = Task(rows, slow, np.zeros(3), np.zeros(2), np.full(2, 4.0), CONFIG, stops)
    edge = np.array([[-1.0 - 5e-7, 0.0, 0.0], [-1.0 - 2e-6, 0.0, 0.0], [0.0, -2.0, 0.0]])
    assert judge(task, edge).admissible.tolist() == [True, False, True]


def test_the_greatest_epsilon_is_within_its_bounds() -> None:
    verdict = Judgement(np.zeros((2, 3)), np.array([[9.0, 9.0, 9.0], [0.7, 3.0, -0.4]]), np.ones(2, bool), np.zeros(2))
    assert verdict.greatest(1, 0.5).tolist() == [0.7, 2.0, 0.0]


@pytest.mark.parametrize(
    ("offset", "v", "a_ref", "expected"),
    [
        ((0.79, 0.0, 0.0), STILL, (2.0, 0.0, 0.0), (2.0, -2.0, 0.0)),  # 0.29 m from the margin
        ((0.6, 0.0, 0.0), (0.79, 0.0, 0.0), (2.0, 0.0, 0.0), (2.0, -2.0, 0.0)),  # slow enough
        ((0.6, 0.0, 0.0), (0.81, 0.0, 0.0), (2.0, 0.0, 0.0), (2.0, 0.0, 0.0)),
        ((0.6, 0.0, 0.0), (0.0, 0.0, 0.81), (2.0, 0.0, 0.0), (2.0, 0.0, 0.0)),
        ((0.6, 0.0, 0.0), STILL, (1.62, 1.176, 0.0), (1.62, 1.176 - 2.0019, 0.0)),  # cosine 0.809
        ((0.6, 0.0, 0.0), STILL, (1.58, 1.226, 0.0), (1.58, 1.226, 0.0)),  # cosine 0.790
        ((0.36, 0.48, 0.0), STILL, (0.6, 0.8, 0.0), (0.6 + 0.8, 0.8 - 0.6, 0.0)),  # right of north-east
        ((0.6, 0.0, 0.0), (0.5, 0.0, 0.3), (2.0, 0.0, 0.0), (2.0, 0.0, 2.0)),  # already rising: over it
        ((0.6, 0.0, 0.0), (0.0, 0.0, -0.019), (2.0, 0.0, 0.0), (2.0, -2.0, 0.0)),  # hardly sinking
        ((0.6, 0.0, 0.0), (0.0, 0.0, -0.021), (2.0, 0.0, 0.0), (2.0, 0.0, -2.0)),
        ((0.6, 0.0, 0.0), STILL, (9e-4, 0.0, 0.0), (9e-4, 0.0, 0.0)),  # sent nowhere
        ((0.6, 0.0, 0.0), STILL, (2e-3, 0.0, 0.0), (2e-3, -2e-3, 0.0)),
        ((0.06, 0.0, -0.597), STILL, (0.0, 0.0, -1.0), (1.0, 0.0, -1.0)),  # above but for six degrees: east
        ((0.12, 0.0, -0.588), STILL, (0.0, 0.0, -1.0), (0.0, -1.0, -1.0)),  # for eleven: the right
    ],
)
def test_turns_by_hand(
    offset: tuple[float, ...], v: tuple[float, ...], a_ref: tuple[float, ...], expected: tuple[float, ...]
) -> None:
    assert turned(rows_of([offset], [STILL], v=v), np.array(a_ref)) == pytest.approx(expected, abs=2e-4)


def test_the_turn_is_round_the_nearest_of_those_in_the_way() -> None:
    rows = rows_of([(0.0, -0.55, 0.0), (0.62, 0.1, 0.0), (0.60, -0.1, 0.0)], [STILL] * 3)
    a_ref = np.array([2.0, 0.0, 0.0])
    towards = np.array([0.60, -0.1]) / np.hypot(0.60, 0.1)
    assert turned(rows, a_ref) == pytest.approx([2.0 + 2.0 * towards[1], -2.0 * towards[0], 0.0])


def test_an_obstacle_that_moves_along_is_stood_at() -> None:
    rows = rows_of([(0.6, 0.0, 0.0)], [(2.0, 0.0, 0.0)], v=(2.0, 0.1, 0.0))
    assert turned(rows, np.array([2.0, 0.0, 0.0])) == pytest.approx([2.0, 2.0, 0.0])


def test_one_that_passes_is_not_stood_at_though_it_is_nearest() -> None:
    """Nearest of all is one that flies by; it is the other that the vehicle stands at, off its left."""
    rows = rows_of([(0.55, 0.05, 0.0), (0.6, 0.2, 0.0)], [(0.0, 3.0, 0.0), STILL])
    towards = np.array([0.6, 0.2]) / np.hypot(0.6, 0.2)
    assert turned(rows, np.array([2.0, 0.0, 0.0])) == pytest.approx([2.0 + 2.0 * towards[1], -2.0 * towards[0], 0.0])


def test_standing_is_within_the_first_rows_keep_out_distance() -> None:
    """Sigma grows along the horizon: D is 0.5 m at first and more after it."""
    t = 0.05 * np.arange(23)
    prediction = Prediction(
        start_ns=0,
        dt_s=0.05,
        ids=("0",),
        p_enu=frozen(np.full((1, 23, 3), (0.83, 0.0, 5.0))),
        sigma_m=frozen(np.maximum(t - 0.1, 0.0)[None]),
        v_enu=frozen(np.zeros((1, 3))),
        a_enu=frozen(np.zeros((1, 3))),
        radius_m=frozen([0.2]),
    )
    rows = Barrier(SafetyConfig(kappa=1.0, sigma_delay_s=0.0)).rows(ORIGIN, np.zeros(3), prediction, 0.0)
    assert rows.keep_out_m[0, :2] == pytest.approx([0.5, 0.55])
    assert turned(rows, np.array([2.0, 0.0, 0.0])).tolist() == [2.0, 0.0, 0.0]


def test_what_is_near_and_what_is_ahead_must_be_one() -> None:
    """Near on the right is one past which the vehicle is sent, ahead is one that is far."""
    rows = rows_of([(0.0, -0.6, 0.0), (2.0, 0.0, 0.0)], [STILL] * 2)
    assert turned(rows, np.array([2.0, 0.0, 0.0])).tolist() == [2.0, 0.0, 0.0]
