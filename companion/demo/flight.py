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

from companion.demo.operator import OperatorError, take_off_and_engage
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
        OperatorError: the operator was refused.
    """
    plan.folder.mkdir(parents=True, exist_ok=True)
    onboard, gcs = _free_port(socket.SOCK_DGRAM), _free_port(socket.SOCK_DGRAM)
    endpoint = f"tcp/127.0.0.1:{_free_port(socket.SOCK_STREAM)}"
    trace = plan.folder / "truth.jsonl"
    daemon_words = ["companion.cli", "run", "--json", *_daemon_arguments(plan, onboard, endpoint)]
    sim_words = ["sim_bridge.cli", "run", "--scenario", plan.scenario, "--seed", str(plan.seed), "--json"]
    sim_words += ["--onboard-port", str(onboard), "--gcs-port", str(gcs), "--zenoh-listen", endpoint]
    sim_words += ["--trace", str(trace), *(["--lockstep"] if plan.lockstep else [])]
    sim_words += [] if plan.obstacles else ["--no-obstacles"]
    async with (
        _Process(sim_words, plan.folder / "sim-bridge.log") as simulator,
        _Process(daemon_words, plan.folder / "companion.log") as daemon,
    ):
        operator = asyncio.create_task(take_off_and_engage(gcs, on_progress))
        try:
            simulated = await _first_of(simulator, daemon, operator, on_progress)
        finally:
            operator.cancel()
            await asyncio.gather(operator, return_exceptions=True)
        answered = await daemon.stop()
    return FlightResult(simulated, answered, trace)


class _Process:
    """A Python module as a child process whose standard output is one JSON object; ends it on exit."""

    def __init__(self, words: Sequence[str], log: Path) -> None:
        self._words = words
        self._log = log
        self.name = words[0].partition(".")[0]

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
        self._output = asyncio.create_task(self._child.communicate())
        return self

    async def __aexit__(self, *exc: object) -> None:
        if self._child.returncode is None:
            self._child.kill()
        await self._output
        self._log_file.close()

    async def result(self) -> dict[str, Any]:
        """Its JSON, once it ends by itself."""
        output, _ = await asyncio.shield(self._output)
        lines = output.decode().strip().splitlines()
        if not lines:
            raise FlightFailed(f"{self.name}: exit status {self._child.returncode}: {self.last_words()}")
        parsed: dict[str, Any] = json.loads(lines[-1])
        return parsed

    async def stop(self) -> dict[str, Any]:
        """Its JSON, after SIGTERM."""
        if self._child.returncode is None:
            self._child.send_signal(signal.SIGTERM)
        try:
            async with asyncio.timeout(STOP_S):
                return await self.result()
        except TimeoutError:
            raise FlightFailed(f"{self.name}: did not stop within {STOP_S:g} s of SIGTERM") from None

    def last_words(self) -> str:
        self._log_file.flush()
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"


async def _first_of(
    simulator: _Process, daemon: _Process, operator: asyncio.Task[None], on_progress: Callable[[str], None]
) -> dict[str, Any]:
    """The simulator's summary; whatever else ends first with an error ends the flight."""
    flown = asyncio.create_task(simulator.result())
    daemon_died = asyncio.create_task(daemon.result())
    try:
        await asyncio.wait({flown, daemon_died, operator}, return_when=asyncio.FIRST_COMPLETED)
        if operator.done() and not flown.done() and not daemon_died.done():
            operator.result()
            on_progress("fly")
            await asyncio.wait({flown, daemon_died}, return_when=asyncio.FIRST_COMPLETED)
        if flown.done():
            return flown.result()
        daemon_died.result()
        raise FlightFailed(f"companion: ended before the flight did: {daemon.last_words()}")
    finally:
        for task in (flown, daemon_died):
            task.cancel()
        await asyncio.gather(flown, daemon_died, return_exceptions=True)


def _daemon_arguments(plan: FlightPlan, onboard: int, endpoint: str) -> list[str]:
    """The daemon's command line: a base configuration and what ties it to this simulator."""
    base = plan.config
    if base is None:
        base = plan.folder / "companion.toml"
        base.write_text("# everything at its default; the demo sets the links on the command line\n", encoding="utf-8")
    settings = [
        f'mavlink.url="udpin://127.0.0.1:{onboard}"',
        "mavlink.system_id=1",
        f"zenoh.connect={json.dumps([endpoint])}",
        f"target.position={json.dumps(list(plan.target))}",
        f"tick_hz={plan.control_hz}",
        f"log.directory={json.dumps(str(plan.folder))}",
    ]
    if plan.lockstep:
        settings += ['sync="lockstep"', f"lockstep_sources={json.dumps(list(plan.sources))}"]
    words = ["-c", str(base)]
    for setting in (*settings, *plan.overrides):
        words += ["--set", setting]
    return words


def _free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


__all__ = ["FlightFailed", "FlightPlan", "FlightResult", "OperatorError", "describe_scenario", "fly"]
