"""The whole filter: identity, adjustment, least violation, failing solvers, symmetry, memory."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from functools import partial

import msgspec
import numpy as np
import pytest
from safety_scenes import uniform_motion

from companion.config import LimitsConfig, SafetyConfig, parse_config
from companion.errors import SolverError
from companion.safety import filter as filter_module
from companion.safety import qp
from companion.safety.adapt import decay_interval, epsilon_star
from companion.safety.barrier import Balls, Barrier
from companion.safety.filter import Answer, FilterInput, SafetyFilter
from companion.safety.limits import capability, vehicle_limits
from companion.safety.relax import shares
from companion.safety.stopping import StopRows, stop_rows, swerve_m
from companion.safety.task import Found, Task, Ways
from companion.types import FilterResult, Prediction, Verdict, frozen

SAFETY = SafetyConfig(sigma_delay_s=0.0)
LIMITS = LimitsConfig()


straight = partial(uniform_motion, prefix="s/")


def tick(
    prediction: Prediction,
    *,
    p: tuple[float, ...] = (0.0, 0.0, 2.0),
    v: tuple[float, ...] = (2.0, 0.0, 0.0),
    a: tuple[float, ...] = (1.0, 0.0, 0.0),
    limits_on: bool = True,
    elapsed_s: float | None = 0.05,
) -> FilterInput:
    return FilterInput(np.array(p), np.array(v), np.array(a), prediction, limits_on=limits_on, elapsed_s=elapsed_s)


def true_slack(inputs: FilterInput, result: FilterResult, config: SafetyConfig = SAFETY) -> float:
    """The least slack of all rows of all obstacles, from the recorded epsilons, recomputed from nothing else."""
    rows = Barrier(config).rows(inputs.p_enu, inputs.v_enu, inputs.prediction, inputs.p_std_m)
    epsilon = {record.track: record.epsilon for record in result.rows}
    decay = config.alpha2 * np.array([epsilon[name] for name in rows.ids])
    rise, psi = rows.evaluate(result.a_safe)
    _, norm = rows.gradient(result.a_safe, decay)
    return float(((rise + decay[:, None] * psi) / norm).min())


def test_without_obstacles_the_reference_passes() -> None:
    inputs = tick(straight([], []))
    result = SafetyFilter(SAFETY, LIMITS).step(inputs)
    assert result.verdict is Verdict.NOMINAL
    assert result.a_safe.tobytes() == inputs.a_ref.tobytes()
    assert result.worst is None
    assert result.rows == ()
    assert result.iterations == 0


def test_an_admissible_reference_passes_with_the_least_epsilon() -> None:
    """Head-on from 5 m at 1 m/s: every row at that epsilon holds, at a little less one breaks."""
    inputs = tick(straight([(5.0, 0.0, 2.0)], [(0.0, 0.0, 0.0)]), v=(1.0, 0.0, 0.0), a=(0.0, 0.0, 0.0))
    result = SafetyFilter(SAFETY, LIMITS).step(inputs)
    assert result.verdict is Verdict.NOMINAL
    epsilon = result.rows[0].epsilon
    assert 0.0 < epsilon < 2.0
    rows = Barrier(SAFETY).rows(inputs.p_enu, inputs.v_enu, inputs.prediction, 0.0)
    rise, psi = rows.evaluate(inputs.a_ref)
    assert (rise + 0.5 * epsilon * psi).min() == pytest.approx(0.0, abs=1e-12)
    assert (rise + 0.5 * (epsilon - 1e-6) * psi).min() < 0.0


def test_the_answer_is_read_only() -> None:
    result = SafetyFilter(SAFETY, LIMITS).step(tick(straight([], [])))
    with pytest.raises(ValueError, match="read-only"):
        result.a_safe[0] = 1.0


@pytest.mark.parametrize("solver", ["daqp", "osqp"])
def test_a_collision_course_is_adjusted_and_every_true_row_holds(solver: str) -> None:
    config = msgspec.structs.replace(SAFETY, solver=solver)
    inputs = tick(straight([(2.5, 0.1, 2.0), (2.0, -1.2, 2.0), (9.0, 9.0, 9.0)], [(-1.0, 0.0, 0.0)] * 3))
    result = SafetyFilter(config, LIMITS).step(inputs)
    assert result.verdict is Verdict.ADJUSTED
    assert not np.array_equal(result.a_safe, inputs.a_ref)
    assert np.abs(result.a_safe).max() <= 3.0
    assert true_slack(inputs, result) >= -1e-6
    assert {record.track for record in result.rows} >= {"s/0", "s/1", "s/2"}
    assert result.worst == min(result.rows, key=lambda record: record.slack)
    assert result.solver in {solver, "daqp"}  # which takes over where OSQP does not converge


def test_osqp_and_daqp_agree() -> None:
    inputs = tick(straight([(2.5, 0.1, 2.0)], [(-1.0, 0.0, 0.0)]))
    one, other = (
        SafetyFilter(msgspec.structs.replace(SAFETY, solver=name), LIMITS).step(inputs) for name in ("daqp", "osqp")
    )
    assert one.a_safe == pytest.approx(other.a_safe, abs=1e-3)
    assert (one.solver, other.solver) == ("daqp", "osqp")


def test_the_answer_is_near_the_cheapest_of_a_dense_search() -> None:
    """An independent minimiser: 20 000 random accelerations judged by the definition of admissibility."""
    inputs = tick(straight([(2.5, 0.1, 2.0)], [(-1.0, 0.0, 0.0)]))
    result = SafetyFilter(SAFETY, LIMITS).step(inputs)
    rows = Barrier(SAFETY).rows(inputs.p_enu, inputs.v_enu, inputs.prediction, 0.0)
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (20_000, 3))
    rise, psi = rows.evaluate_many(points)
    holds = (rise + psi >= 0.0).all(axis=(-2, -1))  # epsilon at its bound, the loosest outside the keep-out distance
    best = float(((points[holds] - inputs.a_ref) ** 2).sum(axis=-1).min())
    found = float(((result.a_safe - inputs.a_ref) ** 2).sum())
    assert found <= best + 0.05


def test_a_hopeless_case_is_relaxed_and_named_and_not_the_reference() -> None:
    inputs = tick(straight([(0.75, 0.0, 2.0), (8.0, 0.0, 2.0)], [(-3.0, 0.0, 0.0), (0.0, 0.0, 0.0)]))
    result = SafetyFilter(SAFETY, LIMITS).step(inputs)
    assert result.verdict is Verdict.RELAXED
    assert result.worst is not None
    assert result.worst.track == "s/0"
    assert result.worst.slack < 0.0
    assert not np.array_equal(result.a_safe, inputs.a_ref)
    assert np.abs(result.a_safe).max() <= 3.0


def test_the_relaxed_answer_leaves_more_room_than_any_of_many_others() -> None:
    inputs = tick(straight([(1.2, 0.1, 2.0)], [(-3.0, 0.0, 0.0)]), v=(3.0, 0.0, 0.0))
    result = SafetyFilter(SAFETY, LIMITS).step(inputs)
    assert result.verdict is Verdict.RELAXED
    rows = Barrier(SAFETY).rows(inputs.p_enu, inputs.v_enu, inputs.prediction, 0.0)
    others = np.random.default_rng(1).uniform(-3.0, 3.0, (5000, 3))
    assert shares(rows, result.a_safe[None])[0] >= shares(rows, others).max() - 1e-3


def test_the_arena_gives_way_to_an_obstacle_and_only_as_far_as_it_must() -> None:
    """At the east wall: an obstacle from the west pushes the vehicle through it, one from the east does not."""
    west, east = (
        SafetyFilter(SAFETY, LIMITS).step(
            tick(straight([p], [v]), p=(9.999, 0.0, 5.0), v=(0.0, 0.0, 0.0), a=(3.0, 0.0, 0.0))
        )
        for p, v in (((9.5, 0.0, 5.0), (0.6, 0.0, 0.0)), ((10.5, 0.0, 5.0), (-0.6, 0.0, 0.0)))
    )
    assert west.verdict is east.verdict is Verdict.RELAXED
    assert min(row.slack for row in west.rows if row.track == "arena") < -0.1
    assert min((row.slack for row in east.rows if row.track == "arena"), default=0.0) >= -1e-6


def test_arena_floor_and_speed_bind_without_any_obstacle() -> None:
    nothing = straight([], [])
    floor = SafetyFilter(SAFETY, LIMITS).step(tick(nothing, p=(0.0, 0.0, 0.35), v=(0.0, 0.0, -0.3), a=(0.0, 0.0, -2.0)))
    assert floor.verdict is Verdict.ADJUSTED
    assert floor.worst is not None
    assert floor.worst.track == "floor"
    assert floor.a_safe[2] > -2.0
    ready = SafetyFilter(SAFETY, LIMITS).step(
        tick(nothing, p=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0), a=(0.0, 0.0, 0.0), limits_on=False)
    )
    assert ready.verdict is Verdict.NOMINAL
    fast = SafetyFilter(SAFETY, LIMITS).step(tick(nothing, p=(-9.0, 0.0, 5.0), v=(4.2, 4.2, 0.0), a=(3.0, 0.0, 0.0)))
    assert fast.verdict is Verdict.ADJUSTED
    assert np.linalg.norm(np.array([4.2, 4.2, 0.0]) + 0.05 * fast.a_safe) <= 6.0 + 1e-6 * 0.05
    assert fast.worst is not None
    assert fast.worst.track == "speed"


def test_outside_the_arena_the_answer_is_relaxed_and_points_back() -> None:
    result = SafetyFilter(SAFETY, LIMITS).step(tick(straight([], []), p=(12.0, 0.0, 5.0)))
    assert result.verdict is Verdict.RELAXED
    assert result.worst is not None
    assert result.worst.track == "arena"
    assert result.a_safe[0] == pytest.approx(-3.0)


def fly(start: tuple[float, ...], obstacle: tuple[float, ...], velocity: tuple[float, ...]) -> tuple[list[float], bool]:
    """Euler point mass with a proportional reference to (6, 0, 2): clearances, and whether it arrived."""
    guard, target = SafetyFilter(SAFETY, LIMITS), np.array([6.0, 0.0, 2.0])
    p, v, o, clearances = np.array(start), np.zeros(3), np.array(obstacle), []
    for step in range(320):
        a_ref = np.clip(1.5 * (target - p) - 2.2 * v, -2.5, 2.5)
        result = guard.step(
            FilterInput(p, v, a_ref, straight([tuple(o)], [velocity]), elapsed_s=0.05 if step else None)
        )
        p, v, o = p + 0.05 * v, v + 0.05 * result.a_safe, o + 0.05 * np.array(velocity)
        clearances.append(math.dist(p, o) - 0.4)
    return clearances, math.dist(p, target) < 0.3


@pytest.mark.parametrize(
    ("obstacle", "velocity"),
    [
        ((3.0, 0.0, 2.0), (0.0, 0.0, 0.0)),  # static, exactly in the way
        ((6.0, 0.0, 2.0), (-2.0, 0.0, 0.0)),  # head-on, exactly
        ((2.0, 0.0, 2.0), (0.4, 0.0, 0.0)),  # overtaken from exactly behind
        ((3.0, 0.0, 6.0), (0.0, 0.0, -1.5)),  # from above
    ],
)
def test_exact_symmetry_is_broken_the_same_way_every_time(
    obstacle: tuple[float, ...], velocity: tuple[float, ...]
) -> None:
    first, arrived = fly((-2.0, 0.0, 2.0), obstacle, velocity)
    second, _ = fly((-2.0, 0.0, 2.0), obstacle, velocity)
    assert arrived
    assert min(first) > 0.0
    assert first == second


def test_reset_reproduces_bit_for_bit() -> None:
    guard = SafetyFilter(SAFETY, LIMITS)
    ticks = [tick(straight([(3.0 - 0.05 * k, 0.05, 2.0)], [(-1.0, 0.0, 0.0)])) for k in range(6)]
    first = [guard.step(inputs) for inputs in ticks]
    guard.reset()
    second = [guard.step(inputs) for inputs in ticks]
    assert any(result.verdict is Verdict.ADJUSTED for result in first)
    for one, other in zip(first, second, strict=True):
        assert one.a_safe.tobytes() == other.a_safe.tobytes()
        assert (one.rows, one.verdict, one.iterations) == (other.rows, other.verdict, other.iterations)


def test_a_failing_solver_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(qp.BACKENDS, "daqp", lambda _: None)
    inputs = tick(straight([(2.5, 0.1, 2.0)], [(-1.0, 0.0, 0.0)]))
    result = SafetyFilter(SAFETY, LIMITS).step(inputs)
    assert result.verdict is Verdict.ADJUSTED
    assert result.solver == "osqp"
    assert true_slack(inputs, result) >= -1e-6


@pytest.mark.parametrize("distance_m", [3.5, 0.75])
def test_without_any_solver_the_vehicle_brakes(monkeypatch: pytest.MonkeyPatch, distance_m: float) -> None:
    for name in ("daqp", "osqp"):
        monkeypatch.setitem(qp.BACKENDS, name, lambda _: None)
    inputs = tick(straight([(distance_m, 0.0, 2.0)], [(-1.0, 0.0, 0.0)]), a=(3.0, 0.0, 0.0))
    result = SafetyFilter(SAFETY, LIMITS).step(inputs)
    assert result.verdict is Verdict.BRAKING
    assert result.a_safe[0] < 0.0
    assert result.worst is not None
    if distance_m > 2.0:
        assert true_slack(inputs, result) >= -1e-6


def test_a_solver_that_dies_midway_leaves_the_admissible_iterate(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = iter(range(100))
    real = qp.solve_daqp
    monkeypatch.setitem(qp.BACKENDS, "daqp", lambda program: real(program) if next(calls) < 2 else None)
    monkeypatch.setitem(qp.BACKENDS, "osqp", lambda _: None)
    inputs = tick(straight([(2.5, 0.1, 2.0), (2.0, -1.0, 2.0)], [(-1.0, 0.0, 0.0)] * 2))
    result = SafetyFilter(SAFETY, LIMITS).step(inputs)
    assert result.verdict is Verdict.ADJUSTED
    assert true_slack(inputs, result) >= -1e-6


def test_strict_pricing_follows_the_clf() -> None:
    """At Table 1's prices an approach may not keep its epsilon: V falls by eta a tick, up to the rows' own demand."""
    config = msgspec.structs.replace(SAFETY, lambda_epsilon=10.0, lambda_delta=1e4)
    inputs = tick(straight([(2.5, 0.1, 2.0)], [(-1.0, 0.0, 0.0)]))
    cheap = SafetyFilter(SAFETY, LIMITS).step(inputs)
    strict = SafetyFilter(config, LIMITS).step(inputs)
    assert strict.rows[0].epsilon <= cheap.rows[0].epsilon
    assert strict.rows[0].epsilon_star == 0.0


def test_preset_paper_is_the_letter_of_the_paper() -> None:
    config = parse_config({"safety": {"preset": "paper"}}).safety
    assert (config.form, config.horizon, config.kappa, config.sigma_delay_s) == ("paper", 5, 0.0, 0.0)
    assert (config.lambda_u, config.lambda_epsilon, config.lambda_delta) == (1.0, 10.0, 1e4)
    assert (config.alpha1, config.alpha2, config.epsilon_max) == (0.8, 0.5, 2.0)
    result = SafetyFilter(config, LIMITS).step(tick(straight([(1.5, 0.1, 2.0)], [(-1.0, 0.0, 0.0)], horizon=5)))
    assert result.verdict in (Verdict.ADJUSTED, Verdict.RELAXED)


def test_a_track_that_appears_and_vanishes_has_no_lasting_effect() -> None:
    guard = SafetyFilter(SAFETY, LIMITS)
    far = tick(straight([(8.0, 5.0, 2.0)], [(0.0, 0.0, 0.0)]))
    before = guard.step(far)
    guard.step(tick(straight([(8.0, 5.0, 2.0), (1.0, 0.0, 2.0)], [(0.0, 0.0, 0.0)] * 2)))
    after = guard.step(far)
    assert before.verdict is after.verdict is Verdict.NOMINAL
    assert before.rows == after.rows


def test_on_top_of_an_obstacle_there_is_still_an_answer() -> None:
    result = SafetyFilter(SAFETY, LIMITS).step(
        tick(straight([(0.0, 0.0, 2.0)], [(0.0, 0.0, 0.0)]), v=(0.0, 0.0, 0.0), a=(0.0, 0.0, 0.0))
    )
    assert result.verdict is Verdict.RELAXED
    assert np.isfinite(result.a_safe).all()


def test_no_solver_error_leaves_the_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise SolverError("injected")

    monkeypatch.setattr("companion.safety.filter.least_of_ways", broken)
    result = SafetyFilter(SAFETY, LIMITS).step(tick(straight([(1.0, 0.0, 2.0)], [(-1.0, 0.0, 0.0)])))
    assert result.verdict is Verdict.BRAKING


def arrays_equal(one: object, other: object) -> bool:
    """Every field of two values of the same frozen class, arrays to the bit."""
    for field in dataclasses.fields(one):  # type: ignore[arg-type]
        a, b = getattr(one, field.name), getattr(other, field.name)
        if dataclasses.is_dataclass(a):
            if not arrays_equal(a, b):
                return False
        elif isinstance(a, tuple) and a and dataclasses.is_dataclass(a[0]):
            if not all(arrays_equal(x, y) for x, y in zip(a, b, strict=True)):
                return False
        elif not np.array_equal(a, b):
            return False
    return True


def test_the_problem_is_built_of_rows_limits_target_and_stops() -> None:
    config = msgspec.structs.replace(SAFETY, sigma_delay_s=0.02)
    limits = LimitsConfig(slew_m_s3=10.0, norm_m_s2=2.0)
    prediction = straight(
        [(3.0, 0.5, 2.0), (-2.0, 0.0, 2.5)], [(-1.0, 0.0, 0.0), (-3.0, 0.2, 0.0)], sigma_m=0.05, radius_m=0.9
    )
    inputs = FilterInput(
        np.array([9.0, 0.0, 2.0]),
        np.array([1.0, 0.3, 0.1]),
        np.array([0.5, 0.0, -0.1]),
        prediction,
        p_std_m=0.04,
        accel_shrink_m_s2=0.4,
        elapsed_s=0.02,
        a_before=np.array([0.3, 0.1, 0.0]),
    )
    task = SafetyFilter(config, limits).build(inputs)
    rows = Barrier(config).rows(inputs.p_enu, inputs.v_enu, prediction, 0.04)
    can = capability(limits, shrink_m_s2=0.4, dt_s=0.05)
    assert arrays_equal(task.rows, rows)
    before = inputs.a_before
    assert arrays_equal(
        task.limits, vehicle_limits(inputs.p_enu, inputs.v_enu, limits, can, before=before, elapsed_s=0.02)
    )
    assert task.a_ref is inputs.a_ref
    p_rel, v_rel = prediction.p_enu[:, 0] - inputs.p_enu, prediction.v_enu - inputs.v_enu
    assert task.star == pytest.approx(epsilon_star(p_rel, v_rel, config))
    assert task.star[1] > 0.0  # leaves to the west
    swerve = swerve_m(can.authority_m_s2, 0.05 * math.sqrt(22.0 * 21.0), 10.0)
    stops = stop_rows(-p_rel, -v_rel, rows.keep_out_m[:, 0], can.braking, swerve)
    assert stops is not None
    assert task.stops is not None
    assert task.stops.normal == pytest.approx(stops.normal)
    assert task.stops.floor == pytest.approx(stops.floor)
    ready = SafetyFilter(config, limits).build(dataclasses.replace(inputs, limits_on=False))
    assert ready.limits.arena_high.tolist() == [np.inf] * 3


@pytest.mark.parametrize(("radius", "stops"), [(1.42, False), (1.44, True)])
def test_what_can_be_swerved_round_within_the_horizon_has_no_stop(radius: float, stops: bool) -> None:
    """3 m/s^2 for 0.05 s sqrt(22 * 21) = 1.075 s are 1.733 m, and D is the radius and 0.3 m."""
    config = msgspec.structs.replace(SAFETY, kappa=0.0)
    task = SafetyFilter(config, LIMITS).build(tick(straight([(9.0, 0.0, 2.0)], [(0.0, 0.0, 0.0)], radius_m=radius)))
    assert (task.stops is not None) == stops


def test_the_box_shrinks_and_grows_again_with_the_disturbance() -> None:
    guard, inputs = SafetyFilter(SAFETY, LIMITS), tick(straight([], []))
    for shrink in (0.0, 0.5, 0.5, 0.0):
        assert guard.build(dataclasses.replace(inputs, accel_shrink_m_s2=shrink)).limits.box_m_s2 == 3.0 - shrink


class Asked:
    """Stands for the search: records what it is asked, and answers as given."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, a: tuple[float, ...], *, admissible: bool = True) -> None:
        self.asked: list[tuple[Task, Balls, np.ndarray, tuple[str, ...]]] = []
        self.violated: list[tuple[Task, np.ndarray, tuple[str, ...]]] = []

        def ways(task: Task, balls: Balls, ways: Ways, order: tuple[str, ...]) -> Found:
            self.asked.append((task, balls, np.array(ways.last), order))
            return Found(np.array(a), np.full(len(task.rows), 0.9), admissible, 1.5, 3, "ways")

        def violation(task: Task, ways: Ways, order: tuple[str, ...]) -> Found:
            self.violated.append((task, np.array(ways.last), order))
            return Found(np.array(a), np.full(len(task.rows), 1.1), False, np.inf, 2, "violation")

        monkeypatch.setattr(filter_module, "least_of_ways", ways)
        monkeypatch.setattr(filter_module, "least_violation", violation)


