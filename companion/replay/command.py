"""`companion replay`: exit status 0 equal (or what-if), 1 another answer, 2 a log or configuration that cannot be."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from companion.config import Config, apply_overrides, load_config, parse_config
from companion.errors import ConfigError
from companion.journal_format import Step
from companion.logbook.reader import open_log
from companion.numerics import this_machine
from companion.replay.compare import Comparison
from companion.replay.journal_reader import JournalReader
from companion.replay.moments import engaged_ns, moment_ns
from companion.replay.player import Played, Player, Variant, seconds
from companion.replay.progress import Advance, progress
from companion.replay.usage import as_usage
from companion.replay.whatif import Commanded, WhatIf, as_json, judge

_EPILOG = """\
examples:
  companion replay flights/20261104-101500/flight.mcap           is every answer the same, to the bit?
  companion replay flight.mcap --set safety.kappa=3              what would other margins have answered?
  companion replay flight.mcap --config mine.toml --from 2 --to 5
"""
OPEN_LOOP = (
    "open loop: the recorded vehicle does not follow the other answers, every tick starts from the recorded state"
)


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `replay` to the command line."""
    replay = commands.add_parser(
        "replay",
        help="feed a recorded flight to this version and compare",
        description="Feed the recorded inputs of a flight to the brain of this version and compare its answers.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    replay.add_argument("log", type=Path, metavar="LOG", help="an MCAP log, or the folder of a flight")
    replay.add_argument("-c", "--config", type=Path, metavar="FILE", help="what would this configuration have done?")
    replay.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help="the same for single keys"
    )
    replay.add_argument("--artifact", metavar="FOLDER", help="fly this policy artefact instead of the recorded one")
    replay.add_argument(
        "--from", dest="begin", metavar="T", help="compare from here on: seconds after engaging, or 123ns"
    )
    replay.add_argument("--to", dest="end", metavar="T", help="replay up to here")
    replay.add_argument(
        "--tolerance",
        type=float,
        default=0.0,
        metavar="X",
        help="let numbers differ by X max(1, |x|) (default 0: no bit)",
    )
    replay.add_argument("--json", action="store_true", help="one JSON object on stdout, nothing else there")
    replay.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    """Do it."""
    with as_usage():
        return _run(arguments)


def _run(arguments: argparse.Namespace) -> int:
    """Replay and report."""
    if not (math.isfinite(arguments.tolerance) and arguments.tolerance >= 0.0):
        raise ConfigError(f"--tolerance: expected a number >= 0, got {arguments.tolerance:g}")
    log = open_log(arguments.log)
    origin_ns = engaged_ns(log)
    begin_ns = None if arguments.begin is None else moment_ns("--from", arguments.begin, origin_ns)
    end_ns = None if arguments.end is None else moment_ns("--to", arguments.end, origin_ns)
    variant = _variant(arguments)
    player = Player(JournalReader(log), variant=variant, artifact=arguments.artifact)
    with progress(f"replay {log.path.name}", quiet=arguments.json) as advance:
        ticks = _told(player.ticks(end_ns), advance)
        window = (begin_ns, end_ns)
        if variant is None:
            return _report_comparison(arguments, player, _compare(ticks, window, arguments.tolerance), origin_ns)
        return _report_what_if(arguments, player, _what_if(ticks, player, window), origin_ns)


def _compare(ticks: Iterator[Played], window: tuple[int | None, int | None], tolerance: float) -> Comparison:
    comparison = Comparison()
    for played in ticks:
        if _within(played.step, window):
            comparison.add(played, tolerance)
    return comparison


def _what_if(ticks: Iterator[Played], player: Player, window: tuple[int | None, int | None]) -> WhatIf:
    """Of the ticks flown; of all where none was."""
    flown, idle, commanded, also = WhatIf(), WhatIf(), Commanded(), Commanded()
    for played in ticks:
        if _within(played.step, window):
            logged = player.logged_config
            judge(flown, played, commanded, logged, flown=True)
            if not flown.ticks:
                judge(idle, played, also, logged, flown=False)
    return flown if flown.ticks else idle


def _within(step: Step, window: tuple[int | None, int | None]) -> bool:
    begin_ns, end_ns = window
    return (begin_ns is None or step.stamp_ns >= begin_ns) and (end_ns is None or step.stamp_ns <= end_ns)


