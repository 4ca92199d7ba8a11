"""Least violation: the order of obstacles, the order of what gives way, and the budget."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from safety_scenes import uniform_motion

from companion.config import LimitsConfig, SafetyConfig
from companion.errors import SolverError
from companion.safety import qp, relax
from companion.safety.adapt import decay_interval
from companion.safety.filter import FilterInput, SafetyFilter
from companion.safety.relax import braking, by_contact, least_violation, shares, widest
from companion.safety.task import Task, Ways
from companion.types import Verdict, frozen

SAFETY = SafetyConfig(sigma_delay_s=0.0, kappa=0.0)
T = 0.05 * np.arange(23)


def inputs_of(
    p: list[tuple[float, ...]],
    v: list[tuple[float, ...]],
    *,
    at: tuple[float, ...] = (0.0, 0.0, 5.0),
    speed: tuple[float, ...] = (3.0, 0.0, 0.0),
    a_ref: tuple[float, ...] = (0.0, 0.0, 0.0),
    radius: float = 0.2,
    before: tuple[float, ...] | None = None,
) -> FilterInput:
    prediction = uniform_motion(np.reshape(p, (-1, 3)) + np.array(at), v, radius_m=radius)
    last = None if before is None else np.array(before)
    return FilterInput(np.array(at), np.array(speed), np.array(a_ref), prediction, elapsed_s=0.05, a_before=last)


def task_of(inputs: FilterInput, limits: LimitsConfig | None = None, config: SafetyConfig = SAFETY) -> Task:
    return SafetyFilter(config, limits or LimitsConfig()).build(inputs)


def test_shares_by_hand() -> None:
    """At rest 0.45 m from a standing sphere, R = 0.4, D = 0.5: half of the margin is left; 2 m away all of it."""
    task = task_of(inputs_of([(0.45, 0.0, 0.0), (2.0, 0.0, 0.0)], [(0.0, 0.0, 0.0)] * 2, speed=(0.0, 0.0, 0.0)))
    assert shares(task.rows, np.zeros((1, 3)))[0] == pytest.approx([0.5, 1.0])
    away = 3.0 * float(task.rows.reach[2])
    assert shares(task.rows, np.array([[-3.0, 0.0, 0.0]]))[0, 0] == pytest.approx(0.5 + away / 0.1)


def test_obstacles_come_in_the_order_of_contact() -> None:
    """Contacts after 0.8 s, 0.3 s and 0.5 s; then the two that pass, by when they come closest."""
    rows = task_of(
        inputs_of(
            [(2.9, 0.0, 0.0), (1.4, 0.0, 0.0), (2.0, 0.0, 0.0), (2.0, 1.0, 0.0), (1.0, 1.0, 0.0)], [(0.0, 0.0, 0.0)] * 5
        )
    ).rows
    assert by_contact(rows).tolist() == [1, 2, 0, 4, 3]


def test_the_widest_way_touches_nobody_first_and_then_gives_the_first_obstacle_its_margin() -> None:
    assert widest(np.array([[1.0, -0.5], [0.1, 0.0], [0.0, 1.0]])) == 1  # no contact before any margin
    assert widest(np.array([[0.5, 1.0], [0.8, 0.2], [0.8, 0.4]])) == 2
    assert widest(np.array([[-0.5, 1.0], [-0.2, -0.9]])) == 1  # the earlier contact counts more
    assert widest(np.array([[0.50, 0.5], [0.51, 0.6]])) == 1
    assert widest(np.array([[0.50, 0.5], [0.51, 0.51], [0.5, 0.5]])) == 1  # the same to a twentieth: then the sum


def test_the_first_obstacle_keeps_what_it_can_and_the_second_what_is_left() -> None:
    """Against a dense search over the box, lexicographic to a hundredth."""
    task = task_of(inputs_of([(1.9, 0.1, 0.0), (2.3, -0.6, 0.1)], [(-1.0, 0.0, 0.0)] * 2))
    found = least_violation(task, Ways(task, np.zeros(3)), ("daqp", "osqp"))
    first, second = shares(task.rows, found.a[None])[0]
    dense = np.random.default_rng(0).uniform(-3.0, 3.0, (60_000, 3))
    offered = shares(task.rows, dense)
    unharmed = offered[(offered >= min(0.0, first)).all(axis=1)]
    assert by_contact(task.rows).tolist() == [0, 1]
    assert first < 1.0
    assert first >= unharmed[:, 0].max() - 0.02
    assert second >= unharmed[unharmed[:, 0] >= first, 1].max(initial=-np.inf) - 0.02
    assert not found.admissible


def test_nobody_is_touched_for_the_margin_of_another() -> None:
    """Between two spheres side by side, through a gap too narrow for both margins: contact with neither."""
    task = task_of(inputs_of([(1.6, 0.47, 0.0), (1.7, -0.43, 0.0)], [(-2.0, 0.0, 0.0)] * 2, radius=0.2))
    found = least_violation(task, Ways(task, np.zeros(3)), ("daqp",))
    assert shares(task.rows, found.a[None]).min() >= -1e-3


@pytest.mark.parametrize("iterations", [1, 2, 4])
def test_the_budget_is_kept_with_many_obstacles(iterations: int, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    real = relax.solve
    monkeypatch.setattr(relax, "solve", lambda *a: (calls.append(a), real(*a))[1])
    ring = [(1.2, y, z) for y in (-0.4, 0.0, 0.4) for z in (-0.4, 0.0, 0.4)]
    config = msgspec.structs.replace(SAFETY, iterations=iterations)
    task = task_of(inputs_of(ring, [(-2.0, 0.0, 0.0)] * 9), config=config)
    found = least_violation(task, Ways(task, np.zeros(3)), ("daqp",))
    assert found.iterations == len(calls) <= iterations
    assert np.isfinite(found.a).all()
    assert np.abs(found.a).max() <= 3.0


def test_what_the_vehicle_cannot_do_is_kept() -> None:
    limits = LimitsConfig(slew_m_s3=10.0, norm_m_s2=2.0, tilt_deg=8.0)
    guard = SafetyFilter(SAFETY, limits)
    for before in ((0.0, 0.0, 0.0), (1.0, 0.5, 0.0)):
        inputs = inputs_of([(0.9, 0.05, 0.0)], [(-2.0, 0.0, 0.0)], before=before)
        result = guard.step(inputs)
        assert result.verdict is Verdict.RELAXED
        assert np.abs(result.a_safe - before).max() <= 0.5 + 1e-9
        assert np.linalg.norm(result.a_safe) <= 2.0 + 1e-9
        assert np.hypot(*result.a_safe[:2]) <= np.tan(np.radians(8.0)) * (result.a_safe[2] + 9.80665) + 1e-9


def test_speed_gives_way_before_the_arena_and_the_arena_before_the_obstacle() -> None:
    """Each stands alone against the next: what may be broken by a lot is broken by nothing where it need not be."""
    fast = task_of(inputs_of([], [], at=(9.0, 0.0, 5.0), speed=(6.5, 0.0, 0.0), a_ref=(3.0, 0.0, 0.0)))
    alone = least_violation(fast, Ways(fast, np.zeros(3)), ("daqp",))
    assert alone.a[0] == pytest.approx(-3.0, abs=1e-6)  # all of the box towards the inside
    chased = task_of(
        inputs_of([(-0.9, 0.0, 0.0)], [(7.5, 0.0, 0.0)], at=(0.0, 0.0, 5.0), speed=(6.0, 0.0, 0.0)),
        LimitsConfig(arena_min=(-50.0, -50.0, 0.3), arena_max=(50.0, 50.0, 20.0)),
    )
    found = least_violation(chased, Ways(chased, np.zeros(3)), ("daqp",))
    assert (
        shares(chased.rows, found.a[None])[0, 0]
        >= shares(chased.rows, np.random.default_rng(2).uniform(-3.0, 3.0, (20_000, 3))).max() - 0.01
    )


def test_a_solver_that_fails_after_the_first_program_leaves_its_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    real, calls = qp.solve_daqp, iter(range(9))
    monkeypatch.setitem(qp.BACKENDS, "daqp", lambda program: real(program) if next(calls) < 1 else None)
    task = task_of(inputs_of([(1.2, 0.1, 0.0), (1.4, -0.3, 0.0)], [(-2.0, 0.0, 0.0)] * 2))
    found = least_violation(task, Ways(task, np.zeros(3)), ("daqp",))
    assert found.iterations == 1
    with pytest.raises(SolverError):
        least_violation(task, Ways(task, np.zeros(3)), ("daqp",))


def test_the_way_of_the_last_answer_is_kept_unless_another_is_much_wider() -> None:
    task = task_of(inputs_of([(1.0, 0.0, 0.0)], [(-2.0, 0.0, 0.0)]))
    left = least_violation(task, Ways(task, np.array([-3.0, 3.0, 3.0])), ("daqp",))
    right = least_violation(task, Ways(task, np.array([-3.0, -3.0, -3.0])), ("daqp",))
    assert left.a[1] > 1.0
    assert right.a[1] < -1.0


def test_braking_takes_the_admissible_then_the_widest_then_the_slowest() -> None:
    free = task_of(inputs_of([(8.0, 0.0, 0.0)], [(0.0, 0.0, 0.0)]))
    stop = braking(free, Ways(free, np.zeros(3)))
    assert stop.admissible
    assert stop.a == pytest.approx([-3.0, 0.0, 0.0])
    creeping = task_of(inputs_of([(8.0, 0.0, 0.0)], [(0.0, 0.0, 0.0)], speed=(0.1, 0.0, 0.0)))
    slow = braking(creeping, Ways(creeping, np.zeros(3)))
    assert slow.a == pytest.approx([-2.0, 0.0, 0.0])  # to rest in one step, and no further
    tight = task_of(inputs_of([(1.0, 0.1, 0.0)], [(-2.0, 0.0, 0.0)]))
    found = braking(tight, Ways(tight, np.zeros(3)))
    assert not found.admissible
    offered = shares(tight.rows, np.random.default_rng(0).uniform(-3.0, 3.0, (5000, 3)))
    assert shares(tight.rows, found.a[None])[0, 0] >= offered.max() - 0.3
    assert (found.epsilon >= 0.0).all()
    assert (found.epsilon <= 2.0).all()


def test_without_any_margin_a_share_is_of_a_millimetre() -> None:
    config = msgspec.structs.replace(SAFETY, cushion_m=0.0)
    task = task_of(inputs_of([(0.4005, 0.0, 0.0)], [(0.0, 0.0, 0.0)], speed=(0.0, 0.0, 0.0)), config=config)
    assert shares(task.rows, np.zeros((1, 3)))[0, 0] == pytest.approx(0.5)


def test_contacts_of_one_step_come_in_the_order_of_their_depth() -> None:
    """Both are inside at the first step; and of two that never come within D, the nearer pass counts at one instant."""
    rows = task_of(inputs_of([(0.4, 0.0, 0.0), (0.3, 0.0, 0.0)], [(3.0, 0.0, 0.0)] * 2)).rows
    assert by_contact(rows).tolist() == [1, 0]
    rows = task_of(inputs_of([(1.0, 1.2, 0.0), (1.0, -1.0, 0.0)], [(0.0, 0.0, 0.0)] * 2)).rows
    assert by_contact(rows).tolist() == [1, 0]


SLEWED = LimitsConfig(slew_m_s3=20.0, norm_m_s2=2.0, tilt_deg=8.0, speed_m_s=3.2)


def hand_program(task: Task, a: np.ndarray, kept: np.ndarray, raised: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Rows over (a, t, t at the end, stop, arena, speed), one loop after another."""
    rows, floors = [], []

    def add(normal: np.ndarray, floor: float, *others: tuple[int, float]) -> None:
        row = np.zeros(8)
        row[:3] = normal
        for column, coefficient in others:
            row[column] = coefficient
        rows.append(row)
        floors.append(floor)

    for cone in task.limits.cones:  # kept
        add(*cone.tangent(a))
    add(*task.limits.speed.tangent(a), (7, 1.0))
    assert task.stops is not None
    for normal, floor in zip(task.stops.normal, task.stops.floor, strict=True):
        if np.isfinite(floor):
            add(normal, floor, (5, 1.0))
    for axis in range(3):
        add(np.eye(3)[axis], task.limits.arena_low[axis], (6, 1.0))
    for axis in range(3):
        add(-np.eye(3)[axis], -task.limits.arena_high[axis], (6, 1.0))
    barrier, last = task.rows, task.rows.keep_out_m.shape[1] - 1

    def tangent(j: int, i: int) -> tuple[np.ndarray, float, float]:
        """|r| >= d + s n . (x - a); what that leaves of R, and the margin."""
        reach = barrier.reach[i + 2]
        r = barrier.drift[:, j, i + 2] + reach * a
        d = float(np.linalg.norm(r))
        margin = barrier.keep_out_m[j, i] - barrier.radii_m[j]
        return reach * r / d, float(reach * (r @ a) / d) - d + float(barrier.radii_m[j]), float(margin)

    for j in range(len(barrier)):
        for i in range(last + 1):
            normal, floor, margin = tangent(j, i)
            add(normal, floor + kept[j, 0] * margin)
    for j in range(len(barrier)):
        normal, floor, margin = tangent(j, last)
        add(normal, floor + max(kept[j, 1], -1e3) * margin)
    for j in raised:
        for i in range(last + 1):
            normal, floor, margin = tangent(j, i)
            add(normal, floor, (3, -margin))
    for j in raised:
        normal, floor, margin = tangent(j, last)
        add(normal, floor, (4, -margin))
    return np.array(rows), np.array(floors)


