"""What a bench has measured, as tables for people."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.table import Table

from companion.bench.crossing import CrossingResult
from companion.bench.envelope import Figure
from companion.bench.motions import MOTIONS
from companion.bench.timing import Timing
from companion.bench.tracking import HEADLINE, CellResult

_ORDER = ("hindsight", "ours", "paper", "CV only", "CA only", "filterpy IMM")


def print_tracking(
    results: list[CellResult],
    crossings: Mapping[int, Mapping[str, CrossingResult]],
    times: list[Timing],
    figures: list[Figure],
) -> None:
    """All tables of `companion bench tracking`."""
    console = Console(width=130, markup=False)  # brackets are units
    for result in results:
        if result.cell in HEADLINE:
            console.print(_ahead_table(result))
            console.print(_ours_table(result))
    others = [result for result in results if result.cell not in HEADLINE]
    if others:
        console.print(_cells_table(others))
    console.print(_crossing_table(crossings))
    console.print(_time_table(times))
    console.print(figure_table(figures))


def titled(title: str, *columns: str) -> Table:
    """A table whose first column is text, the others aligned to the right."""
    table = Table(title=title, title_justify="left", title_style="bold")
    table.add_column(columns[0], no_wrap=True)
    for column in columns[1:]:
        table.add_column(column, justify="right")
    return table


def _names(result: CellResult) -> list[str]:
    return [name for name in _ORDER if name in result.filters]


def _ahead_table(result: CellResult) -> Table:
    names = _names(result)
    table = titled(f"{result.cell.name}: RMSE of the position 0.25 s ahead [m]", "motion", *names, "ours / hindsight")
    for index, motion in enumerate(MOTIONS):
        values = {name: float(result.filters[name].ahead_m[0][index]) for name in names}
        ratio = values["ours"] / values["hindsight"]
        table.add_row(motion.name, *(f"{values[name]:.3f}" for name in names), f"{ratio:.2f}")
    means = {name: float(result.filters[name].ahead_m[0].mean()) for name in names}
    table.add_section()
    table.add_row("mean", *(f"{means[name]:.3f}" for name in names), f"{means['ours'] / means['hindsight']:.2f}")
    return table


def _ours_table(result: CellResult) -> Table:
    title = f"{result.cell.name}: ours, and hindsight in brackets"
    table = titled(title, "motion", "now [m]", "velocity [m/s]", "+0.5 s [m]", "in 95 % at +0.25 s", "NEES (true: 3)")
    ours, best = result.filters["ours"], result.filters["hindsight"]
    for index, motion in enumerate(MOTIONS):
        pairs = [(ours.now_m, best.now_m), (ours.velocity_m_s, best.velocity_m_s), (ours.ahead_m[1], best.ahead_m[1])]
        cells = [f"{one[index]:.3f} ({other[index]:.3f})" for one, other in pairs]
        stated = (ours.coverage, ours.nees)
        table.add_row(motion.name, *cells, *("-" if values is None else f"{values[index]:.3f}" for values in stated))
    table.caption = f"{ours.lost} tracks lost, {ours.restarted} detections taken for outliers"
    return table


def _cells_table(results: list[CellResult]) -> Table:
    names = _ORDER[:-1]
    table = titled(
        "other conditions: mean RMSE of the position 0.25 s ahead [m]",
        "condition",
        *names,
        "ours / hindsight",
        "least coverage",
        "coverage",
    )
    for result in results:
        means = {name: float(result.filters[name].ahead_m[0].mean()) for name in names}
        coverage = result.filters["ours"].coverage
        table.add_row(
            result.cell.name,
            *(f"{means[name]:.3f}" for name in names),
            f"{means['ours'] / means['hindsight']:.2f}",
            "-" if coverage is None else f"{coverage.min():.3f}",
            "-" if coverage is None else f"{coverage.mean():.3f}",
        )
    return table


def _crossing_table(crossings: Mapping[int, Mapping[str, CrossingResult]]) -> Table:
    table = titled(
        "ten anonymous obstacles crossing for 60 s, 5 % clutter, 5 % lost, sigma 0.05 m",
        "filter",
        *(f"swaps, seed {seed}" for seed in crossings),
        "obstacle ticks without track",
        "false tracks a tick",
    )
    names = next(iter(crossings.values()), {})
    for name in names:
        rows = [filters[name] for filters in crossings.values()]
        lost = sum(row.lost_share for row in rows) / len(rows)
        false = sum(row.false_share for row in rows) / len(rows)
        table.add_row(name, *(str(row.swaps) for row in rows), f"{lost:.2%}", f"{false:.3f}")
    return table


def _time_table(times: list[Timing]) -> Table:
    table = titled(
        "time [ms]: update from a frame, prediction of 22 instants with covariance; filterpy: update only",
        "obstacles",
        "update p50",
        "predict p50",
        "both p50",
        "p99",
        "p99.9",
        "max",
        "filterpy p50",
        "p99",
        "times faster",
    )
    table.caption = "-: too few samples"
    for timing in times:
        both, theirs = timing.both, timing.filterpy
        ours = (timing.update.p50, timing.predict.p50, both.p50, both.p99, both.p999, both.max)
        rival = (None, None) if theirs is None else (theirs.p50, theirs.p99)
        speed_up = "-" if timing.speed_up is None else f"{timing.speed_up:.0f}"
        table.add_row(str(timing.obstacles), *(milliseconds(value) for value in (*ours, *rival)), speed_up)
    return table


def milliseconds(value: float | None) -> str:
    """A table's cell; None: too few samples."""
    return "-" if value is None else f"{value:.3f}"


def figure_table(figures: list[Figure]) -> Table:
    """Every figure beside its limit."""
    table = titled("figures", "figure", "measured", "limit", "")
    for figure in figures:
        limit = f"{figure.relation} {figure.limit:g}"
        table.add_row(figure.name, f"{figure.value:.3f}", limit, "met" if figure.met else "MISSED")
    return table
