"""The programs of the search: touching planes against the rows themselves, and answers against a dense search."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from companion.config import LimitsConfig, SafetyConfig
from companion.errors import SolverError
from companion.safety import qp, search
from companion.safety import task as task_module
from companion.safety.filter import FilterInput, SafetyFilter
from companion.safety.search import form, least_cost, least_of_ways, limit_rows
from companion.safety.task import Found, Task, Ways, judge
from companion.types import Prediction, Verdict, frozen

ORDER = ("daqp", "osqp")
HOVER = np.zeros(3)


def random_inputs(seed: int, count: int, config: SafetyConfig, *, close: bool = True) -> FilterInput:
    """Obstacles on curved paths towards a vehicle in mid-air."""
    rng = np.random.default_rng(seed)
    t = config.dt_s * np.arange(config.horizon + 3)
    p = np.array([0.0, 0.0, 5.0])
    away = rng.standard_normal((count, 1, 3)) * (1.0, 1.0, 0.5)
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    start = p + away * rng.uniform(1.6 if close else 6.0, 3.5 if close else 9.0, (count, 1, 1))
    v = -away * rng.uniform(0.5, 2.0, (count, 1, 1))
    path = start + v * t[:, None] + 0.5 * rng.normal(0.0, 0.5, (count, 1, 3)) * t[:, None] ** 2
    prediction = Prediction(
        start_ns=0,
        dt_s=config.dt_s,
        ids=tuple(str(index) for index in range(count)),
        p_enu=frozen(path),
        sigma_m=frozen(np.full((count, len(t)), 0.03)),
        v_enu=frozen(v[:, 0]),
        a_enu=frozen(np.zeros((count, 3))),
        radius_m=frozen(np.full(count, 0.2)),
    )
    return FilterInput(p, rng.normal(0.0, 0.8, 3), rng.uniform(-2.5, 2.5, 3), prediction, elapsed_s=0.05)


def task_of(inputs: FilterInput, config: SafetyConfig, limits: LimitsConfig | None = None) -> Task:
    task = SafetyFilter(config, limits or LimitsConfig()).build(inputs)
    return Task(task.rows, task.limits, task.a_ref, task.star, np.full(len(task.rows), 0.3), config, task.stops)


def value(task: Task, a: np.ndarray, epsilon: np.ndarray) -> np.ndarray:
    rise, psi = task.rows.evaluate(a)
    return np.asarray(rise + task.config.alpha2 * epsilon[:, None] * psi)


@pytest.mark.parametrize("seed", range(6))
def test_a_touching_plane_admits_nothing_that_its_row_refuses(seed: int) -> None:
    config = SafetyConfig(horizon=8)
    task = task_of(random_inputs(seed, 2, config), config)
    rng = np.random.default_rng(seed)
    a, epsilon = rng.uniform(-3.0, 3.0, 3), rng.uniform(0.4, 2.0, 2)
    shared = form(task, task.rows.balls(np.ones(2)))
    program = search._tangent_program(task, shared, a, epsilon, epsilon)
    count = 2 * 9
    points = rng.uniform(-3.0, 3.0, (300, 3))
    at_epsilon = np.concatenate((points, np.tile(epsilon, (300, 1)), np.zeros((300, 2))), axis=1)
    admitted = at_epsilon @ program.rows[:count].T >= program.floor[:count]
    holds = np.array([value(task, point, epsilon).reshape(-1) >= 0.0 for point in points])
    assert (holds | ~admitted).all()
    assert admitted.any()


@pytest.mark.parametrize("seed", range(6))
def test_planes_touch_their_balls_and_their_slopes_are_the_jacobian(seed: int) -> None:
    """Where a plane touches, the row is zero, and its finite differences in a and epsilon are the plane's, scaled."""
    config = SafetyConfig(horizon=8)
    task = task_of(random_inputs(seed, 2, config), config)
    rng = np.random.default_rng(seed)
    a, epsilon = rng.uniform(-3.0, 3.0, 3), rng.uniform(0.4, 2.0, 2)
    balls = task.rows.balls(config.alpha2 * epsilon)
    program = search._tangent_program(task, form(task, task.rows.balls(np.ones(2))), a, epsilon, epsilon)
    checked = 0
    for j in range(2):
        for i in range(9):
            centre, square = balls.centre[:, j, i], balls.square[j, i]
            distance = np.linalg.norm(a - centre)
            normal, index = (a - centre) / distance, 9 * j + i
            assert program.rows[index, :3] == pytest.approx(normal)
            if square < 0.25 * distance**2:
                continue
            checked += 1
            touch = centre + np.sqrt(square) * normal
            assert value(task, touch, epsilon)[j, i] == pytest.approx(0.0, abs=1e-9)
            assert program.floor[index] == pytest.approx(
                normal @ touch + program.rows[index, 3 + j] * epsilon[j], rel=1e-6, abs=1e-6
            )
            step = 1e-4
            slopes = [
                (value(task, touch + step * axis, epsilon) - value(task, touch - step * axis, epsilon))[j, i]
                / (2 * step)
                for axis in np.eye(3)
            ]
            scale = np.linalg.norm(slopes)
            assert np.array(slopes) / scale == pytest.approx(normal, abs=1e-6)
            shift = step * np.eye(2)[j]
            by_epsilon = (value(task, touch, epsilon + shift) - value(task, touch, epsilon - shift))[j, i] / (2 * step)
            assert program.rows[index, 3 + j] == pytest.approx(by_epsilon / scale, rel=1e-6)
    assert checked > 4


