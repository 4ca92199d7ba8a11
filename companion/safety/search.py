"""The acceleration of least cost that keeps every row and limit: a sequence of quadratic programs.

Each program is (29) about the last iterate, rows by their tangents, each divided by its gradient's norm [m/s^2].
Tangents in a bound the rows from below (see `barrier`); the product of epsilon and a does not, so after each program
several shares of its step are judged by the true rows, with epsilon where these want it, and the cheapest admissible
one is the next iterate. The sequence is cut after a fixed number of programs; any admissible iterate is an answer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from companion.errors import SolverError
from companion.safety.qp import UNBOUNDED, Infeasible, Program, solve
from companion.safety.relax import least_violation
from companion.safety.task import Found, Judgement, Task, candidates, judge
from companion.types import FloatArray, Vec3

SETTLED_M_S2 = 1e-3  # iterates closer than this have converged: the answer is admissible either way
SETTLED = 0.01  # so has a sequence whose last program saved less than this share of the cost
INSET_M_S2 = 1e-7  # tangents are kept by this much, so that the solver's tolerance stays inside the rows
_STEPS = np.array([[1.0], [0.5], [0.25], [0.1]])  # shares of a program's step that are judged


def least_cost(task: Task, shared: Form, start: Found, order: tuple[str, ...]) -> Found:
    """The best admissible iterate of a sequence of programs from ``start``; ``start`` itself if none is better.

    Raises:
        SolverError: no solver answers a program about an admissible start. About an inadmissible one there may be
            no answer, which is no failure.
    """
    best, a, epsilon = start, start.a, start.epsilon
    for count in range(1, task.config.iterations + 1):
        try:
            x, solver = solve(_tangent_program(task, shared, a, epsilon), order)
        except SolverError as error:
            if start.admissible and not best.iterations and not isinstance(error, Infeasible):
                raise
            break
        previous, before = a, best.cost
        tried = task.limits.clip(a + _STEPS * (x[:3] - a))
        verdict = judge(task, tried)
        taken = int(verdict.ranked.argmin())
        a, cost = tried[taken], float(verdict.ranked[taken])
        epsilon = np.minimum(np.maximum(task.star, verdict.lower[taken]), verdict.upper[taken])
        if cost < best.cost:
            best = Found(a, epsilon, True, cost, count, solver)
        if best.admissible and (
            before - best.cost < SETTLED * best.cost or max(map(abs, (a - previous).tolist())) < SETTLED_M_S2
        ):
            break
    return best


@dataclass(frozen=True, slots=True)
class Form:
    """What the programs of one task share."""

    weight: FloatArray
    linear: FloatArray
    low: FloatArray
    high: FloatArray
    empty: FloatArray  # (R M + M + 1, 3 + 2 M) rows: ones at the deltas, nothing else
    slopes: npt.NDArray[np.intp]  # (R M,) where, in the flat rows, a barrier row has its slope in epsilon
    clf: npt.NDArray[np.intp]  # (M,) where the CLF row of an obstacle has its own


def form(task: Task) -> Form:
    """(29)'s cost and bounds over a, epsilon_j, delta_j, and the places of the rows' entries."""
    config, limits, count = task.config, task.limits, len(task.rows)
    epsilons, deltas, size = slice(3, 3 + count), slice(3 + count, None), 3 + 2 * count
    weight, linear, low, high = np.zeros((4, size))
    weight[:3], weight[epsilons], weight[deltas] = config.lambda_u, config.lambda_epsilon, config.lambda_delta
    linear[:3], linear[epsilons] = config.lambda_u * task.a_ref, config.lambda_epsilon * task.star
    low[:3], low[epsilons] = limits.low, task.rows.least_decay / config.alpha2
    high[:3], high[epsilons], high[deltas] = limits.high, 1.0 / config.alpha2, UNBOUNDED
    return Form(2.0 * weight, -2.0 * linear, low, high, *_places(count, config.horizon + 1))


@lru_cache(maxsize=32)
def _places(count: int, steps: int) -> tuple[FloatArray, npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """``empty``, ``slopes`` and ``clf`` of a form: they depend on the number of obstacles and rows only."""
    size, every = 3 + 2 * count, count * steps
    empty = np.zeros((every + count + 1, size))
    own, row = np.arange(count), np.arange(every)
    empty[every + own, 3 + count + own] = 1.0
    empty.flags.writeable = False
    return empty, row * size + 3 + row // steps, (every + own) * size + 3 + own


def _tangent_program(task: Task, shared: Form, a: Vec3, epsilon: FloatArray) -> Program:
    """(29) about (a, epsilon): variables a, epsilon_j, delta_j."""
    alpha2, every = task.config.alpha2, len(shared.slopes)
    rise, psi = task.rows.evaluate(a).reshape(2, every)
    gradient, norm = task.rows.gradient(a, alpha2 * epsilon)
    entries = np.empty(
        (5, every)
    )  # normal, d row / d epsilon, floor: the row is affine in epsilon, so it cancels there
    entries[:3] = gradient.reshape(3, every)
    np.multiply(psi, alpha2, out=entries[3])
    np.subtract(a @ entries[:3], rise, out=entries[4])
    entries /= norm.reshape(every)
    rows, floors = shared.empty.copy(), np.empty(len(shared.empty))
    rows[:every, :3] = entries[:3].T
    rows.reshape(-1)[shared.slopes] = entries[3]
    np.add(entries[4], INSET_M_S2, out=floors[:every])
    deviation = epsilon - task.star
    tangent = 2.0 * deviation  # of (26): delta - tangent epsilon >= V - budget - tangent epsilon_0
    rows.reshape(-1)[shared.clf] = -tangent
    floors[every:-1] = deviation * deviation - task.budget - tangent * epsilon
    floors[-1] = -UNBOUNDED
    if task.limits.may_speed:  # else the row cannot bind in the box: it stays empty
        rows[-1, :3], floors[-1] = task.limits.speed_row(a)
    return Program(shared.weight, shared.linear, shared.low, shared.high, rows, floors)


def solve_task(task: Task, last: Vec3 | None, order: tuple[str, ...]) -> Found:
    """Least cost where the true rows can hold, least violation where not.

    The way round an obstacle taken in the last tick is kept as long as the rows still leave it open and no candidate
    is cheaper than what it leads to: noise in the prediction must not throw the vehicle from side to side.

    Raises:
        SolverError: no solver works; `braking` needs none.
    """
    starts, shared = candidates(task, last), form(task)
    judgement = judge(task, starts)
    ranked = judgement.ranked
    found = least_cost(task, shared, _start(task, starts, judgement, 0), order)
    first = int(ranked.argmin())
    if ranked[first] < found.cost:
        other = least_cost(task, shared, _start(task, starts, judgement, first), order)
        found = other if other.cost < found.cost else found
    return found if found.admissible else least_violation(task, starts, order)


def _start(task: Task, starts: FloatArray, judgement: Judgement, index: int) -> Found:
    admissible = bool(judgement.admissible[index])
    epsilon = np.minimum(np.maximum(task.star, judgement.lower[index]), judgement.upper[index])
    return Found(
        a=starts[index],
        epsilon=np.clip(epsilon, 0.0, 1.0 / task.config.alpha2),
        admissible=admissible,
        cost=float(judgement.cost[index]) if admissible else math.inf,
        iterations=0,
        solver="none",
    )
