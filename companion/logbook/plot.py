"""A flight on one page: plan and side view, verdicts, clearance, accelerations, epsilon, margins, latency."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import ConfigError
from companion.logbook.reader import FlightLog
from companion.logbook.series import Series, Stretch, epsilons, norms, worst_margins
from companion.types import FloatArray

SHOWN_TRACKS = 12  # with a colour and a name of their own: those that came closest

# Okabe and Ito: colour-blind people tell them apart
INK, GREY = "#222222", "#9a9a9a"
BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"
TRACKS = (VERMILION, GREEN, PURPLE, ORANGE, SKY, "#8c6d31")
DASHES = ("-", "--")  # the second time round the colours
VERDICTS = {"nominal": "#d9e9f2", "adjusted": ORANGE, "relaxed": PURPLE, "braking": VERMILION, "silent": GREY}
STATES = {"WAITING": "#eeeeee", "READY": "#cfcfcf", "ACTIVE": GREEN, "HOLD": ORANGE, "OVERRIDDEN": SKY}
STATES |= {"FAULT": VERMILION}


def plot(log: FlightLog, series: Series, path: Path) -> None:
    """Write the PNG.

    Raises:
        ConfigError: matplotlib is not installed, the log holds no tick, or the file cannot be written.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib.figure import Figure
    except ImportError:
        raise ConfigError(
            "log plot: matplotlib is not installed, expected: pip install 'companion-safety[plot]'"
        ) from None
    if not series.records or not len(series.p_enu):
        raise ConfigError(f"{log.path}: no tick, nothing to plot")
    figure = Figure(figsize=(11.0, 15.5), layout="constrained")
    halves: Any = figure.subfigures(2, 1, height_ratios=(0.3, 0.7))
    top, bottom = halves
    shown = _shown(series)
    _draw_views(top, series, shown)
    axes = bottom.subplots(
        6, 1, sharex=True, gridspec_kw={"height_ratios": (0.35, 1.0, 1.15, 0.8, 1.0, 0.8), "hspace": 0.02}
    )
    _draw_strips(axes[0], series)
    _draw_clearance(axes[1], series, shown)
    _draw_acceleration(axes[2], series)
    _draw_epsilon(axes[3], series)
    _draw_margins(axes[4], series)
    _draw_latency(axes[5], log, series)
    axes[-1].set_xlabel("time since the first tick [s]")
    axes[-1].set_xlim(0.0, max(float(series.t_s[-1]), 1e-3))
    figure.suptitle(_title(log, series), fontsize=11)
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise ConfigError(f"-o {path}: cannot be written ({error.strerror or error}), expected a PNG file") from None


def _title(log: FlightLog, series: Series) -> str:
    vehicle = log.configs[-1].values.get("vehicle", {})
    cut = "" if log.cut is None else ", log cut short"
    return (
        f"{vehicle.get('name')} ({vehicle.get('profile')}), {series.t_s[-1]:.1f} s, {len(series.records)} ticks{cut}\n"
        f"companion {log.version}, configuration {log.config_hash[:12]}"
    )


