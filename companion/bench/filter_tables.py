"""What `companion bench filter` has measured, as tables for people."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from companion.bench.chatter import Encounter
from companion.bench.envelope import Figure
from companion.bench.filter_timing import FilterTiming
from companion.bench.programs import SOLVERS, ProgramTiming
from companion.bench.tables import figure_table, milliseconds, titled
from companion.bench.timing import Quantiles

_QUANTILES = ("p50", "p99", "p99.9", "max")


def print_filter(
    times: list[FilterTiming],
    programs: list[ProgramTiming],
    encounters: list[Encounter],
    free_s: float,
    figures: list[Figure],
) -> None:
    """All tables of `companion bench filter`."""
    console = Console(width=130, markup=False)  # brackets are units
    console.print(_parts_table(times))
    console.print(_rivals_table(times))
    console.print(_states_table(times))
    console.print(_programs_table(programs))
    console.print(_flights_table(encounters, free_s))
    console.print(figure_table(figures))


def _told(quantiles: Quantiles) -> list[str]:
    return [milliseconds(value) for value in (quantiles.p50, quantiles.p99, quantiles.p999, quantiles.max)]


def _parts_table(times: list[FilterTiming]) -> Table:
    told = titled("time of the filter's parts over active states [ms]", "condition", "part", *_QUANTILES)
    told.caption = "-: too few samples"
    for timing in times:
        parts = {"rows": timing.rows, "solve": timing.solve, "verify": timing.verify, "whole": timing.whole}
        for index, (name, quantiles) in enumerate(parts.items()):
            told.add_row("" if index else timing.condition.name, name, *_told(quantiles))
        told.add_section()
    return told


def _rivals_table(times: list[FilterTiming]) -> Table:
    told = titled("whole filter, by solver, and cbfpy [ms]", "condition", "filter", "states", *_QUANTILES)
    for timing in times:
        rows = [(f"ours ({name})", timing.solver_states, each) for name, each in timing.solvers.items()]
        rows += [(f"cbfpy ({name})", timing.states, each) for name, each in timing.rivals.items()]
        for index, (name, states, quantiles) in enumerate(rows):
            told.add_row("" if index else timing.condition.name, name, str(states), *_told(quantiles))
        told.add_section()
    return told


def _states_table(times: list[FilterTiming]) -> Table:
    told = titled(
        "what the states are",
        "condition",
        "states",
        "adjusted",
        "relaxed",
        "braking",
        "programs",
        "adjusted p50 [ms]",
        "p99",
        "relaxed p50",
        "p99",
    )
    for timing in times:
        shares = [f"{timing.verdicts[name]:.0%}" for name in ("adjusted", "relaxed", "braking")]
        cells = []
        for name in ("adjusted", "relaxed"):
            quantiles = timing.by_verdict.get(name)
            cells += ["-", "-"] if quantiles is None else [milliseconds(quantiles.p50), milliseconds(quantiles.p99)]
        told.add_row(timing.condition.name, str(timing.states), *shares, f"{timing.programs:.2f}", *cells)
    return told


def _programs_table(programs: list[ProgramTiming]) -> Table:
    told = titled(
        "the filter's programs in every solver [ms]; apart: greatest difference of the minimiser from DAQP's",
        "condition",
        "up to",
        "solver",
        "programs",
        *_QUANTILES,
        "no answer",
        "apart",
    )
    told.caption = f"{sum(timing.infeasible for timing in programs)} infeasible ones left out"
    if any("quadprog" in timing.solvers for timing in programs):
        told.caption += f", {sum(timing.disputed for timing in programs)} of which quadprog solves"
        told.caption += "; quadprog without the making of its matrices"
    for timing in programs:
        size = f"{timing.variables} x {timing.rows}"
        names = [name for name in SOLVERS if name in timing.solvers or name in timing.failed]
        for index, name in enumerate(names):
            head = ("", "") if index else (timing.condition.name, size)
            quantiles = timing.solvers.get(name)
            times = ["-"] * len(_QUANTILES) if quantiles is None else _told(quantiles)
            apart = f"{timing.apart[name]:.0e}" if name in timing.apart else "-"
            told.add_row(*head, name, str(timing.programs), *times, str(timing.failed.get(name, 0)), apart)
        if not names:
            told.add_row(timing.condition.name, "-", "none seen")
        told.add_section()
    return told


def _flights_table(encounters: list[Encounter], free_s: float) -> Table:
    told = titled(
        f"chatter: flights of 8 m at N = 20, {free_s:.2f} s without obstacles",
        "encounter",
        "sigma [m]",
        "flights",
        "sign changes",
        "most",
        "adjusted",
        "relaxed",
        "braking",
        "arrived",
        "time [s]",
        "clearance [m]",
    )
    told.caption = "sign changes: in all flights, and the most in one; time: mean; clearance: the least"
    for encounter in encounters:
        flights = encounter.flights
        count = len(flights)
        arrivals = [flight.arrival_s for flight in flights if flight.arrival_s is not None]
        shares = [
            sum(getattr(flight, name) for flight in flights) / count for name in ("adjusted", "relaxed", "braking")
        ]
        told.add_row(
            encounter.name,
            f"{encounter.sigma_m:g}",
            str(count),
            str(sum(flight.turns for flight in flights)),
            str(max(flight.turns for flight in flights)),
            *(f"{share:.1%}" for share in shares),
            f"{len(arrivals)}/{count}",
            f"{sum(arrivals) / len(arrivals):.2f}" if arrivals else "-",
            f"{min(flight.clearance_m for flight in flights):.3f}",
        )
    return told
