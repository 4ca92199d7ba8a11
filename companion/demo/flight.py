"""One flight of the demo: the simulator and the daemon as processes, the operator beside them.

The two sides share nothing but sockets; what the demo knows of the flight it reads from their JSON.
"""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.config import apply_overrides, load_config, parse_config
from companion.errors import CompanionError, ConfigError

STOP_S = 5.0  # a process that was asked to stop is given this long


class FlightFailed(CompanionError):
    """A process of the demo ended in an unexpected way; the message carries its last words."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """What to fly and where to write."""

    folder: Path
    scenario: str
    seed: int
    lockstep: bool
    obstacles: bool
    config: Path | None  # the daemon's base configuration
    overrides: tuple[str, ...]
    target: tuple[float, float, float]
    sources: tuple[str, ...]
    control_hz: int
    http_port: int | None = None  # of the daemon's page; None: none is served


@dataclass(frozen=True, slots=True)
class FlightResult:
    """``simulator`` knows the truth (reached, clearance, times), ``daemon`` its own work (verdicts, latencies)."""

    simulator: dict[str, Any]
    daemon: dict[str, Any]
    trace: Path


def describe_scenario(name: str, seed: int) -> dict[str, Any]:
    """The scenario as the simulator will fly it.

    Raises:
        ConfigError: unknown or invalid scenario, or the simulator is not installed.
    """
    import subprocess

    command = [sys.executable, "-m", "sim_bridge.cli", "scenario", name, "--seed", str(seed), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        words = done.stderr.strip().splitlines()
        if "ModuleNotFoundError" in done.stderr:
            raise ConfigError(f"demo: the simulator is not installed ({words[-1]}), expected: pip install '.[sim]'")
        raise ConfigError(words[-1] if words else "sim-bridge scenario failed")
    described: dict[str, Any] = json.loads(done.stdout)
    return described


async def fly(plan: FlightPlan, on_progress: Callable[[str], None]) -> FlightResult:
    """Fly once; both processes are gone when this returns or raises.

    Raises:
        FlightFailed: a process died or said no.
    """
    plan.folder.mkdir(parents=True, exist_ok=True)
    onboard, gcs = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    trace = plan.folder / "truth.jsonl"
    daemon_words = ["companion.cli", "run", "--json", *_daemon_arguments(plan, onboard, endpoint)]
    sim_words = ["sim_bridge.cli", "run", "--scenario", plan.scenario, "--seed", str(plan.seed), "--json"]
    sim_words += ["--onboard-port", str(onboard), "--gcs-port", str(gcs), "--zenoh-listen", endpoint]
    sim_words += ["--trace", str(trace), *(["--lockstep"] if plan.lockstep else [])]
    sim_words += [] if plan.obstacles else ["--no-obstacles"]
    operator_words = ["companion.demo.operator", str(gcs), *(str(x) for x in plan.target)]
    async with (
        _Process(sim_words, plan.folder / "sim-bridge.log") as simulator,
        _Process(daemon_words, plan.folder / "companion.log") as daemon,
        _Process(operator_words, plan.folder / "operator.log", on_line=on_progress) as operator,
    ):
        simulated = await _until_flown(simulator, daemon, operator)
        answered = _parsed(await daemon.stop(), daemon)
    return FlightResult(simulated, answered, trace)


class _Process:
    """A Python module as a child process; its standard error goes to a log, its end is awaited or forced on exit."""

    def __init__(self, words: Sequence[str], log: Path, *, on_line: Callable[[str], None] | None = None) -> None:
        self._words = words
        self._log = log
        self._on_line = on_line
        self.name = words[0].rpartition(".cli")[0] or words[0]

    async def __aenter__(self) -> _Process:
        self._log_file = self._log.open("wb")
        self._child = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            *self._words,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=self._log_file,
        )
        self.ended = asyncio.create_task(self._read())
        return self

    async def __aexit__(self, *exc: object) -> None:
        if self._child.returncode is None:
            self._child.kill()
        await asyncio.gather(self.ended, return_exceptions=True)
        self._log_file.close()

    async def _read(self) -> list[str]:
        """Every line of its standard output, once it has ended."""
        assert self._child.stdout is not None
        lines: list[str] = []
        async for line in self._child.stdout:
            lines.append(line.decode().rstrip("\n"))
            if self._on_line is not None:
                self._on_line(lines[-1])
        await self._child.wait()
        return lines

    @property
    def status(self) -> int | None:
        return self._child.returncode

    async def stop(self) -> list[str]:
        """Its output, after SIGTERM."""
        if self._child.returncode is None:
            self._child.send_signal(signal.SIGTERM)
        try:
            async with asyncio.timeout(STOP_S):
                return await asyncio.shield(self.ended)
        except TimeoutError:
            raise FlightFailed(f"{self.name}: did not stop within {STOP_S:g} s of SIGTERM") from None

    def last_words(self) -> str:
        self._log_file.flush()
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"


async def _until_flown(simulator: _Process, daemon: _Process, operator: _Process) -> dict[str, Any]:
    """The simulator's summary; a daemon that ends or an operator that fails before it ends the flight."""
    while not simulator.ended.done():
        waiting = [process.ended for process in (simulator, daemon, operator) if not process.ended.done()]
        await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        if simulator.ended.done():
            break
        if daemon.ended.done():
            if daemon.status == 2:  # its configuration: it has said so in one line that needs no frame
                raise ConfigError(daemon.last_words().removeprefix("companion: "))
            raise FlightFailed(f"{daemon.name} ended before the flight did: {daemon.last_words()}")
        if operator.ended.done() and operator.status != 0:
            raise FlightFailed(f"{operator.name}: {operator.last_words()}")
    return _parsed(simulator.ended.result(), simulator)


