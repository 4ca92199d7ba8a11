"""`companion bench wire`: from an obstacle frame on Zenoh to the first setpoint that knows it, and messages parsed.

The daemon runs as a process of its own (`wire_daemon`), autopilot and sensor in this one (`wire_peer`), joined by UDP
and TCP on the loopback. With d the delivery of a frame into the daemon's loop, and w what it then waits there for the
next state message of the autopilot, a setpoint that knows it comes L = d + w + c after it was published. The figure is
L - w = d + c: what the wires and the daemon cost. A frame that a state message overtakes on its way waits for the next
one, which is part of w; ``after_next_state`` has the harsher view, in which it is not.
"""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from companion.bench.envelope import Figure
from companion.bench.parsing import Parsing, measure_parsing
from companion.bench.timing import Quantiles, quantiles
from companion.bench.wire_daemon import Notes
from companion.bench.wire_peer import OBSTACLES, Seen, fly
from companion.clock import SystemClock
from companion.errors import CompanionError

T = TypeVar("T")
Daemon = subprocess.Popen[bytes]

RATE_HZ = 50
WARM_S = 2.0
MEASURED_S, QUICK_MEASURED_S = 90.0, 12.0
ROUNDS, QUICK_ROUNDS = 1000, 150
LIMITS_MS = {"p50": 2.0, "p99": 6.0}


@dataclass(frozen=True, slots=True)
class Latency:
    """Milliseconds over the frames that some setpoint answered."""

    frames: int
    lost: int  # published and never known: Zenoh may drop, and the newest of two states is answered
    overtaken: int  # by a state message on their way to the daemon
    whole: Quantiles  # L
    beyond: Quantiles  # L - w
    delivery: Quantiles  # d
    answer: Quantiles  # state message sent to setpoint received
    after_next_state: Quantiles  # first state message after publication to the setpoint
    daemon_tick: dict[str, float]  # the daemon's own figure of all its ticks: state received to setpoint sent


def measure_latency(measured_s: float, *, warm_s: float) -> Latency:
    """Fly for ``measured_s`` with a frame every 30 to 70 ms.

    Raises:
        CompanionError: the daemon did not come up or did not fly.
    """

    def live(port: int, endpoint: str, daemon: Daemon) -> Seen:
        return fly(
            port,
            endpoint,
            SystemClock(),
            rate_hz=RATE_HZ,
            warm_s=warm_s,
            measured_s=measured_s,
            alive=lambda: daemon.poll() is None,
        )

    seen, notes = beside_daemon(live)
    if "fly" not in notes.tasks:
        raise CompanionError("bench wire: the daemon never flew")
    return evaluate(seen, notes)


def beside_daemon(live: Callable[[int, str, Daemon], T], *flags: str) -> tuple[T, Notes]:
    """Run ``live(MAVLink port, Zenoh endpoint, process)`` beside a daemon; its result, and the daemon's notes.

    Raises:
        CompanionError: ``live`` or the daemon's end took too long; with the end of the daemon's log.
    """
    port, endpoint = free_port(socket.SOCK_DGRAM), f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    with tempfile.TemporaryDirectory(prefix="companion-bench-") as folder:
        config, log = Path(folder) / "daemon.toml", Path(folder) / "daemon.log"
        config.write_text(
            f'[vehicle]\nprofile = "px4"\n[engage]\nby = "command"\n'
            f'[mavlink]\nurl = "udpin://127.0.0.1:{port}"\nsystem_id = 1\n'
            f"[zenoh]\nlisten = {json.dumps([endpoint])}\n",
            encoding="utf-8",
        )
        with log.open("wb") as stderr:
            words = [sys.executable, "-m", "companion.bench.wire_daemon", str(config), *flags]
            daemon = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=stderr)
        try:
            outcome = live(port, endpoint, daemon)
            daemon.send_signal(signal.SIGTERM)
            out, _ = daemon.communicate(timeout=10.0)
        except (TimeoutError, subprocess.TimeoutExpired) as error:
            raise CompanionError(f"{error}: {log.read_text(encoding='utf-8')[-500:]}") from None
        finally:
            if daemon.poll() is None:
                daemon.kill()
                daemon.communicate()
    return outcome, msgspec.json.decode(out, type=Notes)


