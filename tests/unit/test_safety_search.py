"""The programs of the search: touching planes against the rows themselves, and answers against a dense search."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest
from safety_scenes import uniform_motion

from companion.config import LimitsConfig, SafetyConfig
from companion.errors import SolverError
from companion.safety import qp, search
from companion.safety import task as task_module
from companion.safety.filter import FilterInput, SafetyFilter
from companion.safety.search import form, least_cost, least_of_ways, limit_rows
from companion.safety.stopping import StopRows
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


def random_program(seed: int) -> tuple[Task, np.ndarray, np.ndarray, qp.Program]:
    """Two obstacles, nine rows each: the task, the acceleration and epsilon that a program is about, and itself."""
    config = SafetyConfig(horizon=8)
    task = task_of(random_inputs(seed, 2, config), config)
    rng = np.random.default_rng(seed)
    a, epsilon = rng.uniform(-3.0, 3.0, 3), rng.uniform(0.4, 2.0, 2)
    shared = form(task, task.rows.balls(np.ones(2)))
    return task, a, epsilon, search._tangent_program(task, shared, a, epsilon, epsilon)


@pytest.mark.parametrize("seed", range(6))
def test_a_touching_plane_admits_nothing_that_its_row_refuses(seed: int) -> None:
    task, _, epsilon, program = random_program(seed)
    count, rng = 2 * 9, np.random.default_rng(seed)
    points = rng.uniform(-3.0, 3.0, (300, 3))
    at_epsilon = np.concatenate((points, np.tile(epsilon, (300, 1)), np.zeros((300, 2))), axis=1)
    admitted = at_epsilon @ program.rows[:count].T >= program.floor[:count]
    holds = np.array([value(task, point, epsilon).reshape(-1) >= 0.0 for point in points])
    assert (holds | ~admitted).all()
    assert admitted.any()


@pytest.mark.parametrize("seed", range(6))
def test_planes_touch_their_balls_and_their_slopes_are_the_jacobian(seed: int) -> None:
    """Where a plane touches, the row is zero, and its finite differences in a and epsilon are the plane's, scaled."""
    task, a, epsilon, program = random_program(seed)
    balls = task.rows.balls(task.config.alpha2 * epsilon)
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
    task = dataclasses.replace(task_of(random_inputs(1, 2, config), config), star=np.array([0.3, 0.1]))
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
    prediction = uniform_motion([2.0, 0.35, 5.0], [-1.0, 0.0, 0.0])
    guard = SafetyFilter(config, LimitsConfig())
    inputs = FilterInput(np.array([0.0, 0.0, 5.0]), np.array([2.0, 0.0, 0.0]), np.zeros(3), prediction)
    task = guard.build(inputs)
    found = least_of_ways(task, task.rows.balls(np.ones(1)), Ways(task, np.array([0.0, 3.0, 0.0])), ORDER)
    assert found.a[1] < 0.0  # the obstacle is to the left of the path
    assert guard.step(inputs).verdict is Verdict.ADJUSTED


@pytest.mark.parametrize("epsilon", [(2.0, 2.0), (0.7, 1.6)])
def test_every_plane_is_the_row_linearised_where_it_touches(epsilon: tuple[float, float]) -> None:
    """At the ball's surface or half way to it: n . (a - x) + alpha2 psi (e - e_0) / (q rho) >= -g(x) / (q rho)."""
    config = SafetyConfig(horizon=8)
    task = task_of(random_inputs(3, 2, config), config)
    a, at, small = np.array([1.5, -2.0, 0.7]), np.array(epsilon), 0
    balls = task.rows.balls(config.alpha2 * at)
    program = search._tangent_program(task, form(task, task.rows.balls(np.ones(2))), a, at, at)
    for j in range(2):
        for i in range(9):
            way = a - balls.centre[:, j, i]
            distance = float(np.linalg.norm(way))
            rho = np.sqrt(max(balls.square[j, i], 0.25 * distance**2))
            small += balls.square[j, i] < 0.25 * distance**2
            touch = balls.centre[:, j, i] + rho * way / distance
            scale = balls.q[j, i] * rho
            _, psi = task.rows.evaluate(touch)
            slope = 0.5 * psi[j, i] / scale
            row, floor = program.rows[9 * j + i], program.floor[9 * j + i]
            assert row[3 + j] == pytest.approx(slope)
            assert row[[3 + (1 - j), 5, 6]].tolist() == [0.0, 0.0, 0.0]
            least = way @ touch / distance - value(task, touch, at)[j, i] / scale + slope * at[j]
            assert floor - least == pytest.approx(1e-7, abs=2e-9)  # kept by the inset
    assert 0 < small < 18