NEAR = [(2.0, 0.05, 2.0), (2.2, -0.3, 2.0)]


def test_the_search_has_what_is_within_reach_and_the_last_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    prediction = straight([NEAR[0], (0.0, 9.0, 2.0), NEAR[1]], [(-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)])
    ways, guard = Asked(monkeypatch, (-2.0, 1.0, 0.5)), SafetyFilter(SAFETY, LIMITS)
    inputs = tick(prediction, a=(1.0, 0.2, 0.0))
    answer = guard.solve(guard.build(inputs), 0.05)
    task, balls, last, order = ways.asked[0]
    assert task.rows.ids == ("s/0", "s/2")
    assert len(balls.decay) == 2
    assert balls.decay.tolist() == [1.0, 1.0]
    assert balls.centre.shape == (3, 2, 21)
    assert last.tolist() == [1.0, 0.2, 0.0]
    assert order == ("daqp", "osqp")
    assert answer.verdict is Verdict.ADJUSTED
    assert not ways.violated
    found = answer.found
    assert (found.admissible, found.cost, found.iterations, found.solver) == (True, 1.5, 3, "ways")
    assert found.epsilon[[0, 2]].tolist() == [0.9, 0.9]
    whole = guard.build(inputs)
    lower, upper = decay_interval(whole.rows.evaluate(found.a), whole.rows.least_decay)
    assert found.epsilon[1] == pytest.approx(float(np.clip(whole.star[1], lower[1] / 0.5, upper[1] / 0.5)))
    assert np.array_equal(answer.values, whole.rows.evaluate(found.a))
    guard.step(inputs)
    guard.step(inputs)
    assert ways.asked[-1][2].tolist() == [-2.0, 1.0, 0.5]
    guard.reset()
    guard.step(inputs)
    assert ways.asked[-1][2].tolist() == [1.0, 0.2, 0.0]
    osqp = SafetyFilter(msgspec.structs.replace(SAFETY, solver="osqp"), LIMITS)
    osqp.step(inputs)
    assert ways.asked[-1][3] == ("osqp", "daqp")


