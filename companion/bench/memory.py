"""`companion bench memory`: resident memory of the daemon over an hour of vehicle time, in lockstep.

The simulator and the daemon fly as processes as fast as they can, 72 000 ticks at 20 Hz, with four obstacles, the log
written and every key read. Memory is flat where it does not grow between the tenth minute and the end: what the first
minutes fill are windows of fixed size.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from companion.bench.envelope import Figure
from companion.bench.processes import (
    Child,
    Links,
    daemon_settings,
    memory_mib,
    open_zenoh,
    scenario_text,
    simulator_words,
)
from companion.bench.tick_flight import Ground
from companion.clock import SystemClock
from companion.errors import CompanionError
from companion.types import NS_PER_S

RATE_HZ, OBSTACLES = 20, 4
MINUTES, QUICK_MINUTES = 60.0, 3.0
LIMIT_MIB, GROWTH_MIB = 200.0, 4.0
SETTLED_SHARE = 1.0 / 6.0  # of the flight, after which memory is held to be flat
LOG_SETTINGS = ("log.max_mb=64", "log.keep_mb=192")  # an hour's log would be 1.5 GB
STALL_S = 30.0
_POLL_S = 0.1


@dataclass(frozen=True, slots=True)
class Memory:
    """``samples``: vehicle time in external mode [s], resident memory [MiB]."""

    minutes: float
    ticks: int
    real_time_factor: float
    start_mib: float
    settled_mib: float  # a sixth into the flight: the tenth minute of an hour
    end_mib: float
    peak_mib: float
    samples: list[tuple[float, float]]

    @property
    def growth_mib(self) -> float:
        """From a sixth of the flight to its end."""
        return self.end_mib - self.settled_mib


def measure_memory(minutes: float, progress: Callable[[float], None]) -> Memory:
    """Fly for ``minutes`` of vehicle time; ``progress`` is told the seconds flown.

    Raises:
        ConfigError: the simulator is not installed.
        CompanionError: a process ended, or vehicle time stood still.
    """
    links, seconds = Links.free(), 60.0 * minutes
    with tempfile.TemporaryDirectory(prefix="companion-bench-") as name:
        folder = Path(name)
        scenario, config = folder / "memory.toml", folder / "daemon.toml"
        scenario.write_text(scenario_text(RATE_HZ, OBSTACLES, seconds), encoding="utf-8")
        config.write_text("# everything at its default\n", encoding="utf-8")
        words = ["companion.cli", "run", "--json", "-c", str(config)]
        for setting in (*daemon_settings(links, RATE_HZ, folder, lockstep=True), *LOG_SETTINGS):
            words += ["--set", setting]
        ground = Ground(links.ground)
        with (
            Child(simulator_words(links, scenario, "--lockstep"), folder / "sim.log") as simulator,
            Child(words, folder / "daemon.log") as daemon,
            open_zenoh(links.daemon) as session,
        ):
            try:
                samples = _sampled(simulator, daemon, _Clock(session), ground, seconds, progress)
            finally:
                ground.close()
            peak = memory_mib(daemon.process.pid)["peak"]
            outcome, told = json.loads(simulator.stop().splitlines()[-1]), json.loads(daemon.stop().splitlines()[-1])
    return evaluate(samples, minutes, peak, outcome["real_time_factor"], told["ticks"])


def evaluate(samples: list[tuple[float, float]], minutes: float, peak: float, factor: float, ticks: int) -> Memory:
    """The figures of a flight.

    Raises:
        CompanionError: it was too short to tell.
    """
    if not samples or samples[-1][0] < 0.9 * 60.0 * minutes:
        raise CompanionError(f"bench memory: the flight ended early, after {samples[-1][0] if samples else 0.0:g} s")
    settled = next(mib for t_s, mib in samples if t_s >= SETTLED_SHARE * 60.0 * minutes)
    return Memory(minutes, ticks, factor, samples[0][1], settled, samples[-1][1], peak, samples)


class _Clock:
    """Vehicle time, as the daemon's records tell it; reads every key of the daemon."""

    def __init__(self, session: zenoh.Session) -> None:
        self.active_s = 0.0
        self._since_ns: int | None = None
        self.connected = False
        self._all = session.declare_subscriber("uav/uav1/companion/*", self._on_sample)
        self._alive = session.liveliness().declare_subscriber("uav/uav1/companion/alive", self._on_alive, history=True)

    def _on_alive(self, sample: zenoh.Sample) -> None:
        self.connected = True

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if not str(sample.key_expr).endswith("/setpoint"):
            return
        record = json.loads(sample.payload.to_bytes())
        if record["state"] == "ACTIVE" and self._since_ns is None:
            self._since_ns = record["stamp_ns"]
        if self._since_ns is not None:
            self.active_s = (record["stamp_ns"] - self._since_ns) / NS_PER_S


def _sampled(
    simulator: Child, daemon: Child, flown: _Clock, ground: Ground, seconds: float, progress: Callable[[float], None]
) -> list[tuple[float, float]]:
    """Memory twice a second of wall time and at the end, until the simulator is done."""
    clock, samples = SystemClock(), []
    moved_ns, newest_s = clock.monotonic_ns(), -1.0
    engaged = False
    while simulator.running:
        daemon.check()
        engaged = engaged or (flown.connected and ground.engage())  # lockstep waits for the command, and keeps it
        ground.listen()
        now_ns, now_s = clock.monotonic_ns(), flown.active_s
        if now_s > newest_s:
            moved_ns, newest_s = now_ns, now_s
        elif now_ns - moved_ns > STALL_S * NS_PER_S:
            raise simulator.failed(f"stood still for {STALL_S:g} s after {newest_s:g} s of flight")
        if now_s > 0.0:
            samples.append((now_s, memory_mib(daemon.process.pid)["resident"]))
            progress(now_s)
        simulator.wait(_POLL_S)
    return samples


def figures(memory: Memory) -> list[Figure]:
    """What memory is held to."""
    return [
        Figure("resident memory at its highest, MiB", memory.peak_mib, "at most", LIMIT_MIB),
        Figure(
            f"growth over the last {memory.minutes * (1.0 - SETTLED_SHARE):g} minutes, MiB",
            memory.growth_mib,
            "at most",
            GROWTH_MIB,
        ),
    ]


def as_json(memory: Memory) -> dict[str, Any]:
    """Everything measured; samples thinned to a hundred."""
    stride = max(1, len(memory.samples) // 100)
    return {
        "minutes": memory.minutes,
        "ticks": memory.ticks,
        "real_time_factor": memory.real_time_factor,
        "resident_mib": {
            "start": memory.start_mib,
            "settled": memory.settled_mib,
            "end": memory.end_mib,
            "peak": memory.peak_mib,
        },
        "samples": [(round(t_s, 1), round(mib, 2)) for t_s, mib in memory.samples[::stride]],
    }


def print_memory(memory: Memory) -> None:
    """For people."""
    print(
        f"{memory.minutes:g} minutes of vehicle time in {memory.ticks} ticks, {memory.real_time_factor:.1f} times real"
        f" time: resident {memory.start_mib:.1f} MiB at the start, {memory.settled_mib:.1f} after a sixth,"
        f" {memory.end_mib:.1f} at the end, {memory.peak_mib:.1f} at most"
    )
