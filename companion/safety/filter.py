"""The safety filter: the paper's (29) for several obstacles, with an answer that is checked before it leaves.

    minimise over a, epsilon_j, delta_j   the cost of `task`
    subject to   rows (24) for every obstacle j and step i = 0..N                     `barrier`
                 CLF (26) of each epsilon_j, relaxed by delta_j >= 0                  `adapt`
                 acceleration box, slew, norm, tilt, arena, floor, ceiling, speed     `limits`, `cone`
                 braking distance to what is too large to swerve round                `stopping`

Identity first: if every limit admits the reference and every obstacle has some epsilon in [0, 1 / alpha2] under which
its rows hold there, the reference passes to the bit and epsilon is the least such (delta relaxes only the CLF, so the
CLF cannot refuse a reference). Else solve, then judge the *true* rows at the answer: `adjusted` only if they hold
within the tolerance, otherwise `relaxed`, and the worst row is named.

Why the vehicle does not fly into a state from which nothing helps. An admissible acceleration clears every obstacle at
every step of the horizon T = (N + 2) dt when simply held, and holding it stays within box, norm, tilt and slew: what is
admissible now stays so for the same obstacles as they were predicted. What is new at the horizon's end needs room:
within T the vehicle gets sideways by the swerve a_max T^2 / 2 (1.8 m for 1.1 s and 3 m/s^2; less with a slew limit).
An obstacle whose D is smaller is first seen by the rows while a swerve still clears it, at any closing speed. Before
one that is larger the braking distance itself is the bound (`stopping`), as it is for walls, which do not move.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from companion.config import LimitsConfig, SafetyConfig
from companion.errors import SolverError
from companion.safety.adapt import clf_budget, decay_interval, epsilon_star
from companion.safety.barrier import Barrier
from companion.safety.detour import Detour
from companion.safety.limits import DIAGONAL, Capability, capability, vehicle_limits
from companion.safety.relax import braking, least_violation
from companion.safety.search import least_of_ways
from companion.safety.stopping import StopRows, stop_rows, swerve_m
from companion.safety.task import Found, Task, Ways, turned
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
    detours: bool = True  # whether the reference leads to a target, round what stands in the way
    accel_shrink_m_s2: float = 0.0  # the box is smaller by what the disturbance estimate may add
    elapsed_s: float | None = None  # vehicle time since the last call, None on the first
    a_before: Vec3 | None = None  # the last setpoint sent, for slew; None: hover [m/s^2]


@dataclass(frozen=True, slots=True)
class Answer:
    """What `SafetyFilter.solve` found, before its verdict."""

    found: Found
    values: FloatArray  # (2, M, R) the true rows there: rise and psi
    verdict: Verdict  # nominal, adjusted or braking


class SafetyFilter:
    """Admissible accelerations, tick by tick. Hidden state: last answer, epsilons, a detour under way."""

    def __init__(self, safety: SafetyConfig, limits: LimitsConfig) -> None:
        self.retune(safety, limits)
        self.reset()

    def retune(self, safety: SafetyConfig, limits: LimitsConfig) -> None:
        """Use other constants from the next step on; the last answer, every epsilon and a detour stay."""
        self._safety = safety
        self._limits = limits
        self._barrier = Barrier(safety)
        self._order = _OTHER[safety.solver]
        self._kept: tuple[float, Capability] | None = None

    def reset(self) -> None:
        """Forget the last answer and every epsilon: the next step equals the first of a new filter, bit for bit."""
        self._last: Vec3 | None = None
        self._epsilon: dict[str, float] = {}
        self._detour = Detour()

    def step(self, inputs: FilterInput) -> FilterResult:
        """The safe acceleration for one tick: build, solve, verify; never raises on finite input.

        Raises:
            ValueError: the prediction is shorter than horizon + 3 instants.
        """
        task, elapsed_s, detour = self.build(inputs), inputs.elapsed_s or 0.0, self._detour
        turned_off = inputs.detours and detour.active
        if turned_off:
            task = replace(task, a_ref=detour.reference(task))
        result = self.verify(task, self.solve(task, elapsed_s))
        if turned_off:
            nominal = result.verdict is Verdict.NOMINAL
            result = replace(result, verdict=Verdict.ADJUSTED if nominal else result.verdict, detour=True)
        if inputs.detours:
            refused = result.verdict is not Verdict.NOMINAL
            in_the_way = refused and result.worst is not None and result.worst.track in task.rows.ids
            detour.note(inputs.p_enu, inputs.a_ref, elapsed_s, in_the_way=in_the_way)
        return result

    def build(self, inputs: FilterInput) -> Task:
        """The tick's problem: rows, limits and epsilon*, from which tests can read every matrix.

        Its CLF has no budget as yet: a reference that passes needs none.
        """
        config, prediction = self._safety, inputs.prediction
        rows = self._barrier.rows(inputs.p_enu, inputs.v_enu, prediction, inputs.p_std_m)
        can = self._capability(inputs.accel_shrink_m_s2)
        limits = vehicle_limits(
            inputs.p_enu,
            inputs.v_enu,
            self._limits,
            can,
            arena_on=inputs.limits_on,
            before=inputs.a_before,
            elapsed_s=inputs.elapsed_s,
        )
        r, v_rel = -rows.drift[:, :, 0].T, prediction.v_enu - inputs.v_enu
        star = epsilon_star(r, v_rel, config)
        stops = None
        if config.braking and len(prediction):
            swerve = swerve_m(can.authority_m_s2, math.sqrt(2.0 * rows.reach[-1]), can.braking.slew_m_s3)
            stops = stop_rows(-r, -v_rel, rows.keep_out_m[:, 0], can.braking, swerve)
        return Task(rows, limits, inputs.a_ref, star, star, config, stops)

    def _capability(self, shrink_m_s2: float) -> Capability:
        """Kept from tick to tick: it changes with the shrinking only."""
        if self._kept is None or self._kept[0] != shrink_m_s2:
            can = capability(self._limits, shrink_m_s2=shrink_m_s2, dt_s=self._safety.dt_s)
            self._kept = shrink_m_s2, can
        return self._kept[1]

    def solve(self, task: Task, elapsed_s: float) -> Answer:
        """The reference where it is admissible, else the search's answer, as yet unjudged."""
        values = task.rows.evaluate(task.a_ref)
        lower, upper = decay_interval(values, task.rows.least_decay)
        stopping = task.stops is None or bool((task.stops.slack(task.a_ref) >= 0.0).all())
        if stopping and bool((lower <= upper).all()) and task.limits.admits(task.a_ref):
            return Answer(Found(task.a_ref, lower / self._safety.alpha2, True, 0.0, 0, "none"), values, Verdict.NOMINAL)
        budget = self._budget(task, elapsed_s)
        return self._search(Task(task.rows, task.limits, task.a_ref, task.star, budget, task.config, task.stops))

    def _budget(self, task: Task, elapsed_s: float) -> FloatArray:
        """What the CLF leaves each obstacle; one without history starts from the greatest epsilon."""
        ids, config = task.rows.ids, self._safety
        previous = np.array([self._epsilon.get(name, 1.0 / config.alpha2) for name in ids])
        elapsed = np.array([elapsed_s if name in self._epsilon else 0.0 for name in ids])
        return clf_budget(previous, task.star, elapsed, config.eta)

    def _search(self, task: Task) -> Answer:
        """The answer with epsilons of all obstacles."""
        balls = task.rows.balls(np.ones(len(task.rows)))
        near = balls.reachable(task.limits.hard_low, task.limits.hard_high)
        if task.stops is not None:
            near |= task.stops.floor > -DIAGONAL * task.limits.box_m_s2
        taken = near.nonzero()[0]
        reduced = task
        if len(taken) < len(near):
            reduced, balls = task.select(taken), balls.select(taken)
        a_ref = turned(reduced.rows, task.a_ref)
        if a_ref is not task.a_ref:
            reduced = replace(reduced, a_ref=a_ref)
        ways = Ways(reduced, a_ref if self._last is None else self._last)
        verdict = Verdict.ADJUSTED
        try:
            found = None if self._hopeless(reduced) else least_of_ways(reduced, balls, ways, self._order)
            if found is None or not found.admissible:
                found = least_violation(reduced, ways, self._order)
        except SolverError:
            found, verdict = braking(reduced, ways), Verdict.BRAKING
        values = task.rows.evaluate(found.a)
        if reduced.rows is task.rows:
            return Answer(found, values, verdict)
        lower, upper = decay_interval(values, task.rows.least_decay)
        epsilon = np.minimum(np.maximum(task.star, lower / self._safety.alpha2), upper / self._safety.alpha2)
        epsilon[taken] = found.epsilon
        found = Found(found.a, epsilon, found.admissible, found.cost, found.iterations, found.solver)
        return Answer(found, values, verdict)

    def _hopeless(self, task: Task) -> bool:
        """No acceleration at all stops in time: nothing admissible to search for."""
        limits = task.limits
        return task.stops is not None and task.stops.beyond(limits.low, limits.high, 10.0 * self._safety.tolerance_m_s2)

    def verify(self, task: Task, answer: Answer) -> FilterResult:
        """The verdict and the record: the true rows at the answer decide between adjusted and relaxed."""
        found, verdict, rows = answer.found, answer.verdict, task.rows
        a = found.a
        obstacles = _worst_rows(task, found, answer.values)
        slacks = task.limits.slacks(a)
        limits = [
            RowRecord(track=name, step=-1, slack=slack, margin=None, epsilon=0.0, epsilon_star=0.0)
            for name, slack in slacks.items()
            if slack < LIMIT_LISTED_M_S2
        ]
        stops = [] if task.stops is None else _stop_records(task, found, task.stops)
        records = (*obstacles, *stops, *limits)
        worst = min(records, key=lambda record: record.slack, default=None)
        if verdict is Verdict.ADJUSTED and worst is not None and not worst.slack >= -self._safety.tolerance_m_s2:
            verdict = Verdict.RELAXED
        self._last = a = frozen(a)
        self._epsilon = dict(zip(rows.ids, found.epsilon.tolist(), strict=True))
        return FilterResult(a, verdict, worst, records, found.iterations, found.solver)