def crowded() -> Task:
    """Three small obstacles and one too large to swerve round, with every limit in the way."""
    inputs = inputs_of(
        [(1.6, 0.2, 0.1), (2.0, -0.5, 0.0), (1.2, 0.4, -0.6)],
        [(-1.0, 0.0, 0.0), (-0.5, 0.3, 0.0), (-0.4, -0.6, 0.2)],
        speed=(2.9, 0.2, -0.1),
        a_ref=(0.5, -0.3, 0.2),
        before=(0.4, 0.1, 0.0),
    )
    sigma = frozen(np.outer((0.1, 0.2, 0.3), T))
    prediction = dataclasses.replace(inputs.prediction, radius_m=frozen([0.2, 0.3, 2.5]), sigma_m=sigma)
    config = msgspec.structs.replace(SAFETY, kappa=1.0, sigma_growth_s=9.0)
    return task_of(dataclasses.replace(inputs, prediction=prediction), SLEWED, config)


@pytest.mark.parametrize("raised", [[1], [2, 0]])
def test_a_program_of_shares_by_hand(raised: list[int]) -> None:
    task, a = crowded(), np.array([0.3, -0.2, 0.4])
    assert [cone.name for cone in task.limits.cones] == ["norm", "tilt"]
    assert task.limits.may_speed
    assert task.stops is not None
    assert np.isfinite(task.stops.floor).tolist() == [False, False, True]
    kept = np.array([[0.25, -np.inf], [-0.1, 0.4], [-0.3, -np.inf]])
    program = relax._share_program(task, a, kept, np.array(raised))
    rows, floors = hand_program(task, a, kept, raised)
    assert program.rows == pytest.approx(rows)
    assert program.floor == pytest.approx(floors)
    assert program.weight.tolist() == [2.0] * 8
    assert program.linear.tolist() == [-1.0, 0.6, -0.4, -1e6, -1e4, 3e3, 1e3, 1e2]
    assert program.low.tolist() == [*task.limits.hard_low, -qp.UNBOUNDED, -qp.UNBOUNDED, 0.0, 0.0, 0.0]
    assert program.high.tolist() == [*task.limits.hard_high, 1.0, 1.0, *[qp.UNBOUNDED] * 3]


