"""Many encounters at once: a pool of processes that flies them, and their figures.

An outcome depends on its seed alone and outcomes are put in order of seed, so the report is the same for any number
of processes.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from companion.config import Config
from companion.errors import CompanionError
from companion.policy import load_policy
from companion.types import Vec3
from policies.evaluation.encounters import Outcome, Reference, Sensor, outcome_of
from policies.evaluation.statistics import wilson

CHUNKS_PER_JOB = 8
MAX_CHUNK = 8  # encounters: a few seconds, so that the progress moves


@dataclass(frozen=True, slots=True)
class Report:
    """A set of encounters in figures; a figure of nothing is None."""

    flights: int
    collisions: int
    collision_rate_95: tuple[float, float]  # Wilson interval
    deadlocks: int  # target not reached within the time-out
    time_ratio_mean: float | None
    time_ratio_p95: float | None
    clearance_p1_p10_p50_m: tuple[float, float, float]
    verdict_shares: dict[str, float]  # of all ticks
    relaxed_ticks_per_flight: float
    reversals_per_flight: float
    collided_seeds: tuple[int, ...]
    deadlocked_seeds: tuple[int, ...]

    def to_json(self) -> dict[str, Any]:
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}


def report(outcomes: Iterable[Outcome]) -> Report:
    """The figures of at least one outcome, whatever their order."""
    flown = sorted(outcomes, key=lambda outcome: outcome.seed)
    number = len(flown)
    verdicts = sum((Counter(outcome.verdicts) for outcome in flown), Counter[str]())
    ticks = max(sum(outcome.ticks for outcome in flown), 1)
    ratios = [outcome.time_ratio for outcome in flown if outcome.time_ratio is not None]
    p1, p10, p50 = np.percentile([outcome.clearance_m for outcome in flown], (1, 10, 50)).tolist()
    collided = tuple(outcome.seed for outcome in flown if outcome.collided)
    deadlocked = tuple(outcome.seed for outcome in flown if not outcome.reached)
    return Report(
        flights=number,
        collisions=len(collided),
        collision_rate_95=wilson(len(collided), number),
        deadlocks=len(deadlocked),
        time_ratio_mean=math.fsum(ratios) / len(ratios) if ratios else None,
        time_ratio_p95=float(np.percentile(ratios, 95)) if ratios else None,
        clearance_p1_p10_p50_m=(p1, p10, p50),
        verdict_shares={name: count / ticks for name, count in sorted(verdicts.items())},
        relaxed_ticks_per_flight=verdicts["relaxed"] / number,
        reversals_per_flight=sum(outcome.reversals for outcome in flown) / number,
        collided_seeds=collided,
        deadlocked_seeds=deadlocked,
    )


def run(seeds: range, count: int, config: Config, reference: Reference, sensor: Sensor) -> Report:
    """Fly one encounter a seed in this process, with any reference."""
    return report(outcome_of(seed, count, config, reference, sensor) for seed in seeds)


def shipped_reference(config: Config) -> Reference:
    """The configured policy, each axis held to the limit less the disturbance reserve, as in the pilot.

    Raises:
        ArtifactError: the policy cannot be flown with this configuration.
    """
    policy, limit = load_policy(config.policy, config.limits), config.reference_limit_m_s2

    def act(v_enu: Vec3, e_enu: Vec3) -> Vec3:
        return np.clip(policy.act(v_enu, e_enu), -limit, limit)

    return act


def fly_all(
    seeds: range,
    count: int,
    config: Config,
    sensor: Sensor,
    *,
    jobs: int,
    on_outcome: Callable[[Outcome], None] = lambda _: None,
) -> list[Outcome]:
    """One encounter a seed with the configured policy, in ``jobs`` processes; in order of seed.

    ``on_outcome`` sees each as it comes in. An interrupt ends the processes and passes on.

    Raises:
        ArtifactError: the policy cannot be flown with this configuration.
        CompanionError: a process died.
    """
    shipped_reference(config)  # what is wrong with it is told here, before any process starts
    size = max(1, min(MAX_CHUNK, len(seeds) // (CHUNKS_PER_JOB * jobs)))
    chunks = [seeds[first : first + size] for first in range(0, len(seeds), size)]
    outcomes: list[Outcome] = []
    with _workers(min(jobs, len(chunks))) as pool:
        for done in as_completed(_start(pool, chunks, count, config, sensor)):
            try:
                flown = done.result()
            except BrokenProcessPool:
                raise CompanionError("encounters: a worker process died, expected it to answer") from None
            for outcome in flown:
                outcomes.append(outcome)
                on_outcome(outcome)
    return sorted(outcomes, key=lambda outcome: outcome.seed)


def _start(
    pool: ProcessPoolExecutor, chunks: list[range], count: int, config: Config, sensor: Sensor
) -> list[Future[list[Outcome]]]:
    """All chunks handed in, which also starts the processes: single-threaded and deaf to Ctrl-C.

    The terminal sends an interrupt to them too, and each would print its own traceback; this process ends them.
    Environment and signal mask are inherited at the start, before a worker has imported anything.
    """
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    before = {name: os.environ.get(name) for name in threads}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        os.environ.update(dict.fromkeys(threads, "1"))
        return [pool.submit(_fly_chunk, chunk, count, config, sensor) for chunk in chunks]
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def _workers(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """A pool whose processes are ended at once, mid-flight, where the block is left by an exception."""
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"))
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        raise
    finally:
        pool.shutdown()


def _fly_chunk(seeds: range, count: int, config: Config, sensor: Sensor) -> list[Outcome]:
    reference = shipped_reference(config)
    return [outcome_of(seed, count, config, reference, sensor) for seed in seeds]