def test_at_a_balls_very_centre_the_program_is_finite() -> None:
    config = SafetyConfig(horizon=4)
    task = task_of(random_inputs(1, 1, config), config)
    balls = task.rows.balls(np.ones(1))
    centre = balls.centre[:, 0, 3]
    program = search._tangent_program(task, form(task, balls), centre, np.full(1, 2.0), np.full(1, 2.0))
    assert np.isfinite(program.rows).all()
    assert np.isfinite(program.floor).all()
    near = search._tangent_program(
        task, form(task, balls), centre + np.array([5e-4, 0.0, 0.0]), np.full(1, 2.0), np.full(1, 2.0)
    )
    assert near.rows[3, :3] == pytest.approx([0.5, 0.0, 0.0])  # no arm is shorter than 1e-3 m/s^2


def test_bounds_are_those_of_the_arena_and_of_who_is_inside() -> None:
    config = SafetyConfig(horizon=4, recovery=0.1)
    inputs = random_inputs(2, 2, config)
    inside = Prediction(
        0,
        0.05,
        ("0", "1"),
        frozen(np.concatenate((np.full((1, 7, 3), (0.3, 0.0, 5.0)), inputs.prediction.p_enu[1:]))),
        inputs.prediction.sigma_m,
        inputs.prediction.v_enu,
        inputs.prediction.a_enu,
        inputs.prediction.radius_m,
    )
    p = FilterInput(inputs.p_enu, np.array([1.0, 0.0, 0.0]), inputs.a_ref, inside)
    task = task_of(p, config, LimitsConfig(arena_max=(0.3, 10.0, 10.0)))
    shared = form(task, task.rows.balls(np.ones(2)))
    assert shared.low[3:5].tolist() == [0.2, 0.0]
    assert shared.high[0] == task.limits.high[0] < 3.0
    assert shared.low[:3].tolist() == task.limits.low.tolist()
    assert shared.weight.tolist() == [2.0, 2.0, 2.0, 0.02, 0.02, 0.02, 0.02]


def test_stops_have_a_row_where_they_may_bind() -> None:
    config = SafetyConfig(horizon=4)
    task = task_of(random_inputs(3, 2, config), config)
    stops = StopRows(np.array([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]), np.array([-0.7, -np.inf]))
    task = Task(task.rows, task.limits, task.a_ref, task.star, task.budget, config, stops)
    rows, floors = limit_rows(task, HOVER, 7)
    assert rows.tolist() == [[0.6, 0.8, 0.0, 0.0, 0.0, 0.0, 0.0]]
    assert floors.tolist() == [-0.7]
    program = search._tangent_program(task, form(task, task.rows.balls(np.ones(2))), HOVER, np.ones(2), np.ones(2))
    assert program.rows[-1].tolist() == rows[0].tolist()
    assert program.floor[-1] == -0.7
    assert len(program.rows) == len(program.floor) == 2 * 5 + 2 + 1
    normed = task_of(random_inputs(3, 2, config), config, LimitsConfig(norm_m_s2=2.0))
    rows, floors = limit_rows(dataclasses.replace(normed, stops=stops), HOVER, 7)
    assert rows[:, :3].tolist() == [[-1.0, 0.0, 0.0], [0.6, 0.8, 0.0]]
    assert floors.tolist() == [-2.0, -0.7]


