"""The safety filter: the paper's (29) for several obstacles, with an answer that is checked before it leaves.

    minimise over a, epsilon_j, delta_j   the cost of `task`
    subject to   rows (24) for every obstacle j and step i = 0..N                     `barrier`
                 CLF (26) of each epsilon_j, relaxed by delta_j >= 0                  `adapt`
                 acceleration box, arena with floor and ceiling, speed                `limits`

Identity first: if every limit admits the reference and every obstacle has some epsilon in [0, 1 / alpha2] under which
its rows hold there, the reference passes to the bit and epsilon is the least such (delta relaxes only the CLF, so the
CLF cannot refuse a reference). Else solve, then judge the *true* rows at the answer: `adjusted` only if they hold
within the tolerance, otherwise `relaxed`, and the worst row is named.

Why the vehicle does not fly into a state from which nothing helps: an admissible acceleration clears every obstacle
at every step of the horizon T = (N + 2) dt when simply held. Within T a box of a_max moves the vehicle sideways by
a_max T^2 / 2 (1.8 m for 1.1 s and 3 m/s^2), so an obstacle whose D is less than that is first seen by the rows while
a swerve still clears it, at any closing speed; one that is larger asks for a longer horizon, N dt >= sqrt(2 D / a_max),
or for a speed limit from which the vehicle stops within it. Walls do not move: there the braking distance itself is
the bound (`limits`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.config import LimitsConfig, SafetyConfig
from companion.errors import SolverError
from companion.safety.adapt import clf_budget, decay_interval, epsilon_star
from companion.safety.barrier import Barrier, BarrierRows
from companion.safety.limits import vehicle_limits
from companion.safety.relax import braking
from companion.safety.search import solve_task
from companion.safety.task import Found, Task, turned, within_reach
from companion.types import FilterResult, FloatArray, Prediction, RowRecord, Vec3, Verdict, frozen

LIMIT_LISTED_M_S2 = 0.05  # a vehicle limit with less room than this is listed with the answer
_OTHER = {"daqp": ("daqp", "osqp"), "osqp": ("osqp", "daqp")}


@dataclass(frozen=True, slots=True)
class FilterInput:
    """One tick, at the instant at which the setpoint acts."""

    p_enu: Vec3  # [m]
    v_enu: Vec3  # [m/s]
    a_ref: Vec3  # net reference, gravity excluded [m/s^2]
    prediction: Prediction  # obstacles from the same instant on, k = 0..N+2
    p_std_m: float = 0.0  # 1 sigma of the vehicle's own position
    limits_on: bool = True  # arena, floor and ceiling; off in READY
    accel_shrink_m_s2: float = 0.0  # the box is smaller by what the disturbance estimate may add
    elapsed_s: float | None = None  # vehicle time since the last call, None on the first


class SafetyFilter:
    """Admissible accelerations, tick by tick. Hidden state: the last answer and each obstacle's epsilon."""

    def __init__(self, safety: SafetyConfig, limits: LimitsConfig) -> None:
        self._safety = safety
        self._limits = limits
        self._barrier = Barrier(safety)
        self._order = _OTHER[safety.solver]
        self.reset()

    def reset(self) -> None:
        """Forget the last answer and every epsilon: the next step equals the first of a new filter, bit for bit."""
        self._last: Vec3 | None = None
        self._epsilon: dict[str, float] = {}

    def step(self, inputs: FilterInput) -> FilterResult:
        """The safe acceleration for one tick; never raises on finite input.

        Raises:
            ValueError: the prediction is shorter than horizon + 3 instants.
        """
        task = self._task(inputs)
        lower, upper = decay_interval(task.rows.evaluate(inputs.a_ref), task.rows.least_decay)
        if bool((lower <= upper).all()) and task.limits.admits(inputs.a_ref):
            found = Found(inputs.a_ref, lower / self._safety.alpha2, True, 0.0, 0, "none")
            return self._answer(task, found, Verdict.NOMINAL)
        found, fallback = self._solve(task)
        return self._answer(task, found, Verdict.BRAKING if fallback else Verdict.ADJUSTED)

    def _task(self, inputs: FilterInput) -> Task:
        config, prediction = self._safety, inputs.prediction
        rows = self._barrier.rows(inputs.p_enu, inputs.v_enu, prediction, inputs.p_std_m)
        limits = vehicle_limits(
            inputs.p_enu,
            inputs.v_enu,
            self._limits,
            arena_on=inputs.limits_on,
            shrink_m_s2=inputs.accel_shrink_m_s2,
            dt_s=config.dt_s,
        )
        star = epsilon_star(-rows.drift[:, 0], prediction.v_enu - inputs.v_enu, config)
        elapsed_s = inputs.elapsed_s or 0.0
        known = np.array([name in self._epsilon for name in rows.ids], dtype=np.bool_)
        previous = np.array([self._epsilon.get(name, 1.0 / config.alpha2) for name in rows.ids])
        budget = clf_budget(previous, star, np.where(known, elapsed_s, 0.0), config.eta)
        return Task(rows, limits, inputs.a_ref, star, budget, config)

    def _solve(self, task: Task) -> tuple[Found, bool]:
        """The answer with epsilons of all obstacles, and whether it had to do without solvers."""
        near = within_reach(task.rows, task.limits)
        rows = task.rows if near.all() else task.rows.select(near)
        a_ref = turned(rows, task.a_ref)
        reduced = Task(rows, task.limits, a_ref, task.star[near], task.budget[near], task.config)
        try:
            found, fallback = solve_task(reduced, self._last, self._order), False
        except SolverError:
            found, fallback = braking(reduced, self._last), True
        lower, upper = decay_interval(task.rows.evaluate(found.a), task.rows.least_decay)
        epsilon = np.minimum(np.maximum(task.star, lower / self._safety.alpha2), upper / self._safety.alpha2)
        epsilon[near] = found.epsilon
        return Found(found.a, epsilon, found.admissible, found.cost, found.iterations, found.solver), fallback

    def _answer(self, task: Task, found: Found, verdict: Verdict) -> FilterResult:
        """The record: the true rows at the answer decide between adjusted and relaxed."""
        a, rows = found.a, task.rows
        obstacles = _worst_rows(rows, a, found.epsilon, task.star, self._safety.alpha2)
        slacks = task.limits.slacks(a)
        limits = [
            RowRecord(track=name, step=-1, slack=slack, margin=None, epsilon=0.0, epsilon_star=0.0)
            for name, slack in slacks.items()
            if slack < LIMIT_LISTED_M_S2
        ]
        records = (*obstacles, *limits)
        worst = min(records, key=lambda record: record.slack, default=None)
        if verdict is Verdict.ADJUSTED and worst is not None and worst.slack < -self._safety.tolerance_m_s2:
            verdict = Verdict.RELAXED
        self._last = a = frozen(a)
        self._epsilon = dict(zip(rows.ids, found.epsilon.tolist(), strict=True))
        return FilterResult(a, verdict, worst, records, found.iterations, found.solver)


def _worst_rows(rows: BarrierRows, a: Vec3, epsilon: FloatArray, star: FloatArray, alpha2: float) -> list[RowRecord]:
    """The row of least slack of each obstacle, in m/s^2: the row's value over its gradient's norm at ``a``."""
    if not len(rows):
        return []
    decay = alpha2 * epsilon
    rise, psi = rows.evaluate(a)
    _, norm = rows.gradient(a, decay)
    slack = (rise + decay[:, None] * psi) / norm
    steps, own = slack.argmin(axis=-1), np.arange(len(rows))
    parts = zip(
        rows.ids,
        steps.tolist(),
        slack[own, steps].tolist(),
        rows.margins(steps),
        epsilon.tolist(),
        star.tolist(),
        strict=True,
    )
    return [RowRecord(*part) for part in parts]
