"""`sim-bridge render`: pictures and films of a flight from its trace, drawn by PyBullet's own renderer."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from sim_bridge.errors import ScenarioError

if TYPE_CHECKING:
    from PIL.Image import Image

    from sim_bridge.pictures.log import Log

SUFFIXES = (".mp4", ".gif", ".png")
MOST_FRAMES = 20_000
MOST_PIXELS = 3840

_DESCRIPTION = """\
Draws a flight from the trace that `sim-bridge run --trace` or `companion demo` (truth.jsonl) wrote. A .mp4 or .gif
is a film at real speed; a .png is one picture at --at, or a sheet of nine over the time from --from to --to. The
vehicle is drawn enlarged to its collision sphere, whose outline turns amber and red as it is approached and touched.
"""
_EPILOG = """\
examples:
  sim-bridge render flights/x/truth.jsonl -o flight.gif --camera chase --from 8 --to 14
  sim-bridge render flight.jsonl -o still.png --at 12.5 --size 1280x720
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `render` to the command line."""
    render = commands.add_parser(
        "render",
        help="draw a flight: film, picture or contact sheet",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    render.add_argument("log", type=Path, metavar="LOG", help="a trace, JSON lines")
    render.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=" ".join(SUFFIXES))
    render.add_argument(
        "--camera", choices=("overview", "chase", "top"), default="overview", help="where from (default overview)"
    )
    render.add_argument("--fps", type=_fps, default=20.0, metavar="F", help="frames a second (default 20)")
    render.add_argument("--size", type=_size, default=(640, 360), metavar="WxH", help="pixels (default 640x360)")
    render.add_argument("--from", dest="since", type=_seconds, metavar="S", help="vehicle time (default: the start)")
    render.add_argument("--to", dest="until", type=_seconds, metavar="S", help="vehicle time (default: the end)")
    render.add_argument("--at", type=_seconds, metavar="S", help="of a .png: one picture at this time")
    render.set_defaults(run=_run)


def _fps(text: str) -> float:
    value = _number(text)
    if not 0.1 <= value <= 120.0:
        raise argparse.ArgumentTypeError(f"expected 0.1 to 120 frames a second, got {text}")
    return value


def _seconds(text: str) -> float:
    value = _number(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected seconds, got {text}")
    return value


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT, got {text}")
    if not all(16 <= int(side) <= MOST_PIXELS for side in (width, height)):
        raise argparse.ArgumentTypeError(f"expected 16 to {MOST_PIXELS} pixels a side, got {text}")
    return int(width), int(height)


def _run(arguments: argparse.Namespace) -> int:
    path, suffix = arguments.output, arguments.output.suffix.lower()
    if suffix not in SUFFIXES:
        raise ScenarioError(f"-o {path}: expected a name that ends in one of {', '.join(SUFFIXES)}")
    if arguments.at is not None and suffix != ".png":
        raise ScenarioError(f"--at: expected only with a .png, got -o {path}")
    if not os.access(path.parent, os.W_OK):
        raise ScenarioError(f"-o {path}: cannot be written, expected a folder to write to")
    from sim_bridge.pictures import film
    from sim_bridge.pictures.log import read_log

    if suffix == ".mp4":
        film.check_mp4(arguments.size)
    log = read_log(arguments.log)
    since_s, until_s = _span(arguments, log)
    if suffix == ".png":
        _write_png(arguments, log, since_s, until_s)
        return 0
    times_s = film.frame_times(since_s, until_s, arguments.fps)
    if len(times_s) > MOST_FRAMES:
        raise ScenarioError(f"--fps: expected at most {MOST_FRAMES} frames, got {len(times_s)}: shorten --from, --to")
    pictures = film.shoot(log, times_s, camera=arguments.camera, size=arguments.size, since_s=since_s)
    write = film.write_mp4 if suffix == ".mp4" else film.write_gif
    write(path, _shown(pictures, len(times_s)), arguments.fps)
    return 0


def _span(arguments: argparse.Namespace, log: Log) -> tuple[float, float]:
    """From when to when, within the log."""
    since_s = log.start_s if arguments.since is None else arguments.since
    until_s = log.end_s if arguments.until is None else arguments.until
    covers = f"the log covers {log.start_s:g} to {log.end_s:g} s"
    if not log.start_s <= since_s <= until_s <= log.end_s:
        raise ScenarioError(f"--from {since_s:g} --to {until_s:g}: expected a span within the log: {covers}")
    if arguments.at is not None and not since_s <= arguments.at <= until_s:
        raise ScenarioError(f"--at {arguments.at:g}: expected a time within the log: {covers}")
    return since_s, until_s


def _write_png(arguments: argparse.Namespace, log: Log, since_s: float, until_s: float) -> None:
    from sim_bridge.pictures import film

    if arguments.at is not None:
        (picture,) = film.shoot(log, [arguments.at], camera=arguments.camera, size=arguments.size, since_s=since_s)
        picture.save(arguments.output)
        return
    columns, rows = film.SHEET
    count = columns * rows
    times_s = [since_s + (until_s - since_s) * k / (count - 1) for k in range(count)]
    cell = (arguments.size[0] // columns, arguments.size[1] // rows)
    pictures = film.shoot(log, times_s, camera=arguments.camera, size=cell, since_s=since_s)
    film.contact_sheet(_shown(pictures, count), arguments.size).save(arguments.output)


def _shown(pictures: Iterable[Image], count: int) -> Iterator[Image]:
    """The same pictures, with a bar on a terminal."""
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True, quiet=not sys.stderr.isatty())
    yield from track(pictures, "render", total=count, console=console)