def _variant(arguments: argparse.Namespace) -> Variant | None:
    """What flies in place of a recorded configuration; None where nothing else was asked for."""
    overrides = tuple(arguments.overrides)
    if arguments.config is None and not overrides:
        return None
    other = None if arguments.config is None else load_config(arguments.config, overrides)

    def of(recorded: Config) -> Config:
        if other is not None:
            auto = other.vehicle.profile == "auto" and recorded.vehicle.profile != "auto"
            return other.flown_as(recorded.vehicle.profile) if auto else other
        raw: dict[str, Any] = msgspec.to_builtins(recorded)
        return parse_config(apply_overrides(raw, overrides), source="--set")

    return of


def _report_comparison(arguments: argparse.Namespace, player: Player, comparison: Comparison, origin_ns: int) -> int:
    first, recorded = comparison.first, player.construct
    here = this_machine()
    same_machine = recorded is not None and recorded.machine.numerics == here.numerics
    equal = comparison.differing == 0
    if arguments.json:
        report = {
            "equal": equal,
            "ticks": comparison.ticks,
            "compared": comparison.compared,
            "differing": comparison.differing,
            "tolerance": arguments.tolerance,
            "first_difference": None if first is None else msgspec.to_builtins(first),
            "largest_differences": {name: _finite(size) for name, size in comparison.largest.items()},
            "configurations": [{"stamp_ns": stamp_ns, "what": what} for stamp_ns, what in player.retunes],
            "notes": player.reader.notes,
            "same_numerics": same_machine,
        }
        print(json.dumps(report), flush=True)
        return 0 if equal else 1
    how = "to the bit" if arguments.tolerance == 0.0 else f"within {arguments.tolerance:g}"
    _tell_notes(player, origin_ns)
    if equal:
        print(f"equal {how}: {comparison.compared} ticks")
        return 0
    print(f"differs: {comparison.differing} of {comparison.compared} ticks are not equal {how}")
    if first is not None:
        at_s = seconds(first.stamp_ns, origin_ns)
        print(f"first    {at_s:.3f} s ({first.stamp_ns} ns): {first.field}")
        print(f"  log    {first.recorded!r}\n  here   {first.replayed!r}")
    sizes = sorted(comparison.largest.items(), key=lambda item: -item[1])[:6]
    print("largest  " + ", ".join(f"{name} {size:.3g}" for name, size in sizes))
    if recorded is not None and not same_machine:
        made, now = (f"{m.architecture}, numpy {m.numpy}, {m.simd}" for m in (recorded.machine, here))
        print(f"The log was made on {made}; here it is {now}, which rounds differently: try --tolerance 1e-6")
    return 1


def _report_what_if(arguments: argparse.Namespace, player: Player, result: WhatIf, origin_ns: int) -> int:
    told = as_json(result)
    if arguments.json:
        print(json.dumps({**told, "open_loop": True, "notes": player.reader.notes}), flush=True)
        return 0
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"what another configuration would have answered, {result.ticks} ticks")
    for name in ("", "log", "other"):
        table.add_column(name, justify="left" if not name else "right")
    for verdict in ("nominal", "adjusted", "relaxed", "braking"):
        table.add_row(verdict, *(str(side.verdicts.get(verdict, 0)) for side in (result.logged, result.other)))
    logged: Any = told["log"]
    other: Any = told["other"]
    for label, key, unit in (
        ("mean change of the reference", "mean_change_m_s2", "m/s^2"),
        ("least predicted clearance", "min_predicted_clearance_m", "m"),
    ):
        cells = ["-" if side[key] is None else f"{side[key]:.2f} {unit}" for side in (logged, other)]
        table.add_row(label, *cells)
    Console().print(table)
    _tell_notes(player, origin_ns)
    if told["mean_difference_m_s2"] is not None:
        print(
            f"answers differ in {told['differing_ticks']} ticks, by {told['mean_difference_m_s2']:.3f} m/s^2 on average"
            f" and {told['max_difference_m_s2']:.3f} m/s^2 at most"
        )
    if result.first is not None:
        first = result.first
        print(
            f"first at {seconds(first.stamp_ns, origin_ns):.3f} s: log {_vector(first.logged)} {first.logged_verdict}, "
            f"other {_vector(first.other)} {first.other_verdict} [m/s^2]"
        )
    print(OPEN_LOOP)
    return 0


def _tell_notes(player: Player, origin_ns: int) -> None:
    for stamp_ns, what in player.retunes:
        print(f"config   {seconds(stamp_ns, origin_ns):.3f} s: {what}")
    for note in player.reader.notes:
        print(f"note     {note}")


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _vector(values: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in values) + ")"


def _told(ticks: Iterator[Played], advance: Advance) -> Iterator[Played]:
    for played in ticks:
        advance()
        yield played
