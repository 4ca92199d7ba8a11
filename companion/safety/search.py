"""The acceleration of least cost that keeps every row, and the one of least violation where none does.

Cost (29), per tick, over a, epsilon_j and delta_j of the obstacles within reach:

    lambda_u |a - a_ref|^2 + sum_j lambda_epsilon (epsilon_j - epsilon*_j)^2 + lambda_delta delta_j^2

1. Candidates (last answer, reference, a lattice of the box, two rings across the relative velocity) are judged by
   their true rows in one batch; the admissible one of least cost starts. What lies inside a row's ball has several
   ways round it; the batch chooses the way, and for a head-on obstacle the order of the ring does: to the right.
2. Quadratic programs about the last iterate, rows by their tangents, each divided by its gradient's norm [m/s^2].
   Tangents in a bound the rows from below (see `barrier`); the product of epsilon and a does not, so after each
   program epsilon is moved into the interval that the true rows leave it at the new a, and the iterate counts only
   if that interval is not empty.
3. Where no admissible acceleration is found: the largest share t <= 1 of the margin beyond the bare radii that all
   obstacles can be left over the horizon, |r_k(a)| >= R + t (D - R). Row values in m/s^2 would rank the first steps
   of the horizon, which no acceleration moves much, above the closest approach. |r_k| is convex in a, so tangents
   bound it from below again and t never falls from one program to the next. Walls are kept while t >= 0, that is
   while nobody is touched, and given up after that; the speed limit goes before both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.config import SafetyConfig
from companion.errors import SolverError
from companion.safety.adapt import decay_interval
from companion.safety.barrier import BarrierRows
from companion.safety.limits import VehicleLimits
from companion.safety.qp import UNBOUNDED, Infeasible, Program, solve
from companion.types import FloatArray, Vec3

SETTLED_M_S2 = 1e-3  # iterates closer than this have converged: the answer is admissible either way
SETTLED = 0.01  # so has a sequence whose last program saved less than this share of the cost
INSET_M_S2 = 1e-7  # tangents are kept by this much, so that the solver's tolerance stays inside the rows
SHARE_WEIGHT = 1e4  # cost of the whole margin, against |a - a_ref|^2 in (m/s^2)^2
LEAVE_WEIGHT = 1e2  # the same at the end of the horizon: a vehicle inside the margin leaves it
KEEP_WAY = 0.15  # share of the margin that another way round must offer before the last answer's is left
_ANGLES = np.arange(8) * (2.0 * np.pi / 8)
_RING = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)), axis=-1)  # (P, 2) over (right, up)
_STEPS = np.array([[1.0], [0.5], [0.25], [0.1]])  # shares of a program's step that are judged
_LATTICE = np.array([(x, y, z) for x in (0, -1, 1) for y in (0, -1, 1) for z in (0, -1, 1)], dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Task:
    """One tick's problem."""

    rows: BarrierRows
    limits: VehicleLimits
    a_ref: Vec3
    star: FloatArray  # (M,) epsilon*
    budget: FloatArray  # (M,) what the CLF leaves (epsilon - epsilon*)^2 without delta
    config: SafetyConfig


@dataclass(frozen=True, slots=True)
class Found:
    """An acceleration, whether its true rows and limits hold, and how it was found."""

    a: Vec3
    epsilon: FloatArray  # (M,)
    admissible: bool
    cost: float
    iterations: int
    solver: str


@dataclass(frozen=True, slots=True)
class Judgement:
    """True rows and limits at C accelerations."""

    lower: FloatArray  # (C, M) least epsilon
    upper: FloatArray  # (C, M) greatest epsilon
    admissible: npt.NDArray[np.bool_]  # (C,)
    cost: FloatArray  # (C,) with the cheapest epsilon


def within_reach(rows: BarrierRows, limits: VehicleLimits) -> npt.NDArray[np.bool_]:
    """Obstacles that can bind: not those whose rows hold at decay 1 for every acceleration of the box, (M,).

    At decay 1 a row is psi_{i+1} >= 0; over |a| <= sqrt(3) box it is at least its constant less |linear| |a|.
    """
    at_one = rows.rise + rows.psi
    linear = np.sqrt(np.einsum("ijk,ijk->ij", at_one[..., 1:4], at_one[..., 1:4]))
    least = at_one[..., 0] - (3.0**0.5 * limits.box_m_s2) * linear
    return np.asarray((least < 0.0).any(axis=-1))