class Programs:
    """Records what each program is about, and answers with what is given, then with the solver."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, answers: list[np.ndarray]) -> None:
        self.about: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self.answers = iter(answers)
        program, solver = search._tangent_program, search.solve

        def asked(task: Task, shared: object, a: np.ndarray, epsilon: np.ndarray, about: np.ndarray) -> object:
            self.about.append((a.copy(), epsilon.copy(), about.copy()))
            return program(task, shared, a, epsilon, about)

        def solve(problem: object, order: tuple[str, ...]) -> tuple[np.ndarray, str]:
            given = next(self.answers, None)
            return solver(problem, order) if given is None else (given, "given")

        monkeypatch.setattr(search, "_tangent_program", asked)
        monkeypatch.setattr(search, "solve", solve)


def test_the_first_program_is_about_the_start_and_the_next_about_what_it_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = SafetyConfig(iterations=3)
    task = task_of(random_inputs(4, 2, config), config)
    start = Found(np.array([0.1, 0.2, 0.3]), np.array([2.0, 1.5]), False, np.inf, 0, "none")
    answer = np.array([-1.0, 0.5, 0.25, 0.8, 1.1, 0.0, 0.0])
    programs = Programs(monkeypatch, [answer])
    best = least_cost(task, form(task, task.rows.balls(np.ones(2))), start, ORDER)
    (a, epsilon, about), (then, then_epsilon, then_about) = programs.about[:2]
    assert (a.tolist(), epsilon.tolist()) == ([0.1, 0.2, 0.3], [2.0, 1.5])
    assert about == pytest.approx(task.star + np.sqrt(0.3))  # where the CLF begins to cost
    on = [0.0, 0.02, 0.05, 0.1, 0.2, 0.35, 0.55, 0.8]
    tried = [answer[:3] + share * (task.a_ref - answer[:3]) for share in on]
    tried += [start.a + share * (answer[:3] - start.a) for share in (0.0, 0.25, 0.5)]
    verdict = judge(task, task.limits.clip(np.array(tried)))
    taken = int(verdict.ranked.argmin())
    assert np.isfinite(verdict.ranked[taken])
    assert then.tolist() == task.limits.clip(np.array(tried))[taken].tolist()
    expected = np.clip(answer[3:5], verdict.lower[taken], verdict.upper[taken])
    assert then_epsilon.tolist() == then_about.tolist() == expected.tolist()
    assert best.cost <= verdict.ranked[taken]
    assert len(programs.about) <= 3


def test_the_clf_is_linearised_a_tenth_from_its_target_at_least(monkeypatch: pytest.MonkeyPatch) -> None:
    config = SafetyConfig(iterations=1)
    task = task_of(random_inputs(4, 2, config), config)
    task = Task(task.rows, task.limits, task.a_ref, np.array([0.4, 0.0]), np.array([0.0, 0.25]), config)
    programs = Programs(monkeypatch, [])
    start = Found(task.a_ref, np.full(2, 2.0), False, np.inf, 0, "none")
    least_cost(task, form(task, task.rows.balls(np.ones(2))), start, ORDER)
    assert programs.about[0][2] == pytest.approx([0.5, 0.5])
    assert len(programs.about) == 1


@pytest.mark.parametrize(
    ("answers", "asked"),
    [
        ([(-2.0, 0.0, 0.0), (-2.0, 1.5, 0.0), (-2.0, 1.5, 1.0)], 2),  # the second saves nothing
        ([(-2.0, 0.0, 0.0), (-1.5, 0.0, 0.0), (-1.0, 0.0, 0.0)], 3),  # each saves
        ([(-2.0, 0.0, 0.0), (-1.98, 0.0, 0.0), (-1.0, 0.0, 0.0)], 2),  # the second less than 3 %
        ([(0.05, 0.0, 0.0), (0.04, 0.0, 0.0), (0.0, 0.0, 0.0)], 2),  # less than 1e-3 (m/s^2)^2
        ([(0.05, 0.0, 0.0), (0.03, 0.0, 0.0), (0.0, 0.0, 0.0)], 3),
    ],
)
def test_a_sequence_ends_where_it_saves_no_more(
    answers: list[tuple[float, ...]], asked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Free of obstacles a judged cost is |a - a_ref|^2, and the whole answer is tried beside shares of its step."""
    config = SafetyConfig(iterations=3)
    task = task_of(random_inputs(0, 0, config), config)
    task = Task(task.rows, task.limits, np.zeros(3), task.star, task.budget, config)
    monkeypatch.setattr(search, "_ON", np.array([[0.0]]))
    monkeypatch.setattr(search, "_BACK", np.zeros((0, 1)))
    programs = Programs(monkeypatch, [np.array(answer) for answer in answers])
    start = Found(np.array([3.0, 0.0, 0.0]), np.zeros(0), False, np.inf, 0, "none")
    best = least_cost(task, form(task, task.rows.balls(np.ones(0))), start, ORDER)
    assert len(programs.about) == asked
    costs = [float(np.sum(np.square(answer))) for answer in answers[:asked]]
    assert best.cost == pytest.approx(min(costs))
    assert best.iterations == 1 + int(np.argmin(costs))
    assert best.admissible
    assert best.solver == "given"


