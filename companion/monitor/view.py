"""What the terminal shows: a line for each vehicle, and one of them in full. Names of others are shown as text only."""

from __future__ import annotations

from collections.abc import Sequence

from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from companion.monitor.essentials import Essentials, Sight, essentials
from companion.monitor.plan import plan

_STATES = {
    "READY": "green",
    "ACTIVE": "bold green",
    "HOLD": "bold yellow",
    "OVERRIDDEN": "bold magenta",
    "FAULT": "bold red",
}
_VERDICTS = {"nominal": "green", "adjusted": "yellow", "relaxed": "bold red", "braking": "bold yellow"}
_FACTS_WIDTH = 58  # columns of the words beside the picture
_FACTS_ROWS = 16  # lines of those words, as a rule
_FRAME = 3  # lines: the panel's edges, and one that a terminal scrolls by
MIN_PLAN_ROWS, MAX_PLAN_ROWS = 8, 28


def screen(sights: Sequence[Sight], chosen: int, *, columns: int, rows: int, endpoint: str) -> RenderableType:
    """Everything, for a terminal of that size. ``chosen``: index of the vehicle shown in full."""
    if not sights:
        return Panel(Text(f"no vehicle heard yet ({endpoint})"), title="companion monitor", subtitle="q quit")
    sight = sights[min(chosen, len(sights) - 1)]
    listed = min(len(sights), max(3, rows - _FACTS_ROWS - _FRAME))
    body: list[RenderableType] = [fleet_table(sights, chosen, listed)] if len(sights) > 1 else []
    plan_rows = min(MAX_PLAN_ROWS, rows - _FRAME - (listed + 1 if body else 0))
    keys = "↑ ↓ choose, q quit" if len(sights) > 1 else "q quit"
    parts: list[RenderableType] = [facts(sight)]
    plan_columns = columns - _FACTS_WIDTH - 8
    if sight.vehicle is not None and plan_columns >= 20 and plan_rows >= MIN_PLAN_ROWS:
        parts.append(plan(sight, min(plan_columns, 2 * plan_rows), plan_rows))
    title = Text(f"companion monitor: {shown(sight.name)}")
    body.append(Panel(Columns(parts, padding=(0, 3)), title=title, subtitle=keys))
    return Group(*body)


