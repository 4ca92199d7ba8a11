"""The command lines of `companion bench tick` and `companion bench memory`."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

TICK = """\
Flies the real daemon beside the real simulator, both as processes at the pace of the clock, ten minutes at each rate,
with the log written and every key read: the whole tick from the state received to the setpoint sent and to the end of
its work, deadline misses and jitter. Then the brain's tick in this process among 1, 10, 100 and 1000 obstacles, and
start to READY. Times on the processor leave out what others on the machine cost. The simulator is in the sim extra.
"""

MEMORY = """\
Flies the real daemon in lockstep with the real simulator for an hour of vehicle time (72 000 ticks, some minutes of
wall time) with the log written and every key read, and reads its resident memory. The simulator is in the sim extra.
"""

Report = Callable[[str, float], None]  # what is done now, and the share of all that is done


def add_arguments(tick: argparse.ArgumentParser, memory: argparse.ArgumentParser) -> None:
    """The options of both parts."""
    tick.add_argument("--minutes", type=_positive, metavar="M", help="of flight at each rate (default 10)")
    tick.add_argument(
        "--rates", type=_whole_numbers, default=(20, 50, 100), metavar="HZ,HZ", help="tick rates (default 20,50,100)"
    )
    tick.add_argument("--obstacles", type=int, choices=(1, 4, 10), default=4, help="beside the simulator (default 4)")
    tick.add_argument("--quick", action="store_true", help="15 s at each rate, a tenth of the brain's ticks, 3 starts")
    tick.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help="of the daemon (repeatable)"
    )
    memory.add_argument("--minutes", type=_positive, metavar="M", help="of vehicle time (default 60)")
    memory.add_argument("--quick", action="store_true", help="3 minutes of vehicle time")


def run_tick(arguments: argparse.Namespace, print_json: Callable[[Any], None]) -> int:
    """Measure and tell; exit status 0 whatever the figures are."""
    from companion.bench import tick, tick_brain, tick_flight, tick_start
    from companion.bench.envelope import envelope
    from companion.bench.processes import physics_hz

    minutes = arguments.minutes or (tick.QUICK_MINUTES if arguments.quick else tick.MINUTES)
    settings = tuple(arguments.overrides)
    for rate_hz in arguments.rates:
        physics_hz(rate_hz)  # a rate that does not fit is told before anything flies
    runs, times = [], []
    parts = len(arguments.rates) + 2
    with _progress() as report:
        for index, rate_hz in enumerate(arguments.rates):

            def flown(seconds: float, index: int = index, rate_hz: int = rate_hz) -> None:
                share = min(1.0, seconds / (60.0 * minutes))
                report(f"{rate_hz} Hz, {seconds:.0f} of {60.0 * minutes:.0f} s", (index + share) / parts)

            runs.append(tick_flight.fly(rate_hz, arguments.obstacles, 60.0 * minutes, flown, settings=settings))
        for count in tick_brain.COUNTS:
            report(f"brain, {count} obstacles", (parts - 2) / parts)
            times.append(tick_brain.measure_brain(count, tick_brain.repeats(count, quick=arguments.quick)))
        report("start to READY", (parts - 1) / parts)
        starts = tick_start.measure_starts(tick_start.QUICK_STARTS if arguments.quick else tick_start.STARTS)
    figures = tick.figures(runs, times, starts)
    if arguments.json:
        print_json(envelope("tick", tick.as_json(runs, times, starts), figures))
    else:
        tick.print_tick(runs, times, starts, figures)
    return 0


def run_memory(arguments: argparse.Namespace, print_json: Callable[[Any], None]) -> int:
    """Measure and tell; exit status 0 whatever the figures are."""
    from companion.bench import memory
    from companion.bench.envelope import envelope
    from companion.bench.wire import print_figures

    minutes = arguments.minutes or (memory.QUICK_MINUTES if arguments.quick else memory.MINUTES)
    with _progress() as report:

        def flown(seconds: float) -> None:
            report(f"{seconds / 60.0:.1f} of {minutes:g} minutes", min(1.0, seconds / (60.0 * minutes)))

        measured = memory.measure_memory(minutes, flown)
    figures = memory.figures(measured)
    if arguments.json:
        print_json(envelope("memory", memory.as_json(measured), figures))
    else:
        memory.print_memory(measured)
        print_figures(figures)
    return 0


@contextmanager
def _progress() -> Iterator[Report]:
    """A bar on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        bar = progress.add_task("", total=1.0)
        yield lambda what, share: progress.update(bar, description=what, completed=share)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value <= 1440.0:
        raise argparse.ArgumentTypeError(f"expected minutes, above 0 and at most 1440, got {text}")
    return value


def _whole_numbers(text: str) -> tuple[int, ...]:
    try:
        rates = tuple(int(word) for word in text.split(","))
    except ValueError:
        rates = ()
    if not rates or any(not 1 <= rate <= 400 for rate in rates):
        raise argparse.ArgumentTypeError(f"expected whole rates of 1 to 400 Hz with commas between, got {text}")
    return rates