def test_a_row_that_always_holds_has_a_plane_that_refuses_nothing() -> None:
    config = SafetyConfig(horizon=4)
    task = task_of(random_inputs(0, 1, config, close=False), config)
    balls = task.rows.balls(np.ones(1))
    program = search._tangent_program(task, form(task, balls), HOVER, np.full(1, 2.0), np.ones(1))
    corners = 3.0 * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    at_two = np.concatenate((corners, np.full((8, 1), 2.0), np.zeros((8, 1))), axis=1)
    assert (at_two @ program.rows[:5].T >= program.floor[:5]).all()


def test_the_clf_row_is_the_tangent_of_26() -> None:
    """delta >= V(e) - budget about e = 0.8, V = (e - star)^2: at 0.8 itself to the digit, below V elsewhere."""
    config = SafetyConfig(horizon=4)
    task = task_of(random_inputs(1, 2, config), config)
    about = np.array([0.8, 1.4])
    balls = task.rows.balls(np.ones(2))
    program = search._tangent_program(task, form(task, balls), HOVER, np.full(2, 2.0), about)
    for j in range(2):
        row, floor = program.rows[10 + j], program.floor[10 + j]
        assert row[[0, 1, 2, 3 + (1 - j), 5 + (1 - j)]].tolist() == [0.0] * 5
        for epsilon in (0.0, 0.5, about[j], 1.9):
            least_delta = (floor - row[3 + j] * epsilon) / row[5 + j]
            exact = (epsilon - task.star[j]) ** 2 - 0.3
            assert least_delta <= exact + 1e-12
            assert epsilon != about[j] or least_delta == pytest.approx(exact)


def test_cost_and_bounds_are_those_of_29() -> None:
    config = SafetyConfig(horizon=4, lambda_u=2.0, lambda_epsilon=0.5, lambda_delta=7.0)
    task = task_of(random_inputs(2, 2, config), config)
    shared = form(task, task.rows.balls(np.ones(2)))
    x = np.array([0.3, -0.2, 0.9, 0.7, 1.2, 0.1, 0.4])
    cost = 0.5 * x @ (shared.weight * x) + shared.linear @ x
    constant = 2.0 * task.a_ref @ task.a_ref + 0.5 * task.star @ task.star
    by_hand = (
        2.0 * np.sum((x[:3] - task.a_ref) ** 2) + 0.5 * np.sum((x[3:5] - task.star) ** 2) + 7.0 * np.sum(x[5:] ** 2)
    )
    assert cost + constant == pytest.approx(by_hand)
    assert shared.low.tolist() == [-3.0, -3.0, -3.0, 0.0, 0.0, 0.0, 0.0]
    assert shared.high.tolist() == [3.0, 3.0, 3.0, 2.0, 2.0, qp.UNBOUNDED, qp.UNBOUNDED]


def test_limit_rows_are_the_tangents_of_what_may_bind() -> None:
    config = SafetyConfig(horizon=4, braking=False)
    limits = LimitsConfig(norm_m_s2=2.0, tilt_deg=10.0, speed_m_s=1.0)
    inputs = random_inputs(3, 1, config)
    task = task_of(inputs, config, limits)
    rows, floors = limit_rows(task, np.array([1.0, 0.0, 0.0]), 5)
    assert rows.shape == (3, 5)
    for cone, row, floor in zip((*task.limits.cones, task.limits.speed), rows, floors, strict=True):
        normal, least = cone.tangent(np.array([1.0, 0.0, 0.0]))
        assert row[:3].tolist() == normal.tolist()
        assert floor == least
    free, none = limit_rows(task_of(inputs, config), HOVER, 5)
    assert free.shape == (0, 5)
    assert none.shape == (0,)