def _shown(series: Series) -> list[tuple[Stretch, str, str]]:
    """The tracks that came closest, with colour and dash each."""
    nearest = sorted(series.tracks, key=lambda track: float(track.clearance_m.min()))[:SHOWN_TRACKS]
    return [
        (track, TRACKS[index % len(TRACKS)], DASHES[index // len(TRACKS) % len(DASHES)])
        for index, track in enumerate(nearest)
    ]


def _draw_views(figure: Any, series: Series, shown: list[tuple[Stretch, str, str]]) -> None:
    """From above and from the south, to the same scale."""
    plan, side = figure.subplots(1, 2)
    for axes, other, name in ((plan, 1, "north [m]"), (side, 2, "up [m]")):
        for track in series.tracks:
            axes.plot(track.p_enu[:, 0], track.p_enu[:, other], color=GREY, linewidth=0.4, alpha=0.4, zorder=1)
        for track, colour, dash in shown:
            at = int(np.argmin(track.clearance_m))
            axes.plot(track.p_enu[:, 0], track.p_enu[:, other], dash, color=colour, linewidth=1.0, alpha=0.8, zorder=2)
            axes.plot(track.p_enu[at, 0], track.p_enu[at, other], "o", color=colour, markersize=7, alpha=0.9, zorder=3)
            own = _at(series, float(track.t_s[at]))
            pair = np.array([track.p_enu[at], own])
            axes.plot(pair[:, 0], pair[:, other], ":", color=colour, linewidth=1.0, zorder=3)
        axes.plot(series.p_enu[:, 0], series.p_enu[:, other], color=BLUE, linewidth=2.0, zorder=4)
        axes.plot(series.p_enu[0, 0], series.p_enu[0, other], "s", color=BLUE, markersize=6, zorder=5)
        if series.target is not None:
            axes.plot(series.target[0], series.target[other], "*", color=INK, markersize=13, zorder=5)
        axes.set(xlabel="east [m]", ylabel=name)
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(alpha=0.25)
    plan.set_title("plan view", fontsize=10)
    side.set_title("side view, from the south", fontsize=10)
    _draw_key(figure, plan, series, shown)


def _draw_key(figure: Any, axes: Any, series: Series, shown: list[tuple[Stretch, str, str]]) -> None:
    axes.plot([], [], color=BLUE, linewidth=2.0, marker="s", label="vehicle, from its start")
    if series.target is not None:
        axes.plot([], [], "*", color=INK, markersize=11, label="target")
    for track, colour, dash in shown:
        axes.plot([], [], dash, color=colour, marker="o", label=track.id)
    hidden = len(series.tracks) - len(shown)
    if hidden > 0:
        axes.plot([], [], color=GREY, linewidth=0.6, label=f"{hidden} other tracks")
    figure.legend(loc="outside lower center", ncols=4, fontsize=8, frameon=False, title="dot: where it came closest")


def _draw_strips(axes: Any, series: Series) -> None:
    """State above, verdict below."""
    edges = np.append(series.t_s, series.t_s[-1] + _typical_step(series))
    _strip(axes, edges, [record.state for record in series.records], STATES, 1.0)
    _strip(axes, edges, [record.verdict for record in series.records], VERDICTS, 0.0)
    for index in np.flatnonzero([record.detour for record in series.records]):
        axes.plot(series.t_s[index], 0.5, "|", color=INK, markersize=4)
    axes.set(ylim=(0.0, 2.0), yticks=(0.5, 1.5), yticklabels=("verdict", "state"))
    axes.tick_params(axis="y", length=0)
    found = {record.state: STATES for record in series.records} | {
        record.verdict: VERDICTS for record in series.records
    }
    for name, colours in found.items():
        axes.plot([], [], "s", color=colours.get(name, INK), label=name)
    if any(record.detour for record in series.records):
        axes.plot([], [], "|", color=INK, label="detour")
    _legend(axes)


def _strip(axes: Any, edges: FloatArray, names: list[str], colours: dict[str, str], bottom: float) -> None:
    """Runs of equal names as one bar each."""
    begin = 0
    for index in range(1, len(names) + 1):
        if index == len(names) or names[index] != names[begin]:
            axes.barh(
                bottom + 0.5,
                edges[index] - edges[begin],
                left=edges[begin],
                height=0.9,
                color=colours.get(names[begin], INK),
                linewidth=0,
            )
            begin = index


def _draw_clearance(axes: Any, series: Series, shown: list[tuple[Stretch, str, str]]) -> None:
    for track, colour, dash in shown:
        t_s, clearance_m = _with_gaps(track)
        axes.plot(t_s, clearance_m, dash, color=colour, linewidth=1.2, label=track.id if len(shown) <= 6 else None)
    axes.axhspan(-10.0, 0.0, color=VERMILION, alpha=0.15, linewidth=0)
    closest = series.closest()
    if closest is not None:
        axes.plot(closest[2], closest[0], "o", color=INK, markersize=4, label=f"least: {closest[0]:.2f} m")
    top = max((float(track.clearance_m.min()) for track, _, _ in shown), default=1.0)
    axes.set(ylabel="clearance [m]", ylim=(-0.3, max(3.0, 2.0 * top)))
    _finish(axes)


def _draw_acceleration(axes: Any, series: Series) -> None:
    """Each axis of the reference and of what was made of it."""
    records = series.records
    for index, (name, colour) in enumerate((("east", BLUE), ("north", VERMILION), ("up", GREEN))):
        for which, style, width in (("u_ref", "--", 0.9), ("u_safe", "-", 1.3)):
            values = [getattr(record, which) for record in records]
            line = [np.nan if value is None else value[index] for value in values]
            axes.plot(series.t_s, line, style, color=colour, linewidth=width, label=name if which == "u_safe" else None)
    changed = norms(
        [
            None if r.u_ref is None or r.u_safe is None else tuple(np.subtract(r.u_safe, r.u_ref).tolist())
            for r in records
        ]
    )
    axes.fill_between(series.t_s, 0.0, changed, color=ORANGE, alpha=0.3, linewidth=0, label="|safe - reference|")
    axes.plot([], [], "--", color=GREY, label="reference")
    axes.plot([], [], "-", color=GREY, label="safe")
    axes.set_ylabel("acceleration [m/s²]")
    _finish(axes)


def _draw_epsilon(axes: Any, series: Series) -> None:
    epsilon, epsilon_star = epsilons(series.records)
    axes.plot(series.t_s, epsilon, color=BLUE, linewidth=1.2, label="ε of the worst row")
    axes.plot(series.t_s, epsilon_star, "--", color=VERMILION, linewidth=0.9, label="ε*")
    axes.set_ylabel("ε")
    axes.set_ylim(bottom=-0.05)
    _finish(axes)


def _draw_margins(axes: Any, series: Series) -> None:
    """What the keep-out distance of the worst row is made of, on top of each other."""
    parts = worst_margins(series.records)
    shown = np.where(np.isnan(parts), 0.0, parts)
    names, colours = ("radii", "cushion", "kappa sigma", "delay"), (GREY, SKY, BLUE, VERMILION)
    axes.stackplot(series.t_s, *shown.T, labels=names, colors=colours, alpha=0.85, linewidth=0)
    axes.set_ylabel("margin of the\nworst row [m]")
    _finish(axes)


def _draw_latency(axes: Any, log: FlightLog, series: Series) -> None:
    for name, colour in (("total", BLUE), ("brain", ORANGE)):
        values = [record.timings_ms.get(name, np.nan) for record in series.records]
        axes.plot(series.t_s, values, ".", color=colour, markersize=2.5, label=f"{name}, p99 {_p99(values):.1f} ms")
    period_ms = 1e3 * _typical_step(series)
    axes.axhline(period_ms, color=INK, linewidth=0.8, linestyle=":", label=f"period, {period_ms:.0f} ms")
    axes.set_yscale("log")
    axes.set_ylabel("tick latency [ms]")
    _finish(axes)


def _finish(axes: Any) -> None:
    axes.grid(alpha=0.25)
    axes.margins(x=0.0)
    _legend(axes)


def _legend(axes: Any) -> None:
    axes.legend(fontsize=7.5, loc="upper left", bbox_to_anchor=(1.0, 1.02), frameon=False, handlelength=1.4)


def _with_gaps(track: Stretch) -> tuple[FloatArray, FloatArray]:
    """A track that was away for a while is not drawn through."""
    breaks = np.flatnonzero(np.diff(track.t_s) > 1.0) + 1
    return np.insert(track.t_s, breaks, np.nan), np.insert(track.clearance_m, breaks, np.nan)


def _at(series: Series, t_s: float) -> FloatArray:
    """The vehicle at a time, by the nearest tick."""
    position: FloatArray = series.p_enu[int(np.argmin(np.abs(series.vehicle_t_s - t_s)))]
    return position


def _typical_step(series: Series) -> float:
    steps = np.diff(series.t_s)
    return float(np.median(steps)) if len(steps) else 0.05


def _p99(values: list[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.quantile(known, 0.99)) if known else float("nan")