def fleet_table(sights: Sequence[Sight], chosen: int, most: int) -> Table:
    """A line for each vehicle, of many those around the chosen one."""
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    first = max(0, min(chosen - most // 2, len(sights) - most))
    for head in ("", "vehicle", "state", "verdict", "clearance", "target", "speed", "tracks", "tick"):
        table.add_column(head, no_wrap=True)
    for index, sight in enumerate(sights[first : first + most], start=first):
        e = essentials(sight)
        table.add_row(
            "▶" if index == chosen else "",
            Text(shown(e.name)),
            _state(e, short=True),
            _verdict(e),
            "-" if e.nearest is None else f"{e.nearest.clearance_m:.2f} m",
            _number(e.target_m, "m"),
            _number(e.speed_m_s, "m/s"),
            str(e.tracks),
            _number(e.latency_ms, "ms"),
        )
    return table


def facts(sight: Sight) -> Table:
    """One vehicle in words and numbers."""
    e = essentials(sight)
    table = Table(box=None, show_header=False, padding=(0, 1, 0, 0), width=_FACTS_WIDTH)
    table.add_column(style="bright_black", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in (
        ("state", _state(e)),
        ("reason" if e.presence == "alive" else "last reason", Text(shown(e.reason or "-"))),
        ("mode" if e.presence == "alive" else "last mode", Text(_mode(e))),
        ("verdict", _verdict(e)),
        ("nearest", _nearest(e)),
        ("target", "-" if e.target_m is None else f"{e.target_m:.1f} m away"),
        ("speed", _number(e.speed_m_s, "m/s")),
        ("position", "-" if e.position is None else "  ".join(f"{x:z.2f}" for x in e.position) + " m"),
        ("worst row", _worst(e)),
        ("latency", Text(_latency(e))),
        ("tracks", str(e.tracks)),
    ):
        table.add_row(name, value)
    if e.presence != "alive":
        return table  # its sources and warnings are no news any more
    for name, source in e.sources.items():
        table.add_row("source", _source(name, source.age_s, source.frames))
    if e.rejected:
        table.add_row("not used", Text(shown(", ".join(f"{n} {why}" for why, n in e.rejected.items())), "yellow"))
    if e.malformed:
        table.add_row("unreadable", Text(f"{e.malformed} payloads, of another version?", "yellow"))
    for warning in e.warnings:
        table.add_row("warning", Text(shown(warning), "bold yellow"))
    return table


def line(e: Essentials) -> str:
    """One vehicle in one line, for a pipe."""
    if e.presence != "alive":
        return f"{shown(e.name)} {_state(e).plain}"
    near = "no track"
    if e.nearest is not None:
        near = f"clearance {e.nearest.clearance_m:.2f} m to {shown(e.nearest.id)}"
        near += f" closing {e.nearest.closing_m_s:z.2f} m/s"
    words = [f"{shown(e.name)} {e.state} ({shown(e.reason or '')})", _mode(e), e.verdict or "no tick", near]
    words.append("no target" if e.target_m is None else f"target {e.target_m:.1f} m")
    words += [f"speed {_number(e.speed_m_s, 'm/s')}", f"tick {_number(e.latency_ms, 'ms')}"]
    ages = (f"{shown(n)} {'never' if s.age_s is None else f'{s.age_s:.1f} s'}" for n, s in e.sources.items())
    words += [f"source {age}" for age in ages] + [f"warning: {shown(w)}" for w in e.warnings]
    return ", ".join(words)


def shown(text: str) -> str:
    """``text`` of others without what could command a terminal.

    >>> shown("ball\\x1b[2J")
    'ball?[2J'
    """
    return "".join(character if character.isprintable() else "?" for character in text)


def _state(e: Essentials, *, short: bool = False) -> Text:
    since = "" if e.silent_s is None else f" for {e.silent_s:.1f} s"
    if short and e.presence != "alive":
        return Text(f"{e.presence.upper()}{since}", "bold red")
    if e.presence == "gone":
        return Text(f"GONE: its presence token was dropped, nothing heard{since}", "bold red")
    if e.presence == "silent":
        return Text(f"SILENT{since}, was {e.state}" if e.state else "SILENT: no status yet", "bold red")
    return Text(e.state or "-", _STATES.get(e.state or "", ""))


def _verdict(e: Essentials) -> Text:
    if e.verdict is None:
        return Text("-")
    return Text(e.verdict + ("" if e.sent else ", nothing sent"), _VERDICTS.get(e.verdict, ""))


def _mode(e: Essentials) -> str:
    if e.mode is None:
        return "-"
    facts = [shown(e.mode), "armed" if e.armed else "disarmed", "in the air" if e.airborne else "on the ground"]
    return " ".join([*facts, "engaged"] if e.engaged else facts)


def _nearest(e: Essentials) -> Text:
    if e.nearest is None:
        return Text("no track")
    near = e.nearest
    motion = f"closing {near.closing_m_s:.2f}" if near.closing_m_s > 0.0 else f"parting {-near.closing_m_s:.2f}"
    style = "bold red" if near.clearance_m <= 0.0 else ""
    tentative = "" if near.status == "confirmed" else f" ({shown(near.status)})"
    return Text(f"{near.clearance_m:.2f} m to {shown(near.id)}{tentative}, {motion} m/s", style)


def _worst(e: Essentials) -> Text:
    if e.worst is None:
        return Text("-")
    return Text(f"{shown(e.worst)}, epsilon {e.epsilon:.3f}, slack {e.slack_m_s2:z.2f} m/s²")


def _latency(e: Essentials) -> str:
    if e.latency_ms is None:
        return "-"
    spread = f", p99 {e.tick_ms['p99']:.1f} ms" if "p99" in e.tick_ms else ""
    rate = "" if e.rate_hz is None else f", {e.rate_hz:.0f} Hz"
    missed = f", {e.deadline_misses} deadlines missed" if e.deadline_misses else ""
    return f"{e.latency_ms:.1f} ms{spread}{rate}{missed}"


def _source(name: str, age_s: float | None, frames: int) -> Text:
    if age_s is None:
        return Text(f"{shown(name)}: never heard", "bold yellow")
    return Text(f"{shown(name)}: {age_s:.2f} s old, {frames} frames", "bold yellow" if age_s > 1.0 else "")


def _number(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.1f} {unit}"
