"""`companion demo`: fly, show, judge. Exit status 0 only if the target was reached and nothing was touched."""

from __future__ import annotations

import argparse
import asyncio
import errno
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from companion.demo.flight import (
    FlightFailed,
    FlightPlan,
    FlightResult,
    check_daemon,
    describe_scenario,
    fly,
    free_port,
)
from companion.demo.watch import show_page
from companion.errors import ConfigError

_EPILOG = """\
examples:
  companion demo                                     real time, three figure-eight obstacles
  companion demo --watch                             the same, seen in a browser
  companion demo --lockstep --json --seed 3          as fast as the machine can, reproducible
  companion demo --lockstep --filter none            the control: without the filter it collides
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `demo` to the command line."""
    demo = commands.add_parser(
        "demo",
        help="fly the simulated vehicle through crossing obstacles",
        description="Start the simulator and the daemon, take off with MAVSDK, engage, fly to the target, report.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    demo.add_argument("--scenario", default="demo", metavar="NAME", help="a shipped scenario or a TOML file")
    demo.add_argument("--seed", type=int, default=0, help="fixes obstacles and sensor noise (default 0)")
    demo.add_argument("--lockstep", action="store_true", help="simulated time waits for the daemon: fast, reproducible")
    demo.add_argument("--watch", action="store_true", help="open the daemon's live page in a browser (real time)")
    demo.add_argument("--filter", choices=("acbf", "none"), default="acbf", help="safety filter (default acbf)")
    demo.add_argument("-c", "--config", type=Path, metavar="FILE", help="the daemon's base configuration")
    demo.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help="daemon key")
    demo.add_argument("--out", type=Path, metavar="DIR", help="where to write (default flights/<time>)")
    demo.add_argument("--json", action="store_true", help="one JSON object on stdout, nothing else there")
    demo.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    """Fly the unobstructed flight and the flight itself; report both.

    Raises:
        ConfigError: a scenario, configuration or folder that cannot be used, before anything flies.
        FlightFailed: a process died or said no, or SIGINT or SIGTERM ended the demo; its processes are gone.
    """
    try:
        return _run(arguments)
    except KeyboardInterrupt:  # before or after the flights; during them the loop handles the signal
        raise FlightFailed("demo: stopped by SIGINT") from None


def _run(arguments: argparse.Namespace) -> int:
    if arguments.watch and arguments.lockstep:
        raise ConfigError("demo: --watch: expected without --lockstep, which flies faster than anyone can watch")
    described = describe_scenario(arguments.scenario, arguments.seed)
    if described["target"] is None:
        raise ConfigError(f"scenario {arguments.scenario}: target: expected a position, the demo flies to it")
    folder = arguments.out or Path("flights") / time.strftime("%Y%m%d-%H%M%S")
    plan = FlightPlan(
        folder=folder,
        scenario=arguments.scenario,
        seed=arguments.seed,
        lockstep=arguments.lockstep,
        obstacles=True,
        config=arguments.config,
        overrides=(f'safety.filter="{arguments.filter}"', *arguments.overrides),
        target=tuple(described["target"]),
        sources=tuple(described["sources"]),
        control_hz=described["control_hz"],
        http_port=free_port(socket.SOCK_STREAM) if arguments.watch else None,
    )
    check_daemon(plan)
    _make_folder(folder)
    with _Progress(quiet=arguments.json) as show:
        free, flight = asyncio.run(_fly_until_told(plan, show))
        report = _report(free, flight)
        (folder / "report.json").write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
        show("draw the picture")
        picture = _draw(described, flight, folder)
    if arguments.json:
        print(json.dumps(report), flush=True)
    else:
        _print_table(report, flight, picture)
    return 0 if report["reached"] and not report["collided"] else 1


def _make_folder(folder: Path) -> None:
    try:
        (folder / "unobstructed").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror
    else:
        reason = None if os.access(folder, os.W_OK | os.X_OK) else os.strerror(errno.EACCES)
    if reason is not None:
        raise ConfigError(f"--out {folder}: cannot be made ({reason}), expected a folder to write to")


async def _fly_until_told(plan: FlightPlan, show: Callable[[str], None]) -> tuple[FlightResult, FlightResult]:
    """Both flights; on SIGINT or SIGTERM the task is cancelled, so that each process is ended on the way out."""
    loop, flying = asyncio.get_running_loop(), asyncio.create_task(_fly_both(plan, show))
    told: list[signal.Signals] = []

    def stop(number: signal.Signals) -> None:
        told.append(number)
        flying.cancel()

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop, number)
    try:
        return await flying
    except asyncio.CancelledError:
        if not told:
            raise
        raise FlightFailed(f"demo: stopped by {told[0].name}") from None