@pytest.mark.parametrize(("price", "penalty", "iterations", "factor"), [(0.01, 0.01, 4, 1.05), (10.0, 1e4, 10, 1.4)])
def test_answers_are_nearly_the_cheapest_of_a_dense_search(
    price: float, penalty: float, iterations: int, factor: float
) -> None:
    """The dense search refines 4000 random points of true cost. Dear epsilons have several local ways to be cheap."""
    config = SafetyConfig(lambda_epsilon=price, lambda_delta=penalty, iterations=iterations)
    rng, compared = np.random.default_rng(0), 0
    for seed in range(14):
        inputs = random_inputs(seed, 2, config)
        task = task_of(inputs, config)
        found = least_of_ways(task, task.rows.balls(np.ones(2)), Ways(task, task.a_ref), ORDER)
        points = task.limits.clip(rng.uniform(-3.0, 3.0, (4000, 3)))
        for spread in (0.3, 0.1, 0.03, 0.01):
            ranked = judge(task, points).ranked
            best = points[np.argsort(ranked)[:20]]
            points = task.limits.clip(
                np.concatenate((best, *(best + rng.normal(0.0, spread, best.shape) for _ in range(15))))
            )
        least = float(judge(task, points).ranked.min())
        if np.isfinite(least):
            compared += 1
            assert found.admissible
            assert found.cost <= factor * least + 0.05
            assert judge(task, found.a[None]).ranked[0] == pytest.approx(found.cost)
    assert compared > 6


def test_the_budget_of_programs_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    config = SafetyConfig(iterations=2)
    task, calls = task_of(random_inputs(4, 2, config), config), []
    real = search.solve
    monkeypatch.setattr(search, "solve", lambda *a: (calls.append(a), real(*a))[1])
    start = Found(task.a_ref, np.full(2, 2.0), False, np.inf, 0, "none")
    found = least_cost(task, form(task, task.rows.balls(np.ones(2))), start, ORDER)
    assert found.iterations <= len(calls) <= 2


def test_a_first_program_without_an_answer_is_an_error_and_an_infeasible_one_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = SafetyConfig()
    task = task_of(random_inputs(4, 1, config), config)
    shared = form(task, task.rows.balls(np.ones(1)))
    start = Found(task.a_ref, np.full(1, 2.0), True, 5.0, 0, "none")

    def raising(error: SolverError) -> object:
        def solve(*_: object) -> None:
            raise error

        return solve

    monkeypatch.setattr(search, "solve", raising(SolverError("failed")))
    with pytest.raises(SolverError, match="failed"):
        least_cost(task, shared, start, ORDER)
    monkeypatch.setattr(search, "solve", raising(qp.Infeasible("proven")))
    assert least_cost(task, shared, start, ORDER) is start


def test_a_small_correction_looks_for_no_other_way(monkeypatch: pytest.MonkeyPatch) -> None:
    config = SafetyConfig()
    task = task_of(random_inputs(0, 1, config, close=False), config)
    asked = []
    monkeypatch.setattr(task_module, "candidates", lambda *_: asked.append(1))
    found = least_of_ways(task, task.rows.balls(np.ones(1)), Ways(task, task.a_ref), ORDER)
    assert found.cost <= search.CHEAP
    assert not asked


def test_a_cheaper_way_round_is_taken() -> None:
    """From the costly side of an obstacle, with the last answer there."""
    config = msgspec.structs.replace(SafetyConfig(), kappa=0.0)
    t = 0.05 * np.arange(23)
    prediction = Prediction(
        start_ns=0,
        dt_s=0.05,
        ids=("0",),
        p_enu=frozen((np.array([2.0, 0.35, 5.0]) + t[:, None] * np.array([-1.0, 0.0, 0.0]))[None]),
        sigma_m=frozen(np.zeros((1, 23))),
        v_enu=frozen([[-1.0, 0.0, 0.0]]),
        a_enu=frozen(np.zeros((1, 3))),
        radius_m=frozen([0.2]),
    )
    guard = SafetyFilter(config, LimitsConfig())
    inputs = FilterInput(np.array([0.0, 0.0, 5.0]), np.array([2.0, 0.0, 0.0]), np.zeros(3), prediction)
    task = guard.build(inputs)
    found = least_of_ways(task, task.rows.balls(np.ones(1)), Ways(task, np.array([0.0, 3.0, 0.0])), ORDER)
    assert found.a[1] < 0.0  # the obstacle is to the left of the path
    assert guard.step(inputs).verdict is Verdict.ADJUSTED
