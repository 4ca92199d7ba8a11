"""The two solvers against each other and against numbers worked by hand; failures are answered, not passed on."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import osqp
import pytest

from companion.errors import SolverError
from companion.safety import qp
from companion.safety.qp import Infeasible, Program, solve, solve_daqp, solve_osqp


def program(rows: list[list[float]], floor: list[float], *, linear: tuple[float, float] = (-2.0, -2.0)) -> Program:
    return Program(
        weight=np.array([2.0, 2.0]),
        linear=np.array(linear),
        low=np.array([-3.0, -3.0]),
        high=np.array([3.0, 3.0]),
        rows=np.array(rows, dtype=np.float64).reshape(-1, 2),
        floor=np.array(floor, dtype=np.float64),
    )


@pytest.mark.parametrize("name", ["daqp", "osqp"])
@pytest.mark.parametrize(
    ("problem", "expected"),
    [
        (program([], []), (1.0, 1.0)),  # |x - (1, 1)|^2, nothing in the way
        (program([[-1.0, 0.0]], [0.5]), (-0.5, 1.0)),  # x <= -0.5
        (program([[-1.0, -1.0]], [0.0]), (0.0, 0.0)),  # projection on x + y <= 0
        (program([], [], linear=(-20.0, 0.0)), (3.0, 0.0)),  # the box
    ],
)
def test_projections_by_hand(name: str, problem: Program, expected: tuple[float, float]) -> None:
    x, solver = solve(problem, (name,))
    assert x == pytest.approx(expected, abs=1e-6)
    assert solver == name


@pytest.mark.parametrize("seed", range(8))
def test_solvers_agree_on_random_programs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    problem = Program(
        weight=rng.uniform(0.02, 3.0, 7),
        linear=rng.normal(size=7),
        low=np.full(7, -3.0),
        high=np.full(7, 3.0),
        rows=rng.normal(size=(30, 7)),
        floor=-rng.uniform(0.0, 2.0, 30),
    )
    one, other = solve_daqp(problem), solve_osqp(problem)
    assert one is not None
    assert other is not None
    assert one == pytest.approx(other, abs=1e-5)
    assert problem.residual(one) <= 1e-8


@pytest.mark.parametrize("name", ["daqp", "osqp"])
def test_an_infeasible_program_is_named_so(name: str) -> None:
    with pytest.raises(Infeasible, match=r"^infeasible: 2 variables, 2 rows$"):
        solve(program([[1.0, 0.0], [-1.0, 0.0]], [1.0, 1.0]), (name,))


def test_residual_names_the_worst_of_rows_and_bounds() -> None:
    problem = program([[1.0, 0.0]], [2.0])
    assert problem.residual(np.array([2.0, 0.0])) == 0.0
    assert problem.residual(np.array([1.5, 0.0])) == pytest.approx(0.5)
    assert problem.residual(np.array([3.25, 0.0])) == pytest.approx(0.25)
    assert problem.residual(np.array([2.0, -4.0])) == pytest.approx(1.0)


@pytest.mark.parametrize("wrong", [None, np.array([np.nan, 0.0]), np.array([1.0, 1.0])])
def test_the_other_solver_takes_over(monkeypatch: pytest.MonkeyPatch, wrong: np.ndarray | None) -> None:
    """No answer, one that is not finite, and one that breaks a row are all no answer."""
    monkeypatch.setitem(qp.BACKENDS, "daqp", lambda _: wrong)
    x, solver = solve(program([[-1.0, 0.0]], [0.5]), ("daqp", "osqp"))
    assert solver == "osqp"
    assert x == pytest.approx((-0.5, 1.0), abs=1e-6)


def test_both_failing_is_a_solver_error(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("daqp", "osqp"):
        monkeypatch.setitem(qp.BACKENDS, name, lambda _: None)
    with pytest.raises(SolverError, match=r"^no answer from daqp, osqp: 2 variables, 0 rows$"):
        solve(program([], []), ("daqp", "osqp"))


def test_a_solver_cut_short_gives_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(qp.daqp, "solve", lambda *_, **__: (np.zeros(2), 0.0, -4, {}))
    assert solve_daqp(program([], [])) is None


def test_daqp_answers_to_a_billionth() -> None:
    """2 x <= -1 and 3 y >= 4 in a program whose minimum lies elsewhere."""
    problem = program([[-2.0, 0.0], [0.0, 3.0]], [1.0, 4.0])
    x = solve_daqp(problem)
    assert x is not None
    assert x == pytest.approx((-0.5, 4.0 / 3.0), abs=1e-9)
    assert x.dtype == np.float64


def test_an_answer_may_break_its_rows_by_the_solvers_tolerance_only(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = program([[-1.0, 0.0]], [0.5])
    monkeypatch.setitem(qp.BACKENDS, "daqp", lambda _: np.array([-0.5 + 9e-6, 1.0]))
    assert solve(problem, ("daqp", "osqp"))[1] == "daqp"
    monkeypatch.setitem(qp.BACKENDS, "daqp", lambda _: np.array([-0.5 + 2e-5, 1.0]))
    assert solve(problem, ("daqp", "osqp"))[1] == "osqp"
    monkeypatch.setitem(qp.BACKENDS, "daqp", lambda _: np.array([np.inf, 1.0]))
    assert solve(problem, ("daqp", "osqp"))[1] == "osqp"


def test_osqp_is_polished_and_silent(capfd: pytest.CaptureFixture[str]) -> None:
    x = solve_osqp(program([[-2.0, 0.0], [0.0, 3.0]], [1.0, 4.0]))
    assert x is not None
    assert x == pytest.approx((-0.5, 4.0 / 3.0), abs=1e-8)  # without polishing the tolerance of 1e-6
    assert capfd.readouterr().out == ""


def test_what_a_solver_names_otherwise_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = SimpleNamespace(info=SimpleNamespace(status="maximum iterations reached"), x=np.zeros(2))
    monkeypatch.setattr(osqp.OSQP, "solve", lambda *_, **__: stopped)
    assert solve_osqp(program([], [])) is None


def test_osqp_is_pinned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its penalty changes by iterations, not by time, or answers would depend on the load of the machine."""
    real, given = osqp.OSQP.setup, {}

    def setup(*arguments: object, **settings: object) -> None:
        given.update(settings)
        real(*arguments, **settings)

    monkeypatch.setattr(osqp.OSQP, "setup", setup)
    solve_osqp(program([], []))
    assert given["adaptive_rho_interval"] == 25
    assert given["max_iter"] == 4000
    assert (given["eps_abs"], given["eps_rel"]) == (1e-6, 1e-6)