def _parsed(lines: list[str], process: _Process) -> dict[str, Any]:
    """The JSON object that a process printed last."""
    if not lines:
        kind = ConfigError if process.status == 2 else FlightFailed
        raise kind(f"{process.name}: exit status {process.status}: {process.last_words()}")
    parsed: dict[str, Any] = json.loads(lines[-1])
    return parsed


def check_daemon(plan: FlightPlan) -> None:
    """Load the configuration that the daemon will be given.

    Raises:
        ConfigError: the daemon would refuse it; the message is the daemon's own.
    """
    settings = _daemon_settings(plan, 1, "tcp/127.0.0.1:1")  # the ports are chosen when the flight begins
    if plan.config is None:
        parse_config(apply_overrides({}, settings), source="demo")
    else:
        load_config(plan.config, settings)


def _daemon_arguments(plan: FlightPlan, onboard: int, endpoint: str) -> list[str]:
    """The daemon's command line: a base configuration and what ties it to this simulator."""
    base = plan.config
    if base is None:
        base = plan.folder / "companion.toml"
        base.write_text("# everything at its default; the demo sets the links on the command line\n", encoding="utf-8")
    words = ["-c", str(base)]
    for setting in _daemon_settings(plan, onboard, endpoint):
        words += ["--set", setting]
    return words


def _daemon_settings(plan: FlightPlan, onboard: int, endpoint: str) -> tuple[str, ...]:
    settings = [
        f'mavlink.url="udpin://127.0.0.1:{onboard}"',
        "mavlink.system_id=1",
        f"zenoh.connect={json.dumps([endpoint])}",
        f"target.position={json.dumps(list(plan.target))}",
        f"tick_hz={plan.control_hz}",
        f"log.directory={json.dumps(str(plan.folder))}",
    ]
    settings += ["http.enabled=false"] if plan.http_port is None else [f"http.port={plan.http_port}"]
    if plan.lockstep:
        settings += ['sync="lockstep"', f"lockstep_sources={json.dumps(list(plan.sources))}"]
    return (*settings, *plan.overrides)


def free_port(kind: socket.SocketKind) -> int:
    """A port on 127.0.0.1 that nobody holds now."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
