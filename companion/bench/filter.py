"""`companion bench filter`: time of the safety filter where it acts, its solvers beside others, and its chatter."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from companion.bench import chatter, filter_timing
from companion.bench.cbfpy_rival import GAIN_HZ, TOLERANCES
from companion.bench.chatter import Encounter
from companion.bench.envelope import Figure
from companion.bench.filter_timing import Condition, FilterTiming
from companion.bench.programs import ProgramTiming

CONDITIONS = tuple(Condition(obstacles, horizon) for horizon in (5, 20) for obstacles in (1, 10, 20, 100))
HEADLINE = (Condition(10, 5), Condition(20, 5), Condition(10, 20), Condition(100, 20))  # those with figures
STATES, QUICK_STATES = 2000, 150  # of a condition
PROGRAMS, QUICK_PROGRAMS = 1200, 30  # some are infeasible
QUICK_FLIGHTS = 2
BESIDE_CBFPY = Condition(20, 5)

# whole, milliseconds at most
LIMITS_MS = {
    Condition(10, 5): {"p50": 0.3, "p99": 0.8},
    Condition(10, 20): {"p50": 0.5},
    Condition(100, 20): {"p50": 2.0},
}
LIMITS_OVER_CBFPY = {"p50": 3.0, "p99": 0.25}


def figures(times: list[FilterTiming]) -> list[Figure]:
    """The measured values that the filter is held to; none of a quantile of too few samples."""
    return [figure for timing in times for figure in _figures(timing)]


def _figures(timing: FilterTiming) -> Iterator[Figure]:
    ours, at = asdict(timing.whole), timing.condition.name
    for quantile, limit in LIMITS_MS.get(timing.condition, {}).items():
        if ours[quantile] is not None:
            yield Figure(f"{at}: {quantile} of the whole, ms", ours[quantile], "at most", limit)
    if timing.condition != BESIDE_CBFPY:
        return
    for backend, rival in timing.rivals.items():
        theirs = asdict(rival)
        for quantile, limit in LIMITS_OVER_CBFPY.items():
            if ours[quantile] is not None and theirs[quantile] is not None:
                ratio = ours[quantile] / theirs[quantile]
                yield Figure(f"{at}: {quantile} over that of cbfpy ({backend})", ratio, "at most", limit)


def as_json(
    times: list[FilterTiming], programs: list[ProgramTiming], encounters: list[Encounter], free_s: float
) -> dict[str, Any]:
    """Everything measured, in plain types."""
    return {
        "seeds": {"states": filter_timing.SEED, "flights": chatter.SEED},
        "rivals": {name: _version(name) for name in ("cbfpy", "qpax", "elastiqp", "jax", "quadprog", "daqp", "osqp")},
        "cbfpy_formulation": {"gain_hz": GAIN_HZ, "tolerance": TOLERANCES},
        "default_solver": Condition(1, 5).config().solver,
        "timing_ms": [{**asdict(timing), "name": timing.condition.name} for timing in times],
        "programs_ms": [{**asdict(timing), "name": timing.condition.name} for timing in programs],
        "free_flight_s": free_s,
        "flights": [asdict(encounter) for encounter in encounters],
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
