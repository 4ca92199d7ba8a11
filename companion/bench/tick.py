"""`companion bench tick`: what a tick costs, in flight and in this process, and how long a start takes.

Three parts: the whole tick of the real daemon beside the real simulator at the pace of the clock (`tick_flight`), the
brain's tick by the number of obstacles (`tick_brain`), and start to READY (`tick_start`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from companion.bench.envelope import Figure
from companion.bench.tables import figure_table, milliseconds, titled
from companion.bench.tick_brain import BrainTiming, growth_exponent
from companion.bench.tick_flight import TickRun
from companion.bench.tick_start import Starts
from companion.bench.timing import Quantiles

RATES_HZ = (20, 50, 100)
OBSTACLES = (1, 4, 10)
MINUTES, QUICK_MINUTES = 10.0, 0.25

BRAIN_P50_MS = {1: 0.5, 10: 1.0, 100: 5.0}
BRAIN_P999_MS = 20.0  # the period of 50 Hz
EXPONENT = 1.0
READY_S = 2.0


def figures(runs: Sequence[TickRun], times: list[BrainTiming], starts: Starts | None) -> list[Figure]:
    """The measured values that ticks and starts are held to."""
    told = [
        Figure(f"{run.rate_hz} Hz, {run.obstacles} obstacles: share of deadlines missed", share, "at most", 0.0)
        for run in runs
        if (share := run.misses / (run.ticks + run.overtaken)) is not None
    ]
    told += [
        Figure(f"brain, {timing.obstacles} obstacles: p50, ms", timing.whole.p50, "at most", limit)
        for timing in times
        if (limit := BRAIN_P50_MS.get(timing.obstacles)) is not None
    ]
    told += [
        Figure(f"brain, {timing.obstacles} obstacles: p99.9, ms", timing.whole.p999, "at most", BRAIN_P999_MS)
        for timing in times
        if timing.obstacles in BRAIN_P50_MS and timing.whole.p999 is not None
    ]
    if (exponent := growth_exponent(times)) is not None:
        told.append(Figure("brain: exponent of growth from 10 to 1000 obstacles", exponent, "at most", EXPONENT))
    if starts is not None:
        told.append(
            Figure(f"start to READY, slowest of {len(starts.ready_s)}, s", starts.ready_s[-1], "at most", READY_S)
        )
    return told


def as_json(runs: Sequence[TickRun], times: list[BrainTiming], starts: Starts | None) -> dict[str, Any]:
    """Everything measured, in plain types."""
    return {
        "flights_ms": [asdict(run) for run in runs],
        "brain_ms": [asdict(timing) for timing in times],
        "growth_exponent_10_to_1000": growth_exponent(times),
        "start": None if starts is None else asdict(starts),
    }


def print_tick(runs: Sequence[TickRun], times: list[BrainTiming], starts: Starts | None, told: list[Figure]) -> None:
    """Tables for people."""
    from rich.console import Console

    console = Console()
    for run in runs:
        console.print(_flight_table(run))
    table = titled(
        "brain: track, predict, policy, filter, encode, N = 20 [ms]",
        "obstacles",
        "p50",
        "p99",
        "p99.9",
        "max",
        "on the processor p50",
        "p99.9",
        "filter acts",
    )
    for timing in times:
        used = (milliseconds(timing.processor.p50), milliseconds(timing.processor.p999))
        table.add_row(str(timing.obstacles), *_cells(timing.whole), *used, f"{timing.acting:.0%}")
    console.print(table)
    if (exponent := growth_exponent(times)) is not None:
        console.print(f"grows with the number of obstacles to the power {exponent:.2f} (10 to 1000)\n")
    if starts is not None:
        used_s = starts.processor_s[len(starts.processor_s) // 2]
        console.print(
            f"start to READY: median {starts.median_s:.2f} s, slowest {starts.ready_s[-1]:.2f} s of"
            f" {len(starts.ready_s)}, {used_s:.2f} s on the processor; resident {starts.memory_mib:.0f} MiB\n"
        )
    console.print(figure_table(told))


def _flight_table(run: TickRun) -> Any:
    table = titled(
        f"{run.rate_hz} Hz, {run.obstacles} obstacles, {run.seconds:g} s beside the simulator [ms]",
        "whole tick",
        "p50",
        "p99",
        "p99.9",
        "max",
    )
    for name, values in (
        ("state received to setpoint sent", run.to_setpoint),
        ("state received to the end of its work", run.to_end),
        ("on the processor", run.processor),
        ("jitter of the setpoints' spacing", run.interval_jitter),
        ("jitter of the states' spacing", run.state_jitter),
    ):
        table.add_row(name, *_cells(values))
    pauses = run.pauses
    table.caption = (
        f"{run.misses} of {run.ticks + run.overtaken} deadlines missed, {run.overtaken} of them by states that a newer"
        f" one overtook; garbage collected {pauses.collections} times, {pauses.inside} of them within a tick, the"
        f" longest {pauses.max_ms:.2f} ms; resident {run.memory_mib:.0f} MiB, {run.threads} threads"
    )
    return table


def _cells(values: Quantiles) -> tuple[str, ...]:
    return tuple(milliseconds(value) for value in (values.p50, values.p99, values.p999, values.max))
