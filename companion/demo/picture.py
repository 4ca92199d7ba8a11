"""The picture of a flight: the 3-D path with every obstacle at its closest approach, and clearance over time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from companion.demo.flight import FlightResult
from companion.types import FloatArray

_INK, _PATH = "#222222", "#0072b2"
_OBSTACLES = ("#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f")  # readable by colour-blind people


def draw(described: dict[str, Any], flight: FlightResult, path: Path) -> None:
    """Write the PNG; positions are the simulator's truth, ENU [m]."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    trace = _trace(flight.trace)
    figure = Figure(figsize=(13.0, 5.2))
    space = figure.add_axes((0.0, 0.0, 0.6, 0.9), projection="3d")
    over_time = figure.add_axes((0.66, 0.12, 0.32, 0.74))
    _draw_space(space, described, flight, trace)
    _draw_clearance(over_time, described, flight, trace)
    outcome = "touched an obstacle" if flight.simulator["collided"] else "touched nothing"
    arrival = "reached the target" if flight.simulator["reached"] else "did not reach the target"
    figure.suptitle(f"{flight.simulator['scenario']}, seed {flight.simulator['seed']}: {arrival}, {outcome}")
    figure.savefig(path, dpi=110)


def _trace(path: Path) -> dict[str, FloatArray]:
    """Time since offboard (T,), vehicle (T, 3) and obstacles (T, M, 3) from the entry into offboard on."""
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    flown = [line for line in lines if line["offboard_s"] is not None]
    return {
        "t_s": np.array([line["offboard_s"] for line in flown]),
        "vehicle": np.array([line["position"] for line in flown]).reshape(-1, 3),
        "obstacles": np.array([line["obstacles"] for line in flown]).reshape(len(flown), -1, 3),
    }


def _draw_space(axes: Any, described: dict[str, Any], flight: FlightResult, trace: dict[str, FloatArray]) -> None:
    vehicle, obstacles = trace["vehicle"], trace["obstacles"]
    axes.plot(*vehicle.T, color=_PATH, linewidth=2.0, label="vehicle")
    axes.scatter(*vehicle[0], color=_PATH, marker="o", s=30)
    axes.scatter(*described["target"], color=_INK, marker="*", s=120, label="target")
    by_id = {approach["id"]: approach for approach in flight.simulator["approaches"]}
    for index, obstacle in enumerate(described["obstacles"]):
        colour = _OBSTACLES[index % len(_OBSTACLES)]
        axes.plot(*obstacles[:, index].T, color=colour, linewidth=1.0, linestyle="--", alpha=0.7)
        approach = by_id.get(obstacle["id"])
        if approach is None:
            continue
        label = f"{obstacle['id']}: {approach['clearance_m']:.2f} m at {approach['t_s']:.1f} s"
        _sphere(axes, approach["p_obstacle_enu"], obstacle["radius_m"], colour, label)
        _sphere(axes, approach["p_enu"], 0.2, _PATH, None)
        axes.plot(*np.array([approach["p_enu"], approach["p_obstacle_enu"]]).T, color=colour, linewidth=1.0)
    points = np.concatenate([vehicle, obstacles.reshape(-1, 3)])
    low, high = points.min(axis=0) - 0.3, points.max(axis=0) + 0.3
    low[2], high[2] = min(low[2], 0.5), max(high[2], 2.5)  # not so flat that the axis is unreadable
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.15)
    axes.set(ylabel="north [m]", zlabel="up [m]", title="path, obstacles at closest approach")
    axes.set_xlabel("east [m]", labelpad=14.0)
    for artist in (*axes.lines, *axes.collections):
        artist.set_clip_on(False)  # enlarged, the box reaches beyond its frame
    axes.locator_params(axis="z", nbins=3)
    axes.locator_params(axis="y", nbins=4)
    axes.view_init(elev=42.0, azim=-78.0)
    axes.legend(loc="upper left", fontsize=8, bbox_to_anchor=(0.0, 1.0))


def _sphere(axes: Any, centre: list[float], radius_m: float, colour: str, label: str | None) -> None:
    polar, azimuth = np.mgrid[0.0 : np.pi : 13j, 0.0 : 2.0 * np.pi : 25j]
    unit = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    axes.plot_surface(*(np.array(centre)[:, None, None] + radius_m * unit), color=colour, alpha=0.6, linewidth=0)
    if label is not None:
        axes.plot([], [], color=colour, linewidth=4.0, label=label)


def _draw_clearance(axes: Any, described: dict[str, Any], flight: FlightResult, trace: dict[str, FloatArray]) -> None:
    t_s, vehicle = trace["t_s"], trace["vehicle"]
    for index, obstacle in enumerate(described["obstacles"]):
        distance = np.linalg.norm(trace["obstacles"][:, index] - vehicle, axis=1)
        clearance = distance - obstacle["radius_m"] - 0.2
        colour = _OBSTACLES[index % len(_OBSTACLES)]
        axes.plot(t_s, clearance, color=colour, linewidth=1.5, label=obstacle["id"])
    axes.axhspan(-1.0, 0.0, color="#cc0000", alpha=0.15, label="contact")
    arrived = flight.simulator["flight_time_s"]
    if arrived is not None:
        axes.axvline(arrived, color=_INK, linewidth=1.0, linestyle=":", label=f"at the target, {arrived:.2f} s")
    axes.set(xlabel="time since engaged [s]", ylabel="clearance, surface to surface [m]", title="clearance")
    axes.set_ylim(bottom=-0.3)
    axes.set_xlim(left=0.0)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