def judge(task: Task, a: FloatArray) -> Judgement:
    """True rows and limits at ``a`` (C, 3), all in one batch."""
    config = task.config
    lower, upper = decay_interval(task.rows.evaluate_many(a), task.rows.least_decay)
    lower, upper = lower / config.alpha2, upper / config.alpha2
    admissible = (lower <= upper).all(axis=-1) & (task.limits.slow(a) <= config.tolerance_m_s2)
    epsilon = np.minimum(np.maximum(task.star, lower), upper)
    deviation = (epsilon - task.star) ** 2
    delta = np.maximum(deviation - task.budget, 0.0)
    priced = config.lambda_epsilon * deviation + config.lambda_delta * delta * delta
    cost = config.lambda_u * ((a - task.a_ref) ** 2).sum(axis=-1) + priced.sum(axis=-1)
    return Judgement(lower, upper, admissible, cost)


def candidates(task: Task, last: Vec3 | None) -> FloatArray:
    """Where a search may start, all inside box and arena: (C, 3)."""
    box = task.limits.box_m_s2
    starts = [task.a_ref[None], box * _LATTICE]
    if last is not None:
        starts.insert(0, last[None])
    if len(task.rows):
        ring = _ring(task.rows)
        starts += [box * ring, 0.5 * box * ring]
    return task.limits.clip(np.concatenate(starts))


def _ring(rows: BarrierRows) -> FloatArray:
    """Unit vectors across the relative velocity of the obstacle that comes closest, the first to the right, (P, 3)."""
    distance = np.einsum("ijk,ijk->ij", rows.drift, rows.drift).min(axis=-1)
    nearest = rows.drift[int((np.sqrt(distance) - rows.radii_m).argmin())]
    x, y, z = (nearest[1] - nearest[0]).tolist()
    if x * x + y * y + z * z < 1e-12:  # at rest to each other: across the line between
        x, y, z = (-nearest[0]).tolist()
    level = math.hypot(x, y)
    length = math.hypot(level, z)
    right = (y / level, -x / level, 0.0) if level > 1e-6 * length else (1.0, 0.0, 0.0)
    if length < 1e-9:
        x, y, z, length = 0.0, 1.0, 0.0, 1.0
    up = (-right[1] * z, right[0] * z, right[1] * x - right[0] * y)  # along x right, turned: up for level flight
    return np.asarray(_RING @ (np.array((right, up)) / ((1.0,), (-length,))))


def least_cost(task: Task, start: Found, order: tuple[str, ...]) -> Found:
    """The best admissible iterate of a sequence of programs from ``start``; ``start`` itself if none is better.

    Raises:
        SolverError: no solver answers a program about an admissible start. About an inadmissible one there may be
            no answer, which is no failure.
    """
    best, a, epsilon = start, start.a, start.epsilon
    for count in range(1, task.config.iterations + 1):
        try:
            x, solver = solve(_tangent_program(task, a, epsilon), order)
        except SolverError as error:
            if start.admissible and not best.iterations and not isinstance(error, Infeasible):
                raise
            break
        previous, before = a, best.cost
        tried = task.limits.clip(a + _STEPS * (x[:3] - a))
        verdict = judge(task, tried)
        taken = int(np.where(verdict.admissible, verdict.cost, np.inf).argmin())
        a = tried[taken]
        epsilon = np.minimum(np.maximum(task.star, verdict.lower[taken]), verdict.upper[taken])
        if verdict.admissible[taken] and verdict.cost[taken] < best.cost:
            best = Found(a, epsilon, True, float(verdict.cost[taken]), count, solver)
        if best.admissible and (
            before - best.cost < SETTLED * best.cost or float(np.abs(a - previous).max()) < SETTLED_M_S2
        ):
            break
    return best


