"""Time of the filter's rows, solution, verdict and whole over active states, beside its other solver and cbfpy.

All of them are timed tick by tick in turn, on the same inputs, by filters that have flown the ticks before: no tick
is the first of its flight. A state is active, and counted, where the verdict is not `nominal`: some row or limit
refused the reference. The flights follow our answers. Bringing up a filter or compiling cbfpy's is not timed.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Literal

from companion.bench.cbfpy_rival import cbfpy_filter
from companion.bench.scenes import FLIGHT_TICKS, Flight, Scene, scenes
from companion.bench.timing import Quantiles, quantiles
from companion.clock import stopwatch_ns
from companion.config import LimitsConfig, SafetyConfig
from companion.safety.filter import FilterInput, SafetyFilter
from companion.types import FilterResult, Verdict

SEED = 90210
Solver = Literal["daqp", "osqp"]
SOLVERS: tuple[Solver, ...] = ("daqp", "osqp")
OTHER_SOLVER_ROWS = 500  # obstacles times rows; above, the other solver flies in one flight of ten: minutes else
OTHER_SOLVER_STRIDE = 10
WARM_FLIGHTS = 2  # flown first, not counted
_ACTIVE = (Verdict.ADJUSTED, Verdict.RELAXED, Verdict.BRAKING)


@dataclass(frozen=True, slots=True)
class Condition:
    """Obstacles at once, and the N of the horizon."""

    obstacles: int
    horizon: int

    @property
    def name(self) -> str:
        plural = "" if self.obstacles == 1 else "s"
        return f"{self.obstacles} obstacle{plural}, N = {self.horizon}"

    def config(self, solver: Solver | None = None) -> SafetyConfig:
        """The default configuration but for the horizon, and the solver where one is given."""
        return SafetyConfig(horizon=self.horizon, solver=solver or SafetyConfig().solver)


@dataclass(frozen=True, slots=True)
class FilterTiming:
    """Milliseconds over the active states of one condition."""

    condition: Condition
    states: int
    verdicts: dict[str, float]  # shares
    programs: float  # solved a state, mean
    rows: Quantiles  # build
    solve: Quantiles
    verify: Quantiles
    whole: Quantiles  # all three in a row
    by_verdict: dict[str, Quantiles]  # whole
    solvers: dict[str, Quantiles]  # whole, by solver, over the same `solver_states`
    solver_states: int
    rivals: dict[str, Quantiles]  # cbfpy, by solver


class _Samples:
    """Nanoseconds by name."""

    def __init__(self) -> None:
        self._taken: dict[str, list[int]] = {}

    def add(self, name: str, took_ns: int) -> None:
        self._taken.setdefault(name, []).append(took_ns)

    def count(self, name: str) -> int:
        return len(self._taken.get(name, ()))

    def told(self, name: str) -> Quantiles:
        return quantiles(self._taken[name])


def timed_step(safety_filter: SafetyFilter, inputs: FilterInput) -> tuple[FilterResult, tuple[int, int, int]]:
    """`SafetyFilter.step` and the nanoseconds of build, solve and verify."""
    began = stopwatch_ns()
    task = safety_filter.build(inputs)
    built = stopwatch_ns()
    answer = safety_filter.solve(task, inputs.elapsed_s or 0.0)
    solved = stopwatch_ns()
    result = safety_filter.verify(task, answer)
    return result, (built - began, solved - built, stopwatch_ns() - solved)


def measure_timing(condition: Condition, states: int, *, backends: tuple[str, ...], seed: int = SEED) -> FilterTiming:
    """``states`` active states of one condition; cbfpy on each of ``backends``."""
    bench = _Bench(condition, backends)
    for index, scene in enumerate(scenes(seed, condition.obstacles, bench.config)):
        if index == WARM_FLIGHTS:
            bench.forget()
        if len(bench.verdicts) >= states and index > WARM_FLIGHTS:
            break
        bench.fly(scene, states, other=index % bench.stride == 0)
    return bench.told()


class _Bench:
    """Our filter, the same with the other solver, and the rivals, all for one condition."""

    def __init__(self, condition: Condition, backends: tuple[str, ...]) -> None:
        self.condition, self.config, self._limits = condition, condition.config(), LimitsConfig()
        (other,) = [name for name in SOLVERS if name != self.config.solver]
        self._ours = SafetyFilter(self.config, self._limits)
        self._other, self._other_name = SafetyFilter(condition.config(other), self._limits), other
        many = condition.obstacles * (condition.horizon + 1) > OTHER_SOLVER_ROWS
        self.stride = OTHER_SOLVER_STRIDE if many else 1
        example = Flight(next(scenes(0, condition.obstacles, self.config)), self.config).inputs()
        self._rivals = {name: cbfpy_filter(name, example, self.config, self._limits) for name in backends}
        self.forget()

    def forget(self) -> None:
        """Start counting."""
        self.verdicts: list[Verdict] = []
        self._programs: list[int] = []
        self._samples = _Samples()

    def fly(self, scene: Scene, states: int, *, other: bool) -> None:
        """One flight, or as much of it as ``states`` in all ask for."""
        flight = Flight(scene, self.config)
        self._ours.reset()
        self._other.reset()
        while flight.ticks < FLIGHT_TICKS and len(self.verdicts) < states:
            inputs = flight.inputs()
            result, took = timed_step(self._ours, inputs)
            theirs = sum(timed_step(self._other, inputs)[1]) if other else None
            if flight.ticks and result.verdict is not Verdict.NOMINAL:
                self._count(result, took, theirs)
                for name, rival in self._rivals.items():
                    began = stopwatch_ns()
                    rival(inputs)
                    self._samples.add(name, stopwatch_ns() - began)
            flight.advance(result.a_safe)

    def _count(self, result: FilterResult, took: tuple[int, int, int], theirs: int | None) -> None:
        self.verdicts.append(result.verdict)
        self._programs.append(result.iterations)
        whole = sum(took)
        for name, part in zip(("rows", "solve", "verify", "whole"), (*took, whole), strict=True):
            self._samples.add(name, part)
        self._samples.add(result.verdict.value, whole)
        if theirs is not None:
            self._samples.add(self.config.solver, whole)
            self._samples.add(self._other_name, theirs)

    def told(self) -> FilterTiming:
        """What was counted."""
        samples, states = self._samples, len(self.verdicts)
        shares = Counter(self.verdicts)
        return FilterTiming(
            condition=self.condition,
            states=states,
            verdicts={name.value: shares[name] / states for name in _ACTIVE},
            programs=sum(self._programs) / states,
            rows=samples.told("rows"),
            solve=samples.told("solve"),
            verify=samples.told("verify"),
            whole=samples.told("whole"),
            by_verdict={name.value: samples.told(name.value) for name in _ACTIVE if shares[name]},
            solvers={name: samples.told(name) for name in SOLVERS if samples.count(name)},
            solver_states=samples.count(self._other_name),
            rivals={name: samples.told(name) for name in self._rivals},
        )
