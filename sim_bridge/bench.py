"""`sim-bridge bench`: how fast the simulator flies one vehicle among four obstacles, and where the time goes.

Three cases, each at least so many times real time on two cores: in this process without the brain, in a process of
its own with it (`policies` may import both), and in lockstep over real sockets with the daemon.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console
from rich.table import Table

from sim_bridge.bench_lockstep import measure_lockstep
from sim_bridge.errors import SimError
from sim_bridge.flight import Flight
from sim_bridge.inprocess import Law, measure
from sim_bridge.messages import Vec3
from sim_bridge.placement import Resolved, resolve
from sim_bridge.scenario import load_scenario
from sim_bridge.sections import Case
from sim_bridge.sensors import Frame

SCHEMA = 1
SCENARIO = "bench"
PLAIN_DEMAND, BRAIN_DEMAND, LOCKSTEP_DEMAND = 60.0, 30.0, 20.0  # times real time
SECONDS, QUICK_SECONDS = 60.0, 10.0  # of vehicle time a case
_BRAIN = "policies.evaluation.inprocess"
_STIFFNESS, _DAMPING = 2.0, 2.5  # of the law without a brain [1/s^2], [1/s]
_PACKAGES = ("companion-safety", "numpy", "pybullet", "pymavlink", "eclipse-zenoh", "msgspec")

_DESCRIPTION = """\
Flies one vehicle among four moving obstacles for a minute of vehicle time: in this process with a plain law, in a
process of its own with the daemon's brain, and in lockstep over UDP and Zenoh with the daemon as a subprocess. Prints
p50, p99, p99.9 and the largest time of a control tick, vehicle time over wall time, and where a tick's time goes
(measured in a second flight, so that the figures are those of the plain simulator).
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `bench` to the command line."""
    bench = commands.add_parser(
        "bench",
        help="how fast it flies, and where the time goes",
        description=_DESCRIPTION,
        epilog="example: sim-bridge bench --quick --json",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    bench.add_argument("--quick", action="store_true", help="10 s of vehicle time a case instead of 60")
    bench.add_argument("--json", action="store_true", help="one JSON object on standard output")
    bench.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> int:
    seconds = QUICK_SECONDS if arguments.quick else SECONDS
    scene = scenery(seconds)
    jobs: list[tuple[str, Callable[[], Case]]] = [
        ("in process", lambda: measure("in process", scene, plain_law, seconds, demand=PLAIN_DEMAND)),
        ("in process with the brain", lambda: _measure_brain(seconds)),
        ("lockstep with the daemon", lambda: measure_lockstep("lockstep", scene, demand=LOCKSTEP_DEMAND)),
    ]
    cases = []
    console = Console(stderr=True, quiet=not sys.stderr.isatty())
    with console.status("start") as status:
        for told, job in jobs:
            status.update(f"bench: {told}")
            cases.append(job())
    if arguments.json:
        print(json.dumps(envelope(cases)))
    else:
        print_cases(cases)
    return 0


def scenery(seconds: float) -> Resolved:
    """The bench's scenario, over after ``seconds`` in external mode."""
    name, scenario = load_scenario(SCENARIO)
    end = msgspec.structs.replace(scenario.end, timeout_s=seconds)
    return resolve(name, msgspec.structs.replace(scenario, end=end), 0)


def plain_law() -> Law:
    """Spring and damper to the target: the cheapest law that flies."""

    def law(flight: Flight, frames: Sequence[Frame]) -> Vec3:
        craft = flight.crafts[0]
        goal = craft.target_enu if craft.target_enu is not None else (0.0, 0.0, 1.5)
        (x, y, z), (vx, vy, vz), (gx, gy, gz) = craft.state.p_enu, craft.state.v_enu, goal
        k, d = _STIFFNESS, _DAMPING
        return (k * (gx - x) - d * vx, k * (gy - y) - d * vy, k * (gz - z) - d * vz)

    return law


def _measure_brain(seconds: float) -> Case:
    """The same flight with the daemon's brain, which this package must not import: a process of its own."""
    command = [sys.executable, "-m", _BRAIN, str(seconds), str(BRAIN_DEMAND)]
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode:
        last = (done.stderr.decode(errors="replace").strip().splitlines() or ["it said nothing"])[-1]
        raise SimError(f"bench: {_BRAIN}: {last}")
    return msgspec.json.decode(done.stdout, type=Case)


def envelope(cases: Sequence[Case]) -> dict[str, Any]:
    """The JSON object of ``--json``; times in ms."""
    return {
        "bench": "sim-bridge",
        "schema": SCHEMA,
        "machine": _machine(),
        "commit": _commit(),
        "versions": _versions(),
        "cases": [{**msgspec.to_builtins(case), "met": case.met} for case in cases],
    }


def print_cases(cases: Sequence[Case]) -> None:
    """Two tables for people: the figures, and where a tick's time goes."""
    table = Table(title="a control tick in ms, one vehicle, four obstacles")
    for column in ("case", "ticks", "p50", "p99", "p99.9", "max", "x real time", "demand", "filter acts"):
        table.add_column(column, justify="left" if column == "case" else "right")
    for case in cases:
        tail = ["-" if value is None else f"{value:.3f}" for value in (case.p50, case.p99, case.p999, case.max)]
        verdict = f"{case.demand:g} {'met' if case.met else '[bold red]missed[/]'}"
        acting = "-" if case.acting is None else f"{100.0 * case.acting:.0f} %"
        table.add_row(case.name, str(case.n), *tail, f"{case.factor:.1f}", verdict, acting)
    where = Table(title="where it goes, ms a tick (the daemon's own by its records: medians)")
    where.add_column("case")
    where.add_column("section")
    where.add_column("ms", justify="right")
    for case in cases:
        for index, (section, ms) in enumerate(case.sections.items()):
            where.add_row(case.name if index == 0 else "", section, f"{ms:.3f}")
    console = Console()
    console.print(table)
    console.print(where)
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    if load > cores:
        console.print(f"load {load:.1f} on {cores} cores: these are the scheduler's figures more than the simulator's")


def _machine() -> dict[str, Any]:
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load_1min": round(os.getloadavg()[0], 2),  # above the cores, the figures are the scheduler's
        "system": platform.platform(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "unknown")


def _versions() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def _commit() -> str | None:
    """Of the checkout that this package is imported from, None where there is none."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() or None