def _tangent_program(task: Task, a: Vec3, epsilon: FloatArray) -> Program:
    """(29) about (a, epsilon): variables a, epsilon_j, delta_j; rows that cannot bind in the box are left out."""
    config, limits, count = task.config, task.limits, len(task.rows)
    top = 1.0 / config.alpha2
    rise, psi = task.rows.evaluate(a)
    decay = config.alpha2 * epsilon
    gradient, norm = task.rows.gradient(a, decay)
    slope = config.alpha2 * psi / norm  # d row / d epsilon
    normal = gradient / norm[..., None]
    floor = normal @ a - rise / norm + INSET_M_S2  # the terms in epsilon cancel: the row is affine in it
    middle, half = 0.5 * (limits.low + limits.high), 0.5 * (limits.high - limits.low)
    least = normal @ middle - np.abs(normal) @ half + top * np.minimum(slope, 0.0)
    which, step = (least < floor).nonzero()
    kept, own = len(which), np.arange(count)
    rows = np.zeros((kept + count + 1, 3 + 2 * count))
    floors = np.empty(len(rows))
    rows[:kept, :3] = normal[which, step]
    rows[np.arange(kept), 3 + which] = slope[which, step]
    floors[:kept] = floor[which, step]
    tangent = 2.0 * (epsilon - task.star)  # of (26): delta - tangent epsilon >= V - budget - tangent epsilon_0
    rows[kept + own, 3 + own] = -tangent
    rows[kept + own, 3 + count + own] = 1.0
    floors[kept:-1] = (epsilon - task.star) ** 2 - task.budget - tangent * epsilon
    rows[-1, :3], floors[-1] = limits.speed_row(a)
    return _priced(task, rows, floors)


def _priced(task: Task, rows: FloatArray, floors: FloatArray) -> Program:
    """The program of (29)'s cost and bounds with the given rows."""
    config, limits, count = task.config, task.limits, len(task.rows)
    epsilons, deltas = slice(3, 3 + count), slice(3 + count, None)
    weight, linear, low, high = np.zeros((4, 3 + 2 * count))
    weight[:3], weight[epsilons], weight[deltas] = config.lambda_u, config.lambda_epsilon, config.lambda_delta
    linear[:3], linear[epsilons] = config.lambda_u * task.a_ref, config.lambda_epsilon * task.star
    low[:3], low[epsilons] = limits.low, task.rows.least_decay / config.alpha2
    high[:3], high[epsilons], high[deltas] = limits.high, 1.0 / config.alpha2, UNBOUNDED
    return Program(2.0 * weight, -2.0 * linear, low, high, rows, floors)


def shares(rows: BarrierRows, a: FloatArray) -> FloatArray:
    """Least share of the margin left by any obstacle over the horizon at ``a`` (C, 3): 1 all, 0 contact, (C,)."""
    r = rows.positions(a)
    distance = np.sqrt(np.einsum("...k,...k->...", r, r))
    share = (distance - rows.radii_m[:, None]) / _margins(rows)
    return np.asarray(share.min(axis=(-2, -1), initial=1.0))


def _margins(rows: BarrierRows) -> FloatArray:
    """Margin beyond the bare radii, (M, R) [m]; a millimetre where the configuration leaves none."""
    return np.maximum(rows.keep_out_m - rows.radii_m[:, None], 1e-3)


def least_violation(task: Task, starts: FloatArray, order: tuple[str, ...]) -> Found:
    """The acceleration that keeps the largest share of the margin; the walls go when contact is predicted.

    Raises:
        SolverError: no solver has an answer.
    """
    walled = _widest(task, starts, task.limits.low, task.limits.high, order)
    if float(shares(task.rows, walled.a[None])[0]) >= 0.0:
        return walled
    box = np.full(3, task.limits.box_m_s2)
    return _widest(task, starts, -box, box, order)


