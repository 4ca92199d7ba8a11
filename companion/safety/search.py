"""The acceleration of least cost that keeps every row and limit: a sequence of quadratic programs.

For a given epsilon a row admits what lies outside a ball. Each program is (29) with every ball replaced by the half
space that touches it where the line from its centre to the last iterate leaves it: all of the half space is
admissible, and for one ball the program's answer is the nearest admissible point at once. The product of epsilon and
a is not bounded so; after each program several shares of its step are judged by the true rows, with epsilon where
these want it, and the cheapest admissible one is the next iterate. The sequence is cut after a fixed number of
programs; any admissible iterate is an answer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from companion.errors import SolverError
from companion.safety.barrier import Balls
from companion.safety.qp import UNBOUNDED, Infeasible, Program, solve
from companion.safety.task import Found, Task, Ways, judge
from companion.types import FloatArray, Vec3

SETTLED_M_S2 = 1e-3  # iterates closer than this have converged: the answer is admissible either way
SETTLED = 0.03  # so has a sequence whose last program saved less than this share of the cost
MIN_ARM_M_S2 = 1e-3  # an iterate at a ball's very centre has no direction to leave it
INSET_M_S2 = 1e-7  # tangents are kept by this much, so that the solver's tolerance stays inside the rows
LEAST_DEVIATION = 0.1  # of epsilon, about which the CLF is linearised at least: at none it would ask nothing
CHEAP = 0.5  # (m/s^2)^2: a correction this small is not worth another way round
SETTLED_COST = 1e-3  # (m/s^2)^2: what is left of a correction this small
_BACK = np.array([[0.0], [0.25], [0.5]])  # shares of a program's step that are judged beside the whole
_ON = np.array(
    [[0.0], [0.02], [0.05], [0.1], [0.2], [0.35], [0.55], [0.8]]
)  # and, from its answer, of the way to a_ref


def least_of_ways(task: Task, balls: Balls, ways: Ways, order: tuple[str, ...]) -> Found:
    """Least cost where the true rows can hold, else an answer that is not admissible.

    The way round an obstacle taken in the last tick is kept as long as the rows still leave it open and it is cheap,
    or no candidate is cheaper than what it leads to: noise in the prediction must not throw the vehicle from side to
    side.

    Args:
        balls: of the task's rows, at decay 1.
        ways: the last answer, and the candidates.
    Raises:
        SolverError: no solver works; `braking` needs none.
    """
    shared, count = form(task, balls), len(task.rows)
    first = task.limits.clip(ways.last[None])[0]
    unjudged = Found(first, np.full(count, 1.0 / task.config.alpha2), False, math.inf, 0, "none")
    found = least_cost(task, shared, unjudged, order)
    if found.cost <= CHEAP:
        return found
    starts = task.limits.clip(ways.offered)
    judgement = judge(task, starts)
    best = int(judgement.ranked.argmin())
    cost = float(judgement.ranked[best])
    if cost < found.cost:
        epsilon = judgement.greatest(best, task.config.alpha2)
        other = least_cost(task, shared, Found(starts[best], epsilon, True, cost, 0, "none"), order)
        found = other if other.cost < found.cost else found
    return found


def least_cost(task: Task, shared: Form, start: Found, order: tuple[str, ...]) -> Found:
    """The best admissible iterate of a sequence of programs from ``start``; ``start`` itself if none is better.

    The first program is about the greatest epsilon, which asks least of a, and about the CLF where it begins to cost;
    the others are about what the one before has found. The answer has the cheapest epsilon.

    Raises:
        SolverError: no solver answers the first program, although none proves that there is no answer.
    """
    best, a, epsilon = start, start.a, start.epsilon
    about = task.star + np.maximum(np.sqrt(task.budget), LEAST_DEVIATION)
    for count in range(1, task.config.iterations + 1):
        try:
            x, solver = solve(_tangent_program(task, shared, a, epsilon, about), order)
        except SolverError as error:
            if count == 1 and not isinstance(error, Infeasible):
                raise
            break
        previous, before, answer = a, best.cost, x[:3]
        tried = task.limits.clip(np.concatenate((answer + _ON * (task.a_ref - answer), a + _BACK * (answer - a))))
        verdict = judge(task, tried)
        ranked = verdict.ranked
        taken = int(ranked.argmin())
        a, cost, lower, upper = tried[taken], float(ranked[taken]), verdict.lower[taken], verdict.upper[taken]
        epsilon = about = np.minimum(np.maximum(x[3 : 3 + len(lower)], lower), upper)
        if cost < best.cost:
            best = Found(a, np.minimum(np.maximum(task.star, lower), upper), True, cost, count, solver)
        if best.admissible and (
            before - best.cost < SETTLED * best.cost + SETTLED_COST
            or max(map(abs, (a - previous).tolist())) < SETTLED_M_S2
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
    balls: Balls  # of the rows at decay 1
    empty: FloatArray  # (R M + M, 3 + 2 M) rows: ones at the deltas, nothing else
    slopes: npt.NDArray[np.intp]  # (R M,) where, in the flat rows, a barrier row has its slope in epsilon
    clf: npt.NDArray[np.intp]  # (M,) where the CLF row of an obstacle has its own


def form(task: Task, balls: Balls) -> Form:
    """(29)'s cost and bounds over a, epsilon_j, delta_j, and the places of the rows' entries."""
    config, limits, count = task.config, task.limits, len(task.rows)
    epsilons, deltas, size = slice(3, 3 + count), slice(3 + count, None), 3 + 2 * count
    weight, linear, low, high = np.zeros((4, size))
    weight[:3], weight[epsilons], weight[deltas] = config.lambda_u, config.lambda_epsilon, config.lambda_delta
    linear[:3], linear[epsilons] = config.lambda_u * task.a_ref, config.lambda_epsilon * task.star
    low[:3], low[epsilons] = limits.low, task.rows.least_decay / config.alpha2
    high[:3], high[epsilons], high[deltas] = limits.high, 1.0 / config.alpha2, UNBOUNDED
    return Form(2.0 * weight, -2.0 * linear, low, high, balls, *_places(count, config.horizon + 1))


@lru_cache(maxsize=32)
def _places(count: int, steps: int) -> tuple[FloatArray, npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """``empty``, ``slopes`` and ``clf`` of a form: they depend on the number of obstacles and rows only."""
    size, every = 3 + 2 * count, count * steps
    empty = np.zeros((every + count, size))
    own, row = np.arange(count), np.arange(every)
    empty[every + own, 3 + count + own] = 1.0
    empty.flags.writeable = False
    return empty, row * size + 3 + row // steps, (every + own) * size + 3 + own


def _tangent_program(task: Task, shared: Form, a: Vec3, epsilon: FloatArray, about: FloatArray) -> Program:
    """(29), rows about (a, epsilon), the CLF about the epsilon ``about``: variables a, epsilon_j, delta_j.

    With n the unit vector from a ball's centre c to ``a`` and x = c + rho n, a row is
    n . a + psi(x) alpha2 (epsilon - epsilon_0) / (q rho) >= n . x. Where the ball is smaller than half the way to
    ``a``, or none, the tangent at half the way serves: any tangent bounds a convex row from below.
    """
    alpha2, every, count = task.config.alpha2, len(shared.slopes), len(epsilon)
    rows, floors = shared.empty.copy(), np.empty(len(shared.empty))
    decay = alpha2 * epsilon
    balls = shared.balls if bool((decay == 1.0).all()) else task.rows.balls(decay)
    centre = balls.centre
    normal = a[:, None, None] - centre
    distance = np.sqrt(np.add.reduce(normal * normal))
    np.maximum(distance, MIN_ARM_M_S2, out=distance)
    normal /= distance
    rho = np.sqrt(np.maximum(balls.square, 0.25 * distance * distance))
    touch = normal * rho
    touch += centre
    psi = task.rows.psi
    slope = np.add.reduce(psi[1:4] * touch)
    slope += psi[0] + (0.5 * psi[4]) * np.add.reduce(touch * touch)
    slope *= alpha2 / (balls.q * rho)
    floor = np.add.reduce(normal * centre)
    floor += (rho * rho + balls.square) / (2.0 * rho)
    floor += slope * epsilon[:, None]
    rows[:every, :3] = normal.reshape(3, every).T
    rows.reshape(-1)[shared.slopes] = slope.reshape(every)
    np.add(floor.reshape(every), INSET_M_S2, out=floors[:every])
    deviation = about - task.star
    tangent = 2.0 * deviation  # of (26): delta - tangent epsilon >= V - budget - tangent epsilon_0
    rows.reshape(-1)[shared.clf] = -tangent
    floors[every : every + count] = deviation * deviation - task.budget - tangent * about
    extra, bound = limit_rows(task, a, rows.shape[1])
    return Program(
        shared.weight,
        shared.linear,
        shared.low,
        shared.high,
        np.concatenate((rows, extra)) if len(extra) else rows,
        np.concatenate((floors, bound)) if len(extra) else floors,
    )


def limit_rows(task: Task, a: Vec3, size: int) -> tuple[FloatArray, FloatArray]:
    """Tangents at ``a`` of the limits that are no box and may bind, and the stops: (L, size), (L,)."""
    limits = task.limits
    cones = (*limits.cones, limits.speed) if limits.may_speed else limits.cones
    tangents = [cone.tangent(a) for cone in cones]
    if task.stops is not None:
        tangents += [pair for pair in zip(task.stops.normal, task.stops.floor.tolist(), strict=True) if pair[1] > -1e9]
    rows, floors = np.zeros((len(tangents), size)), np.zeros(len(tangents))
    for index, (normal, floor) in enumerate(tangents):
        rows[index, :3], floors[index] = normal, floor
    return rows, floors