def evaluate(seen: Seen, notes: Notes) -> Latency:
    """Latencies out of what both processes noted."""
    came = {stamp_ns: (n, notes.arrivals_ns[n]) for n, stamp_ns in enumerate(notes.stamps_ns)}
    sent_ns = sorted(seen.states.values())
    samples: list[tuple[int, int, int, int, int]] = []
    overtaken = 0
    for stamp_ns, put_ns in seen.published:
        n, arrived_ns = came.get(stamp_ns, (-1, 0))
        tick_ms = notes.taken.get(n, -1) // 1_000_000
        if tick_ms not in seen.states or tick_ms not in seen.setpoints:
            continue
        state_ns, setpoint_ns = seen.states[tick_ms], seen.setpoints[tick_ms]
        next_ns = next(t for t in sent_ns if t >= put_ns or t == state_ns)
        overtaken += next_ns < state_ns
        whole_ns = setpoint_ns - put_ns
        waited_ns = max(0, state_ns - arrived_ns)
        samples.append(
            (whole_ns, whole_ns - waited_ns, arrived_ns - put_ns, setpoint_ns - state_ns, setpoint_ns - next_ns)
        )
    if not samples:
        raise CompanionError("bench wire: no setpoint knew any frame")
    whole, beyond, delivery, answer, after = (quantiles(list(column)) for column in zip(*samples, strict=True))
    lost = len(seen.published) - len(samples)
    return Latency(len(samples), lost, overtaken, whole, beyond, delivery, answer, after, notes.tick_ms)


def measure(*, quick: bool) -> tuple[Latency, Parsing]:
    """Both parts, one after the other."""
    latency = measure_latency(QUICK_MEASURED_S if quick else MEASURED_S, warm_s=WARM_S)
    return latency, asyncio.run(measure_parsing(QUICK_ROUNDS if quick else ROUNDS))


def figures(latency: Latency) -> list[Figure]:
    """The measured values that the wire is held to; none of a quantile of too few samples."""
    return [
        Figure(f"frame to setpoint beyond the wait: {name}, ms", value, "at most", limit)
        for name, limit in LIMITS_MS.items()
        if (value := asdict(latency.beyond)[name]) is not None
    ]


def as_json(latency: Latency, parsing: Parsing) -> dict[str, Any]:
    """Everything measured, in plain types."""
    rates = {"ours_per_s": round(parsing.ours_per_s), "mavutil_per_s": round(parsing.theirs_per_s)}
    return {
        "telemetry_hz": RATE_HZ,
        "obstacles": OBSTACLES,
        "latency_ms": asdict(latency),
        "parsing": {**asdict(parsing), **rates},
    }


def print_wire(latency: Latency, parsing: Parsing) -> None:
    """Tables for people."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(title=f"{latency.frames} frames of {OBSTACLES} obstacles, {RATE_HZ} Hz telemetry [ms]")
    for column in ("", "p50", "p99", "p99.9", "max"):
        table.add_column(column, justify="left" if column == "" else "right")
    for name, row in (
        ("frame published to setpoint", latency.whole),
        ("  of it beyond the wait for a state message", latency.beyond),
        ("  of it delivery into the daemon", latency.delivery),
        ("state message to setpoint", latency.answer),
        ("first state message after publication to setpoint", latency.after_next_state),
    ):
        table.add_row(name, *("-" if value is None else f"{value:.2f}" for value in asdict(row).values()))
    console.print(table)
    console.print(f"{latency.overtaken} frames overtaken by a state message on their way, {latency.lost} lost\n")
    console.print(
        f"messages parsed a second off UDP (medians of {parsing.rounds} rounds of {parsing.datagrams}):"
        f" ours {parsing.ours_per_s:,.0f}, mavutil recv_match {parsing.theirs_per_s:,.0f}\n"
    )


def print_figures(told: list[Figure]) -> None:
    """Measured values beside their limits."""
    print("figures (on a busy machine the tails of time are the scheduler's)")
    for figure in told:
        met = "met" if figure.met else "MISSED"
        print(f"  {figure.name}: {figure.value:.4g}, {figure.relation} {figure.limit:g}: {met}")


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
