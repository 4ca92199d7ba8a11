"""The quadratic programs that the filter solves, taken from its flights and given to DAQP, OSQP and quadprog.

    minimise  x' diag(weight) x / 2 + linear' x   subject to   low <= x <= high,   A x >= floor

DAQP and OSQP are timed from a `Program` to its minimiser, as the filter calls them. quadprog (the dual active set
method of Goldfarb and Idnani) is timed without the making of its matrices.
"""

from __future__ import annotations

import copy
import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from companion.bench.filter_timing import SEED, Condition
from companion.bench.scenes import FLIGHT_TICKS, Flight, scenes
from companion.bench.timing import Quantiles, quantiles
from companion.clock import stopwatch_ns
from companion.config import LimitsConfig
from companion.safety import qp
from companion.safety.filter import SafetyFilter
from companion.types import FloatArray

SOLVERS = ("daqp", "osqp", "quadprog")
FLIGHTS = 400  # at most, where few programs come of a flight


@dataclass(frozen=True, slots=True)
class ProgramTiming:
    """Milliseconds of every solver over the same programs, without those that DAQP proves infeasible."""

    condition: Condition
    programs: int
    infeasible: int  # left out
    disputed: int  # of these, those that quadprog solves
    variables: int  # the most
    rows: int  # the most
    solvers: dict[str, Quantiles]
    failed: dict[str, int]  # no answer; no time is counted then
    apart: dict[str, float]  # greatest difference of a component of the minimiser from DAQP's


def available() -> bool:
    """Whether quadprog is installed."""
    return importlib.util.find_spec("quadprog") is not None


@contextmanager
def recording() -> Iterator[list[qp.Program]]:
    """A list to which every program is added that the filter gives a solver within the block."""
    seen: list[qp.Program] = []
    backends = dict(qp.BACKENDS)

    def recorded(backend: qp.Backend) -> qp.Backend:
        def solve(program: qp.Program) -> FloatArray | None:
            seen.append(copy.deepcopy(program))  # its arrays may be written to in the next tick
            return backend(program)

        return solve

    qp.BACKENDS.update({name: recorded(backend) for name, backend in backends.items()})
    try:
        yield seen
    finally:
        qp.BACKENDS.update(backends)


def captured(condition: Condition, count: int, *, seed: int = SEED) -> list[qp.Program]:
    """``count`` programs of flights of one condition, fewer where 400 flights have not as many."""
    config = condition.config()
    safety_filter = SafetyFilter(config, LimitsConfig())
    with recording() as seen:
        for _, scene in zip(range(FLIGHTS), scenes(seed, condition.obstacles, config), strict=False):
            flight = Flight(scene, config)
            safety_filter.reset()
            while flight.ticks < FLIGHT_TICKS and len(seen) < count:
                flight.advance(safety_filter.step(flight.inputs()).a_safe)
            if len(seen) >= count:
                break
    return seen[:count]


def solve_quadprog(program: qp.Program) -> Callable[[], FloatArray]:
    """A call that has quadprog solve the program, its matrices made: minimise x'Gx / 2 - a'x, C'x >= b.

    Bounds and rows that are not there (1e30) are left out.
    """
    import quadprog

    identity = np.eye(len(program.linear))
    columns = np.concatenate((program.rows, identity, -identity))
    floor = np.concatenate((program.floor, program.low, -program.high))
    real = floor > -0.1 * qp.UNBOUNDED
    hessian, linear = np.diag(program.weight), -program.linear
    columns, floor = np.ascontiguousarray(columns[real].T), floor[real]
    return lambda: np.asarray(quadprog.solve_qp(hessian, linear, columns, floor)[0])


def measure_programs(condition: Condition, count: int, *, seed: int = SEED) -> ProgramTiming:
    """Every solver on each of ``count`` programs, in turn; quadprog where it is installed."""
    found = captured(condition, count, seed=seed)
    taken: dict[str, list[int]] = {}
    failed: dict[str, int] = {}
    apart: dict[str, float] = {}
    infeasible = disputed = 0
    for program in found:
        answers = {name: _timed(call) for name, call in _calls(program).items()}
        if answers["daqp"].infeasible:
            infeasible += 1
            disputed += "quadprog" in answers and answers["quadprog"].x is not None
            continue
        ours = answers["daqp"].x
        for name, answer in answers.items():
            if answer.x is None:
                failed[name] = failed.get(name, 0) + 1
                continue
            taken.setdefault(name, []).append(answer.took_ns)
            if ours is not None and name != "daqp":
                apart[name] = max(apart.get(name, 0.0), float(np.abs(answer.x - ours).max()))
    return ProgramTiming(
        condition=condition,
        programs=len(found) - infeasible,
        infeasible=infeasible,
        disputed=disputed,
        variables=max((len(program.linear) for program in found), default=0),
        rows=max((len(program.floor) for program in found), default=0),
        solvers={name: quantiles(samples) for name, samples in taken.items()},
        failed=failed,
        apart=apart,
    )


def _calls(program: qp.Program) -> dict[str, Callable[[], FloatArray | None]]:
    calls: dict[str, Callable[[], FloatArray | None]] = {
        "daqp": lambda: qp.solve_daqp(program),
        "osqp": lambda: qp.solve_osqp(program),
    }
    if available():
        calls["quadprog"] = solve_quadprog(program)
    return calls


@dataclass(frozen=True, slots=True)
class _Answer:
    x: FloatArray | None  # None: failed, or infeasible
    infeasible: bool
    took_ns: int


def _timed(call: Callable[[], FloatArray | None]) -> _Answer:
    x, infeasible = None, False
    began = stopwatch_ns()
    try:
        x = call()
    except qp.Infeasible:
        infeasible = True
    except ValueError:  # quadprog: inconsistent constraints, or a matrix that it cannot factor
        pass
    return _Answer(x, infeasible, stopwatch_ns() - began)