def _stop_records(task: Task, found: Found, stops: StopRows) -> list[RowRecord]:
    """Braking rows with little room left; like the vehicle's limits they have no horizon step."""
    margins = task.rows.margins(np.zeros(len(task.rows), dtype=np.intp))
    return [
        RowRecord(task.rows.ids[j], -1, slack, margins[j], float(found.epsilon[j]), float(task.star[j]))
        for j, slack in enumerate(stops.slack(found.a).tolist())
        if slack < LIMIT_LISTED_M_S2
    ]


def _worst_rows(task: Task, found: Found, values: FloatArray) -> list[RowRecord]:
    """The row of least slack of each obstacle, in m/s^2: the row's value over its gradient's norm at the answer."""
    rows, (rise, psi) = task.rows, values
    if not len(rows):
        return []
    decay = task.config.alpha2 * found.epsilon
    _, norm = rows.gradient(found.a, decay)
    slack = psi * decay[:, None]
    slack += rise
    slack /= norm
    steps = slack.argmin(axis=-1)
    least = np.minimum.reduce(slack, axis=-1)
    names, epsilons, stars = rows.ids, found.epsilon.tolist(), task.star.tolist()
    parts = zip(names, steps.tolist(), least.tolist(), rows.margins(steps), epsilons, stars, strict=True)
    return [RowRecord(*part) for part in parts]
