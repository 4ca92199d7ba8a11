"""Where no acceleration keeps every row: the least violation, and without any solver: braking.

The violation is measured by the share t <= 1 of the margin beyond the bare radii that every obstacle can be left
over the horizon, |r_k(a)| >= R + t (D - R): 1 is all of D, 0 is contact. Row values in m/s^2 would rank the first steps
of the horizon, which no acceleration moves much, above the closest approach. |r_k| is convex in a, so its tangents
bound it from below and t never falls from one program to the next. Walls are kept while t >= 0, that is while nobody
is touched, and given up after that; the speed limit goes before both.
"""

from __future__ import annotations

import math

import numpy as np

from companion.safety.adapt import decay_interval
from companion.safety.barrier import BarrierRows
from companion.safety.qp import UNBOUNDED, Program, solve
from companion.safety.task import Found, Task, candidates, judge
from companion.types import FloatArray, Vec3

SHARE_WEIGHT = 1e4  # cost of the whole margin, against |a - a_ref|^2 in (m/s^2)^2
LEAVE_WEIGHT = 1e2  # the same at the end of the horizon: a vehicle inside the margin leaves it
SPEED_WEIGHT = 10.0  # cost of breaking the speed limit by 1 m/s^2
KEEP_WAY = 0.15  # share of the margin that another way round must offer before the last answer's is left
SETTLED_M_S2 = 1e-3  # iterates closer than this have converged


def shares(rows: BarrierRows, a: FloatArray) -> FloatArray:
    """Least share of the margin left by any obstacle over the horizon at ``a`` (C, 3): 1 all, 0 contact, (C,)."""
    r = rows.positions(a)
    share = np.sqrt(np.add.reduce(r * r))  # (C, M, R)
    share -= rows.radii_m[:, None]
    share /= _margins(rows)
    return np.asarray(np.minimum.reduce(share.reshape(len(a), share[0].size), axis=-1, initial=1.0))


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
    distance = np.maximum(np.sqrt(np.add.reduce(r * r)), 1e-9)
    normal = r * (rows.reach[2:] / distance)
    floor = (a @ normal.reshape(3, -1)).reshape(distance.shape) - distance + rows.radii_m[:, None]
    margins, every = _margins(rows), floor.size
    tangents = np.zeros((every + len(rows) + 1, 6))
    floors = np.empty(len(tangents))
    tangents[:every, :3], tangents[every:-1, :3] = normal.reshape(3, -1).T, normal[:, :, -1].T
    tangents[:every, 3], tangents[every:-1, 4] = -margins.reshape(-1), -margins[:, -1]
    floors[:every], floors[every:-1] = floor.reshape(-1), floor[:, -1]
    tangents[-1, :3], floors[-1] = task.limits.speed_row(a)
    tangents[-1, 5] = 1.0
    return Program(
        weight=np.array([2.0, 2.0, 2.0, 2.0, 2.0, 2.0 * SPEED_WEIGHT]),
        linear=np.array([*(-2.0 * task.a_ref), -SHARE_WEIGHT, -LEAVE_WEIGHT, 0.0]),
        low=np.array([*low, -UNBOUNDED, -UNBOUNDED, 0.0]),
        high=np.array([*high, 1.0, 1.0, UNBOUNDED]),
        rows=tangents,
        floor=floors,
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
