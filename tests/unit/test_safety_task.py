"""Where a search starts, which obstacles it may leave out, and how a vehicle at an obstacle gets round it."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config import LimitsConfig, SafetyConfig
from companion.safety.barrier import Barrier, BarrierRows
from companion.safety.limits import capability, vehicle_limits
from companion.safety.task import STANDING_M, Task, candidates, judge, turned
from companion.types import Prediction, frozen

CONFIG = SafetyConfig(kappa=0.0, sigma_delay_s=0.0)
ORIGIN = np.array([0.0, 0.0, 5.0])


def rows_of(
    offsets: list[tuple[float, ...]], velocities: list[tuple[float, ...]], v: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> BarrierRows:
    count, t = len(offsets), 0.05 * np.arange(23)
    start, velocity = ORIGIN + np.reshape(offsets, (count, 3)), np.reshape(velocities, (count, 3))
    prediction = Prediction(
        start_ns=0,
        dt_s=0.05,
        ids=tuple(str(index) for index in range(count)),
        p_enu=frozen(start[:, None] + t[:, None] * velocity[:, None]),
        sigma_m=frozen(np.zeros((count, 23))),
        v_enu=frozen(velocity),
        a_enu=frozen(np.zeros((count, 3))),
        radius_m=frozen(np.full(count, 0.2)),
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