def test_without_an_arena_a_program_has_no_infinite_floor() -> None:
    inputs = dataclasses.replace(inputs_of([(1.2, 0.1, 0.0)], [(-2.0, 0.0, 0.0)]), limits_on=False)
    task = task_of(inputs)
    program = relax._share_program(task, np.zeros(3), np.full((1, 2), -np.inf), np.array([0]))
    assert program.floor[:6].tolist() == [-qp.UNBOUNDED] * 6
    assert np.isfinite(program.floor).all()


def test_on_top_of_an_obstacle_a_program_is_finite() -> None:
    task = task_of(inputs_of([(0.0, 0.0, 0.0)], [(3.0, 0.0, 0.0)]))
    program = relax._share_program(task, np.zeros(3), np.zeros((1, 2)), np.array([0]))
    assert np.isfinite(program.rows).all()
    assert np.isfinite(program.floor).all()


class Programs:
    """Records what each program is asked, and answers as given: accelerations, shares, shares at the end."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, answers: list[tuple[float, ...]]) -> None:
        self.asked: list[tuple[np.ndarray, np.ndarray, list[int]]] = []
        given = iter(answers)

        def program(_: Task, a: np.ndarray, kept: np.ndarray, raised: np.ndarray) -> None:
            self.asked.append((a.copy(), kept.copy(), raised.tolist()))

        monkeypatch.setattr(relax, "_share_program", program)
        monkeypatch.setattr(relax, "solve", lambda *_: (np.array([*next(given), 0.0, 0.0, 0.0]), "given"))


def three() -> Task:
    """Contacts with 1, with 0, then with 2."""
    return task_of(inputs_of([(2.0, 0.1, 0.0), (1.4, 0.0, 0.0), (2.9, 0.0, 0.0)], [(-0.5, 0.0, 0.0)] * 3))


def test_obstacles_are_raised_one_after_the_other_and_the_last_repeatedly(monkeypatch: pytest.MonkeyPatch) -> None:
    task = three()
    assert by_contact(task.rows).tolist() == [1, 0, 2]
    programs = Programs(
        monkeypatch,
        [
            (-1.0, 9.0, 0.0, 0.7, 0.9),
            (-1.0, 2.0, 0.0, 0.4, 0.6),
            (-1.5, 2.0, 0.0, 0.2, 0.3),
            (-1.5, 2.0, 1e-2, 0.2, 0.3),
        ],
    )
    found = least_violation(task, Ways(task, np.zeros(3)), ("daqp",))
    assert [raised for _, _, raised in programs.asked] == [[1], [0], [2], [2]]
    start = programs.asked[0][0]
    first = np.minimum(shares(task.rows, start[None])[0], 0.0) - 1e-6
    end = [-np.inf] * 3
    for (a, kept, _), moved, low, late in zip(
        programs.asked,
        (start, [-1.0, 3.0, 0.0], [-1.0, 2.0, 0.0], [-1.5, 2.0, 0.0]),
        (first, [first[0], 0.7 - 1e-6, first[2]], *([[0.4 - 1e-6, 0.7 - 1e-6, first[2]]] * 2)),
        (end, [-np.inf, 0.9 - 1e-6, -np.inf], *([[0.6 - 1e-6, 0.9 - 1e-6, -np.inf]] * 2)),
        strict=True,
    ):
        assert a.tolist() == pytest.approx(list(moved))
        assert kept[:, 0].tolist() == pytest.approx(list(low), abs=1e-12)
        assert kept[:, 1].tolist() == pytest.approx(list(late), abs=1e-12)
    assert found.a.tolist() == [-1.5, 2.0, 1e-2]
    assert (found.admissible, found.cost, found.iterations, found.solver) == (False, np.inf, 4, "given")
    lower, upper = decay_interval(task.rows.evaluate(found.a), task.rows.least_decay)
    assert found.epsilon == pytest.approx(np.clip((lower + upper) / 2.0, 0.0, 1.0) / 0.5)


def test_the_last_obstacles_are_repeated_until_the_answer_settles(monkeypatch: pytest.MonkeyPatch) -> None:
    config = msgspec.structs.replace(SAFETY, iterations=6)
    task = task_of(inputs_of([(1.4, 0.0, 0.0), (2.0, 0.1, 0.0)], [(-0.5, 0.0, 0.0)] * 2), config=config)
    same = (-1.0, 2.0, 0.0, 0.5, 0.5)
    programs = Programs(monkeypatch, [same, same, (-1.0, 2.0, 0.002, 0.5, 0.5), (-1.0, 2.0, 0.0025, 0.5, 0.5)])
    found = least_violation(task, Ways(task, np.zeros(3)), ("daqp",))
    # the second answer equals the first, and no more is asked: it was the last group's
    assert [raised for _, _, raised in programs.asked] == [[0], [1]]
    assert found.iterations == 2
    programs = Programs(
        monkeypatch, [same, (-1.0, 2.0, 0.002, 0.5, 0.5), (-1.0, 2.0, 0.0025, 0.5, 0.5), (0.0, 0.0, 0.0, 0.0, 0.0)]
    )
    found = least_violation(task, Ways(task, np.zeros(3)), ("daqp",))
    assert [raised for _, _, raised in programs.asked] == [[0], [1], [1]]
    assert found.a.tolist() == [-1.0, 2.0, 0.0025]


@pytest.mark.parametrize(
    ("iterations", "groups"),
    [(1, [[1, 0, 2]]), (2, [[1], [0, 2]]), (3, [[1], [0, 2], [0, 2]]), (4, [[1], [0], [2], [2]])],
)
def test_half_of_the_programs_are_for_one_obstacle_each(
    iterations: int, groups: list[list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = msgspec.structs.replace(SAFETY, iterations=iterations)
    task = dataclasses.replace(three(), config=config)
    programs = Programs(monkeypatch, [(0.1 * count, 0.0, 0.0, 0.5, 0.5) for count in range(9)])
    least_violation(task, Ways(task, np.zeros(3)), ("daqp",))
    assert [raised for _, _, raised in programs.asked] == groups


def test_it_starts_from_the_widest_way_and_from_the_last_one_unless_another_is_wider(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Straight at a sphere a metre away: the best corner leaves a share of -0.24, 3 % less of it -0.35."""
    task = task_of(inputs_of([(1.2, 0.02, 0.0)], [(0.0, 0.0, 0.0)]))
    best = np.array([-3.0, -3.0, 3.0])
    assert shares(task.rows, best[None])[0, 0] == pytest.approx(-0.2437, abs=1e-4)
    for last, start in (
        (np.zeros(3), best),
        (0.97 * best, 0.97 * best),  # worse by less than 0.15: kept
        (0.93 * best, best),
        (9.0 * best, best),  # clipped to what the vehicle can do
    ):
        programs = Programs(monkeypatch, [(0.0, 0.0, 0.0, 0.5, 0.5)] * 9)
        least_violation(task, Ways(task, last), ("daqp",))
        assert np.abs(programs.asked[0][0]) == pytest.approx(np.abs(start))
        assert programs.asked[0][1][0, 0] == pytest.approx(shares(task.rows, start[None])[0, 0] - 1e-6, abs=1e-12)


