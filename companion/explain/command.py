"""`companion explain`: one moment of a flight in words, the worst one, or the ticks around it as a table."""

from __future__ import annotations

import argparse
import json
import math
import textwrap
from pathlib import Path
from typing import Any

import msgspec

from companion.errors import ConfigError
from companion.explain.facts import facts
from companion.explain.moment import Outline, intervention, moment, outlines
from companion.explain.words import paragraphs
from companion.logbook.reader import open_log
from companion.pilot import Task
from companion.replay.moments import engaged_ns, moment_ns
from companion.replay.progress import progress
from companion.replay.usage import as_usage
from companion.types import NS_PER_S

WIDTH = 112
_EPILOG = """\
examples:
  companion explain flights/20261104-101500 --worst       the tick with the least room
  companion explain flight.mcap --at 2.35                 2.35 s after the flight was engaged
  companion explain flight.mcap --at 2.35 --around 0.5    half a second before and after it, a line a tick
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `explain` to the command line."""
    explain = commands.add_parser(
        "explain",
        help="why did the vehicle do what it did at one moment of a recorded flight?",
        description="Say in words why the vehicle did what it did at one moment of a recorded flight.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    explain.add_argument("log", type=Path, metavar="LOG", help="an MCAP log, or the folder of a flight")
    which = explain.add_mutually_exclusive_group(required=True)
    which.add_argument("--at", metavar="T", help="seconds after the flight was engaged, or a stamp such as 123ns")
    which.add_argument("--worst", action="store_true", help="the flown tick of least slack")
    explain.add_argument("--around", type=float, metavar="S", help="also the ticks within S seconds, a line each")
    explain.add_argument("--json", action="store_true", help="one JSON object on stdout, nothing else there")
    explain.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    """Do it."""
    with as_usage():
        return _run(arguments)


def _run(arguments: argparse.Namespace) -> int:
    """Explain and print."""
    around = arguments.around
    if around is not None and not (math.isfinite(around) and around > 0.0):
        raise ConfigError(f"--around: expected seconds > 0, got {around:g}")
    log = open_log(arguments.log)
    origin_ns = engaged_ns(log)
    at_ns = None if arguments.worst else moment_ns("--at", arguments.at, origin_ns)
    with progress(f"read {log.path.name}", quiet=arguments.json) as advance:
        ticks = outlines(log, advance)
        if not ticks:
            raise ConfigError(f"{log.path}: no tick with an answer of the brain")
        number = _worst(ticks) if at_ns is None else _nearest(ticks, at_ns, log.path)
        found = facts(moment(log, number, advance), ticks, intervention(ticks, number))
    near = [] if around is None else _near(ticks, number, around)
    told = paragraphs(found, origin_ns)
    if arguments.json:
        body: dict[str, Any] = {"t_s": (found.stamp_ns - origin_ns) / NS_PER_S, **msgspec.to_builtins(found)}
        body["text"] = [f"{heading}: {text}" for heading, text in told]
        body["around"] = [_as_json(tick, origin_ns) for tick in near]
        print(json.dumps(body), flush=True)
        return 0
    for heading, text in told:
        print(textwrap.fill(text, WIDTH, initial_indent=f"{heading:<9}", subsequent_indent=" " * 9))
    if near:
        print()
        _print_table(near, found.stamp_ns, origin_ns)
    return 0


def _worst(ticks: list[Outline]) -> int:
    """The tick of least slack among those flown, of all where none was."""
    flown = [number for number, tick in enumerate(ticks) if tick.task is not Task.STAY]
    return min(flown or range(len(ticks)), key=lambda number: ticks[number].slack)


def _nearest(ticks: list[Outline], stamp_ns: int, path: Path) -> int:
    """The tick nearest to a stamp. Raises ConfigError where the log has none within a second."""
    number = min(range(len(ticks)), key=lambda index: abs(ticks[index].stamp_ns - stamp_ns))
    if abs(ticks[number].stamp_ns - stamp_ns) > NS_PER_S:
        first, last = (f"{tick.stamp_ns}ns" for tick in (ticks[0], ticks[-1]))
        raise ConfigError(f"{path}: --at: expected a moment between {first} and {last}, got {stamp_ns}ns")
    return number


def _near(ticks: list[Outline], number: int, around_s: float) -> list[Outline]:
    centre_ns = ticks[number].stamp_ns
    return [tick for tick in ticks if abs(tick.stamp_ns - centre_ns) <= around_s * NS_PER_S]


def _as_json(tick: Outline, origin_ns: int) -> dict[str, Any]:
    slack = None if math.isinf(tick.slack) else tick.slack
    return {
        "t_s": (tick.stamp_ns - origin_ns) / NS_PER_S,
        "stamp_ns": tick.stamp_ns,
        "state": tick.state,
        "verdict": tick.verdict,
        "change_m_s2": tick.change_m_s2,
        "worst": tick.worst,
        "slack_m_s2": slack,
    }


def _print_table(ticks: list[Outline], centre_ns: int, origin_ns: int) -> None:
    print(f"  {'t [s]':>8}  {'state':<10}{'verdict':<10}{'change':>8}  {'tightest row':<24}{'room':>8}  [m/s^2]")
    for tick in ticks:
        mark = ">" if tick.stamp_ns == centre_ns else " "
        t_s = (tick.stamp_ns - origin_ns) / NS_PER_S
        room = "" if math.isinf(tick.slack) else f"{tick.slack:8.2f}"
        row = f"{tick.change_m_s2:8.2f}  {tick.worst or '-':<24}{room}"
        print(f"{mark} {t_s:8.2f}  {tick.state:<10}{tick.verdict:<10}{row}")
