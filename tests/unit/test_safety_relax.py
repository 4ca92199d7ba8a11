"""Least violation: the order of obstacles, the order of what gives way, and the budget."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from companion.config import LimitsConfig, SafetyConfig
from companion.errors import SolverError
from companion.safety import qp, relax
from companion.safety.filter import FilterInput, SafetyFilter
from companion.safety.relax import braking, by_contact, least_violation, shares, widest
from companion.safety.task import Task, Ways
from companion.types import Prediction, Verdict, frozen

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
    start, velocity = np.reshape(p, (len(p), 3)) + np.array(at), np.reshape(v, (len(p), 3))
    prediction = Prediction(
        start_ns=0,
        dt_s=0.05,
        ids=tuple(str(index) for index in range(len(p))),
        p_enu=frozen(start[:, None] + T[:, None] * velocity[:, None]),
        sigma_m=frozen(np.zeros((len(p), 23))),
        v_enu=frozen(velocity),
        a_enu=frozen(np.zeros((len(p), 3))),
        radius_m=frozen(np.full(len(p), radius)),
    )
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
    assert widest(np.array([[0.50, 0.5], [0.51, 0.6]])) == 1  # the same to a twentieth: then the sum


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