def test_braking_takes_what_is_admissible_before_what_is_wide() -> None:
    """The epsilon is the target where that is admissible, else the least; and the stop takes no longer than a step."""
    task = task_of(inputs_of([(4.0, 0.0, 0.0)], [(0.0, 0.0, 0.0)], speed=(1.0, 0.0, 0.0)))
    found = braking(task, Ways(task, np.zeros(3)))
    assert found.a == pytest.approx([-3.0, 0.0, 0.0])
    lower, _ = decay_interval(task.rows.evaluate(found.a), task.rows.least_decay)
    assert found.epsilon == pytest.approx(np.clip(np.maximum(task.star, lower / 0.5), 0.0, 2.0))
    assert (found.cost, found.iterations, found.solver) == (np.inf, 0, "none")
    moving = task_of(inputs_of([], [], speed=(0.03, -0.04, 0.0)))
    assert braking(moving, Ways(moving, np.zeros(3))).a == pytest.approx([-0.6, 0.8, 0.0])
    quick = task_of(inputs_of([], [], speed=(3.0, -4.0, 0.0), at=(0.0, 0.0, 5.0)))
    assert braking(quick, Ways(quick, np.zeros(3))).a == pytest.approx(
        [-3.0, 3.0, 0.0]
    )  # slower after it than straight braking
    resting = task_of(inputs_of([], [], speed=(0.0, 0.0, 0.0)))
    assert braking(resting, Ways(resting, np.array([1.0, 0.0, 0.0]))).a.tolist() == [0.0, 0.0, 0.0]