def test_the_least_violation_is_asked_where_no_way_is_admissible(monkeypatch: pytest.MonkeyPatch) -> None:
    ways = Asked(monkeypatch, (-2.0, 1.0, 0.5), admissible=False)
    guard = SafetyFilter(SAFETY, LIMITS)
    inputs = tick(straight(NEAR, [(-1.0, 0.0, 0.0)] * 2))
    task = guard.build(inputs)
    answer = guard.solve(task, 0.05)
    assert answer.found.solver == "violation"
    reduced, last, order = ways.violated[0]
    assert reduced is ways.asked[0][0]
    assert reduced.rows is task.rows  # both are within reach
    assert last.tolist() == [1.0, 0.0, 0.0]
    assert order == ("daqp", "osqp")
    assert answer.found.epsilon.tolist() == [1.1, 1.1]


def test_a_vehicle_at_an_obstacle_is_sent_round_it(monkeypatch: pytest.MonkeyPatch) -> None:
    ways, guard = Asked(monkeypatch, (0.0, 0.0, 0.0)), SafetyFilter(SAFETY, LIMITS)
    inputs = tick(straight([(0.55, 0.0, 2.0)], [(0.0, 0.0, 0.0)]), v=(0.0, 0.0, 0.0), a=(2.0, 0.0, 0.0))
    guard.step(inputs)
    task, _, last, _ = ways.asked[0]
    assert task.a_ref == pytest.approx([2.0, -2.0, 0.0])
    assert last == pytest.approx([2.0, -2.0, 0.0])