def test_a_solver_that_fails_later_leaves_the_best_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    config = SafetyConfig(iterations=4)
    task = task_of(random_inputs(0, 0, config), config)
    task = Task(task.rows, task.limits, np.zeros(3), task.star, task.budget, config)
    answers = iter([np.array([-2.0, 0.0, 0.0])])

    def solve(*_: object) -> tuple[np.ndarray, str]:
        for answer in answers:
            return answer, "given"
        raise SolverError("failed")

    monkeypatch.setattr(search, "solve", solve)
    monkeypatch.setattr(search, "_ON", np.array([[0.0]]))
    start = Found(np.array([3.0, 0.0, 0.0]), np.zeros(0), False, np.inf, 0, "none")
    best = least_cost(task, form(task, task.rows.balls(np.ones(0))), start, ORDER)
    assert best.a.tolist() == [0.5, 0.0, 0.0]  # half way from (3, 0, 0) to (-2, 0, 0)
    assert best.cost == pytest.approx(0.25)


def test_a_cheap_answer_keeps_its_way_and_a_dear_one_is_measured_against_the_best_candidate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = SafetyConfig()
    task = task_of(random_inputs(10, 2, config), config)
    balls, starts = task.rows.balls(np.ones(2)), []
    last, away = np.array([9.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0])
    costs = {"first": 0.5, "other": 0.4}

    def fake(_: Task, __: object, start: Found, ___: object) -> Found:
        starts.append(start)
        name = "first" if len(starts) % 2 else "other"
        return Found(start.a, start.epsilon, True, costs[name], 1, name)

    monkeypatch.setattr(search, "least_cost", fake)
    assert least_of_ways(task, balls, Ways(task, last), ORDER).solver == "first"
    assert len(starts) == 1
    assert starts[0].a.tolist() == [3.0, 0.0, 0.0]  # the last answer, clipped
    assert starts[0].epsilon.tolist() == [2.0, 2.0]
    assert (starts[0].admissible, starts[0].cost, starts[0].iterations, starts[0].solver) == (False, np.inf, 0, "none")
    ranked = judge(task, task.limits.clip(task_module.candidates(task))).ranked
    best = float(ranked.min())
    for first, other, taken in ((best + 1.0, 0.7, "other"), (best + 1.0, best + 2.0, "first")):
        starts.clear()
        costs.update(first=first, other=other)
        assert least_of_ways(task, balls, Ways(task, away), ORDER).solver == taken
        assert len(starts) == 2
        assert starts[1].a.tolist() == task.limits.clip(task_module.candidates(task))[int(ranked.argmin())].tolist()
        assert (starts[1].admissible, starts[1].cost, starts[1].iterations) == (True, pytest.approx(best), 0)
        assert starts[1].solver == "none"
        assert judge(task, starts[1].a[None]).upper[0] == pytest.approx(starts[1].epsilon)
    starts.clear()
    costs.update(first=0.5 * (best + search.CHEAP), other=0.0)
    assert best > search.CHEAP
    assert least_of_ways(task, balls, Ways(task, away), ORDER).solver == "first"  # no candidate is cheaper
    assert len(starts) == 1