def test_the_last_way_is_not_kept_where_it_touches_and_another_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """A share of -0.05 and its bonus of 0.15 are still a touch; 0.0 of another way is none."""
    task = task_of(inputs_of([(1.2, 0.02, 0.0)], [(0.0, 0.0, 0.0)]))
    offered = np.full((45, 1), -0.9)
    offered[0], offered[7] = -0.05, 0.0
    monkeypatch.setattr(relax, "shares", lambda *_: offered.copy())
    programs = Programs(monkeypatch, [(0.0, 0.0, 0.0, 0.5, 0.5)] * 9)
    ways = Ways(task, np.array([1.0, 1.0, 1.0]))
    least_violation(task, ways, ("daqp",))
    assert programs.asked[0][0].tolist() == task.limits.clip_hard(ways.offered)[7].tolist()


@pytest.mark.parametrize(
    ("last", "other", "kept"),
    [
        ((0.9, 0.2), (1.0, 0.9), True),  # 1.05 in the first place
        ((0.8, 0.9), (1.0, 0.2), False),
        ((1.0, 0.2), (1.0, 0.9), False),  # all of the margin is not favoured: the second obstacle decides
    ],
)
def test_the_last_way_is_favoured_where_it_leaves_less_than_the_margin(
    last: tuple[float, float], other: tuple[float, float], kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = task_of(inputs_of([(1.4, 0.0, 0.0), (2.0, 0.1, 0.0)], [(-0.5, 0.0, 0.0)] * 2))
    ways = Ways(task, np.array([1.0, 2.0, 3.0]))
    offered = np.full((len(ways.offered), 2), -1.0)
    offered[0], offered[7] = last, other
    monkeypatch.setattr(relax, "shares", lambda *_: offered.copy())
    programs = Programs(monkeypatch, [(0.0, 0.0, 0.0, 0.5, 0.5)] * 9)
    least_violation(task, ways, ("daqp",))
    assert programs.asked[0][0].tolist() == ways.offered[0 if kept else 7].tolist()
    assert programs.asked[0][1][:, 0].tolist() == [-1e-6, -1e-6]


def test_an_epsilon_is_none_where_no_decay_serves() -> None:
    """Inside the margin and further in at 1 m/s: even the least decay is more than the rows leave."""
    task = task_of(inputs_of([(0.45, 0.0, 0.0)], [(0.0, 0.0, 0.0)], speed=(1.0, 0.0, 0.0)))
    found = least_violation(task, Ways(task, np.zeros(3)), ("daqp",))
    lower, upper = decay_interval(task.rows.evaluate(found.a), task.rows.least_decay)
    assert lower[0] + upper[0] < 0.0
    assert found.epsilon.tolist() == [0.0]


def test_braking_takes_the_widest_where_nothing_is_admissible() -> None:
    task = task_of(inputs_of([(1.05, 0.25, 0.0)], [(0.0, 0.0, 0.0)]))
    ways = Ways(task, np.zeros(3))
    found = braking(task, ways)
    offered = shares(task.rows, task.limits.clip(ways.offered))[:, 0]
    assert not found.admissible
    assert shares(task.rows, found.a[None])[0, 0] == pytest.approx(offered.max())
    assert 0.5 < offered.max() < 0.7
    assert np.sort(offered)[-3] < offered.max() - 0.2


def test_brakings_epsilon_has_all_of_its_range() -> None:
    task = dataclasses.replace(
        task_of(inputs_of([(4.0, 0.0, 0.0)], [(0.0, 0.0, 0.0)], speed=(1.0, 0.0, 0.0))), star=np.array([1.7])
    )
    assert braking(task, Ways(task, np.zeros(3))).epsilon.tolist() == [1.7]


def test_braking_prefers_the_admissible_to_the_slower(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both leave the whole margin; the slower breaks a row."""
    task = task_of(inputs_of([(6.0, 0.0, 0.0)], [(0.0, 0.0, 0.0)], speed=(1.0, 0.0, 0.0)))
    real = relax.judge

    def judged(task: Task, a: np.ndarray) -> object:
        verdict = real(task, a)
        return dataclasses.replace(verdict, admissible=np.arange(len(a)) == 5)

    monkeypatch.setattr(relax, "judge", judged)
    ways = Ways(task, np.zeros(3))
    found = braking(task, ways)
    assert found.admissible
    assert found.a.tolist() == task.limits.clip(ways.offered)[4].tolist()
