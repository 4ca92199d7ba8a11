"""One tick's problem, and what its true rows and limits say about any acceleration.

Cost (29), over a, epsilon_j and delta_j of the obstacles within reach:

    lambda_u |a - a_ref|^2 + sum_j lambda_epsilon (epsilon_j - epsilon*_j)^2 + lambda_delta delta_j^2

For a given a the cheapest epsilon and delta are known in closed form, so accelerations are judged in batches. What
lies inside a row's ball has several ways round it: `candidates` offers them, and for a head-on obstacle, where all
cost the same, the order of the ring decides: to the right. A vehicle that already stands at an obstacle and is sent
through it has no cheaper way than to stand still, or to be pushed along; there `turned` sends it round the side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from companion.config import SafetyConfig
from companion.safety.adapt import decay_interval
from companion.safety.barrier import BarrierRows
from companion.safety.limits import VehicleLimits
from companion.safety.stopping import StopRows
from companion.types import FloatArray, Vec3

_ANGLES = np.arange(8) * (2.0 * np.pi / 8)
_RING = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)), axis=-1)  # (P, 2) over (right, up)
STANDING_M = 0.3  # nearer than this to the keep-out distance,
STANDING_M_S = 0.8  # slower than this against the obstacle,
STANDING_COS = 0.8  # and sent at it within 37 degrees: the vehicle stands in front of it
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
    stops: StopRows | None = None  # of obstacles too large to swerve round

    def select(self, taken: npt.NDArray[np.intp]) -> Task:
        """The problem of some obstacles only."""
        rows, stops = self.rows.select(taken), None if self.stops is None else self.stops.select(taken)
        return Task(rows, self.limits, self.a_ref, self.star[taken], self.budget[taken], self.config, stops)


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

    def greatest(self, index: int, alpha2: float) -> FloatArray:
        """The epsilon that asks least of a, (M,)."""
        return np.asarray(np.maximum(np.minimum(self.upper[index], 1.0 / alpha2), 0.0))

    @property
    def ranked(self) -> FloatArray:
        """Cost where admissible, infinite elsewhere, (C,)."""
        return np.where(self.admissible, self.cost, np.inf)


def judge(task: Task, a: FloatArray) -> Judgement:
    """True rows and limits at ``a`` (C, 3), within box, slew, arena and cones, all in one batch."""
    config = task.config
    lower, upper = decay_interval(task.rows.evaluate_many(a), task.rows.least_decay)
    lower /= config.alpha2
    upper /= config.alpha2
    admissible = np.logical_and.reduce(lower <= upper, axis=-1)
    if task.limits.may_speed:
        admissible &= task.limits.fast(a) <= config.tolerance_m_s2
    if task.stops is not None:
        admissible &= np.minimum.reduce(task.stops.slack(a), axis=-1) >= -config.tolerance_m_s2
    deviation = np.minimum(np.maximum(task.star, lower), upper)
    deviation -= task.star
    deviation *= deviation
    delta = np.maximum(deviation - task.budget, 0.0)
    delta *= delta
    away = a - task.a_ref
    priced = config.lambda_epsilon * deviation + config.lambda_delta * delta
    cost = config.lambda_u * np.vecdot(away, away) + np.add.reduce(priced, axis=-1)
    return Judgement(lower, upper, admissible, cost)


class Ways:
    """Accelerations to begin a search from: the last answer, and candidates, made once where somebody asks."""

    def __init__(self, task: Task, last: Vec3) -> None:
        self._task = task
        self.last = last

    @cached_property
    def offered(self) -> FloatArray:
        """The last answer, then the candidates, not yet within limits, (C, 3)."""
        return np.concatenate((self.last[None], candidates(self._task)))


def candidates(task: Task) -> FloatArray:
    """Ways to go, the reference first, not yet within limits: (C, 3)."""
    box = task.limits.box_m_s2
    starts = [task.a_ref[None], box * _LATTICE]
    if len(task.rows):
        ring = box * _ring(task.rows)
        starts += [ring, 0.5 * ring]
    return np.concatenate(starts)


def turned(rows: BarrierRows, a_ref: Vec3) -> Vec3:
    """``a_ref``, with as much again sideways where the vehicle stands at an obstacle and is sent through it.

    The side is the one to which the vehicle already moves against the obstacle, else the right.
    """
    strength = math.hypot(*a_ref.tolist())
    if not len(rows) or strength < 1e-3:
        return a_ref
    r = rows.drift[:, :, 0]
    distance = np.sqrt(np.add.reduce(r * r))
    standing = distance - rows.keep_out_m[:, 0] < STANDING_M
    if not standing.any():
        return a_ref
    v = (rows.drift[:, :, 1] - r) / math.sqrt(rows.reach[2])
    standing &= np.add.reduce(v * v) < STANDING_M_S**2
    standing &= a_ref @ r < -STANDING_COS * strength * distance
    if not standing.any():
        return a_ref
    nearest = int(np.where(standing, distance, np.inf).argmin())
    towards = -r[:, nearest] / distance[nearest]
    side = v[:, nearest] - (v[:, nearest] @ towards) * towards
    speed = math.hypot(*side.tolist())
    if speed < 0.02:
        side = np.array((towards[1], -towards[0], 0.0)) if abs(towards[2]) < 0.99 else np.array((1.0, 0.0, 0.0))
        speed = math.hypot(*side.tolist())
    return np.asarray(a_ref + (strength / speed) * side)


def _ring(rows: BarrierRows) -> FloatArray:
    """Unit vectors across the relative velocity of the obstacle that comes closest, the first to the right, (P, 3)."""
    distance = np.minimum.reduce(np.add.reduce(rows.drift * rows.drift), axis=-1)
    nearest = rows.drift[:, int((np.sqrt(distance) - rows.radii_m).argmin())]
    x, y, z = (nearest[:, 1] - nearest[:, 0]).tolist()
    if x * x + y * y + z * z < 1e-12:  # at rest to each other: across the line between
        x, y, z = (-nearest[:, 0]).tolist()
    level = math.hypot(x, y)
    length = math.hypot(level, z)
    right = (y / level, -x / level, 0.0) if level > 1e-6 * length else (1.0, 0.0, 0.0)
    if length < 1e-9:
        x, y, z, length = 0.0, 1.0, 0.0, 1.0
    up = (-right[1] * z, right[0] * z, right[1] * x - right[0] * y)  # along x right, turned: up for level flight
    return np.asarray(_RING @ (np.array((right, up)) / ((1.0,), (-length,))))
