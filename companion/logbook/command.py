"""`companion log`: what a flight's log holds, as numbers, a page of plots, or tables."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from companion.logbook.export import export
from companion.logbook.info import info
from companion.logbook.reader import open_log
from companion.logbook.series import load_series

_EPILOG = """\
examples:
  companion log info flights/today                        what flew, and how it went
  companion log plot flights/today/flight.mcap -o a.png   a page of plots
  companion log export flight.mcap -o tables --format csv one file a table: setpoints, rows, vehicle, tracks, ...
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `log` to the command line."""
    log = commands.add_parser(
        "log",
        help="read the log of a flight",
        description="Read the log of a flight (flight.mcap, or the folder that holds it), also of one cut short.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parts = log.add_subparsers(dest="part", required=True, metavar="PART")
    about = _add_part(parts, "info", _info, "what flew, for how long, and how it went")
    about.add_argument("--json", action="store_true", help="one JSON object on stdout, nothing else there")
    plot = _add_part(parts, "plot", _plot, "a page of plots as PNG; needs the extra plot (matplotlib)")
    plot.add_argument("-o", "--out", type=Path, metavar="PNG", help="where to write (default beside the log)")
    tables = _add_part(parts, "export", _export, "tables as CSV, or Parquet with the extra parquet (pyarrow)")
    tables.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="folder, one file a table")
    tables.add_argument("--format", choices=("csv", "parquet"), default="csv", help="default csv")


def _add_part(
    parts: argparse._SubParsersAction[argparse.ArgumentParser], name: str, handler: Any, text: str
) -> argparse.ArgumentParser:
    part = parts.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    part.add_argument("file", type=Path, metavar="FILE", help="flight.mcap, or its folder")
    part.set_defaults(handler=handler)
    return part


def _info(arguments: argparse.Namespace) -> int:
    log = open_log(arguments.file)
    told = info(log, load_series(log))
    if arguments.json:
        print(json.dumps(told), flush=True)
    else:
        _print_info(told)
    return 0


def _plot(arguments: argparse.Namespace) -> int:
    from companion.logbook.plot import plot

    log = open_log(arguments.file)
    path = log.path.with_suffix(".png") if arguments.out is None else arguments.out
    plot(log, load_series(log), path)
    print(path)
    return 0


def _export(arguments: argparse.Namespace) -> int:
    written = export(open_log(arguments.file), arguments.out, arguments.format)
    for name, rows in written.items():
        print(f"{arguments.out / name}: {rows} rows")
    return 0


def _print_info(told: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=told["file"], show_header=False)
    table.add_row("vehicle", f"{told['vehicle']} ({told['profile']})")
    table.add_row("version", f"{told['version']}, commit {(told['commit'] or 'unknown')[:12]}")
    table.add_row("configuration", f"{told['config_hash'][:12]}, changed {told['config_changes']} times in flight")
    table.add_row("policy", f"{told['artifact']} ({(told['artifact_digest'] or 'unknown')[:12]})")
    table.add_row("started", told["started"] or "unknown")
    table.add_row("duration", f"{told['duration_s']:.1f} s, {told['ticks']} ticks, {told['sent']} setpoints")
    table.add_row("states", ", ".join(f"{state} {length:.1f} s" for state, length in told["states_s"].items()))
    table.add_row("verdicts", ", ".join(f"{name} {count}" for name, count in sorted(told["verdicts"].items())))
    closest = told["minimum_clearance"]
    where = "no track" if closest is None else f"{closest['m']:.2f} m to {closest['track']} at {closest['t_s']:.1f} s"
    table.add_row("least clearance", f"{where} (as tracked, surface to surface)")
    for name, found in told["latency_ms"].items():
        shown = ", ".join(f"{which} {value:.2f}" for which, value in found.items())
        table.add_row(f"latency {name}", f"{shown} ms" if shown else "-")
    table.add_row("messages", ", ".join(f"{topic} {count}" for topic, count in told["topics"].items()))
    tlog = told["tlog"]
    table.add_row("tlog", "none" if tlog is None else f"{', '.join(tlog['files'])}: {tlog['packets']} packets")
    table.add_row("complete", "yes" if told["cut"] is None else f"[bold]no[/]: {told['cut']}")
    console = Console()
    console.print(table)
    for text in told["texts"]:
        console.print(f"{text['t_s']:9.2f} s  {text['text']}", highlight=False, markup=False)
