"""`companion bench PART`: measures a part of the daemon beside its rivals, in one run, on this machine."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

import msgspec

from companion.bench import tick_command

_EPILOG = """\
examples:
  companion bench tracking                accuracy, identity and time of the tracker beside its rivals (minutes)
  companion bench tracking --quick        the two headline conditions on fewer trials (under two minutes)
  companion bench tracking --json > tracking.json
  companion bench filter                  time of the safety filter beside cbfpy, OSQP and quadprog (minutes)
  companion bench filter --quick --json   fewer states and flights, one JSON object
  companion bench wire                    obstacle frame to setpoint on real sockets, and messages parsed a second
  companion bench tick                    the whole tick beside the simulator at 20, 50 and 100 Hz (half an hour)
  companion bench tick --quick --json     15 s at each rate, one JSON object
  companion bench memory                  resident memory over an hour of vehicle time (some minutes)
"""

_TRACKING = """\
Tracks nine fixed motions (straight, accelerating, circle, three figure eights, climbing turn, jink, dash and stop)
with our tracker, the paper's settings, CV alone, CA alone, filterpy's IMM and the hindsight filter (per motion the
best of CV and CA over a grid of process noise), all on the same measurements. Then ten anonymous obstacles that cross
for a minute, and the time of an update and prediction beside filterpy's update loop. Seeds are fixed, and disjoint
from those that anything was tuned on. filterpy is part of the dev extra; without it its rows are left out.
"""

_FILTER = """\
Times the safety filter (rows, solve, verify, whole) over states in which some row refuses the reference, with 1, 10,
20 and 100 obstacles and N = 5 and 20: with DAQP and with OSQP, and beside cbfpy, compiled, on its own double integrator
with the same obstacles. The filter's programs are given to DAQP, OSQP and quadprog too. Then whole flights past
obstacles, with and without noise, in which sign changes of the correction are counted. Seeds are fixed. cbfpy and
quadprog are in the bench extra; without them their columns are left out.
"""

_WIRE = """\
Runs the daemon as a process on real UDP and Zenoh sockets of the loopback, beside an autopilot that streams its state
at 50 Hz and a sensor that publishes ten obstacles at random phases, and measures from the publication of a frame to
the first setpoint that knows it, beyond its wait for the next state message. Then messages a second off a UDP socket,
by our transport and codec and by pymavlink's mavutil, in turn. Then a load of 1000 frames of 20 obstacles and 2000
MAVLink messages a second for a minute: ticks lost, and memory.
"""

TICKS = 1000  # timed with one and ten obstacles, a tenth with a hundred


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The `bench` command with one subcommand a part."""
    bench = commands.add_parser(
        "bench",
        help="measure a part beside its rivals",
        description="Measure a part of the daemon beside its rivals.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parts = bench.add_subparsers(dest="part", required=True, metavar="PART")
    tracking = _add_part(parts, "tracking", _tracking, "the tracker: accuracy, covariance, identity, time", _TRACKING)
    depth = tracking.add_mutually_exclusive_group()
    depth.add_argument("--quick", action="store_true", help="the headline conditions only, on four trials a motion")
    depth.add_argument("--all", action="store_true", help="every combination of noise, rate, dropout and latency")
    depth.add_argument(
        "--tune-rivals", action="store_true", help="instead: search the rivals' process noises on the tuning seed"
    )
    safety = _add_part(parts, "filter", _filter, "the safety filter: time where it acts, solvers, chatter", _FILTER)
    safety.add_argument("--quick", action="store_true", help="the conditions with figures only, on fewer states")
    wire = _add_part(parts, "wire", _wire, "obstacle frame to setpoint, and messages parsed a second", _WIRE)
    wire.add_argument("--quick", action="store_true", help="12 s of flight instead of 90, 10 s of load instead of 60")
    told = "the whole tick beside the simulator, deadlines, the brain by obstacles, start to READY"
    tick = _add_part(parts, "tick", partial(tick_command.run_tick, print_json=_print_json), told, tick_command.TICK)
    told = "resident memory of the daemon over an hour of vehicle time"
    run = partial(tick_command.run_memory, print_json=_print_json)
    tick_command.add_arguments(tick, _add_part(parts, "memory", run, told, tick_command.MEMORY))


def _add_part(
    parts: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    handler: Callable[[argparse.Namespace], int],
    told: str,
    description: str,
) -> argparse.ArgumentParser:
    """A subcommand with what all of them have."""
    part = parts.add_parser(
        name,
        help=told,
        description=description,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    part.add_argument("--json", action="store_true", help="one JSON object on stdout, nothing else there")
    part.set_defaults(handler=handler)
    return part


def _tracking(arguments: argparse.Namespace) -> int:
    from companion.bench import tracking
    from companion.bench.accuracy import Cell
    from companion.bench.envelope import envelope
    from companion.bench.tables import print_tracking
    from companion.bench.timing import Timing

    filterpy = importlib.util.find_spec("filterpy") is not None
    if arguments.tune_rivals:
        if not filterpy:
            print("companion: bench tracking: --tune-rivals needs filterpy (the dev extra)", file=sys.stderr)
            return 2
        return _tune_rivals()
    trials = 4 if arguments.quick else tracking.TRIALS
    cells = list(tracking.HEADLINE) if arguments.quick else tracking.cells(every=arguments.all)
    seeds = tracking.CROSSING_SEEDS[:1] if arguments.quick else tracking.CROSSING_SEEDS
    results: list[tracking.CellResult] = []
    crossings: dict[int, Any] = {}
    times: list[Timing] = []

    def measure_cell(cell: Cell) -> None:
        headline = filterpy and cell in tracking.HEADLINE
        results.append(tracking.measure_cell(cell, seed=tracking.REPORT_SEED, trials=trials, filterpy=headline))

    def measure_crossing(seed: int) -> None:
        crossings[seed] = tracking.measure_crossing(seed, filterpy=filterpy)

    def measure_times() -> None:
        times.extend(tracking.measure_times(filterpy=filterpy, repeats=TICKS))

    jobs: list[tuple[str, Callable[[], None]]] = [("time", measure_times)]  # first, while nothing else is warm
    jobs += [(cell.name, partial(measure_cell, cell)) for cell in cells]
    jobs += [(f"crossing, seed {seed}", partial(measure_crossing, seed)) for seed in seeds]
    _run(jobs)
    figures = tracking.figures(results, crossings, times)
    if arguments.json:
        _print_json(envelope("tracking", tracking.as_json(results, crossings, times), figures))
    else:
        print_tracking(results, crossings, times, figures)
    return 0


def _filter(arguments: argparse.Namespace) -> int:
    from companion.bench import cbfpy_rival, chatter, filter, programs
    from companion.bench.envelope import envelope
    from companion.bench.filter_tables import print_filter
    from companion.bench.filter_timing import Condition, FilterTiming, measure_timing

    backends = cbfpy_rival.backends()
    for name, present in (("cbfpy", bool(backends)), ("quadprog", programs.available())):
        if not present:
            print(f"companion: bench filter: without {name}: {cbfpy_rival.HOW_TO_INSTALL}", file=sys.stderr)
    quick = arguments.quick
    conditions = filter.HEADLINE if quick else filter.CONDITIONS
    states, count = (filter.QUICK_STATES, filter.QUICK_PROGRAMS) if quick else (filter.STATES, filter.PROGRAMS)
    flights = filter.QUICK_FLIGHTS if quick else chatter.FLIGHTS
    times: list[FilterTiming] = []
    solved: list[programs.ProgramTiming] = []
    encounters: list[chatter.Encounter] = []

    def measure(condition: Condition) -> None:
        times.append(measure_timing(condition, states, backends=backends))
        solved.append(programs.measure_programs(condition, count))

    def fly(name: str, sigma_m: float) -> None:
        encounters.append(chatter.measure_encounter(name, sigma_m, flights))

    jobs: list[tuple[str, Callable[[], None]]] = [(one.name, partial(measure, one)) for one in conditions]
    jobs += [(f"{name}, sigma {s:g}", partial(fly, name, s)) for s in chatter.SIGMAS_M for name in chatter.ENCOUNTERS]
    _run(jobs)
    figures, free_s = filter.figures(times), chatter.free_s()
    if arguments.json:
        _print_json(envelope("filter", filter.as_json(times, solved, encounters, free_s), figures))
    else:
        print_filter(times, solved, encounters, free_s, figures)
    return 0


def _wire(arguments: argparse.Namespace) -> int:
    from companion.bench import wire, wire_load
    from companion.bench.envelope import envelope

    measured: list[Any] = []
    seconds = wire_load.QUICK_LOAD_S if arguments.quick else wire_load.LOAD_S
    _run(
        [
            ("the wire", lambda: measured.extend(wire.measure(quick=arguments.quick))),
            ("the load", lambda: measured.append(wire_load.measure_load(seconds))),
        ]
    )
    latency, parsing, load = measured
    figures = [*wire.figures(latency), *wire_load.figures(load)]
    if arguments.json:
        _print_json(envelope("wire", wire.as_json(latency, parsing) | {"load": asdict(load)}, figures))
    else:
        wire.print_wire(latency, parsing)
        wire_load.print_load(load)
        wire.print_figures(figures)
    return 0


def _tune_rivals() -> int:
    from companion.bench import tracking

    found: dict[str, Any] = {}
    _run([("the rivals' process noises", lambda: found.update(tracking.tune_rivals(tracking.TRIALS)))])
    _print_json(found)
    return 0


def _run(jobs: list[tuple[str, Callable[[], None]]]) -> None:
    """One after the other, with a progress bar on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (
        BarColumn(),
        TextColumn("{task.completed}/{task.total}"),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        bar = progress.add_task("", total=len(jobs))
        for name, job in jobs:
            progress.update(bar, description=name)
            job()
            progress.advance(bar)


def _print_json(value: Any) -> None:
    print(msgspec.json.format(msgspec.json.encode(value), indent=2).decode())
