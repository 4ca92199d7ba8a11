"""Where no acceleration keeps every row: the least violation, lexicographic, and without any solver: braking.

What counts first is that nobody is touched, obstacle by obstacle in the order of the time to contact; then their
margins in the same order; then braking distances, the arena and speed; then the reference. Box, slew, norm and tilt
are kept by all of it: the vehicle cannot leave them.

The violation is measured by the share t <= 1 of the margin beyond the bare radii that an obstacle is left over the
horizon, |r_k(a)| >= R + t (D - R): 1 is all of D, 0 is contact. Row values in m/s^2 would rank the first steps of the
horizon, which no acceleration moves much, above the closest approach. |r_k| is convex in a, so its tangents bound it
from below and a share never falls from one program to the next. Each program raises the share of one obstacle and
keeps those of the obstacles before it.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from companion.errors import SolverError
from companion.safety.adapt import decay_interval
from companion.safety.barrier import BarrierRows
from companion.safety.qp import UNBOUNDED, Program, solve
from companion.safety.search import limit_rows
from companion.safety.task import Found, Task, Ways, judge
from companion.types import FloatArray, Vec3

SHARE_WEIGHT = 1e6  # cost of the whole margin, against |a - a_ref|^2 in (m/s^2)^2
LEAVE_WEIGHT = 1e4  # the same at the end of the horizon: a vehicle inside the margin leaves it
STOP_WEIGHT, ARENA_WEIGHT, SPEED_WEIGHT = 3e3, 1e3, 1e2  # cost of breaking each by 1 m/s^2
KEEP_WAY = 0.15  # share of the margin that another way round must offer before the last answer's is left
SETTLED_M_S2 = 1e-3  # iterates closer than this have converged
KEPT = 1e-6  # share that an obstacle may lose to those after it: the solver's tolerance
UNKEPT = 1e3  # a share below which no obstacle can be
_VARIABLES, _STOP, _ARENA, _SPEED = 8, 5, 6, 7
_WALLS = np.concatenate((np.eye(3), -np.eye(3)))
_STEP = 0.05  # of a share: candidates closer than this are equally good for an obstacle


def shares(rows: BarrierRows, a: FloatArray) -> FloatArray:
    """Least share of the margin left by each obstacle over the horizon at ``a`` (C, 3): 1 all, 0 contact, (C, M)."""
    r = rows.positions(a)
    share = np.sqrt(np.add.reduce(r * r))  # (C, M, R)
    share -= rows.radii_m[:, None]
    share /= _margins(rows)
    return np.asarray(np.minimum(np.minimum.reduce(share, axis=-1), 1.0))


def _margins(rows: BarrierRows) -> FloatArray:
    """Margin beyond the bare radii, (M, R) [m]; a millimetre where the configuration leaves none."""
    return np.maximum(rows.keep_out_m - rows.radii_m[:, None], 1e-3)


def by_contact(rows: BarrierRows) -> npt.NDArray[np.intp]:
    """Obstacles by the time to contact, (M,): without acceleration, the first step within D, else the closest."""
    drift = rows.drift[:, :, 2:]
    gap = np.sqrt(np.add.reduce(drift * drift)) - rows.keep_out_m
    inside = gap < 0.0
    steps = gap.shape[1]
    first = np.where(inside.any(axis=1), inside.argmax(axis=1), steps + gap.argmin(axis=1))
    return np.lexsort((gap.min(axis=1), first))


def widest(offered: FloatArray) -> int:
    """The candidate that is lexicographically best: contact first, then margin, in the obstacles' order.

    Args:
        offered: shares of candidates, obstacles by the time to contact, (C, M).
    """
    contact = np.minimum(offered, 0.0)
    keys = np.round(np.concatenate((contact, offered), axis=1) / _STEP)
    return int(np.lexsort(np.concatenate((-offered.sum(axis=1)[:, None], -keys[:, ::-1]), axis=1).T)[0])


def least_violation(task: Task, ways: Ways, order: tuple[str, ...]) -> Found:
    """The lexicographically least violation, within ``config.iterations`` programs.

    The first obstacles each have a program of their own, what comes after them one together, which is repeated.

    Raises:
        SolverError: no solver has an answer.
    """
    rows, limits, budget = task.rows, task.limits, task.config.iterations
    starts = limits.clip_hard(ways.offered)
    ranks, offered = by_contact(rows), shares(rows, starts)
    favoured = offered.take(ranks, axis=1)
    mine, more = favoured[0].copy(), favoured[0] + KEEP_WAY
    more = np.where(mine < 0.0, np.maximum(mine, np.minimum(more, -_STEP)), more)  # a touch stays one
    favoured[0] = np.where(mine < 1.0, more, mine)
    first = widest(favoured)
    a = starts[first]
    kept = np.full((len(rows), 2), -np.inf)  # shares over the horizon and at its end that may not be lost
    kept[:, 0] = np.minimum(offered[first], 0.0) - KEPT  # no obstacle is touched for another's margin
    alone = min(len(ranks) - 1, budget // 2)
    groups = [ranks[j : j + 1] for j in range(alone)] + [ranks[max(alone, 0) :]]
    x, solver = solve(_share_program(task, a, kept, groups[0]), order)
    count = 1
    while True:
        previous, a = a, limits.clip_hard(x[None, :3])[0]
        settled = float(np.abs(a - previous).max()) < SETTLED_M_S2
        if count == budget or (settled and len(groups) == 1):
            break
        if len(groups) > 1:
            kept[groups.pop(0)] = x[3:5] - KEPT
        try:
            x, solver = solve(_share_program(task, a, kept, groups[0]), order)
        except SolverError:  # what was kept is no longer to be had to the last digit: the iterate is an answer
            break
        count += 1
    lower, upper = decay_interval(rows.evaluate(a), rows.least_decay)
    epsilon = np.clip(0.5 * (lower + upper), 0.0, 1.0) / task.config.alpha2
    return Found(a, epsilon, False, np.inf, count, solver)


def _share_program(task: Task, a: Vec3, kept: FloatArray, raised: npt.NDArray[np.intp]) -> Program:
    """|r_k|'s tangent at ``a`` >= R + t (D - R), t common to the ``raised`` obstacles and no less than what is kept.

    Variables a, t, t at the horizon's end, and how far stops, arena and speed are broken.
    """
    rows, limits = task.rows, task.limits
    r = rows.positions(a)
    distance = np.maximum(np.sqrt(np.add.reduce(r * r)), 1e-9)
    normal = r * (rows.reach[2:] / distance)
    floor = (a @ normal.reshape(3, -1)).reshape(distance.shape) - distance + rows.radii_m[:, None]
    margins = _margins(rows)
    # limits; of every obstacle what is kept, over the horizon and at its end; of those raised t, and t at the end
    count, steps, high = len(rows), floor.shape[1], len(raised)
    tangents, floors, first = _limit_part(task, a, (count + high) * (steps + 1))
    planes, least = normal.reshape(3, -1).T, np.maximum(kept, -UNKEPT)
    last, at = planes[steps - 1 :: steps], first + floor.size
    tangents[first:at, :3] = planes
    floors[first:at] = (floor + least[:, :1] * margins).reshape(-1)
    end = at + count
    tangents[at:end, :3] = last
    floors[at:end] = floor[:, -1] + least[:, 1] * margins[:, -1]
    to = end + high * steps
    tangents[end:to, :3], tangents[end:to, 3] = normal[:, raised].reshape(3, -1).T, -margins[raised].reshape(-1)
    floors[end:to] = floor[raised].reshape(-1)
    tangents[to:, :3], tangents[to:, 4] = last[raised], -margins[raised, -1]
    floors[to:] = floor[raised, -1]
    return Program(
        weight=np.full(_VARIABLES, 2.0),
        linear=np.array([*(-2.0 * task.a_ref), -SHARE_WEIGHT, -LEAVE_WEIGHT, STOP_WEIGHT, ARENA_WEIGHT, SPEED_WEIGHT]),
        low=np.array([*limits.hard_low, -UNBOUNDED, -UNBOUNDED, 0.0, 0.0, 0.0]),
        high=np.array([*limits.hard_high, 1.0, 1.0, UNBOUNDED, UNBOUNDED, UNBOUNDED]),
        rows=tangents,
        floor=floors,
    )


def _limit_part(task: Task, a: Vec3, after: int) -> tuple[FloatArray, FloatArray, int]:
    """Cones (kept), speed, stops, arena (each with what breaks it), room for ``after`` rows, and where that begins."""
    limits = task.limits
    extra, bound = limit_rows(task, a, _VARIABLES)
    walls = len(extra)
    first = walls + 6
    tangents, floors = np.zeros((first + after, _VARIABLES)), np.empty(first + after)
    tangents[:walls], floors[:walls] = extra, bound
    kept = len(limits.cones)
    if limits.may_speed:
        tangents[kept, _SPEED] = 1.0
        kept += 1
    tangents[kept:walls, _STOP] = 1.0
    tangents[walls:first, :3], tangents[walls:first, _ARENA] = _WALLS, 1.0
    floors[walls : walls + 3], floors[walls + 3 : first] = limits.arena_low, -limits.arena_high
    np.maximum(floors[walls:first], -UNBOUNDED, out=floors[walls:first])
    return tangents, floors, first


def braking(task: Task, ways: Ways) -> Found:
    """Without any solver, of ``ways`` and a straight stop: admissible first, then widest, then slowest.

    The vehicle is to lose speed along the safest direction, so among equally safe candidates |v + a dt| decides.
    """
    limits, dt_s = task.limits, task.config.dt_s
    speed = math.dist((0.0, 0.0, 0.0), limits.v_enu)
    stop = -limits.v_enu * min(limits.box_m_s2 / max(speed, 1e-9), 1.0 / dt_s)
    starts = limits.clip(np.concatenate((stop[None], ways.offered)))
    judgement = judge(task, starts)
    least = np.minimum.reduce(shares(task.rows, starts), axis=-1, initial=1.0)
    share = np.where(judgement.admissible, 1.0, least)
    v_next = limits.v_enu + starts * dt_s
    order = np.lexsort((np.vecdot(v_next, v_next), -np.round(share, 3), ~judgement.admissible))
    best = int(order[0])
    epsilon = np.clip(np.maximum(task.star, judgement.lower[best]), 0.0, 1.0 / task.config.alpha2)
    return Found(starts[best], epsilon, bool(judgement.admissible[best]), np.inf, 0, "none")