async def _fly_both(plan: FlightPlan, show: Callable[[str], None]) -> tuple[FlightResult, FlightResult]:
    """First without obstacles, in lockstep whatever was asked for: same plant, policy and filter, and fast."""
    import dataclasses

    folder = plan.folder / "unobstructed"
    bare = dataclasses.replace(plan, folder=folder, obstacles=False, lockstep=True, http_port=None)
    free = await fly(bare, lambda step: show(f"unobstructed flight: {step}"))
    opening = None if plan.http_port is None else asyncio.create_task(show_page(plan.http_port, _tell_page))
    try:
        flight = await fly(plan, lambda step: show(f"flight: {step}"))
    finally:
        if opening is not None:
            opening.cancel()
            await asyncio.gather(opening, return_exceptions=True)
    return free, flight


def _tell_page(url: str, opened: bool) -> None:
    print(f"page     {url}" + ("" if opened else "  (open it: no browser was found)"), file=sys.stderr, flush=True)


def _report(free: FlightResult, flight: FlightResult) -> dict[str, Any]:
    """The JSON object of ``--json``."""
    truth, daemon = flight.simulator, flight.daemon
    ticks = {name: daemon["tick_ms"].get(name) for name in ("p50", "p99", "p99.9", "max")}
    return {
        "scenario": truth["scenario"],
        "seed": truth["seed"],
        "reached": truth["reached"],
        "collided": truth["collided"],
        "min_clearance_m": truth["min_clearance_m"],
        "flight_time_s": truth["flight_time_s"],
        "unobstructed_time_s": free.simulator["flight_time_s"],
        "verdicts": daemon["verdicts"],
        "tick_ms": ticks,
        "deadline_misses": daemon["deadline_misses"],
        "real_time_factor": truth.get("real_time_factor") or truth["sim_s"] / truth["wall_s"],
        "lockstep_ms": truth.get("tick_ms"),  # where a lockstep tick goes: sending, awaiting the daemon, physics
        "log": daemon["log"],
        "log_hash": daemon["log_hash"],
    }


def _draw(described: dict[str, Any], flight: FlightResult, folder: Path) -> Path:
    from companion.demo.picture import draw

    path = folder / "flight.png"
    draw(described, flight, path)
    return path


class _Progress:
    """A spinner with the current step on a terminal; nothing otherwise."""

    def __init__(self, *, quiet: bool) -> None:
        self._live = sys.stderr.isatty() and not quiet

    def __enter__(self) -> Callable[[str], None]:
        from rich.console import Console

        self._status = Console(stderr=True, quiet=not self._live).status("start")
        self._status.start()
        return self._status.update

    def __exit__(self, *exc: object) -> None:
        self._status.stop()


def _print_table(report: dict[str, Any], flight: FlightResult, picture: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    def metres(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f} m"

    def seconds(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f} s"

    table = Table(title=f"scenario {report['scenario']}, seed {report['seed']}", show_header=False)
    table.add_row("target reached", "yes" if report["reached"] else "[bold red]no[/]")
    table.add_row("touched anything", "[bold red]yes[/]" if report["collided"] else "no")
    table.add_row("minimum clearance", metres(report["min_clearance_m"]))
    table.add_row("flight time", seconds(report["flight_time_s"]))
    table.add_row("unobstructed flight", seconds(report["unobstructed_time_s"]))
    table.add_row("verdicts", ", ".join(f"{name} {count}" for name, count in sorted(report["verdicts"].items())))
    tick = report["tick_ms"]
    table.add_row("tick latency", f"p50 {tick['p50']:.2f} ms, p99 {tick['p99']:.2f} ms, max {tick['max']:.2f} ms")
    table.add_row("deadline misses", str(report["deadline_misses"]))
    table.add_row("real-time factor", f"{report['real_time_factor']:.1f}")
    for part, cost in (report["lockstep_ms"] or {}).items():
        table.add_row(f"lockstep: {part}", f"p50 {cost['p50']:.2f} ms, p99 {cost['p99']:.2f} ms")
    for approach in flight.simulator.get("approaches") or []:
        table.add_row(f"closest to {approach['id']}", f"{approach['clearance_m']:.2f} m at {approach['t_s']:.1f} s")
    console = Console()
    console.print(table)
    console.print(
        f"picture  {picture}\nlog      {report['log']}\nreport   {picture.parent / 'report.json'}", highlight=False
    )