@pytest.mark.parametrize(("floor", "asked"), [(-5.20, []), (-5.19, ["s/1"]), (-0.5, ["s/1"])])
def test_a_stop_that_a_corner_of_the_box_breaks_is_within_reach(
    floor: float, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No row of obstacles 9 m away may break; a corner of the box is sqrt(3) 3 m/s^2 = 5.196 m/s^2 out."""
    ways, guard = Asked(monkeypatch, (0.0, 0.0, 0.0)), SafetyFilter(SAFETY, LIMITS)
    prediction = straight([(9.0, 0.0, 2.0), (0.0, 9.0, 2.0)], [(0.0, 0.0, 0.0)] * 2)
    task = guard.build(tick(prediction, v=(0.0, 0.0, 0.0), a=(3.5, 0.0, 0.0)))
    stops = StopRows(np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([-np.inf, floor]))
    guard.solve(dataclasses.replace(task, stops=stops), 0.05)
    reduced, balls, _, _ = ways.asked[0]
    assert list(reduced.rows.ids) == asked
    assert balls.q.shape == (len(asked), 21)
    assert reduced.stops is not None
    assert reduced.stops.floor.tolist() == [floor] * len(asked)


def test_the_clf_budget_is_that_of_each_obstacles_own_history(monkeypatch: pytest.MonkeyPatch) -> None:
    ways, guard = Asked(monkeypatch, (-2.0, 1.0, 0.5)), SafetyFilter(SAFETY, LIMITS)
    guard.step(tick(straight(NEAR[:1], [(-1.0, 0.0, 0.0)])))
    assert ways.asked[0][0].budget.tolist() == [4.0]  # without history from the greatest epsilon, 2
    guard.step(tick(straight(NEAR, [(-1.0, 0.0, 0.0)] * 2), elapsed_s=0.1))
    assert ways.asked[1][0].budget == pytest.approx([0.5**2 * 0.9**2, 4.0])
    guard.step(tick(straight(NEAR, [(-1.0, 0.0, 0.0)] * 2), elapsed_s=None))
    assert ways.asked[2][0].budget == pytest.approx([0.9**2, 0.9**2])


def judged(task: Task, a: tuple[float, ...], epsilon: np.ndarray, verdict: Verdict) -> FilterResult:
    found = Found(np.array(a), epsilon, True, 0.0, 4, "given")
    return SafetyFilter(SAFETY, LIMITS).verify(task, Answer(found, task.rows.evaluate(found.a), verdict))


def test_the_record_names_of_each_obstacle_its_worst_row() -> None:
    guard = SafetyFilter(SAFETY, LIMITS)
    task = guard.build(tick(straight(NEAR, [(-1.0, 0.0, 0.0), (0.5, 0.0, 0.0)], sigma_m=0.02), p=(0.0, 0.0, 2.0)))
    epsilon = np.array([1.2, 0.7])
    result = judged(task, (-1.0, 0.5, 0.2), epsilon, Verdict.ADJUSTED)
    assert [record.track for record in result.rows] == ["s/0", "s/1"]
    rise, psi = task.rows.evaluate(np.array([-1.0, 0.5, 0.2]))
    for j, record in enumerate(result.rows):
        values = rise[j] + 0.5 * epsilon[j] * psi[j]
        norm = np.linalg.norm(
            [
                task.rows.rise[axis, j]
                + 0.5 * epsilon[j] * task.rows.psi[axis, j]
                + a * (task.rows.rise[4, j] + 0.5 * epsilon[j] * task.rows.psi[4, j])
                for axis, a in ((1, -1.0), (2, 0.5), (3, 0.2))
            ],
            axis=0,
        )
        step = int((values / norm).argmin())
        assert record.step == step
        assert record.slack == pytest.approx(float((values / norm)[step]))
        assert record.margin == task.rows.margins(np.array([step, step]))[j]
        assert (record.epsilon, record.epsilon_star) == (epsilon[j], task.star[j])
    assert (result.iterations, result.solver) == (4, "given")
    assert result.worst == min(result.rows, key=lambda record: record.slack)


@pytest.mark.parametrize(
    ("beyond", "verdict", "expected"),
    [
        (5e-7, Verdict.ADJUSTED, Verdict.ADJUSTED),  # within the tolerance of 1e-6
        (2e-6, Verdict.ADJUSTED, Verdict.RELAXED),
        (2e-6, Verdict.BRAKING, Verdict.BRAKING),
        (2e-6, Verdict.NOMINAL, Verdict.NOMINAL),
    ],
)
def test_a_broken_limit_relaxes_an_adjusted_answer(beyond: float, verdict: Verdict, expected: Verdict) -> None:
    """At 5.9 m/s no more than 2 m/s^2 ahead."""
    task = SafetyFilter(SAFETY, LIMITS).build(tick(straight([], []), v=(5.9, 0.0, 0.0), p=(-9.0, 0.0, 5.0)))
    result = judged(task, (2.0 + beyond, 0.0, 0.0), np.zeros(0), verdict)
    assert result.verdict is expected
    assert result.worst is not None
    assert (result.worst.track, result.worst.step, result.worst.margin) == ("speed", -1, None)
    assert (result.worst.epsilon, result.worst.epsilon_star) == (0.0, 0.0)
    assert result.worst.slack == pytest.approx(-beyond, rel=1e-3)


@pytest.mark.parametrize(("room", "listed"), [(0.049, True), (0.051, False)])
def test_a_limit_is_listed_where_little_room_is_left(room: float, listed: bool) -> None:
    task = SafetyFilter(SAFETY, LIMITS).build(tick(straight([], []), v=(5.9, 0.0, 0.0), p=(-9.0, 0.0, 5.0)))
    result = judged(task, (2.0 - room, 0.0, 0.0), np.zeros(0), Verdict.ADJUSTED)
    assert [record.track for record in result.rows] == (["speed"] if listed else [])
    assert (result.worst is None) != listed


@pytest.mark.parametrize(("room", "listed"), [(0.049, True), (0.051, False)])
def test_a_stop_is_listed_where_little_room_is_left(room: float, listed: bool) -> None:
    task = SafetyFilter(SAFETY, LIMITS).build(tick(straight([(9.0, 0.0, 2.0), (0.0, 9.0, 2.0)], [(0.0, 0.0, 0.0)] * 2)))
    stops = StopRows(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]), np.array([-np.inf, -1.0]))
    task = dataclasses.replace(task, stops=stops, star=np.array([0.3, 0.4]))
    result = judged(task, (1.0 - room, 0.0, 0.0), np.array([0.5, 0.6]), Verdict.ADJUSTED)
    records = [record for record in result.rows if record.step == -1]
    assert len(result.rows) == 2 + len(records)
    assert len(records) == listed
    for record in records:
        assert (record.track, record.epsilon, record.epsilon_star) == ("s/1", 0.6, 0.4)
        assert record.slack == pytest.approx(room)
        assert record.margin == task.rows.margins(np.array([0, 0]))[1]


def test_a_reference_at_the_very_stop_passes() -> None:
    guard = SafetyFilter(SAFETY, LIMITS)
    task = guard.build(tick(straight([(9.0, 0.0, 2.0)], [(0.0, 0.0, 0.0)]), v=(0.0, 0.0, 0.0), a=(1.0, 0.0, 0.0)))
    for floor, verdict in ((-1.0, Verdict.NOMINAL), (-0.999, Verdict.ADJUSTED)):
        stops = StopRows(np.array([[-1.0, 0.0, 0.0]]), np.array([floor]))
        answer = guard.solve(dataclasses.replace(task, stops=stops), 0.05)
        assert answer.verdict is verdict
    assert answer.found.a[0] <= 0.999 + 1e-6
    nominal = guard.solve(task, 0.05)
    assert (nominal.found.admissible, nominal.found.cost, nominal.found.iterations) == (True, 0.0, 0)
    assert nominal.found.solver == "none"


def test_with_a_slew_limit_less_can_be_swerved_round() -> None:
    """At 5 m/s^3 3 m/s^2 take 0.6 s: within 1.075 s 0.18 + 0.9 * 0.475 + 1.5 * 0.475^2 = 0.946 m, not 1.733 m."""
    config, prediction = msgspec.structs.replace(SAFETY, kappa=0.0), straight([(9.0, 0.0, 2.0)], [(0.0, 0.0, 0.0)])
    for radius, stops in ((0.64, False), (0.66, True)):
        inputs = tick(dataclasses.replace(prediction, radius_m=frozen([radius])))
        assert (SafetyFilter(config, LimitsConfig(slew_m_s3=5.0)).build(inputs).stops is not None) == stops


def test_a_stop_is_before_the_first_rows_keep_out_distance() -> None:
    """Sigma grows along the horizon: D is 2.3 m at first and more after it."""
    config = msgspec.structs.replace(SAFETY, kappa=1.0)
    prediction = straight([(9.0, 0.0, 2.0)], [(0.0, 0.0, 0.0)], radius_m=2.0)
    prediction = dataclasses.replace(prediction, sigma_m=frozen(np.maximum(0.05 * np.arange(23) - 0.1, 0.0)[None]))
    task = SafetyFilter(config, LIMITS).build(tick(prediction, v=(0.0, 0.0, 0.0)))
    assert task.stops is not None
    assert task.stops.floor[0] == pytest.approx(-capability(LIMITS, shrink_m_s2=0.0, dt_s=0.05).braking.bound(6.7, 0.0))


def test_an_answer_that_cannot_be_admissible_is_not_searched_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The short cut of the stops leaves every answer as it was, with one program less."""
    config = SafetyConfig(sigma_delay_s=0.0, horizon=5)
    rng = np.random.default_rng(8)
    states = []
    for _ in range(30):
        offset = rng.normal(size=3) * (2.0, 2.0, 0.5)
        moved = tuple((offset / np.linalg.norm(offset) * rng.uniform(0.6, 2.0)).tolist())
        prediction = straight([np.array([0.0, 0.0, 2.0]) + moved], [tuple((-2.0 * np.array(moved)).tolist())])
        states.append(tick(prediction, v=tuple(rng.normal(size=3).tolist())))
    told = [SafetyFilter(config, LIMITS).step(state) for state in states]
    monkeypatch.setattr(StopRows, "beyond", lambda *_: False)
    searched = [SafetyFilter(config, LIMITS).step(state) for state in states]
    answers = [[(result.a_safe.tobytes(), result.verdict) for result in results] for results in (told, searched)]
    assert answers[0] == answers[1]
    assert Counter(result.verdict for result in told)[Verdict.RELAXED] > 10