def _widest(task: Task, starts: FloatArray, low: Vec3, high: Vec3, order: tuple[str, ...]) -> Found:
    offered = shares(task.rows, starts) - task.limits.slow(starts)
    offered[0] += KEEP_WAY
    a = starts[int(offered.argmax())]
    for count in range(1, task.config.iterations + 1):  # noqa: B007
        x, solver = solve(_share_program(task, a, low, high), order)
        previous, a = a, np.clip(x[:3], low, high)
        if float(np.abs(a - previous).max()) < SETTLED_M_S2:
            break
    lower, upper = decay_interval(task.rows.evaluate(a), task.rows.least_decay)
    epsilon = np.clip(0.5 * (lower + upper), 0.0, 1.0) / task.config.alpha2
    return Found(a, epsilon, False, np.inf, count, solver)


def _share_program(task: Task, a: Vec3, low: Vec3, high: Vec3) -> Program:
    """Variables a, t, t at the horizon's end, the speed limit's slack: |r_k|'s tangent at ``a`` >= R + t (D - R)."""
    rows = task.rows
    r = rows.positions(a)
    distance = np.maximum(np.sqrt(np.einsum("ijk,ijk->ij", r, r)), 1e-9)
    reach = rows.reach[2:]
    normal = r * (reach[:, None] / distance[..., None])
    floor = (normal @ a) - distance + rows.radii_m[:, None]
    margins, every = _margins(rows), floor.size
    tangents = np.zeros((every + len(rows) + 1, 6))
    floors = np.empty(len(tangents))
    tangents[:every, :3], tangents[every:-1, :3] = normal.reshape(-1, 3), normal[:, -1]
    tangents[:every, 3], tangents[every:-1, 4] = -margins.reshape(-1), -margins[:, -1]
    floors[:every], floors[every:-1] = floor.reshape(-1), floor[:, -1]
    tangents[-1, :3], floors[-1] = task.limits.speed_row(a)
    tangents[-1, 5] = 1.0
    return Program(
        weight=np.array([2.0, 2.0, 2.0, 2.0, 2.0, 20.0]),
        linear=np.array([*(-2.0 * task.a_ref), -SHARE_WEIGHT, -LEAVE_WEIGHT, 0.0]),
        low=np.array([*low, -UNBOUNDED, -UNBOUNDED, 0.0]),
        high=np.array([*high, 1.0, 1.0, UNBOUNDED]),
        rows=tangents,
        floor=floors,
    )


def solve_task(task: Task, last: Vec3 | None, order: tuple[str, ...]) -> Found:
    """Least cost where the true rows can hold, least violation where not.

    The way round an obstacle taken in the last tick is kept as long as the rows still leave it open and no candidate
    is cheaper than what it leads to: noise in the prediction must not throw the vehicle from side to side.

    Raises:
        SolverError: no solver works; `braking` needs none.
    """
    starts = candidates(task, last)
    judgement = judge(task, starts)
    ranked = np.where(judgement.admissible, judgement.cost, np.inf)
    found = least_cost(task, _start(task, starts, judgement, 0), order)
    first = int(ranked.argmin())
    if ranked[first] < found.cost:
        other = least_cost(task, _start(task, starts, judgement, first), order)
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


def braking(task: Task, last: Vec3 | None) -> Found:
    """Without any solver, of the candidates and a straight stop: admissible first, then widest, then slowest.

    The vehicle is to lose speed along the safest direction, so among equally safe candidates |v + a dt| decides.
    """
    limits = task.limits
    speed = math.dist((0.0, 0.0, 0.0), limits.v_enu)
    stop = -limits.v_enu * min(limits.box_m_s2 / max(speed, 1e-9), 1.0 / limits.dt_s)
    starts = np.concatenate((limits.clip(stop)[None], candidates(task, last)))
    judgement = judge(task, starts)
    share = np.where(judgement.admissible, 1.0, np.minimum(shares(task.rows, starts), 1.0 - 1e-9))
    v_next = limits.v_enu + starts * limits.dt_s
    order = np.lexsort(((v_next * v_next).sum(axis=-1), -np.round(share, 3)))
    best = int(order[0])
    epsilon = np.clip(np.maximum(task.star, judgement.lower[best]), 0.0, 1.0 / task.config.alpha2)
    return Found(starts[best], epsilon, bool(judgement.admissible[best]), np.inf, 0, "none")
