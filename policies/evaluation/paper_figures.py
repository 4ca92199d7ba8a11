"""Figures 5 to 13 of the paper, from our flights: paths, distance to the obstacle, and state, for each case."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from policies.evaluation.paper import Flown

COLOURS = {"RL+ACBF": "#0072b2", "PID+ACBF": "#d55e00", "Pure RL": "#009e73"}  # readable by colour-blind people
STYLES = {"RL+ACBF": "-", "PID+ACBF": "--", "Pure RL": "-."}
_INK, _GREY = "#222222", "#999999"
NUMBERS = {  # of the paper's figures: paths, distance, state
    "case1": (5, 6, 7),
    "case2": (9, 10, 8),
    "case3": (11, 12, 13),
}
TITLES = {
    "case1": "Case 1: linear obstacle",
    "case2": "Case 2: accelerated obstacle",
    "case3": "Case 3: figure eight",
}


def draw_case(case: str, flights: dict[str, Flown], target: tuple[float, ...], folder: Path, note: str) -> list[Path]:
    """Three PNGs of one case; ``flights`` by method, as in the legend."""
    paths, distance, state = NUMBERS[case]
    title = f"{TITLES[case]} ({note})"
    made = {
        folder / f"figure{paths:02d}_{case}_paths.png": _paths(title, flights, target),
        folder / f"figure{distance:02d}_{case}_distance.png": _distance(title, flights),
        folder / f"figure{state:02d}_{case}_state.png": _state(title, flights),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for path, figure in made.items():
        figure.savefig(path, dpi=110)
    return list(made)


def _figure(width: float, height: float) -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _paths(title: str, flights: dict[str, Flown], target: tuple[float, ...]) -> Any:
    figure = _figure(8.0, 6.0)
    axes = figure.add_subplot(projection="3d")
    for name, flight in flights.items():
        axes.plot(*flight.p_enu.T, STYLES[name], color=COLOURS[name], linewidth=2.0, label=name)
        axes.plot(*flight.obstacle_enu.T, ":", color=COLOURS[name], linewidth=1.2, label=f"its obstacle ({name})")
        if flight.collided:
            axes.scatter(*flight.p_enu[-1], color=COLOURS[name], marker="x", s=90, linewidths=3.0)
    first = next(iter(flights.values()))
    axes.scatter(*first.p_enu[0], color=_INK, marker="o", s=40, label="start")
    axes.scatter(*target, color=_INK, marker="*", s=140, label="target")
    _fair(axes, flights)
    axes.set(xlabel="east [m]", ylabel="north [m]", zlabel="up [m]", title=title)
    axes.legend(loc="upper left", fontsize=9)
    return figure


def _fair(axes: Any, flights: dict[str, Flown]) -> None:
    """One scale for all three axes, over what the vehicles covered."""
    low = [min(float(f.p_enu[:, i].min()) for f in flights.values()) - 0.5 for i in range(3)]
    high = [max(float(f.p_enu[:, i].max()) for f in flights.values()) + 0.5 for i in range(3)]
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect([max(most - least, 1.0) for least, most in zip(low, high, strict=True)])


def _distance(title: str, flights: dict[str, Flown]) -> Any:
    figure = _figure(8.0, 4.0)
    axes = figure.subplots()
    for name, flight in flights.items():
        axes.plot(flight.t_s, flight.distance_m, STYLES[name], color=COLOURS[name], label=name)
        if flight.collided:
            axes.plot(flight.t_s[-1], 0.0, "x", color=COLOURS[name], markersize=10, markeredgewidth=3)
    axes.axhline(0.0, color=_INK, linewidth=1.0)
    axes.set(xlabel="time [s]", ylabel="distance between surfaces [m]", title=title, ylim=(-0.2, None))
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def _state(title: str, flights: dict[str, Flown]) -> Any:
    figure = _figure(11.0, 7.0)
    grid = figure.subplots(3, 3, sharex=True)
    kinds = (("p_enu", "position [m]"), ("v_enu", "velocity [m/s]"), ("a_enu", "acceleration [m/s$^2$]"))
    for row, (field, label) in enumerate(kinds):
        for column, axis in enumerate(("east", "north", "up")):
            axes = grid[row][column]
            for name, flight in flights.items():
                values = getattr(flight, field)[:, column]
                axes.plot(flight.t_s, values, STYLES[name], color=COLOURS[name], label=name, linewidth=1.3)
            axes.grid(alpha=0.3)
            if row == 0:
                axes.set_title(axis)
            if column == 0:
                axes.set_ylabel(label)
            if row == 2:
                axes.set_xlabel("time [s]")
    grid[0][0].legend(fontsize=8)
    figure.suptitle(title)
    return figure
